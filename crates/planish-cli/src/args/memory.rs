//! Limits of memory.

use planish::io::ReadOptions;

#[derive(clap::Args)]
pub struct MemoryArgs {
    /// Memory limit for file and point data, such as 500M or 4G [default: 2G]
    ///
    /// The program needs about 50 MB in addition, and LAZ another 100 MB. `smooth` and `info` process larger LAS, LAZ
    /// and PLY files in tiles; other files that need more are refused.
    #[arg(long, value_name = "BYTES", value_parser = parse_bytes, hide_short_help = true, help_heading = super::ENGINE)]
    pub max_memory: Option<u64>,
}

impl MemoryArgs {
    pub fn read_options(&self) -> ReadOptions {
        let default = ReadOptions::default();
        self.max_memory.map_or(default, |bytes| default.with_max_memory_bytes(bytes))
    }
}

/// Parses a number of bytes, such as 500M or 4G.
fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, shift) = match text.strip_suffix(['B', 'b']).unwrap_or(text) {
        text if text.ends_with(['K', 'k']) => (&text[..text.len() - 1], 10),
        text if text.ends_with(['M', 'm']) => (&text[..text.len() - 1], 20),
        text if text.ends_with(['G', 'g']) => (&text[..text.len() - 1], 30),
        text => (text, 0),
    };
    let bytes = number.parse::<u64>().ok().and_then(|number| number.checked_mul(1 << shift));
    bytes.ok_or_else(|| "a number of bytes is expected, such as 500M or 4G".to_owned())
}
