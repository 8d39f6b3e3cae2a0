//! The arguments, and how they become the library's types. Defaults live in the library: options here are `Option`.

mod bench;
mod camera;
mod clean;
mod memory;
mod rig;
mod smoothing;

use std::path::PathBuf;

use clap::{Parser, Subcommand, ValueEnum};
use planish::Outputs;
use planish::io::Encoding;
use planish::source::{Alignment, StreamMode};

pub use bench::{BenchArgs, BenchCommand, BenchGeneralArgs, BenchGpuArgs, BenchRigArgs, ExperimentArgs};
pub use camera::{CameraArgs, Direction, PoseArgs};
pub use clean::CleanArgs;
pub use memory::MemoryArgs;
pub use rig::{PoseErrorsArg, RigArgs, RigWayArg};
pub use smoothing::{
    EdgesArg, EngineArg, GpusArgs, SmoothingArgs, by_option, by_option_of_error, option_of, params_of_voxels,
};

const AFTER_HELP: &str = "Exit codes: 0 done; 1 some frames failed, the others are done; 2 bad arguments or input; 130 ended by a \
                          signal (a stream or recording ends with 0).\nStart with `planish demo`, then `planish smooth your.pcd smooth.pcd`.";

/// Smooth point clouds of depth cameras: organized in, organized out, colour and holes kept.
#[derive(Parser)]
#[command(name = "planish", version = env!("PLANISH_VERSION"), about, after_help = AFTER_HELP)]
pub struct Args {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Simulate a noisy depth frame, smooth it, and show the difference
    Demo(DemoArgs),
    /// Smooth a file, or every frame of a folder
    Smooth(SmoothArgs),
    /// Remove outliers, thin a cloud, cut out a box: what comes before smoothing
    Clean(CleanArgs),
    /// Show what a file contains
    Info(InfoArgs),
    /// Draw the relief of a cloud
    Render(RenderArgs),
    /// Smooth frames live: from a Kinect, a data set, a folder, the simulator
    Stream(StreamArgs),
    /// Describe a rig of several cameras, make one from a calibration, or simulate one; `planish stream --rig` streams
    /// it
    Rig(RigArgs),
    /// Record a source as a data set in TUM layout, or as a recording of ROS 2 (.mcap)
    Record(RecordArgs),
    /// List instruction sets and GPUs of this machine, and what `auto` chooses
    Devices(DevicesArgs),
    /// Measure surface quality: of simulated frames against their truth, or of a file by itself
    Evaluate(EvaluateArgs),
    /// Benchmark the engines; each result is checked against the reference first
    Bench(BenchArgs),
    /// Print the completions of a shell: `planish completions bash >
    /// ~/.local/share/bash-completion/completions/planish`
    Completions(CompletionsArgs),
    /// Write the manual pages, planish.1 and one a command
    Man(ManArgs),
}

#[derive(clap::Args)]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

#[derive(clap::Args)]
pub struct ManArgs {
    /// The folder to write them to
    pub folder: PathBuf,
}

#[derive(clap::Args)]
pub struct DemoArgs {
    /// Folder for raw.pcd, smoothed.pcd and before-after.png
    #[arg(long, value_name = "DIR", default_value = "planish-demo")]
    pub out: PathBuf,
    /// Seed of the scene and the noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
}

