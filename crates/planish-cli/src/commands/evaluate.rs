//! `planish evaluate`: measures the quality of smoothed surfaces.

mod filling;
mod print;
mod sequence;

use crate::exit::ExitCode;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::evaluate::{
    Calibration, CalibrationReport, Case, Evaluation, PatchReport, Report, Suite, TileReport, jitter_mm, patch_planes,
    tile_planes,
};
use planish::io::internal::create_output_folder;
use planish::io::write_rgb_png;
use planish::io::{self, Contents, Encoding, write_cloud, write_whole};
use planish::render::{difference_normals, error_map, normals_of, side_by_side};
use planish::simulate::DepthNoise;
use planish::{
    AttributeValues, CloudParams, DepthFrame, Error, Frame, FrameParams, GridChoice, IntoFrame, Outputs, PointCloud,
    PointsView, SensorModel, Session, Settings, Smoothed, Strength, Xyz,
};
use planish_bench::{errln, outln};
use serde::Serialize;

use self::print::{draw_error_over_z, percent, print};
use super::{ms_since, organized, read_within};
use crate::args::{EvaluateArgs, MemoryArgs, SmoothingArgs, by_option, option_of};

/// Error at which the error maps reach full colour, in metres.
const ERROR_SCALE_M: f32 = 0.01;
/// Name of the method to compare with: the setting of the 2011 report.
const PAPER: &str = "paper";

/// Result of a method on the suite.
#[derive(Serialize)]
struct Row {
    name: String,
    #[serde(flatten)]
    report: Report,
    /// Share of points within one and two of their stated standard errors.
    calibration: Option<Vec<CalibrationReport>>,
    /// Root mean square of the deviations over several frames of a still scene, in millimetres.
    jitter_mm: Option<f64>,
    /// Median time per frame, in milliseconds.
    frame_ms: Option<f64>,
}

#[derive(Serialize)]
struct Tiles {
    file: String,
    raw: TileReport,
    smoothed: TileReport,
}

#[derive(Serialize)]
struct Patches {
    file: String,
    raw: PatchReport,
    smoothed: PatchReport,
}

pub fn run(args: &EvaluateArgs) -> Result<ExitCode> {
    if let Some(videos) = args.sequence {
        return sequence::evaluate(args, videos);
    }
    if args.poses.are_given() || args.frames.is_some() {
        bail!("--poses, --pose-topic and --frames apply only to evaluate --sequence");
    }
    if args.results.len() > 1 {
        bail!("--results can be given more than once only with --sequence");
    }
    if let (Some(_), Some(_)) = (&args.input, args.export.as_ref().or(args.out.as_ref())) {
        bail!("--input cannot be combined with --export or --out, which apply to simulated frames");
    }
    args.smoothing.settings()?.check_no_video().map_err(by_option)?;
    if args.smoothing.settings()?.devices.is_some() && args.rig.is_none() {
        bail!("devices has no effect on evaluate, which smooths one frame at a time; use engine and adapter");
    }
    if let Some(width_px) = args.smoothing.settings()?.fill.filter(|_| args.rig.is_none()) {
        return filling::evaluate(args, width_px);
    }
    match (&args.input, args.rig) {
        (Some(file), _) => on_file(args, file),
        (None, Some(cameras)) => super::rig::evaluate(args, cameras.into()),
        (None, None) => {
            if args.smoothing.settings()?.decimate.is_some() {
                bail!(
                    "--decimate cannot be used with simulated frames, which are compared pixel by pixel with the truth"
                );
            }
            on_suite(args)
        }
    }
}

/// Evaluates a real frame, whose truth is unknown.
fn on_file(args: &EvaluateArgs, file: &Path) -> Result<ExitCode> {
    let contents = read_measured(&args.memory, file)?;
    if let Contents::General(cloud) = &contents {
        return on_general(args, file, cloud);
    }
    let mut cloud = organized(contents, &args.camera, file)?;
    let outputs = Outputs::POINTS.with_normals(true);
    let mut session = Session::new(args.smoothing.settings()?)?;
    session.set_outputs(outputs);
    if let (_, Some(sensor)) = session.params_for(&cloud)? {
        args.smoothing.settings()?.preparation().cloud(&mut cloud, &sensor).map_err(Error::from)?;
    }
    let (width, height) = (cloud.width(), cloud.height());
    let (points, normals) = match args.results.first() {
        Some(result) => result_in(args, result, (width, height))?,
        None => {
            let mut smoothed = Smoothed::default();
            session.smooth(&cloud, &mut smoothed)?;
            (smoothed.points, smoothed.normals.context("normals were requested")?)
        }
    };
    let tiles = |points: &Xyz, normals: &Xyz| tile_planes(&cloud, points, normals);
    let differences = difference_normals(width, height, cloud.positions());
    let report = Tiles {
        file: file.display().to_string(),
        raw: tiles(cloud.positions(), &differences),
        smoothed: tiles(&points, &normals),
    };
    if report.raw.tiles == 0 {
        bail!("{}: no block of 8x8 pixels is on one surface, so flatness cannot be measured", report.file);
    }
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
        return Ok(ExitCode::SUCCESS);
    }
    outln!("{}: {} tiles of 8x8 pixels without a step\n", report.file, report.raw.tiles);
    outln!("            median RMS distance   mean angle to its normal: points   facets    facets over 30°");
    for (name, tiles) in [("raw", report.raw), ("smoothed", report.smoothed)] {
        let (rms_mm, specks) = (tiles.rms_mm, percent(tiles.speck_share));
        outln!("  {name:<9} {rms_mm:16.2} mm {:33.1}° {:7.1}° {specks:>18}", tiles.normal_deg, tiles.facet_deg);
    }
    Ok(ExitCode::SUCCESS)
}

