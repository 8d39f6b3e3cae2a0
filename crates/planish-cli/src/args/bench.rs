//! The arguments of `planish bench`.

use std::path::PathBuf;

use clap::Subcommand;

use super::{CameraArgs, EdgesArg, EngineArg, GpusArgs, RigWayArg};

#[derive(clap::Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    pub what: BenchCommand,
}

#[derive(Subcommand)]
pub enum BenchCommand {
    /// The GPU engine: its kernels, one frame at a time, frames in flight, batches
    Gpu(BenchGpuArgs),
    /// General clouds: from points in memory to points and normals
    General(BenchGeneralArgs),
    /// Rigs: from the depth of a simulated rig's cameras in memory to the fused cloud in memory
    Rig(BenchRigArgs),
    /// Experiment 1 of the 2011 report: times of a frame, and how many times the serial method's
    Speedup(ExperimentArgs),
    /// Experiment 2: time over the candidates of a window
    Connectivity(ExperimentArgs),
    /// Experiment 3: the scene several times over, as a tall cloud and as a batch; threads
    Scaleup(ExperimentArgs),
    /// Where the time of a frame goes
    Profile(ExperimentArgs),
    /// A frame raw and smoothed, and its largest plane before and after
    Quality(ExperimentArgs),
    /// All five, one after the other
    All(ExperimentArgs),
}

#[derive(clap::Args)]
pub struct ExperimentArgs {
    /// Which engines, separated by commas; else, or with auto, all that this machine has but GPUs in software
    #[arg(long, value_enum, value_delimiter = ',', value_name = "ENGINES")]
    pub engine: Vec<EngineArg>,
    /// Frames: organized clouds, or depth images with --camera; else the depth of a simulated room and a simulated
    /// table
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub input: Vec<PathBuf>,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Fewer and shorter measurements: all five in about a minute on two cores
    #[arg(long)]
    pub quick: bool,
    /// Folder for each experiment's JSON, Markdown and plots
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write the machine, the tables and the plots of --out into this Markdown file too, between the lines
    /// `<!-- planish bench NAME -->` and `<!-- end of planish bench NAME -->`, where NAME is that of the folder
    #[arg(long, value_name = "FILE.md", requires = "out")]
    pub update: Option<PathBuf>,
}

#[derive(clap::Args)]
pub struct BenchGpuArgs {
    /// A frame: an organized cloud of a camera at 640x480 with a focal length of 525; else a simulated one
    #[arg(long, value_name = "FILE")]
    pub input: Option<PathBuf>,
    /// Which GPU, by its index or part of its name (see `planish devices`); else the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// With --gpus: measure nothing but what several devices do
    #[arg(long, requires = "gpus")]
    pub only_devices: bool,
    /// Frames for each figure
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(2..))]
    pub runs: u32,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct BenchRigArgs {
    /// How many cameras, 1 to 8
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=8))]
    pub cameras: u8,
    /// Which ways, separated by commas; else each
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WAYS", default_value = "each")]
    pub fuse: Vec<RigWayArg>,
    /// Of merged points: one for each voxel of this size in metres; else all of them
    #[arg(long, value_name = "METRES")]
    pub voxel: Option<f64>,
    /// Of merged points: how far they are smoothed over, in metres; else 0.03, or three voxels where that is more
    #[arg(long, value_name = "METRES")]
    pub radius: Option<f32>,
    /// Of merged points: whether creases and steps are kept; else they are
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// Which engine
    #[arg(long, value_enum, default_value = "auto")]
    pub engine: EngineArg,
    /// Which GPU with --engine gpu, by its index or part of its name (see `planish devices`); else the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// Moments for each figure, as far as 20 s go
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..))]
    pub runs: u32,
    /// Print one JSON array to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct BenchGeneralArgs {
    /// Clouds; points on a grid are taken without it. Else simulated scans of --points
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub input: Vec<PathBuf>,
    /// Points of simulated scans, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "N", value_parser = clap::value_parser!(u32).range(5000..=1_000_000_000))]
    pub points: Vec<u32>,
    /// Radii in metres, separated by commas; else, and with 0, radii by density
    #[arg(long, value_delimiter = ',', value_name = "M")]
    pub radius: Vec<f32>,
    /// Neighbours that radii by density go for
    #[arg(long, value_name = "K", default_value_t = 40)]
    pub neighbours: u32,
    /// Degree of the polynomial
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub degree: u32,
    /// Whether creases and steps are kept
    #[arg(long, value_enum, default_value = "off")]
    pub edges: EdgesArg,
    /// Which engines, separated by commas; else the CPU and a real GPU if there is one
    #[arg(long, value_enum, value_delimiter = ',', value_name = "ENGINES")]
    pub engine: Vec<EngineArg>,
    /// Measure the CPU engine with every instruction set of this machine
    #[arg(long)]
    pub every_simd: bool,
    /// Threads of the CPU engine; one for each core if left out
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// Which GPU, by its index or part of its name (see `planish devices`); else the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// How many points are on the GPU at once, at most; larger clouds go in parts
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1000..))]
    pub points_at_once: Option<u32>,
    /// Runs for each figure, as far as 20 s go
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    pub runs: u32,
    /// Print one JSON array to standard output
    #[arg(long)]
    pub json: bool,
}
