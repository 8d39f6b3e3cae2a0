//! The table of the CPU engine's speed: settings by SIMD level and threads, medians in milliseconds, each result held
//! against the reference first.
//!
//! `cargo run --release -p planish-tests --example speed_table [FILE.pcd [LEVEL]]`, on a quiet machine; without a
//! file it takes a simulated frame, without a level all that the machine has.

use std::path::Path;
use std::time::Instant;

use planish::agreement::{Agreement, radii_m};
use planish::{
    Camera, Engine, OrganizedCloud, Outputs, Radius, SimdLevel, SmoothParams, Smoothed, Smoother, SmootherOptions,
};
use planish_tests::engines::TestEngine;
use planish_tests::scenes::simulated;

const RUNS: usize = 41;

fn main() -> Result<(), planish::Error> {
    let cloud = match std::env::args().nth(1) {
        Some(file) => OrganizedCloud::read(Path::new(&file))?,
        None => simulated(1, true, Camera::kinect_v1()),
    };
    let only = std::env::args().nth(2);
    let fixed = Radius::Fixed { radius_m: 0.03 };
    let setting = |window, stride, degree, radius| {
        SmoothParams::paper().with_window(window).with_stride(stride).with_radius(radius).with_degree(degree)
    };
    let settings = [
        setting(3, 1, 3, fixed),
        setting(3, 3, 2, Radius::Sensor),
        setting(1, 1, 2, fixed),
        setting(7, 1, 3, fixed),
        setting(3, 1, 1, fixed),
    ];
    println!("{}x{}, {} points, median of {RUNS}", cloud.width(), cloud.height(), cloud.points.valid_points());
    println!("| window, stride, degree | level | threads | points only, ms | all outputs, ms |\n|---|---|---|---|---|");
    for params in settings {
        let reference = TestEngine::REFERENCE.smooth(&cloud, params);
        for level in SimdLevel::available().filter(|level| only.as_ref().is_none_or(|only| only == level.name())) {
            let mut agreement = Agreement::default();
            let radii_m = radii_m(&cloud, params);
            agreement.add(&TestEngine::cpu(level).smooth(&cloud, params), &reference, |i| radii_m[i]);
            let misses = agreement.misses();
            assert!(misses.is_empty(), "a wrong result is not timed: {misses:?}");
            for threads in [1, 2] {
                let time = |outputs| median_ms(&cloud, params, level, threads, outputs);
                println!(
                    "| {}, {}, {} | {} | {threads} | {:.2} | {:.2} |",
                    params.window,
                    params.stride,
                    params.degree,
                    level.name(),
                    time(Outputs::POINTS)?,
                    time(Outputs::ALL)?
                );
            }
        }
    }
    Ok(())
}

fn median_ms(
    cloud: &OrganizedCloud,
    params: SmoothParams,
    level: SimdLevel,
    threads: usize,
    outputs: Outputs,
) -> Result<f64, planish::Error> {
    let options = SmootherOptions::default()
        .with_engine(Engine::Cpu)
        .with_outputs(outputs)
        .with_threads(Some(threads))
        .with_simd(Some(level));
    let mut smoother = Smoother::open_with(params, &options, (cloud.width(), cloud.height()))?;
    let mut smoothed = Smoothed::default();
    let mut times = Vec::new();
    for _ in 0..RUNS {
        let start = Instant::now();
        smoother.smooth(cloud, &mut smoothed)?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok(times[RUNS / 2])
}