/// Evaluates a real unorganized cloud.
fn on_general(args: &EvaluateArgs, file: &Path, cloud: &PointCloud) -> Result<ExitCode> {
    let (points, normals) = match args.results.first() {
        Some(result) => {
            let Contents::General(other) = read_measured(&args.memory, result)? else {
                bail!(
                    "{}: the cloud has a grid, but {} is an unorganized cloud; both must be unorganized",
                    result.display(),
                    file.display()
                );
            };
            if other.len() != cloud.len() {
                let counts = format!("{} points but {} has {}", other.len(), file.display(), cloud.len());
                bail!(
                    "{}: the cloud has {counts}; both must contain the same points in the same order",
                    result.display()
                );
            }
            let normals = normals_field(&other);
            (moved_to_origin(&other, cloud.origin_m), normals)
        }
        None => {
            let settings = general_settings(args, &file.display().to_string())?;
            let options = args.smoothing.options(Outputs::POINTS.with_normals(true))?;
            let mut smoothed = Smoothed::default();
            Session::new(settings)?.with_options(options).smooth(cloud, &mut smoothed)?;
            (smoothed.points, smoothed.normals)
        }
    };
    let report = Patches {
        file: file.display().to_string(),
        raw: patch_planes(cloud, &cloud.positions, normals_field(cloud).as_ref())?,
        smoothed: patch_planes(cloud, &points, normals.as_ref())?,
    };
    if report.raw.patches == 0 {
        bail!("{}: no patch of 64 adjacent points is on one surface, so flatness cannot be measured", report.file);
    }
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
        return Ok(ExitCode::SUCCESS);
    }
    outln!("{}: {} patches of 64 points on one surface\n", report.file, report.raw.patches);
    outln!("            median RMS distance   mean angle of the points' normals to the patch's");
    for (name, patches) in [("raw", report.raw), ("smoothed", report.smoothed)] {
        let normal = if patches.normal_deg.is_nan() { "-".to_owned() } else { format!("{:.1}°", patches.normal_deg) };
        outln!("  {name:<9} {:16.3} mm {normal:>33}", patches.rms_mm);
    }
    Ok(ExitCode::SUCCESS)
}

/// Returns the settings for unorganized clouds, and reports options that have no effect on such clouds.
fn general_settings(args: &EvaluateArgs, what: &str) -> Result<Settings> {
    let settings = args.smoothing.settings()?;
    let mut unused = settings.unused_by_clouds();
    // The sensor also applies to the simulated frames.
    unused.retain(|name| *name != "sensor" || args.input.is_some());
    if !unused.is_empty() {
        let verb = if unused.len() == 1 { "has" } else { "have" };
        let options: Vec<String> = unused.into_iter().map(option_of).collect();
        errln!("{what}: {} {verb} no effect on unorganized clouds", options.join(", "));
    }
    settings.cloud_params().map_err(by_option).with_context(|| what.to_owned())?;
    Ok(settings)
}

/// Returns the sensor of the simulated frames.
fn sensor_of(args: &EvaluateArgs) -> Result<SensorModel> {
    args.smoothing
        .settings()?
        .known_sensor()
        .context("--sensor auto: simulated frames need a named sensor, such as d435")
}

/// Returns the normals stored in a cloud.
fn normals_field(cloud: &PointCloud) -> Option<Xyz> {
    let [x, y, z] = ["normal_x", "normal_y", "normal_z"].map(|name| match &cloud.attribute(name)?.values {
        AttributeValues::F32(values) => Some(values.clone()),
        AttributeValues::F64(values) => Some(values.iter().map(|&value| value as f32).collect()),
        _ => None,
    });
    Xyz::from_arrays([x?, y?, z?]).ok()
}

