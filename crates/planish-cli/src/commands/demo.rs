//! `planish demo`: smooths a simulated frame and compares it with the ground truth.

use crate::exit::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result};
use planish::evaluate::{Errors, errors, flat_pixels};
use planish::io::internal::create_output_folder;
use planish::io::write_rgb_png;
use planish::io::{Encoding, write_cloud};
use planish::render::{difference_normals, error_map, relief, side_by_side, stacked};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, Error, Outputs, Session, Smoothed, Xyz};
use planish_bench::outln;

use super::ms_since;
use crate::args::{DemoArgs, by_option};

/// Minimum distance of a flat pixel from every edge, in pixels.
const FLAT_MARGIN_PX: usize = 6;
/// Error at which the error maps reach full colour, in metres.
const ERROR_SCALE_M: f32 = 0.005;
const TIMED_RUNS: usize = 5;

pub fn run(args: &DemoArgs) -> Result<ExitCode> {
    let camera = Camera::kinect_v1();
    let (scene, pose) = Scene::tabletop(args.seed);
    let truth = scene.render(&camera, &pose);
    let mut frame =
        DepthSimulator::new(DepthNoise::default(), camera, args.seed).frame(&truth, 0).map_err(Error::from)?;
    let raw = frame.deproject().map_err(Error::from)?;

    let outputs = Outputs::POINTS.with_normals(true);
    args.smoothing.settings()?.check_no_video().map_err(by_option)?;
    let mut session = Session::new(args.smoothing.settings()?)?;
    session.set_outputs(outputs);
    if let (_, Some(sensor)) = session.params_for(&frame)? {
        args.smoothing.settings()?.preparation().depth(&mut frame, &sensor).map_err(Error::from)?;
    }
    let mut smoothed = Smoothed::default();
    let mut times_ms: Vec<f64> = Vec::new();
    for _ in 0..TIMED_RUNS {
        let start = Instant::now();
        session.smooth(&frame, &mut smoothed)?;
        times_ms.push(ms_since(start));
    }
    times_ms.sort_by(f64::total_cmp);

    create_output_folder(&args.out).with_context(|| format!("cannot create the folder {}", args.out.display()))?;
    write_cloud(&args.out.join("raw.pcd"), &raw, Encoding::Binary)?;
    let mut result = raw.clone();
    result.points.apply(&smoothed, outputs).map_err(Error::from)?;
    write_cloud(&args.out.join("smoothed.pcd"), &result, Encoding::Binary)?;

    let bumps = |points: &Xyz| difference_normals(camera.width, camera.height, points);
    let (raw_normals, smoothed_bumps) = (bumps(raw.positions()), bumps(&smoothed.points));
    let reliefs = [&raw_normals, &smoothed_bumps].map(|normals| relief(camera.width, camera.height, normals));
    let maps = [raw.positions(), &smoothed.points].map(|points| error_map(&truth, points, ERROR_SCALE_M));
    let picture = args.out.join("before-after.png");
    write_rgb_png(&picture, &stacked(side_by_side(&reliefs), &side_by_side(&maps)))?;

    let flat = flat_pixels(&truth, FLAT_MARGIN_PX);
    outln!("A simulated Kinect frame, {}x{}, compared with its truth (flat surfaces):\n", camera.width, camera.height);
    outln!("  range          pixels   distance to the surface (RMS)     mean error of the normal");
    let normals = smoothed.normals.as_ref().unwrap_or(&raw_normals);
    for (near, far) in [(0.5, 1.5), (1.5, 2.5), (2.5, 4.2)] {
        let selected = |i: usize| flat[i] && (near..far).contains(&truth.points.z()[i]);
        let before = errors(&truth, raw.positions(), &raw_normals, selected);
        let after = errors(&truth, &smoothed.points, normals, selected);
        print_row(near, far, before, after);
    }
    outln!("\n  engine {}, {:.1} ms per frame", session.engine().unwrap_or_default().name(), times_ms[TIMED_RUNS / 2]);
    outln!("  {}: relief above, error below (white 0, colour 5 mm), before and after", picture.display());
    outln!("  raw.pcd and smoothed.pcd are in {}", args.out.display());
    Ok(ExitCode::SUCCESS)
}

fn print_row(near: f32, far: f32, before: Errors, after: Errors) {
    if before.pixels == 0 {
        return;
    }
    outln!(
        "  {near:.1} to {far:.1} m  {:>7}   {:6.2} mm -> {:5.2} mm  ({:3.0} %)     {:5.1}° -> {:4.1}°",
        after.pixels,
        1e3 * before.rms_m,
        1e3 * after.rms_m,
        100.0 * after.rms_m / before.rms_m,
        before.mean_normal_deg,
        after.mean_normal_deg,
    );
}