#[derive(clap::Args)]
pub struct SmoothArgs {
    /// A cloud (.pcd, .ply, .las, .laz, .e57, .xyz, .csv, .npy, .npz, .bin, .obj, .stl), a depth image (.png, .tiff,
    /// .npy), a folder of them, or a recording of ROS 2 (.mcap)
    pub input: PathBuf,
    /// The file or folder to write; depth in and .png, .tiff or .npy out gives depth. Of a recording: a recording that
    /// is the same but for its depth, or a folder of its frames
    pub output: PathBuf,
    #[command(flatten)]
    pub topics: TopicArgs,
    /// For recordings: add a cloud for each depth image, on this topic
    #[arg(long, value_name = "TOPIC")]
    pub points_topic: Option<String>,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub gpus: GpusArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub pose: PoseArgs,
    /// Fields to add to the points, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    /// Encoding of the points in a .pcd or .ply; else the input's
    #[arg(long, value_enum)]
    pub encoding: Option<EncodingArg>,
    /// Smooth a general cloud with a radius over a fifth of its extent
    #[arg(long)]
    pub force: bool,
    /// Write over the input where the output is the same file
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// File extension of the results of a folder, if not that of the inputs
    #[arg(long, value_name = "EXTENSION")]
    pub format: Option<String>,
    /// Smooth the loaded frame this many times, for timing
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

/// Topics of a recording of ROS 2.
#[derive(clap::Args)]
pub struct TopicArgs {
    /// For recordings in MCAP: the topic with the depth images or clouds, if there are several. `planish smooth` takes
    /// more than one into another recording
    #[arg(long, value_name = "TOPIC")]
    pub topic: Vec<String>,
    /// For recordings in MCAP: the topic with the camera, if it is not beside the images'
    #[arg(long, value_name = "TOPIC")]
    pub camera_info_topic: Option<String>,
}

#[derive(clap::Args)]
pub struct InfoArgs {
    /// The file; - is standard input
    pub file: PathBuf,
    #[command(flatten)]
    pub memory: MemoryArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub pose: PoseArgs,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct RenderArgs {
    /// A cloud, or a depth image with --camera
    pub file: PathBuf,
    /// The picture to write: relief, and beside it the colours if there are any
    pub output: PathBuf,
    /// Where a general cloud is seen from, as a direction in its frame: 0,0,1 is from above, if z points up
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub from: Option<Direction>,
    #[command(flatten)]
    pub memory: MemoryArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
}

#[derive(clap::Args)]
#[command(mut_arg("name", |name| name.required(false).required_unless_present("rig")))]
pub struct StreamArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Stream several cameras as one sensor: a rig.json that says where each stands (`planish rig` makes one), instead
    /// of SOURCE
    #[arg(long, value_name = "FILE", conflicts_with_all = ["name", "topic", "camera_info_topic", "camera", "camera_file", "depth_units_per_metre", "align", "mode"])]
    pub rig: Option<PathBuf>,
    /// Of a rig: how the frames of a moment are smoothed
    #[arg(long, value_enum, requires = "rig")]
    pub fuse: Option<RigWayArg>,
    /// Of a rig: write each camera's results into a folder of its own in this one; --save writes the fused clouds
    #[arg(long, value_name = "DIR", requires = "rig")]
    pub save_cameras: Option<PathBuf>,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// Write every result into this folder, or into this recording of ROS 2 (.mcap)
    #[arg(long, value_name = "DIR|FILE.mcap")]
    pub save: Option<PathBuf>,
    /// What to write there
    #[arg(long, value_enum)]
    pub format: Option<StreamFormatArg>,
    /// Of a rig smoothed by views: how far surfaces of two cameras may be apart for their poses' sake, in millimetres;
    /// else 10
    #[arg(long, value_name = "MM", requires = "rig")]
    pub registration: Option<f64>,
    /// Of a rig whose points are merged: first keep one point for each voxel of this size in metres, as 0.005; the
    /// fused cloud then has one point a voxel
    #[arg(long, value_name = "METRES", requires = "rig")]
    pub voxel: Option<f64>,
    /// Of a rig: keep a picture of its points and cameras from above in this file, drawn anew once a second
    #[arg(long, value_name = "FILE.png", requires = "rig")]
    pub picture: Option<PathBuf>,
    /// Show raw and smoothed clouds, depth, latency and rate in the viewer of Rerun
    #[cfg(feature = "rerun")]
    #[arg(long, conflicts_with = "rrd")]
    pub rerun: bool,
    /// Write the same as a file that the viewer of Rerun opens; some 7 MB a frame
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE")]
    pub rrd: Option<PathBuf>,
    #[cfg(not(feature = "rerun"))]
    #[arg(long, hide = true)]
    pub rerun: bool,
    #[cfg(not(feature = "rerun"))]
    #[arg(long, hide = true)]
    pub rrd: Option<PathBuf>,
    /// Fields to add to the points, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    /// Print one JSON object to standard output at the end
    #[arg(long)]
    pub json: bool,
}

/// Where frames come from, and until when.
#[derive(clap::Args)]
pub struct SourceArgs {
    /// kinect[:INDEX], realsense[:SERIAL|:FILE.bag|:FILE.db3], openni2[:URI|:FILE.oni], synthetic[:SEED], a data set in
    /// TUM layout, a recording of libfreenect or of ROS 2 (.mcap), a folder of frames, or one file, repeated
    #[arg(value_name = "SOURCE", required = true)]
    pub name: Option<String>,
    #[command(flatten)]
    pub topics: TopicArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// RealSense and OpenNI2: map depth and colour to one image. Colour to depth (the RealSense's default), depth to
    /// colour (the default of OpenNI2 cameras that can), or depth alone
    #[arg(long, value_enum)]
    pub align: Option<AlignArg>,
    /// RealSense and OpenNI2: size and rate of depth, as 848x480@30; else the camera's own
    #[arg(long, value_name = "WxH[@FPS]")]
    pub mode: Option<StreamMode>,
    #[command(flatten)]
    pub limits: LimitArgs,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum AlignArg {
    Depth,
    #[value(name = "color")]
    Colour,
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
    /// Pace the source to N frames a second, as a live camera; else as fast as possible
    #[arg(long, value_name = "N")]
    pub fps: Option<f64>,
    /// Stop after N frames
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// Stop after S seconds
    #[arg(long, value_name = "S")]
    pub duration: Option<f64>,
    /// Wait for a camera that is not there yet, or was unplugged
    #[arg(long)]
    pub reconnect: bool,
}

#[derive(clap::Args)]
pub struct RecordArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// The folder to make, or a recording of ROS 2 (.mcap)
    pub folder: PathBuf,
    /// Print one JSON object to standard output at the end
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum StreamFormatArg {
    /// Organized clouds (the default)
    Pcd,
    Ply,
    /// 16-bit depth images
    Png,
}

#[derive(clap::Args)]
pub struct DevicesArgs {
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct EvaluateArgs {
    /// Simulate seeds 1 to N, three frames each, with the noise of --sensor (a Kinect v1)
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..))]
    pub seeds: u64,
    /// Simulate only this seed
    #[arg(long, value_name = "SEED", conflicts_with = "seeds")]
    pub seed: Option<u64>,
    /// A real cloud, or a depth image with --camera: its flatness tile by tile before and after, of general clouds
    /// patch by patch
    #[arg(long, value_name = "FILE", conflicts_with_all = ["seeds", "seed", "export", "out"])]
    pub input: Option<PathBuf>,
    /// Frames of a camera that stands still, over which the jitter of points is measured; fewer than 2 leave it out
    /// (with --general it takes most of the time)
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u64).range(..=300), conflicts_with_all = ["input", "rig", "export"])]
    pub still_frames: u64,
    /// Smooth the simulated frames as general clouds, without their grid; the default setting on the grid stands beside
    #[arg(long, conflicts_with_all = ["input", "export", "results"])]
    pub general: bool,
    /// Smooth simulated rigs of so many cameras (2 to 8) round a table instead, in each of the ways: where several
    /// cameras see a surface and where one does, and whether it is doubled
    #[arg(long, value_name = "CAMERAS", conflicts_with_all = ["input", "general", "export", "results", "out"],
          value_parser = clap::value_parser!(u8).range(2..=8))]
    pub rig: Option<u8>,
    /// Of rigs: how far the stated poses of all cameras but the first are off, in degrees and millimetres
    #[arg(long, value_name = "DEG,MM", requires = "rig")]
    pub pose_errors: Option<PoseErrorsArg>,
    /// Of rigs whose points are merged: first keep one point for each voxel of this size in metres, as `planish stream`
    /// does
    #[arg(long, value_name = "METRES", requires = "rig")]
    pub voxel: Option<f64>,
    /// Of rigs smoothed by views: add a viewpoint halfway between every two cameras side by side
    #[arg(long, requires = "rig")]
    pub between: bool,
    /// Only write the simulated frames into this folder as organized clouds, for other programs to smooth
    #[arg(long, value_name = "DIR", conflicts_with_all = ["results", "out"])]
    pub export: Option<PathBuf>,
    /// Measure the output of another program instead: organized clouds of the same names (normals optional) in this
    /// folder, or with --input that one file
    #[arg(long, value_name = "DIR|FILE")]
    pub results: Option<PathBuf>,
    /// Folder for report.json, error-over-z.svg and, but with --results, an error map of each frame of the first seed
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FieldArg {
    /// normal_x, normal_y, normal_z
    Normals,
    /// Surface variation
    Curvature,
    /// Status of each point: 0 hole, 1 too few neighbours, 2 line, 3 plane, 4 and 5 polynomial of degree 2 and 3, 6
    /// isolated
    Status,
    /// Nothing (the default)
    None,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum EncodingArg {
    Ascii,
    Binary,
    Compressed,
}

impl From<EncodingArg> for Encoding {
    fn from(encoding: EncodingArg) -> Self {
        match encoding {
            EncodingArg::Ascii => Self::Ascii,
            EncodingArg::Binary => Self::Binary,
            EncodingArg::Compressed => Self::BinaryCompressed,
        }
    }
}

/// The outputs that fields are made from.
pub fn outputs_of(fields: &[FieldArg]) -> Outputs {
    let wants = |field| fields.contains(&field);
    Outputs::POINTS
        .with_normals(wants(FieldArg::Normals))
        .with_curvature(wants(FieldArg::Curvature))
        .with_status(wants(FieldArg::Status))
}

impl SmoothArgs {
    pub fn outputs(&self) -> Outputs {
        outputs_of(&self.fields)
    }

    /// The encoding to write, if one was asked for.
    pub fn encoding(&self) -> Option<Encoding> {
        self.encoding.map(Encoding::from)
    }
}
