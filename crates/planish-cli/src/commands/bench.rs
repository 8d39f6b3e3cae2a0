//! `planish bench`: arguments and frames for the experiments.

use crate::exit::ExitCode;
use std::path::PathBuf;

use anyhow::{Result, bail};
use planish::io::{Contents, Work};
use planish::{CloudRadius, DepthFrame, Engine, Error, FleetDevice, GpuOptions, Outputs, SmootherOptions};
use planish_bench::{Ended, Experiment, GeneralOptions, GpuBenchOptions, Input, Options, RigBenchOptions};

use super::{organized, read_within};
use crate::args::{
    BenchArgs, BenchCommand, BenchGeneralArgs, BenchGpuArgs, BenchRigArgs, EdgesArg, EngineArg, ExperimentArgs,
    params_of_voxels,
};
use crate::signals::stop_flag;

pub fn run(args: &BenchArgs) -> Result<ExitCode> {
    let (args, experiments) = match &args.what {
        BenchCommand::Gpu(args) => return run_gpu(args),
        BenchCommand::General(args) => return run_general(args),
        BenchCommand::Rig(args) => return run_rig(args),
        BenchCommand::Speedup(args) => (args, &[Experiment::Speedup][..]),
        BenchCommand::Connectivity(args) => (args, &[Experiment::Connectivity][..]),
        BenchCommand::Scaleup(args) => (args, &[Experiment::Scaleup][..]),
        BenchCommand::Profile(args) => (args, &[Experiment::Profile][..]),
        BenchCommand::Quality(args) => (args, &[Experiment::Quality][..]),
        BenchCommand::Simd(args) => (args, &[Experiment::Simd][..]),
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
    let makes_copies = experiments.contains(&Experiment::Scaleup);
    let inputs = inputs(args, if makes_copies { Work::BenchCopies } else { Work::Bench })?;
    let stop = stop_flag();
    Ok(match planish_bench::run(experiments, &options, inputs, &stop)? {
        Ended::Whole => ExitCode::SUCCESS,
        Ended::Interrupted => ExitCode::from(130),
    })
}

fn run_gpu(args: &BenchGpuArgs) -> Result<ExitCode> {
    let named = |path: &PathBuf| match read_within(&args.memory, Work::Bench, path)? {
        Contents::Organized(cloud) => Ok((path.display().to_string(), cloud)),
        _ => bail!("{}: not an organized cloud; this benchmark needs points on a grid", path.display()),
    };
    let input = args.input.as_ref().map(named).transpose()?;
    let devices = args.gpus.devices(Engine::Gpu)?;
    let first = devices.iter().find_map(|device| match device {
        FleetDevice::Gpu(adapter) => Some(adapter.clone()),
        _ => None,
    });
    let options = GpuBenchOptions {
        input,
        adapter: args.adapter.clone().or(first),
        devices,
        only_devices: args.only_devices,
        runs: args.runs,
        json: args.json,
    };
    planish_bench::run_gpu(&options)?;
    Ok(ExitCode::SUCCESS)
}

fn run_rig(args: &BenchRigArgs) -> Result<ExitCode> {
    let engine = args.engine.engine();
    if args.adapter.is_some() && engine != Engine::Gpu {
        bail!("--adapter needs --engine gpu");
    }
    let gpu = GpuOptions::default().with_adapter(args.adapter.clone()).with_bounds_checks(false);
    let general_params = params_of_voxels(args.voxel)?;
    let general_params = args.radius.iter().fold(general_params, |params, &radius_m| params.with_radius_m(radius_m));
    let general_params = general_params.with_edges(args.edges.map_or(general_params.fit.edges, EdgesArg::edges));
    planish_bench::run_rig(&RigBenchOptions {
        cameras: args.cameras.into(),
        ways: args.fuse.iter().map(|&way| way.into()).collect(),
        voxel_m: args.voxel,
        general_params,
        smoother: SmootherOptions::new(engine, Outputs::POINTS).with_gpu(gpu),
        devices: args.gpus.devices(engine)?,
        runs: args.runs as usize,
        json: args.json,
    })?;
    Ok(ExitCode::SUCCESS)
}

fn run_general(args: &BenchGeneralArgs) -> Result<ExitCode> {
    let cloud = |path: &PathBuf| {
        let cloud = match read_within(&args.memory, Work::Smooth, path)? {
            Contents::Organized(cloud) => cloud.points,
            Contents::General(cloud) => cloud,
            _ => bail!(
                "{}: this is a depth image, but the benchmark needs a cloud; use `planish bench speedup`",
                path.display()
            ),
        };
        Ok((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), cloud))
    };
    let radius = |&radius_m: &f32| match radius_m {
        0.0 => CloudRadius::Neighbours { count: args.neighbours },
        _ => CloudRadius::Fixed { radius_m },
    };
    let mut scans: Vec<usize> = args.points.iter().map(|&points| points as usize).collect();
    if args.input.is_empty() && scans.is_empty() {
        scans = vec![100_000, 1_000_000];
    }
    planish_bench::run_general(&GeneralOptions {
        clouds: args.input.iter().map(cloud).collect::<Result<_>>()?,
        scans,
        radii: if args.radius.is_empty() { vec![radius(&0.0)] } else { args.radius.iter().map(radius).collect() },
        degree: args.degree,
        edges: args.edges.edges(),
        engines: args.engine.iter().copied().map(EngineArg::engine).collect(),
        every_simd: args.every_simd,
        threads: args.threads,
        adapter: args.adapter.clone(),
        points_at_once: args.points_at_once.map(|points| points as usize),
        runs: args.runs as usize,
        json: args.json,
    })?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the given frames; by default, a simulated room and a simulated table.
fn inputs(args: &ExperimentArgs, work: Work) -> Result<Vec<Input>> {
    let of_file = |(index, file): (usize, &PathBuf)| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match read_within(&args.memory, work, file)? {
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
