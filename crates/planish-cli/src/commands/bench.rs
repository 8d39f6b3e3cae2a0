//! `planish bench`: arguments and frames for the experiments.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use planish::io::{self, Contents};
use planish::{DepthFrame, Error, OrganizedCloud};
use planish_bench::{Ended, Experiment, GpuBenchOptions, Input, Options};

use super::organized;
use crate::args::{BenchArgs, BenchCommand, BenchGpuArgs, EngineArg, ExperimentArgs};
use crate::signals::stop_flag;

pub fn run(args: &BenchArgs) -> Result<ExitCode> {
    let (args, experiments) = match &args.what {
        BenchCommand::Gpu(args) => return run_gpu(args),
        BenchCommand::Speedup(args) => (args, &[Experiment::Speedup][..]),
        BenchCommand::Connectivity(args) => (args, &[Experiment::Connectivity][..]),
        BenchCommand::Scaleup(args) => (args, &[Experiment::Scaleup][..]),
        BenchCommand::Profile(args) => (args, &[Experiment::Profile][..]),
        BenchCommand::Quality(args) => (args, &[Experiment::Quality][..]),
        BenchCommand::All(args) => (args, &Experiment::ALL[..]),
    };
    let options = Options {
        engines: args.engine.iter().copied().map(EngineArg::engine).collect(),
        quick: args.quick,
        out: args.out.clone(),
        update: args.update.clone(),
        version: env!("PLANISH_VERSION"),
        rustc: env!("PLANISH_RUSTC"),
    };
    let inputs = inputs(args)?;
    let stop = stop_flag();
    Ok(match planish_bench::run(experiments, &options, inputs, &stop)? {
        Ended::Whole => ExitCode::SUCCESS,
        Ended::Interrupted => ExitCode::from(130),
    })
}

fn run_gpu(args: &BenchGpuArgs) -> Result<ExitCode> {
    let cloud = args.input.as_ref().map(|path| OrganizedCloud::read(path)).transpose().map_err(Error::from)?;
    let input = cloud.zip(args.input.as_ref()).map(|(cloud, path)| (path.display().to_string(), cloud));
    let options = GpuBenchOptions { input, adapter: args.adapter.clone(), runs: args.runs, json: args.json };
    planish_bench::run_gpu(&options)?;
    Ok(ExitCode::SUCCESS)
}

/// The frames that the user gave, or a simulated room and a simulated table.
fn inputs(args: &ExperimentArgs) -> Result<Vec<Input>> {
    let of_file = |(index, file): (usize, &PathBuf)| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match io::read(file)?.1 {
            Contents::Depth(image) => {
                let camera = args.camera.required((image.width, image.height), file)?;
                Input::of_depth(index, name, DepthFrame::from_image(camera, image).map_err(Error::from)?)
            }
            contents => Ok(Input::of_cloud(index, name, organized(contents, &args.camera, file)?)),
        }
    };
    if args.input.is_empty() {
        return planish_bench::simulated_inputs();
    }
    args.input.iter().enumerate().map(of_file).collect()
}
