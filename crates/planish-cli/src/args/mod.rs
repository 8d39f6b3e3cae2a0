//! The command-line arguments and their conversion to the library's types. The library defines the defaults, so
//! options here are `Option`.

mod bench;
mod camera;
mod clean;
mod convert;
mod encoding;
mod read;
mod rig;
mod smoothing;

use std::path::PathBuf;
use std::str::FromStr;

use anyhow::Result;
use clap::{Parser, Subcommand, ValueEnum};
use planish::simulate::Event;
use planish::source::{Alignment, StreamMode};
use planish::{Outputs, ParamError};

pub use bench::{BenchArgs, BenchCommand, BenchGeneralArgs, BenchGpuArgs, BenchRigArgs, ExperimentArgs};
pub use camera::{CameraArgs, Direction, PoseArgs, PosesArgs};
pub use clean::CleanArgs;
pub use convert::{CompareArgs, ConvertArgs, MergeArgs, MeshArgs};
pub use encoding::EncodingArgs;
pub use read::{MemoryArgs, ReadArgs};
pub use rig::{PoseErrorsArg, RigArgs, RigWayArg};
pub use smoothing::{
    EdgesArg, EngineArg, GpusArgs, SmoothingArgs, by_option, by_option_of_error, option_of, params_of_voxels,
};

const AFTER_HELP: &str = "Start with `planish demo`, then `planish smooth your.pcd smooth.pcd`.\n\
                          Exit codes: 0 success, 1 some frames failed, 2 bad arguments or input, 130 interrupted.";

// Headings of option groups in the help.
const CAMERA: &str = "Camera and pose";
const ENGINE: &str = "Engine";
const INPUT: &str = "Input";
const OTHER_PROGRAMS: &str = "Other programs";
const OUTPUT: &str = "Output";
const RECORDINGS: &str = "ROS 2 recordings";
const RIGS: &str = "Rigs of several cameras";
const TUNING: &str = "Fine-tuning";

