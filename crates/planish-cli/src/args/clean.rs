//! The arguments of `planish clean`.

use std::path::PathBuf;

use super::camera::numbers;
use super::{CameraArgs, EncodingArg, MemoryArgs};

/// The steps are taken in the order of their options here; organized clouds keep their grid, with holes where points
/// were, unless --voxel makes them general.
#[derive(clap::Args)]
pub struct CleanArgs {
    /// A cloud, organized or general, or a depth image with --camera
    pub input: PathBuf,
    /// The cloud to write
    pub output: PathBuf,
    /// Keep what is in a box, in metres in the cloud's frame
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    pub crop: Option<CropBox>,
    /// Keep one point for each voxel of this size in metres: the centroid, with the means of colour, intensity, normals
    /// and floats
    #[arg(long, value_name = "METRES")]
    pub voxel: Option<f64>,
    /// Remove points whose mean distance to K nearest others is above the mean of all points by R standard deviations
    /// (1 if not given)
    #[arg(long, value_name = "K[,R]", allow_hyphen_values = true)]
    pub statistical: Option<Statistical>,
    /// Remove points with fewer than N others within the radius
    #[arg(long = "radius-outliers", value_name = "METRES,N", allow_hyphen_values = true)]
    pub radius: Option<RadiusOutliers>,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Encoding of the points in a .pcd or .ply; else the input's
    #[arg(long, value_enum)]
    pub encoding: Option<EncodingArg>,
    /// Write over the input where the output is the same file
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

/// The least x, y, z and the largest.
#[derive(Clone, Copy)]
pub struct CropBox {
    pub low: [f64; 3],
    pub high: [f64; 3],
}

impl std::str::FromStr for CropBox {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [x0, y0, z0, x1, y1, z1] = numbers(text).ok_or("6 numbers: X0,Y0,Z0,X1,Y1,Z1")?;
        Ok(Self { low: [x0, y0, z0], high: [x1, y1, z1] })
    }
}

/// Nearest others of a point, and standard deviations.
#[derive(Clone, Copy)]
pub struct Statistical {
    pub neighbours: usize,
    pub deviations: f32,
}

impl std::str::FromStr for Statistical {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (neighbours, deviations) = text.split_once(',').unwrap_or((text, "1"));
        let parsed = neighbours.trim().parse().ok().zip(deviations.trim().parse().ok());
        let (neighbours, deviations) =
            parsed.ok_or("a number of neighbours and one of standard deviations, as 20,2")?;
        Ok(Self { neighbours, deviations })
    }
}

/// A radius in metres, and the fewest others within it.
#[derive(Clone, Copy)]
pub struct RadiusOutliers {
    pub radius_m: f32,
    pub least: usize,
}

impl std::str::FromStr for RadiusOutliers {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once(',').and_then(|(radius, least)| {
            let least = least.trim().parse().ok()?;
            Some(Self { radius_m: radius.trim().parse().ok()?, least })
        });
        parsed.ok_or_else(|| "a radius in metres and a number of neighbours, as 0.02,5".to_owned())
    }
}
