//! `planish evaluate --rig`: compares the methods of smoothing rigs, on simulated rigs.

use crate::args::{EvaluateArgs, by_option};
use crate::commands::status_line::ms;
use crate::exit::ExitCode;
use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::evaluate::{RigCaseCamera, RigEvaluation, RigReport, RigSuite};
use planish::rig::{Rig, RigCamera, RigSmoother, RigWay, Viewpoint};
use planish::simulate::DepthNoise;
use planish::{FrameError, IntoFrame, Outputs};
use planish_bench::{out, outln};
use serde::Serialize;
use std::time::{Duration, Instant};

/// Report on one method on the simulated rigs.
#[derive(Serialize)]
struct Row {
    name: &'static str,
    #[serde(flatten)]
    report: RigReport,
    /// Mean time per moment in milliseconds; `None` for raw frames.
    moment_ms: Option<f64>,
}

/// Compares the methods of smoothing rigs, on simulated rigs.
pub fn evaluate(args: &EvaluateArgs, cameras: usize) -> Result<ExitCode> {
    let params = args.smoothing.settings()?.frame_params().map_err(by_option)?;
    let errors = args.pose_errors.map(|errors| errors.0).unwrap_or_default();
    let suite = RigSuite { errors, noise: DepthNoise::of_sensor(&params.sensor), ..RigSuite::new(cameras) };
    let seeds = args.seed.map_or(1..=args.seeds, |seed| seed..=seed);
    let bar = ProgressBar::new(seeds.end() - seeds.start() + 1)
        .with_style(ProgressStyle::with_template("{bar:30} seed {pos} of {len}, {eta} left")?);
    let mut raw = RigEvaluation::default();
    let mut ways = RigWay::ALL.map(|way| (way, RigEvaluation::default(), Duration::ZERO));
    let options = args.smoothing.options(Outputs::POINTS)?;
    let general_params = args.smoothing.merged_params(args.voxel)?;
    let mut moments = 0;
    for seed in seeds {
        let case = suite.case(seed).map_err(planish::Error::from)?;
        let deproject =
            |camera: &RigCaseCamera| Ok(camera.frame.deproject().map_err(planish::Error::from)?.points.positions);
        raw.add(&case, &case.cameras.iter().map(deproject).collect::<Result<Vec<_>>>()?);
        let camera = |(i, camera): (usize, &RigCaseCamera)| {
            Ok(RigCamera::new(&format!("camera{i}"), camera.stated.sensor_pose()?))
        };
        let placed = case.cameras.iter().enumerate().map(camera).collect::<Result<_, FrameError>>();
        let mut rig = Rig::new(placed.map_err(planish::Error::from)?).map_err(planish::Error::from)?;
        if args.between {
            let side_by_side = rig.cameras.windows(2);
            let between = side_by_side.map(|two| Viewpoint::between(&two[0].pose, &two[1].pose, suite.camera));
            let between = between.collect::<Result<_, _>>().map_err(planish::Error::from)?;
            rig = rig.with_viewpoints(between);
        }
        let frames = case.cameras.iter().map(|camera| camera.frame.into_frame().map(Some));
        let frames = frames.collect::<Result<Vec<_>, _>>().map_err(planish::Error::from)?;
        moments += 1;
        for (way, evaluation, time) in &mut ways {
            let mut smoother = RigSmoother::new(&rig, *way, &vec![params; cameras], general_params, &options)?
                .with_voxel_m(args.voxel);
            // An additional, untimed run opens the engines.
            if *way != RigWay::Merged {
                smoother.smooth(&frames)?;
            }
            let start = Instant::now();
            let results = smoother.smooth(&frames)?;
            *time += start.elapsed();
            let points = results.into_iter().map(|result| match result {
                Some(result) => Ok(result.map_err(planish::Error::from)?.points),
                None => bail!("a camera has no result"),
            });
            evaluation.add(&case, &points.collect::<Result<Vec<_>>>()?);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let row = |(way, evaluation, time): &(RigWay, RigEvaluation, Duration)| Row {
        name: way.name(),
        report: evaluation.report(),
        moment_ms: Some(ms(*time) / f64::from(moments)),
    };
    let raw = Row { name: "raw", report: raw.report(), moment_ms: None };
    let rows: Vec<Row> = std::iter::once(raw).chain(ways.iter().map(row)).collect();
    if args.json {
        outln!("{}", serde_json::to_string(&rows)?);
    } else {
        print_rows(&rows);
    }
    Ok(ExitCode::SUCCESS)
}

fn print_rows(rows: &[Row]) {
    let line = |name: &str, value: &dyn Fn(&Row) -> String| {
        out!("  {name:<52}");
        rows.iter().for_each(|row| out!("{:>10}", value(row)));
        outln!();
    };
    line("", &|row| row.name.to_owned());
    outln!("surfaces at 0.5 to 1.5 m");
    line("seen by several: distance to the truth, RMS, mm", &|row| format!("{:.2}", row.report.overlap_rmse_mm));
    line("  facets of adjacent pixels, mean error", &|row| format!("{:.1}°", row.report.overlap_facet_deg));
    line("seen by one: distance to the truth, RMS, mm", &|row| format!("{:.2}", row.report.single_rmse_mm));
    line("  facets of adjacent pixels, mean error", &|row| format!("{:.1}°", row.report.single_facet_deg));
    line("distance between two cameras' surfaces, RMS, mm", &|row| format!("{:.2}", row.report.ghosting_mm));
    line("within 3 px of a step: distance, mean, mm", &|row| format!("{:.2}", row.report.edge_mean_mm));
    line("measured, but lost", &|row| format!("{:.2} %", 100.0 * row.report.lost_share));
    line("time per moment, ms", &|row| row.moment_ms.map_or("-".to_owned(), |ms| format!("{ms:.1}")));
}