/// Real-time smoothing of depth-camera frames and point clouds.
///
/// The output has the points of the input in the same order; colours, other fields, grid and holes are kept.
#[derive(Parser)]
#[command(name = "planish", version = env!("PLANISH_VERSION"), after_help = AFTER_HELP)]
pub struct Args {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Simulate a noisy depth frame, smooth it, and draw both
    Demo(DemoArgs),
    /// Smooth a file, a folder of frames, or a ROS 2 recording
    Smooth(SmoothArgs),
    /// Remove outliers, thin a cloud to voxels, or crop it to a box
    Clean(CleanArgs),
    /// Convert a file to another format, without smoothing
    Convert(ConvertArgs),
    /// Measure the differences between two clouds or depth images
    Compare(CompareArgs),
    /// Merge several clouds, each with its pose
    Merge(MergeArgs),
    /// Smooth a frame and connect its pixels into a triangle mesh
    Mesh(MeshArgs),
    /// Describe a file: format, fields, extent, camera, sensor
    Info(InfoArgs),
    /// Draw a cloud as a shaded relief
    Render(RenderArgs),
    /// Show a frame or cloud in the browser, raw and smoothed
    View(ViewArgs),
    /// Smooth live frames of a camera, or a recording
    Stream(StreamArgs),
    /// Create, check or simulate a rig of several cameras
    Rig(RigArgs),
    /// Record a source as a data set in TUM layout, or as a ROS 2 recording
    Record(RecordArgs),
    /// Complete a ROS 2 recording that was cut off
    Recover(RecoverArgs),
    /// List this machine's instruction sets and GPUs, and the engine that `auto` selects
    Devices(DevicesArgs),
    /// Measure the error of smoothed surfaces, simulated or real
    Evaluate(EvaluateArgs),
    /// Benchmark the engines, after comparing each result with the reference
    Bench(BenchArgs),
    /// Print a completion script for a shell
    Completions(CompletionsArgs),
    /// Write manual pages: planish.1 and one per subcommand
    Man(ManArgs),
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish completions bash > ~/.local/share/bash-completion/completions/planish")]
pub struct CompletionsArgs {
    /// Shell
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish man ~/.local/share/man/man1")]
pub struct ManArgs {
    /// Folder to write to
    pub folder: PathBuf,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish demo --seed 2 --preset strong")]
pub struct DemoArgs {
    /// Folder for raw.pcd, smoothed.pcd and before-after.png
    #[arg(long, value_name = "DIR", default_value = "planish-demo")]
    pub out: PathBuf,
    /// Seed of scene and noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
}

#[derive(clap::Args)]
#[command(after_help = "Example: planish smooth depth.png smooth.png --camera 525,525,319.5,239.5")]
pub struct SmoothArgs {
    /// Cloud, depth image, folder of them, or ROS 2 recording
    ///
    /// Clouds: .pcd, .ply, .las, .laz, .e57, .xyz, .csv, .npy, .npz, .bin, .obj, .stl. Depth images: .png, .tiff, .npy.
    /// ROS 2 recordings: .mcap. The name - is standard input.
    pub input: PathBuf,
    /// File or folder to write
    ///
    /// A depth image stays a depth image in .png, .tiff and .npy, and becomes a cloud in other formats. A recording
    /// becomes a copy with smoothed depth, or a folder of its frames.
    pub output: PathBuf,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Fields to add
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    #[command(flatten)]
    pub gpus: GpusArgs,
    #[command(flatten)]
    pub pose: PoseArgs,
    #[command(flatten)]
    pub poses: PosesArgs,
    #[command(flatten)]
    pub topics: TopicArgs,
    /// Topic for an additional cloud per depth image
    #[arg(long, value_name = "TOPIC", hide_short_help = true, help_heading = RECORDINGS)]
    pub points_topic: Option<String>,
    #[command(flatten)]
    pub encoding: EncodingArgs,
    /// File extension of a folder's results [default: the inputs']
    #[arg(long, value_name = "EXTENSION", hide_short_help = true, help_heading = OUTPUT)]
    pub format: Option<String>,
    /// Allow an output that replaces the input or a read-only file
    #[arg(long, hide_short_help = true, help_heading = OUTPUT)]
    pub overwrite: bool,
    /// Smooth despite an unlikely camera or range, or a radius that is too large for the cloud
    #[arg(long, hide_short_help = true, help_heading = TUNING)]
    pub force: bool,
    #[command(flatten)]
    pub reading: ReadArgs,
    /// Number of times to smooth the loaded frame, for timing
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), hide_short_help = true, help_heading = ENGINE)]
    pub repeat: u32,
    /// Print a report as one JSON object
    #[arg(long, hide_short_help = true)]
    pub json: bool,
}

