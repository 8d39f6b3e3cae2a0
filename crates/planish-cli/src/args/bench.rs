//! The arguments of `planish bench`.

use std::path::PathBuf;

use clap::Subcommand;

use super::{CameraArgs, EngineArg};

#[derive(clap::Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    pub what: BenchCommand,
}

#[derive(Subcommand)]
pub enum BenchCommand {
    /// The GPU engine: its kernels, one frame at a time, frames in flight, batches
    Gpu(BenchGpuArgs),
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
    /// Frames: organized clouds, or depth images with --camera; else the depth of a simulated room and a simulated table
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
    /// Frames for each figure
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(2..))]
    pub runs: u32,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}
