//! `planish evaluate --fill`: measures how well holes are filled.

use std::path::Path;

use anyhow::{Context, Result, bail};
use planish::evaluate::{FillEvaluation, FillReport, HoleReport, Suite, cut_holes, hole_mask};
use planish::io::internal::create_output_folder;
use planish::io::{self, Contents};
use planish::simulate::DepthNoise;
use planish::{Camera, DepthImage, Error, Outputs, Session, Settings, Smoothed, Xyz};
use planish_bench::outln;
use serde::Serialize;

use super::{percent, read_measured, sensor_of};
use crate::args::EvaluateArgs;
use crate::commands::organized;
use crate::exit::ExitCode;

/// Seed for the positions of the holes that are cut into the frame of a file.
const SEED_OF_FILE: u64 = 1;

#[derive(Serialize)]
struct Filling {
    /// The name of the file, or of the sensor of the simulated frames.
    name: String,
    width_px: u32,
    #[serde(flatten)]
    report: FillReport,
}

/// Measures how well holes up to `width_px` pixels wide are filled, in simulated frames or in a file.
pub(super) fn evaluate(args: &EvaluateArgs, width_px: u32) -> Result<ExitCode> {
    if args.general || args.out.is_some() {
        bail!("--fill cannot be combined with --general or --out");
    }
    let (name, report) = match &args.input {
        Some(file) => (file.display().to_string(), of_file(args, file, width_px)?),
        None => match of_suite(args, width_px)? {
            Some(report) => (sensor_of(args)?.name().unwrap_or("simulated").to_owned(), report),
            None => return Ok(ExitCode::SUCCESS),
        },
    };
    let filling = Filling { name, width_px, report };
    if args.json {
        outln!("{}", serde_json::to_string(&filling)?);
    } else {
        print(&filling, args.input.is_none());
    }
    Ok(ExitCode::SUCCESS)
}

/// Measures how well holes cut into simulated frames are filled; returns `None` if the frames are exported.
fn of_suite(args: &EvaluateArgs, width_px: u32) -> Result<Option<FillReport>> {
    let suite = Suite { noise: DepthNoise::of_sensor(&sensor_of(args)?), ..Suite::default() };
    let seeds = args.seed.map_or(1..=args.seeds, |seed| seed..=seed);
    let mut session = session(args.smoothing.settings()?)?;
    let (mut filling, mut smoothed) = (FillEvaluation::default(), Smoothed::default());
    if let Some(folder) = &args.export {
        create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    }
    for seed in seeds {
        for case in suite.cases(seed).map_err(Error::from)? {
            let mut frame = case.frame.clone();
            let cut = cut_holes(&mut frame, width_px, seed);
            if let Some(folder) = &args.export {
                let Camera { width, height, .. } = frame.camera;
                let image = DepthImage { width, height, raw: frame.raw };
                io::write_depth(&folder.join(format!("{}.png", case.name)), &image)?;
                continue;
            }
            match args.results.first() {
                Some(folder) => {
                    let depth_m = result_in(args, folder, &case.name, &frame.camera)?;
                    filling.add(&case.truth, &frame, &cut, &depth_m, None);
                }
                None => {
                    session.smooth(&frame, &mut smoothed)?;
                    filling.add(&case.truth, &frame, &cut, smoothed.points.z(), smoothed.sigma.as_deref());
                }
            }
        }
    }
    Ok(args.export.is_none().then(|| filling.report()))
}

/// Reads another program's result: a depth image in millimetres, depth in metres (.npy), or an organized cloud.
fn result_in(args: &EvaluateArgs, folder: &Path, name: &str, camera: &Camera) -> Result<Vec<f32>> {
    let files = ["png", "tiff", "npy", "pcd", "ply"].map(|extension| folder.join(format!("{name}.{extension}")));
    let file = files.iter().find(|file| file.exists());
    let file = file.with_context(|| {
        format!("{}: no result for this frame; expected {name}.png, .tiff, .npy, .pcd or .ply", folder.display())
    })?;
    let contents = read_measured(&args.memory, file)?;
    if contents.shape() != (camera.width, camera.height) {
        bail!("{}: the size differs from the frame's; expected {}x{}", file.display(), camera.width, camera.height);
    }
    Ok(match contents {
        Contents::Depth(image) => image.raw.iter().map(|&raw| camera.depth_m(raw)).collect(),
        Contents::DepthMetres { depth_m, .. } => depth_m,
        contents => contents.into_organized(Some(camera))?.points.positions.z().to_vec(),
    })
}

/// Measures how well holes cut into the frame of a file are filled. The truth is the result of smoothing the frame
/// without cut holes.
fn of_file(args: &EvaluateArgs, file: &Path, width_px: u32) -> Result<FillReport> {
    let mut cloud = organized(read_measured(&args.memory, file)?, &args.camera, file)?;
    let settings = args.smoothing.settings()?;
    let mut whole = settings.clone();
    whole.fill = None;
    let (mut known, mut smoothed) = (Smoothed::default(), Smoothed::default());
    session(whole)?.smooth(&cloud, &mut known)?;
    let cut = hole_mask((cloud.width(), cloud.height()), width_px, SEED_OF_FILE);
    for i in (0..cut.len()).filter(|&i| cut[i]) {
        cloud.points.positions.set(i, [f32::NAN; 3]);
    }
    session(settings)?.smooth(&cloud, &mut smoothed)?;
    let depth_m = |points: &Xyz| points.z().to_vec();
    let known_m: Vec<f32> =
        depth_m(&known.points).iter().zip(&cut).map(|(z_m, cut)| if *cut { *z_m } else { f32::NAN }).collect();
    let mut filling = FillEvaluation::default();
    filling.add_known(&known_m, smoothed.points.z(), smoothed.sigma.as_deref());
    Ok(filling.report())
}

fn session(settings: Settings) -> Result<Session> {
    let mut session = Session::new(settings)?;
    session.set_outputs(Outputs::POINTS.with_sigma(true));
    Ok(session)
}

fn print(filling: &Filling, is_simulated: bool) {
    let Filling { name, width_px, report } = filling;
    outln!("{name}: holes up to {width_px} pixels wide\n");
    outln!(
        "                              pixels   filled   RMS, mm   median   wrong surface   within 1, 2 sigma   over 3"
    );
    let line = |name: &str, of: &HoleReport| {
        let HoleReport { pixels, filled, rms_mm, median_mm, wrong, within_one, within_two, over_three, .. } = *of;
        let [filled, wrong, one, two, over] = [filled, wrong, within_one, within_two, over_three].map(percent);
        outln!(
            "  {name:<26}{pixels:>8}{filled:>9}{rms_mm:>10.1}{median_mm:>9.1}{wrong:>16}{one:>11}, {two:<7}{over:>8}"
        );
    };
    match is_simulated {
        false => line("cut", &report.cut),
        true => {
            line("cut, away from steps", &report.cut);
            line("cut, within 3 px of a step", &report.cut_near_steps);
            line("of the sensor", &report.own);
        }
    }
}