/// Topics of a ROS 2 recording.
#[derive(clap::Args)]
pub struct TopicArgs {
    /// Topic with depth images or clouds [default: the only one]
    ///
    /// May be repeated if `planish smooth` writes another recording.
    #[arg(long, value_name = "TOPIC", hide_short_help = true, help_heading = RECORDINGS)]
    pub topic: Vec<String>,
    /// Topic with the camera [default: camera_info in the images' namespace]
    #[arg(long, value_name = "TOPIC", hide_short_help = true, help_heading = RECORDINGS)]
    pub camera_info_topic: Option<String>,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish info scan.laz")]
pub struct InfoArgs {
    /// File; - is standard input
    pub file: PathBuf,
    #[command(flatten)]
    pub reading: ReadArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub pose: PoseArgs,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish recover walk.mcap.part")]
pub struct RecoverArgs {
    /// Recording to complete in place: .mcap, or the .mcap.part of a killed process
    ///
    /// Whole messages are kept. NAME.mcap.part is renamed to NAME.mcap.
    pub file: PathBuf,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish render smooth.pcd smooth.png")]
pub struct RenderArgs {
    /// Cloud, or depth image with --camera
    pub file: PathBuf,
    /// PNG picture to write: the relief, and the colours next to it if there are any
    pub output: PathBuf,
    /// Direction from an unorganized cloud to the viewer; 0,0,1 is a view from above if z points up
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub from: Option<Direction>,
    #[command(flatten)]
    pub reading: ReadArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
}

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  planish view frame.png --camera 525,525,319.5,239.5\n  planish view scan.laz")]
pub struct ViewArgs {
    /// Cloud or depth image, in any format that planish reads
    pub file: PathBuf,
    /// Port on this machine [default: a free one]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    pub port: u16,
    /// Print the address without opening a browser
    #[arg(long)]
    pub no_browser: bool,
    /// Folder with the page, for builds that do not contain it
    #[arg(long, value_name = "FOLDER", hide_short_help = true)]
    pub page: Option<PathBuf>,
    #[command(flatten)]
    pub reading: ReadArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
}

#[derive(clap::Args)]
#[command(mut_arg("name", |name| name.required(false).required_unless_present("rig")))]
#[command(after_help = "Examples:\n  planish stream realsense --save smoothed --format png\n  \
                        planish stream synthetic --fps 30 --duration 10")]
pub struct StreamArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub poses: PosesArgs,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// Folder or ROS 2 recording (.mcap) for the results
    #[arg(long, value_name = "DIR|FILE.mcap")]
    pub save: Option<PathBuf>,
    /// Format of the saved results
    #[arg(long, value_enum)]
    pub format: Option<StreamFormatArg>,
    /// Fields to add
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    /// Show raw and smoothed clouds, depth, latency and rate in the Rerun viewer
    #[cfg(feature = "rerun")]
    #[arg(long, conflicts_with = "rrd", hide_short_help = true)]
    pub rerun: bool,
    /// File for the Rerun viewer, about 7 MB per frame
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    pub rrd: Option<PathBuf>,
    #[cfg(not(feature = "rerun"))]
    #[arg(long, hide = true)]
    pub rerun: bool,
    #[cfg(not(feature = "rerun"))]
    #[arg(long, hide = true)]
    pub rrd: Option<PathBuf>,
    /// rig.json of several cameras to stream as one sensor, instead of SOURCE
    #[arg(long, value_name = "FILE", conflicts_with_all = ["name", "topic", "camera_info_topic", "camera", "camera_file", "depth_units_per_metre", "align", "mode"], help_heading = RIGS)]
    pub rig: Option<PathBuf>,
    /// How to smooth the frames of one moment
    #[arg(long, value_enum, requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub fuse: Option<RigWayArg>,
    /// Folder for each camera's results, in subfolders; --save writes the fused clouds
    #[arg(long, value_name = "DIR", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub save_cameras: Option<PathBuf>,
    /// With --fuse views: maximum distance between two cameras' surfaces due to pose errors, in mm [default: 10]
    #[arg(long, value_name = "MM", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub registration: Option<f64>,
    /// With --fuse merged: voxel size for thinning in metres, such as 0.005 [default: keep all points]
    #[arg(long, value_name = "METRES", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub voxel: Option<f64>,
    /// Picture of points and cameras from above, updated once a second
    #[arg(long, value_name = "FILE.png", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub picture: Option<PathBuf>,
    /// Print a report as one JSON object at the end
    #[arg(long)]
    pub json: bool,
}

/// The source of frames, and when to stop.
#[derive(clap::Args)]
pub struct SourceArgs {
    /// Camera, recording, data set, folder or file
    ///
    /// One of: kinect[:INDEX]; realsense[:SERIAL|:FILE.bag|:FILE.db3]; openni2[:URI|:FILE.oni]; synthetic[:SEED]; a
    /// data set in TUM layout; a libfreenect recording; a ROS 2 recording (.mcap); a folder of frames; a file, which is
    /// repeated unless it has several images.
    #[arg(value_name = "SOURCE", required = true)]
    pub name: Option<String>,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub topics: TopicArgs,
    /// RealSense and OpenNI2: alignment of depth and colour
    ///
    /// Default: colour to depth on a RealSense; depth to colour on OpenNI2 cameras that support it.
    #[arg(long, value_enum, hide_short_help = true, help_heading = CAMERA)]
    pub align: Option<AlignArg>,
    /// RealSense and OpenNI2: size and rate of depth, such as 848x480@30 [default: the camera's]
    #[arg(long, value_name = "WxH[@FPS]", hide_short_help = true, help_heading = CAMERA)]
    pub mode: Option<StreamMode>,
    #[command(flatten)]
    pub limits: LimitArgs,
    #[command(flatten)]
    pub memory: MemoryArgs,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum AlignArg {
    /// Map colour onto the depth image
    Depth,
    /// Map depth onto the colour image
    #[value(name = "color")]
    Colour,
    /// Depth without colour
    None,
}

impl From<AlignArg> for Alignment {
    fn from(arg: AlignArg) -> Self {
        match arg {
            AlignArg::Depth => Self::Depth,
            AlignArg::Colour => Self::Colour,
            AlignArg::None => Self::None,
        }
    }
}

#[derive(clap::Args)]
pub struct LimitArgs {
    /// Rate in frames per second at which to play the source, like a live camera [default: as fast as possible]
    #[arg(long, value_name = "N")]
    pub fps: Option<f64>,
    /// Number of frames [default: until the source ends]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Duration in seconds [default: until the source ends]
    #[arg(long, value_name = "S")]
    pub duration: Option<f64>,
    /// Wait for a camera that is missing or was unplugged
    #[arg(long)]
    pub reconnect: bool,
}

#[derive(clap::Args)]
#[command(after_help = "Example:\n  planish record realsense recording.mcap --duration 10")]
pub struct RecordArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Folder (TUM layout) or ROS 2 recording (.mcap) to create
    pub folder: PathBuf,
    /// Print a report as one JSON object at the end
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum StreamFormatArg {
    /// Organized clouds (the default)
    Pcd,
    /// Organized clouds
    Ply,
    /// 16-bit depth images
    Png,
}

#[derive(clap::Args)]
pub struct DevicesArgs {
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  planish evaluate --seeds 2 --sensor d435\n  planish evaluate --input table.pcd")]
pub struct EvaluateArgs {
    /// Number of seeds to simulate, with six frames each and the noise of --sensor
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..))]
    pub seeds: u64,
    /// Single seed to simulate
    #[arg(long, value_name = "SEED", conflicts_with = "seeds")]
    pub seed: Option<u64>,
    /// Real cloud, or depth image with --camera, whose flatness is measured before and after smoothing
    ///
    /// Flatness is measured in tiles of a grid, or in patches of an unorganized cloud.
    ///
    /// With --sequence: a folder of frames, a data set or a recording (.mcap).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["seeds", "seed"])]
    pub input: Option<PathBuf>,
    /// Measure smoothing over time on all simulated videos, the named one, or --input
    ///
    /// Reports jitter, slow changes, errors against the truth, and how late moving objects appear and disappear. With
    /// --out, animated pictures show the measured, the smoothed and the steady frames. Names: still, fixed-pattern,
    /// flickering-holes, slow-object, fast-object, thin-pole, appearing-object, moving-camera.
    #[arg(long, value_name = "NAME", num_args = 0..=1, default_missing_value = "all", conflicts_with_all = ["rig", "general", "seeds"])]
    pub sequence: Option<SequenceArg>,
    /// Number of frames of each video
    #[arg(long, value_name = "N", requires = "sequence", value_parser = clap::value_parser!(u64).range(1..=10_000))]
    pub frames: Option<u64>,
    #[command(flatten)]
    pub poses: PosesArgs,
    /// Folder for report.json, error-over-z.svg, and error maps of the first seed's frames, or animated pictures
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Number of frames of a static camera over which to measure jitter; values below 2 disable this measurement
    ///
    /// With --general, this measurement takes most of the time.
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u64).range(..=300), conflicts_with_all = ["input", "rig", "export", "sequence"], hide_short_help = true)]
    pub still_frames: u64,
    /// Smooth the simulated frames as unorganized clouds, next to the default on the grid
    #[arg(long, conflicts_with_all = ["input", "export", "results"], hide_short_help = true)]
    pub general: bool,
    /// Folder for the simulated frames, to be smoothed by other programs: organized clouds, or depth images for videos
    #[arg(long, value_name = "DIR", conflicts_with_all = ["results", "out"], hide_short_help = true, help_heading = OTHER_PROGRAMS)]
    pub export: Option<PathBuf>,
    /// Another program's results to measure: a folder of files with the exported names, or a file with --input
    ///
    /// Organized clouds, with or without normals. With --sequence: folders of depth images or clouds; repeat the option
    /// for several programs. Depth in whole millimetres looks rougher than in .npy or .tiff.
    #[arg(long, value_name = "DIR|FILE", hide_short_help = true, help_heading = OTHER_PROGRAMS)]
    pub results: Vec<PathBuf>,
    /// Number of cameras (2 to 8) of simulated rigs around a table, smoothed by every method
    ///
    /// Reports the errors of surfaces that several cameras see and of those that one camera sees, and the distance
    /// between doubled surfaces.
    #[arg(long, value_name = "CAMERAS", conflicts_with_all = ["input", "general", "export", "results", "out"],
          value_parser = clap::value_parser!(u8).range(2..=8), hide_short_help = true, help_heading = RIGS)]
    pub rig: Option<u8>,
    /// Errors of the stated poses of all cameras but the first
    #[arg(long, value_name = "DEG,MM", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub pose_errors: Option<PoseErrorsArg>,
    /// For merged points: voxel size for thinning, in metres [default: keep all points]
    #[arg(long, value_name = "METRES", requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub voxel: Option<f64>,
    /// For views: add a viewpoint halfway between adjacent cameras
    #[arg(long, requires = "rig", hide_short_help = true, help_heading = RIGS)]
    pub between: bool,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// The simulated videos to measure.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum SequenceArg {
    All,
    One(Event),
}

