//! The arguments of `planish convert`, `compare`, `merge` and `mesh`.

use std::path::PathBuf;

use super::{CameraArgs, EncodingArgs, ReadArgs, SmoothingArgs};

/// Nothing is smoothed. The output keeps fields, colours, grid and holes if its format can store them. A note lists
/// everything that is dropped.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  planish convert scan.e57 scan.laz\n  planish convert depth.png cloud.ply --camera 525,525,319.5,239.5"
)]
pub struct ConvertArgs {
    /// Cloud or depth image
    pub input: PathBuf,
    /// File to write
    ///
    /// A depth image stays a depth image in .png, .tiff and .npy, and becomes an organized cloud in other formats. An
    /// organized cloud becomes a depth image in .png and .tiff, in millimetres unless --depth-units-per-metre says
    /// otherwise.
    pub output: PathBuf,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Leave out holes; an organized cloud becomes unorganized
    #[arg(long)]
    pub drop_holes: bool,
    /// Fields to keep besides x, y and z, such as intensity,label; write none to drop all [default: all]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub fields: Vec<String>,
    #[command(flatten)]
    pub encoding: EncodingArgs,
    /// Allow an output that replaces the input or a read-only file
    #[arg(long, hide_short_help = true)]
    pub overwrite: bool,
    #[command(flatten)]
    pub reading: ReadArgs,
    /// Print a report as one JSON object
    #[arg(long, hide_short_help = true)]
    pub json: bool,
}

/// Compares pixels and points by index. If the sizes of two clouds differ, compares each point with the nearest one of
/// the other cloud, in both directions.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish compare raw.pcd smooth.pcd --picture difference.png --max 0.02")]
pub struct CompareArgs {
    /// Cloud or depth image
    pub a: PathBuf,
    /// Cloud or depth image to compare with
    pub b: PathBuf,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Compare with the nearest points, whatever their index
    #[arg(long)]
    pub nearest: bool,
    /// Exit with 1 if a distance exceeds this value, or if pixels are holes in only one input
    ///
    /// In metres, or in the units of the images for depth images without --camera.
    #[arg(long, value_name = "DISTANCE")]
    pub max: Option<f64>,
    /// Picture of the distances to write, for two inputs on one grid
    #[arg(long, value_name = "FILE.png")]
    pub picture: Option<PathBuf>,
    #[command(flatten)]
    pub reading: ReadArgs,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// The frame is smoothed, and pixels on one surface are connected; steps are left open. For unorganized clouds, use
/// Open3D or MeshLab.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish mesh depth.png chair.glb --camera 525,525,319.5,239.5")]
pub struct MeshArgs {
    /// Depth image, or organized cloud
    pub input: PathBuf,
    /// Mesh to write: .ply, .obj, .stl or .glb
    pub output: PathBuf,
    /// Connect the points as they are, without smoothing
    #[arg(long)]
    pub raw: bool,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub reading: ReadArgs,
}

/// Holes are left out. The field `scan` contains the index of each point's cloud, starting at 0.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish merge 000.pcd 001.pcd 002.pcd --poses trajectory.log --out room.ply")]
pub struct MergeArgs {
    /// Clouds, or depth images with --camera
    #[arg(required = true)]
    pub inputs: Vec<PathBuf>,
    /// Cloud to write
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// File with the pose of each input in the common frame: trajectory.log (poses by number), or TUM's groundtruth.txt
    /// (poses by file names that are times) [default: all inputs are in one frame]
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub encoding: EncodingArgs,
    #[command(flatten)]
    pub reading: ReadArgs,
}