/// Returns a cloud's positions relative to another origin.
fn moved_to_origin(cloud: &PointCloud, origin_m: [f64; 3]) -> Xyz {
    let by_m = [0, 1, 2].map(|axis| cloud.origin_m[axis] - origin_m[axis]);
    let moved = |p: [f32; 3]| [0, 1, 2].map(|axis| (f64::from(p[axis]) + by_m[axis]) as f32);
    cloud.positions.iter().map(moved).collect()
}

/// Evaluates simulated frames, whose truth is known.
fn on_suite(args: &EvaluateArgs) -> Result<ExitCode> {
    let noise = DepthNoise::of_sensor(&sensor_of(args)?);
    let suite = Suite { noise, ..Suite::default() };
    let seeds = match args.seed {
        Some(seed) => seed..=seed,
        None => 1..=args.seeds,
    };
    let first_seed = *seeds.start();
    let bar = ProgressBar::new(seeds.end() - seeds.start() + 1)
        .with_style(ProgressStyle::with_template("{bar:30} seed {pos} of {len}, {eta} left")?);
    let mut methods = if !args.results.is_empty() || args.export.is_some() { Vec::new() } else { methods(args)? };
    let (mut raw, mut others) = (Evaluation::default(), Evaluation::default());
    for folder in [&args.export, &args.out].into_iter().flatten() {
        create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    }
    for seed in seeds {
        for case in suite.cases(seed).map_err(Error::from)? {
            let cloud = case.frame.deproject().map_err(Error::from)?;
            if let Some(folder) = &args.export {
                write_cloud(&folder.join(format!("{}.pcd", case.name)), &cloud, Encoding::Binary)?;
                continue;
            }
            let differences = difference_normals(cloud.width(), cloud.height(), cloud.positions());
            raw.add(&case, cloud.positions(), &differences);
            if let Some(folder) = args.results.first() {
                let (points, normals) =
                    result_in(args, &folder.join(format!("{}.pcd", case.name)), (cloud.width(), cloud.height()))?;
                others.add(&case, &points, &normals);
            }
            for method in &mut methods {
                method.add(&case, &args.smoothing)?;
            }
            if let (Some(folder), Some(method)) = (&args.out, methods.last())
                && seed == first_seed
            {
                let maps =
                    [cloud.positions(), &method.smoothed.points].map(|p| error_map(&case.truth, p, ERROR_SCALE_M));
                write_rgb_png(&folder.join(format!("{}.png", case.name)), &side_by_side(&maps))?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    if let Some(folder) = &args.export {
        outln!("The frames are in {}. Smooth them, keep their names, and measure with --results.", folder.display());
        return Ok(ExitCode::SUCCESS);
    }

    let (truth, frames) = suite.still(first_seed, args.still_frames).map_err(Error::from)?;
    let stirring = frames.iter().map(|frame| Ok(frame.deproject().map_err(Error::from)?.positions().clone()));
    let jitter_mm = |points: &[Xyz]| (args.still_frames > 1).then(|| jitter_mm(&truth, points));
    let raw_jitter = jitter_mm(&stirring.collect::<Result<Vec<_>>>()?);
    let mut rows = vec![Row {
        name: "raw".into(),
        report: raw.report(),
        calibration: None,
        jitter_mm: raw_jitter,
        frame_ms: None,
    }];
    if let Some(folder) = args.results.first() {
        let name = folder.display().to_string();
        rows.push(Row { name, report: others.report(), calibration: None, jitter_mm: None, frame_ms: None });
    }
    for method in &mut methods {
        let mut points = Vec::new();
        for frame in &frames {
            method.smooth(frame, &args.smoothing)?;
            points.push(method.smoothed.points.clone());
        }
        method.times_ms.sort_by(f64::total_cmp);
        rows.push(Row {
            name: method.name.to_owned(),
            report: method.evaluation.report(),
            calibration: (!method.is_general).then(|| method.calibration.report()),
            jitter_mm: jitter_mm(&points),
            frame_ms: method.times_ms.get(method.times_ms.len() / 2).copied(),
        });
    }
    if let Some(folder) = &args.out {
        let file = folder.join("report.json");
        write_whole(&file, serde_json::to_string_pretty(&rows)?.as_bytes())
            .with_context(|| file.display().to_string())?;
        draw_error_over_z(&folder.join("error-over-z.svg"), &rows)?;
    }
    if args.json {
        outln!("{}", serde_json::to_string(&rows)?);
    } else {
        print(&rows);
    }
    Ok(ExitCode::SUCCESS)
}

/// A method under evaluation, and its results so far.
struct Method {
    name: &'static str,
    /// True if frames are smoothed as unorganized clouds.
    is_general: bool,
    session: Session,
    smoothed: Smoothed,
    evaluation: Evaluation,
    calibration: Calibration,
    times_ms: Vec<f64>,
}

impl Method {
    fn smooth(&mut self, frame: &DepthFrame, smoothing: &SmoothingArgs) -> Result<()> {
        let mut frame = frame.clone();
        let settings = smoothing.settings()?;
        let steps = settings.preparation();
        if self.name != PAPER {
            let sensor = settings.known_sensor().unwrap_or_default();
            steps.depth(&mut frame, &sensor).map_err(Error::from)?;
        }
        if self.is_general {
            let cloud = frame.deproject().map_err(Error::from)?;
            let [x, y, z] = cloud.positions().as_slices();
            let points = PointsView::from_planes(x, y, z).map_err(Error::from)?;
            return self.smooth_timed(points.into_frame().map_err(Error::from)?);
        }
        self.smooth_timed((&frame).into_frame().map_err(Error::from)?)
    }

    fn smooth_timed(&mut self, frame: Frame<'_>) -> Result<()> {
        if self.times_ms.is_empty() {
            // Opens the engine.
            self.session.prepare(frame)?;
        }
        let start = Instant::now();
        self.session.smooth(frame, &mut self.smoothed)?;
        self.times_ms.push(ms_since(start));
        Ok(())
    }

    fn add(&mut self, case: &Case, smoothing: &SmoothingArgs) -> Result<()> {
        self.smooth(&case.frame, smoothing)?;
        let normals = self.smoothed.normals.as_ref().context("normals were requested")?;
        self.evaluation.add(case, &self.smoothed.points, normals);
        if !self.is_general {
            // A separate pass, so that times exclude it.
            let outputs = self.session.outputs();
            self.session.set_outputs(Outputs::POINTS.with_sigma(true));
            let mut with_sigma = Smoothed::default();
            self.session.smooth(&case.frame, &mut with_sigma)?;
            self.session.set_outputs(outputs);
            let sigma = with_sigma.sigma.as_ref().context("sigma was requested")?;
            self.calibration.add(&case.truth, &with_sigma.points, sigma);
        }
        Ok(())
    }
}

/// Returns two methods: one to compare with, and the requested one. The first is the 2011 report's setting or, for
/// unorganized clouds, the default setting on the grid.
fn methods(args: &EvaluateArgs) -> Result<Vec<Method>> {
    let options = args.smoothing.options(Outputs::POINTS.with_normals(true))?;
    let settings = args.smoothing.settings()?;
    let method = |name: &'static str, session: Session, is_general: bool| {
        let (smoothed, evaluation) = (Smoothed::default(), Evaluation::default());
        Method {
            name,
            is_general,
            session,
            smoothed,
            evaluation,
            calibration: Calibration::default(),
            times_ms: Vec::new(),
        }
    };
    let on_grid = |name: &'static str, params: FrameParams| -> Result<Method> {
        let session = Session::with_params(params, CloudParams::default(), options.clone(), Vec::new())?;
        Ok(method(name, session, false))
    };
    if args.general {
        let params = FrameParams::for_sensor(sensor_of(args)?, Strength::DEFAULT);
        let mut settings = general_settings(args, "without their grid")?;
        settings.grid = Some(GridChoice::Off);
        let clouds = Session::new(settings)?.with_options(options.clone());
        return Ok(vec![on_grid("on the grid", params)?, method("smoothed", clouds, true)]);
    }
    let params = settings.frame_params().map_err(by_option)?;
    Ok(vec![on_grid(PAPER, FrameParams::paper())?, on_grid("smoothed", params)?])
}

/// Reads a file to be measured.
fn read_measured(memory: &MemoryArgs, file: &Path) -> Result<Contents> {
    read_within(memory, io::Work::Evaluate, file)
}

/// Reads another program's result for a frame of the given shape: points and normals.
fn result_in(args: &EvaluateArgs, file: &Path, (width, height): (usize, usize)) -> Result<(Xyz, Xyz)> {
    let Contents::Organized(cloud) = read_measured(&args.memory, file)? else {
        bail!("{}: not an organized cloud; results must keep each point on its pixel", file.display());
    };
    if (cloud.width(), cloud.height()) != (width, height) {
        bail!("{}: the size differs from the frame's; expected {width}x{height}", file.display());
    }
    // Normalize the normals and turn them towards the camera, whatever the other program's convention.
    let unit = |(n, p): ([f32; 3], [f32; 3])| {
        let dot = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f32>();
        let length = if dot(n, p) > 0.0 { -dot(n, n).sqrt() } else { dot(n, n).sqrt() };
        n.map(|value| value / length)
    };
    let normals = normals_of(&cloud).iter().zip(cloud.positions().iter()).map(unit).collect();
    Ok((cloud.points.positions, normals))
}
