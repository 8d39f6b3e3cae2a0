//! `planish bench rig`: measures simulated rigs, from depth in memory to the fused cloud in memory.

use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use planish::rig::{Rig, RigCamera, RigSmoother, RigWay};
use planish::simulate::{DepthNoise, DepthSimulator, RigScene};
use planish::{
    Camera, CloudParams, DepthFrame, Error, FleetDevice, Frame, FrameParams, IntoFrame, PointCloud, SensorModel,
    SmootherOptions, Xyz,
};
use serde::Serialize;

use super::timing::Timing;

/// Warm-up time before the first measured moment.
const WARM_UP: Duration = Duration::from_millis(500);
/// Maximum duration of a measurement.
const LONGEST: Duration = Duration::from_secs(20);

/// Options of the rig benchmark.
#[derive(Debug, Clone)]
pub struct RigBenchOptions {
    /// Number of simulated 640x480 cameras around the table.
    pub cameras: usize,
    /// The fusion methods to measure.
    pub ways: Vec<RigWay>,
    /// Size of the voxels to which merged points are thinned, in metres; `None` for all points.
    pub voxel_m: Option<f64>,
    /// Parameters for smoothing merged points.
    pub general_params: CloudParams,
    /// The engine and the outputs.
    pub smoother: SmootherOptions,
    /// The devices that share the cameras; empty to use the device in `smoother`.
    pub devices: Vec<FleetDevice>,
    /// Maximum number of moments per figure; a figure takes at most 20 s.
    pub runs: usize,
    /// True to print the figures as one JSON array.
    pub json: bool,
}

#[derive(Serialize)]
struct Row {
    way: &'static str,
    engine: &'static str,
    points: usize,
    /// Time from the frames of a moment to its fused cloud, one moment at a time.
    one_ms: Timing,
    /// Rate in moments per second, with `in_flight` moments in flight.
    moments_a_second: f64,
    in_flight: usize,
}

/// Measures rigs and prints the figures.
///
/// # Errors
/// If the engine is unavailable, or a fused cloud is wrong.
pub fn run(options: &RigBenchOptions) -> Result<()> {
    let (rig, frames) = simulated(options.cameras)?;
    let views = frames.iter().map(|frame| frame.into_frame().map(Some)).collect::<Result<Vec<_>, _>>();
    let views = views.map_err(Error::from)?;
    let rows = options.ways.iter().map(|&way| measure(way, &rig, &views, options)).collect::<Result<Vec<_>>>()?;
    if options.json {
        crate::outln!("{}", serde_json::to_string(&rows)?);
        return Ok(());
    }
    crate::outln!("{} cameras of 640x480 around a simulated table, default setting", options.cameras);
    crate::outln!(
        "| mode | engine | points | ms per moment | in flight | moments per second |\n|---|---|--:|--:|--:|--:|"
    );
    for Row { way, engine, points, one_ms, moments_a_second, in_flight } in &rows {
        crate::outln!("| {way} | {engine} | {points} | {} | {in_flight} | {moments_a_second:.1} |", one_ms.cell());
    }
    Ok(())
}

/// Returns a simulated rig and one frame from each camera.
fn simulated(cameras: usize) -> Result<(Rig, Vec<DepthFrame>)> {
    let (scene, camera) = (RigScene::tabletop(1, cameras), Camera::kinect_v1());
    let mut placed = Vec::new();
    let mut frames = Vec::new();
    for (i, pose) in scene.poses.iter().enumerate() {
        placed.push(RigCamera::new(&format!("camera{i}"), pose.sensor_pose().map_err(Error::from)?));
        let truth = scene.scene.render(&camera, pose);
        frames
            .push(DepthSimulator::new(DepthNoise::default(), camera, i as u64).frame(&truth, 0).map_err(Error::from)?);
    }
    Ok((Rig::new(placed).map_err(Error::from)?, frames))
}

fn measure(way: RigWay, rig: &Rig, frames: &[Option<Frame<'_>>], options: &RigBenchOptions) -> Result<Row> {
    let params = FrameParams::for_sensor(SensorModel::KINECT_V1, planish::Strength::DEFAULT);
    let params = vec![params; rig.cameras.len()];
    let mut smoother = RigSmoother::new(rig, way, &params, options.general_params, &options.smoother)?
        .with_devices(options.devices.clone())
        .with_voxel_m(options.voxel_m);
    let mut fused = PointCloud::new(Xyz::default());
    let mut one = |smoother: &mut RigSmoother| smoother.next_fused(frames, &mut fused);
    let start = Instant::now();
    while start.elapsed() < WARM_UP {
        one(&mut smoother)?;
    }
    let started = Instant::now();
    let mut moments = 0;
    while moments < options.runs && (moments == 0 || started.elapsed() < LONGEST) {
        one(&mut smoother)?;
        moments += 1;
    }
    let moments_a_second = moments as f64 / started.elapsed().as_secs_f64();
    let in_flight = smoother.in_flight();
    while smoother.receive_fused(&mut fused)? {}
    let (started, mut times) = (Instant::now(), Vec::new());
    while times.len() < options.runs && (times.is_empty() || started.elapsed() < LONGEST) {
        let start = Instant::now();
        smoother.submit_in_place(frames)?;
        smoother.receive_fused(&mut fused)?;
        times.push(1e3 * start.elapsed().as_secs_f64());
    }
    let is_thinned = way == RigWay::Merged && options.voxel_m.is_some();
    check(&fused, frames, if is_thinned { 0 } else { 90 })?;
    Ok(Row {
        way: way.name(),
        engine: smoother.engine().name(),
        points: fused.len(),
        one_ms: Timing::of(times),
        moments_a_second,
        in_flight,
    })
}

/// Checks that a fused cloud has at least `least_percent` % of the points of all cameras, and no holes.
fn check(fused: &PointCloud, frames: &[Option<Frame<'_>>], least_percent: usize) -> Result<()> {
    let measured: usize = frames.iter().flatten().map(Frame::valid_points).sum();
    if fused.is_empty() || 100 * fused.len() < least_percent * measured || fused.valid_points() != fused.len() {
        bail!("the result is wrong, so it is not timed: {} of {measured} points are in the fused cloud", fused.len());
    }
    Ok(())
}
