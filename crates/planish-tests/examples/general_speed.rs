//! Times a general cloud on the CPU engine with every instruction set of this machine, points and normals out:
//! `cargo run --release -p planish-tests --example general_speed FILE.pcd RADIUS_M|NEIGHBOURSn DEGREE THREADS RUNS`, as
//! `scan.pcd 0.03 2 2 9` or `scan.pcd 40n 2 2 9`. Points on a grid are taken without it.

use std::path::Path;
use std::time::Instant;

use planish::io::{self, Contents};
use planish::{Engine, Outputs, PointsView, Radius, SimdLevel, SmoothParams, Smoothed, Smoother, SmootherOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [file, radius, degree, threads, runs] = &args[..] else {
        return Err("usage: general_speed FILE RADIUS_M|NEIGHBOURSn DEGREE THREADS RUNS".into());
    };
    let cloud = match io::read(Path::new(file))?.1 {
        Contents::Organized(cloud) => cloud.points,
        Contents::General(cloud) => cloud,
        _ => return Err("a cloud is needed".into()),
    };
    let radius = match radius.strip_suffix('n') {
        Some(count) => Radius::Neighbours { count: count.parse()? },
        None => Radius::Fixed { radius_m: radius.parse()? },
    };
    let params = SmoothParams::general().with_radius(radius).with_degree(degree.parse()?);
    for simd in SimdLevel::available() {
        let options = SmootherOptions::new(Engine::Cpu, Outputs::POINTS.with_normals(true))
            .with_threads(Some(threads.parse()?))
            .with_simd(Some(simd));
        let mut smoother = Smoother::open_with(params, &options, None)?;
        let mut smoothed = Smoothed::default();
        let mut times_ms = Vec::new();
        for _ in 0..runs.parse::<usize>()?.max(1) {
            let start = Instant::now();
            smoother.smooth(PointsView::from_cloud(&cloud)?, &mut smoothed)?;
            times_ms.push(1e3 * start.elapsed().as_secs_f64());
        }
        times_ms.sort_by(f64::total_cmp);
        println!("{} {:.1} ms, {} points", simd.name(), times_ms[times_ms.len() / 2], cloud.valid_points());
    }
    Ok(())
}
