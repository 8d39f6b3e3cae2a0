//! The arguments of `planish clean`.

use std::path::PathBuf;

use super::camera::numbers;
use super::{CameraArgs, EncodingArgs, ReadArgs};

/// The steps run in the order in which their options are listed here. Organized clouds keep their grid, and removed
/// points become holes; with --voxel the output is unorganized.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish clean scan.ply clean.ply --voxel 0.005 --statistical 20,2")]
pub struct CleanArgs {
    /// Cloud, or depth image with --camera
    pub input: PathBuf,
    /// Cloud to write
    pub output: PathBuf,
    /// Box to keep, in metres in the cloud's frame
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    pub crop: Option<CropBox>,
    /// Voxel size for thinning, in metres
    ///
    /// Keeps one point per voxel: the centroid, with the means of colour, intensity, normals and other floating-point
    /// fields.
    #[arg(long, value_name = "METRES")]
    pub voxel: Option<f64>,
    /// Remove points whose mean distance to K neighbours exceeds the average by R standard deviations [default R: 1]
    #[arg(long, value_name = "K[,R]", allow_hyphen_values = true)]
    pub statistical: Option<Statistical>,
    /// Remove points with fewer than N neighbours within a radius
    #[arg(long = "radius-outliers", value_name = "METRES,N", allow_hyphen_values = true)]
    pub radius: Option<RadiusOutliers>,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub encoding: EncodingArgs,
    /// Allow an output that replaces the input or a read-only file
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    pub reading: ReadArgs,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Smallest and largest x, y, z, in metres.
#[derive(Clone, Copy)]
pub struct CropBox {
    pub low: [f64; 3],
    pub high: [f64; 3],
}

impl std::str::FromStr for CropBox {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let [x0, y0, z0, x1, y1, z1] = numbers(text).ok_or("expected 6 numbers: X0,Y0,Z0,X1,Y1,Z1")?;
        Ok(Self { low: [x0, y0, z0], high: [x1, y1, z1] })
    }
}

/// Number of neighbours, and number of standard deviations beyond which a point is an outlier.
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
            parsed.ok_or("expected a number of neighbours and a number of standard deviations, such as 20,2")?;
        Ok(Self { neighbours, deviations })
    }
}

/// Radius in metres, and minimum number of neighbours within it.
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
        parsed.ok_or_else(|| "expected a radius in metres and a number of neighbours, such as 0.02,5".to_owned())
    }
}
