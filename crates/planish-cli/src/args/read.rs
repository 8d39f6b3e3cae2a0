//! The arguments that control reading: the memory limit, and properties that files do not state.

use planish::io::{LengthUnit, ReadOptions};

use super::CameraArgs;

/// The memory limit of commands that read data.
#[derive(Clone, Copy, clap::Args)]
pub struct MemoryArgs {
    /// Memory limit for file and point data, such as 500M or 4G [default: 2G]
    ///
    /// The program needs about 50 MB in addition, and LAZ another 100 MB. `smooth` and `info` process larger LAS, LAZ
    /// and PLY files in tiles; other inputs that need more are refused.
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes, hide_short_help = true, help_heading = super::ENGINE)]
    pub max_memory: Option<u64>,
}

impl MemoryArgs {
    pub fn options(&self) -> ReadOptions {
        let default = ReadOptions::default();
        self.max_memory.map_or(default, |bytes| default.with_max_memory_bytes(bytes))
    }
}

#[derive(clap::Args)]
pub struct ReadArgs {
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Unit of points and of floating-point depth in files that state none: mm, cm, m, inch or ft [default: m]
    ///
    /// Lengths are converted to metres.
    #[arg(long, value_name = "UNIT", hide_short_help = true, help_heading = super::INPUT)]
    pub unit: Option<LengthUnit>,
    /// Number of columns of a lidar's .bin, such as 4 for KITTI [default: inferred from the values]
    #[arg(long, value_name = "N", hide_short_help = true, help_heading = super::INPUT)]
    pub columns: Option<usize>,
    /// Number of the image to read, from 1, of a TIFF with several pages or a .npy of shape [N, H, W] [default: 1]
    #[arg(long, value_name = "N", hide_short_help = true, help_heading = super::INPUT)]
    pub image: Option<usize>,
}

impl ReadArgs {
    /// Returns the options for reading files, with the depth unit of the given camera.
    pub fn options(&self, camera: &CameraArgs) -> ReadOptions {
        self.read_options().with_depth_units_per_metre(camera.depth_units_per_metre)
    }

    pub fn read_options(&self) -> ReadOptions {
        self.memory.options().with_unit(self.unit).with_columns(self.columns).with_image(self.image)
    }
}

/// Parses a number of bytes, such as 500M or 4G.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, shift) = match text.strip_suffix(['B', 'b']).unwrap_or(text) {
        text if text.ends_with(['K', 'k']) => (&text[..text.len() - 1], 10),
        text if text.ends_with(['M', 'm']) => (&text[..text.len() - 1], 20),
        text if text.ends_with(['G', 'g']) => (&text[..text.len() - 1], 30),
        text => (text, 0),
    };
    let bytes = number.parse::<u64>().ok().and_then(|number| number.checked_mul(1 << shift));
    bytes.ok_or_else(|| "expected a number of bytes, such as 500M or 4G".to_owned())
}