impl FromStr for SequenceArg {
    type Err = ParamError;

    fn from_str(text: &str) -> Result<Self, ParamError> {
        if text == "all" { Ok(Self::All) } else { text.parse().map(Self::One) }
    }
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FieldArg {
    /// Unit normals: normal_x, normal_y, normal_z
    Normals,
    /// Surface variation, 0 to 1/3
    Curvature,
    /// Status: 0 hole, 1 too few neighbours, 2 collinear, 3 plane, 4 and 5 polynomial of degree 2 and 3, 6 isolated, 7
    /// carried over from the previous frame, 8 filled
    Status,
    /// With --temporal: effective number of frames averaged into the point, 1 to 16; 0 for holes
    Frames,
    /// Standard error of each position along its ray, in metres; for frames on a grid
    Sigma,
    /// No field (the default)
    None,
}

/// Returns the outputs that the given fields need.
pub fn outputs_of(fields: &[FieldArg]) -> Outputs {
    let wants = |field| fields.contains(&field);
    Outputs::POINTS
        .with_normals(wants(FieldArg::Normals))
        .with_curvature(wants(FieldArg::Curvature))
        .with_status(wants(FieldArg::Status))
        .with_frames(wants(FieldArg::Frames))
        .with_sigma(wants(FieldArg::Sigma))
}

impl SmoothArgs {
    pub fn outputs(&self) -> Outputs {
        outputs_of(&self.fields)
    }
}
