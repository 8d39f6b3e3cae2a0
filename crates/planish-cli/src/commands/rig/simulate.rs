//! `planish rig --simulate`: writes the data sets of a simulated rig.

use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, bail};
use planish::io::internal::create_output_folder;
use planish::rig::{Rig, RigCamera, rig_to_json};
use planish::simulate::{DepthNoise, DepthSimulator, RigScene};
use planish::source::TumRecorder;
use planish::{Camera, SensorModel, io};
use planish_bench::outln;

use crate::args::RigArgs;
use crate::exit::ExitCode;
use crate::signals::{INTERRUPTED, stop_flag};

/// Simulates a rig: writes a data set for each camera, and rig.json.
pub fn simulate(args: &RigArgs, cameras: usize, folder: &Path) -> Result<ExitCode> {
    if fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
        bail!("{}: the folder is not empty; choose a new or an empty folder for a simulated rig", folder.display());
    }
    let is_new = !folder.exists();
    create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    let written = write(args, cameras, folder);
    if is_new && !matches!(written, Ok(ExitCode::SUCCESS)) {
        // This fails without harm if a data set was already moved to its final name.
        let _ = fs::remove_dir(folder);
    }
    written
}

/// Writes the data sets to a temporary folder, then moves them to their final names and writes rig.json.
fn write(args: &RigArgs, cameras: usize, folder: &Path) -> Result<ExitCode> {
    let scene = RigScene::tabletop(args.seed, cameras);
    let errors = args.pose_errors.map(|errors| errors.0).unwrap_or_default();
    let stated = scene.poses_with_errors(errors, args.seed);
    let partial = tempfile::Builder::new().prefix(".planish-rig-").tempdir_in(folder);
    let partial = partial.with_context(|| format!("cannot create a folder in {}", folder.display()))?;
    let stop = stop_flag();
    let camera = Camera::kinect_v1();
    let mut rig_cameras = Vec::new();
    for (i, (pose, stated)) in scene.poses.iter().zip(&stated).enumerate() {
        let name = format!("camera{i}");
        let simulator = DepthSimulator::new(DepthNoise::default(), camera, args.seed * 100 + i as u64);
        let truth = scene.scene.render(&camera, pose);
        let mut recorder = TumRecorder::create(&partial.path().join(&name))?;
        for number in 0..args.frames {
            if stop.load(Ordering::Relaxed) {
                return Ok(ExitCode::from(INTERRUPTED));
            }
            let frame = simulator.frame(&truth, number).map_err(planish::Error::from)?;
            recorder.add(&frame.with_timestamp_s(number as f64 / 30.0))?;
        }
        let placed =
            RigCamera::new(&name, stated.sensor_pose().map_err(planish::Error::from)?).with_source(Some(name.clone()));
        rig_cameras.push(placed.with_sensor(Some(SensorModel::KINECT_V1)));
    }
    let rig = Rig::new(rig_cameras).map_err(planish::Error::from)?;
    for camera in &rig.cameras {
        let (from, to) = (partial.path().join(&camera.name), folder.join(&camera.name));
        fs::rename(from, &to).with_context(|| format!("cannot create {}", to.display()))?;
    }
    let file = folder.join("rig.json");
    io::write_whole(&file, rig_to_json(&rig).as_bytes()).with_context(|| file.display().to_string())?;
    outln!(
        "{cameras} cameras, {} frames each, in {}; planish stream --rig {}",
        args.frames,
        folder.display(),
        file.display()
    );
    Ok(ExitCode::SUCCESS)
}
