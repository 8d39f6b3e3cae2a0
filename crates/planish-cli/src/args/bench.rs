//! The arguments of `planish bench`.

use std::path::PathBuf;

use clap::Subcommand;

use super::{CameraArgs, EdgesArg, EngineArg, GpusArgs, MemoryArgs, RigWayArg};

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  planish bench speedup --quick\n  planish bench general --points 100000")]
pub struct BenchArgs {
    #[command(subcommand)]
    pub what: BenchCommand,
}

#[derive(Subcommand)]
pub enum BenchCommand {
    /// GPU engine: kernels, single frames, frames in flight, batches
    Gpu(BenchGpuArgs),
    /// Unorganized clouds, from points in memory to points and normals
    General(BenchGeneralArgs),
    /// Simulated rigs, from depth in memory to the fused cloud in memory
    Rig(BenchRigArgs),
    /// Experiment 1 of the 2011 report: time per frame, and speedup over the serial method
    Speedup(ExperimentArgs),
    /// Experiment 2: time by the number of candidates in a window
    Connectivity(ExperimentArgs),
    /// Experiment 3: time for several copies of the scene, as a tall cloud and as a batch, and by number of threads
    Scaleup(ExperimentArgs),
    /// Time per stage of a frame
    Profile(ExperimentArgs),
    /// Raw and smoothed frame, and the flatness of the largest plane before and after smoothing
    Quality(ExperimentArgs),
    /// Time per frame by instruction set of the CPU and by preset, on one thread
    Simd(ExperimentArgs),
    /// All experiments of the 2011 report
    All(ExperimentArgs),
}

#[derive(clap::Args)]
pub struct ExperimentArgs {
    /// Engines, separated by commas [default: all, except software GPUs]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "ENGINES")]
    pub engine: Vec<EngineArg>,
    /// Organized clouds, or depth images with --camera [default: a simulated room and table]
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub input: Vec<PathBuf>,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Fewer and shorter measurements: about a minute for `all` on two cores
    #[arg(long)]
    pub quick: bool,
    /// Folder for JSON, Markdown and plots of each experiment
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Markdown file to update with machine, tables and plots of --out
    ///
    /// Replaces the text between the lines `<!-- planish bench NAME -->` and `<!-- end of planish bench NAME -->`,
    /// where NAME is the name of the folder.
    #[arg(long, value_name = "FILE.md", requires = "out")]
    pub update: Option<PathBuf>,
}

#[derive(clap::Args)]
pub struct BenchGpuArgs {
    /// Organized cloud of a 640x480 camera with a focal length of 525 [default: simulated]
    #[arg(long, value_name = "FILE")]
    pub input: Option<PathBuf>,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// GPU: index or part of the name (see `planish devices`) [default: the first hardware GPU]
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// With --gpus: measure only several devices together, not a single GPU
    #[arg(long, requires = "gpus")]
    pub only_devices: bool,
    /// Frames per measurement
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(2..))]
    pub runs: u32,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct BenchRigArgs {
    /// Number of cameras, 1 to 8
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=8))]
    pub cameras: u8,
    /// Methods of fusion, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', value_name = "WAYS", default_value = "each")]
    pub fuse: Vec<RigWayArg>,
    /// For merged points: voxel size for thinning, in metres [default: keep all points]
    #[arg(long, value_name = "METRES")]
    pub voxel: Option<f64>,
    /// For merged points: radius in metres [default: the larger of 0.03 and three voxels]
    #[arg(long, value_name = "METRES")]
    pub radius: Option<f32>,
    /// For merged points: handling of creases and steps [default: robust]
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// Engine
    #[arg(long, value_enum, default_value = "auto")]
    pub engine: EngineArg,
    /// GPU: index or part of the name (see `planish devices`) [default: the first hardware GPU]
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    #[command(flatten)]
    pub gpus: GpusArgs,
    /// Maximum number of moments per measurement (stops after 20 s)
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(1..))]
    pub runs: u32,
    /// Print a report as one JSON array
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct BenchGeneralArgs {
    /// Clouds; their grids are ignored [default: simulated scans of --points]
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub input: Vec<PathBuf>,
    #[command(flatten)]
    pub memory: MemoryArgs,
    /// Numbers of points of simulated scans, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "N", value_parser = clap::value_parser!(u32).range(5000..=1_000_000_000))]
    pub points: Vec<u32>,
    /// Radii in metres, separated by commas; 0 derives the radius from the density [default: 0]
    #[arg(long, value_delimiter = ',', value_name = "M")]
    pub radius: Vec<f32>,
    /// Target number of neighbours for radii derived from the density
    #[arg(long, value_name = "K", default_value_t = 40)]
    pub neighbours: u32,
    /// Degree of the polynomial
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub degree: u32,
    /// Handling of creases and steps
    #[arg(long, value_enum, default_value = "off")]
    pub edges: EdgesArg,
    /// Engines, separated by commas [default: the CPU, and a hardware GPU if available]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "ENGINES")]
    pub engine: Vec<EngineArg>,
    /// Measure the CPU engine at every SIMD level of this machine
    #[arg(long)]
    pub every_simd: bool,
    /// Threads of the CPU engine [default: one per core]
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
    /// GPU: index or part of the name (see `planish devices`) [default: the first hardware GPU]
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// Maximum number of points on the GPU at once; larger clouds are smoothed in parts
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1000..))]
    pub points_at_once: Option<u32>,
    /// Maximum number of runs per measurement (stops after 20 s)
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    pub runs: u32,
    /// Print a report as one JSON array
    #[arg(long)]
    pub json: bool,
}
