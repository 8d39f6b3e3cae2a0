//! `planish smooth`: one file, or every frame of a folder.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::io::{self, CloudRef, Contents, Format};
use planish::{
    Camera, DepthFrame, DepthImage, Engine, Error, Frame, OrganizedCloud, Outputs, PointCloud, Radius, SmoothParams,
    Smoothed, Smoother, estimate_radius_m, smooth_points,
};
use serde::Serialize;

use super::{ms_since, organized};
use crate::args::SmoothArgs;

/// What is said of one frame.
#[derive(Serialize)]
struct Report {
    input: PathBuf,
    output: PathBuf,
    engine: &'static str,
    /// The GPU's name.
    adapter: Option<String>,
    /// Why `auto` took this engine.
    engine_reason: Option<String>,
    width: usize,
    height: usize,
    points_in: usize,
    status: StatusCounts,
    read_ms: f64,
    smooth_ms: SmoothTimes,
    write_ms: f64,
}

#[derive(Serialize)]
struct StatusCounts {
    hole: usize,
    too_few: usize,
    degenerate: usize,
    plane: usize,
    polynomial: usize,
}

#[derive(Serialize)]
struct SmoothTimes {
    median: f64,
    p99: f64,
    runs: usize,
}

#[derive(Serialize)]
struct Failure {
    input: PathBuf,
    error: String,
}

#[derive(Serialize)]
struct FolderReport {
    frames: Vec<Report>,
    failed: Vec<Failure>,
}

pub fn run(args: &SmoothArgs) -> Result<ExitCode> {
    // Those of clouds without a grid; with --sensor auto the first frame says those of all others.
    let params = args.smoothing.params_for(None)?;
    // Options that contradict each other are refused whatever the input turns out to be.
    args.smoothing.options(Outputs::POINTS)?;
    let mut worker = Worker {
        args,
        params,
        sensor_known: false,
        floating_noise_at_1m: None,
        open: None,
        smoothed: Smoothed::default(),
    };
    if args.input.is_dir() {
        return run_folder(&mut worker);
    }
    let report = worker.smooth_file(&args.input, &args.output)?;
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print_report(&report);
    }
    Ok(ExitCode::SUCCESS)
}

fn run_folder(worker: &mut Worker<'_>) -> Result<ExitCode> {
    let args = worker.args;
    let mut inputs: Vec<PathBuf> = fs::read_dir(&args.input)
        .and_then(|entries| entries.map(|entry| entry.map(|entry| entry.path())).collect())
        .with_context(|| format!("cannot list the folder {}", args.input.display()))?;
    inputs.retain(|path| path.is_file() && Format::of_extension(path).is_some());
    inputs.sort();
    if inputs.is_empty() {
        bail!("{}: the folder has no frames (.pcd, .ply, .png, .tiff, .npy)", args.input.display());
    }
    if args.output.is_file() {
        bail!("{}: is a file; a folder of frames is written to a folder", args.output.display());
    }
    fs::create_dir_all(&args.output).with_context(|| format!("cannot make the folder {}", args.output.display()))?;
    let same = |a: &Path, b: &Path| a.canonicalize().ok().is_some_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    if same(&args.input, &args.output) {
        bail!("input and output are the same folder: give another one, so that no frame is overwritten");
    }

    let outputs: Vec<PathBuf> = inputs.iter().map(|input| output_path(args, input)).collect();
    let mut seen = HashMap::new();
    for (input, output) in inputs.iter().zip(&outputs) {
        if let Some(other) = seen.insert(output, input) {
            bail!(
                "{} and {} would both be written to {}: smooth them into different folders",
                other.display(),
                input.display(),
                output.display()
            );
        }
    }

    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left")?;
    // Hidden by itself where standard error is not a terminal.
    let progress = ProgressBar::new(inputs.len() as u64).with_style(style);
    let mut report = FolderReport { frames: Vec::new(), failed: Vec::new() };
    for (input, output) in inputs.into_iter().zip(outputs) {
        match worker.smooth_file(&input, &output) {
            Ok(frame) => report.frames.push(frame),
            Err(error) => {
                let error = format!("{error:#}");
                progress.suspend(|| eprintln!("error: {error}"));
                report.failed.push(Failure { input, error });
            }
        }
        progress.inc(1);
    }
    progress.finish_and_clear();
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        println!("{} frames smoothed, {} failed", report.frames.len(), report.failed.len());
    }
    Ok(if report.failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

/// Where a frame of the input folder is written.
fn output_path(args: &SmoothArgs, input: &Path) -> PathBuf {
    let path = args.output.join(input.file_name().unwrap_or_default());
    match &args.format {
        Some(extension) => path.with_extension(extension.trim_start_matches('.')),
        None => path,
    }
}

fn print_report(report: &Report) {
    let Report { status, smooth_ms, .. } = report;
    println!("{} -> {}", report.input.display(), report.output.display());
    let adapter = report.adapter.as_ref().map_or(String::new(), |name| format!(" ({name})"));
    println!("  {} x {}, {} points, engine {}{adapter}", report.width, report.height, report.points_in, report.engine);
    println!(
        "  smoothed {} ({} by plane), on a line {}, too few neighbours {}, holes {}",
        status.plane + status.polynomial,
        status.plane,
        status.degenerate,
        status.too_few,
        status.hole
    );
    let runs = if smooth_ms.runs > 1 {
        format!(" (median of {}, p99 {:.2})", smooth_ms.runs, smooth_ms.p99)
    } else {
        String::new()
    };
    println!(
        "  read {:.1} ms, smooth {:.2} ms{runs}, write {:.1} ms",
        report.read_ms, smooth_ms.median, report.write_ms
    );
}

/// What an engine is open for: shape, outputs, parameters.
type OpenFor = ((usize, usize), Outputs, SmoothParams);

/// Smooths file after file, keeping the engine open while shape, outputs and parameters stay.
struct Worker<'a> {
    args: &'a SmoothArgs,
    params: SmoothParams,
    /// Whether the parameters are those of the frames' sensor.
    sensor_known: bool,
    /// By which noise floating pixels are told, if they are to be removed.
    floating_noise_at_1m: Option<f32>,
    open: Option<(Smoother, OpenFor)>,
    smoothed: Smoothed,
}

/// What is written, once the input has been smoothed.
enum Output {
    Organized(OrganizedCloud),
    Points(PointCloud),
    /// Depth as raw values, or in metres if the input was.
    Depth {
        camera: Camera,
        in_metres: bool,
    },
}

impl Worker<'_> {
    fn smooth_file(&mut self, input: &Path, output: &Path) -> Result<Report> {
        let start = Instant::now();
        let (format, contents) = io::read(input)?;
        let read_ms = ms_since(start);
        let (width, height) = contents.shape();

        let (mut result, points_in, times_ms, engine) = match contents {
            Contents::Points(cloud) => {
                let (times_ms, engine) = self.smooth_general(input, &cloud)?;
                let points_in = cloud.valid_points();
                (Output::Points(cloud), points_in, times_ms, engine)
            }
            contents => self.smooth_organized(input, output, contents)?,
        };
        let written_format = Format::of_extension(output);
        match &mut result {
            Output::Organized(cloud) => self.apply(&mut cloud.points, format, written_format)?,
            Output::Points(cloud) => self.apply(cloud, format, written_format)?,
            Output::Depth { .. } => {}
        }

        let start = Instant::now();
        self.write(output, &result)?;
        Ok(Report {
            input: input.to_path_buf(),
            output: output.to_path_buf(),
            engine: engine.name(),
            adapter: self.adapter(engine),
            engine_reason: self.chosen_because(),
            width,
            height,
            points_in,
            status: self.status_counts(),
            read_ms,
            smooth_ms: times_ms,
            write_ms: ms_since(start),
        })
    }

    /// Smooths an organized cloud or a depth image.
    fn smooth_organized(
        &mut self,
        input: &Path,
        output: &Path,
        contents: Contents,
    ) -> Result<(Output, usize, SmoothTimes, Engine)> {
        let shape = contents.shape();
        let in_metres = matches!(contents, Contents::DepthMetres { .. });
        let depth_out = match Format::of_extension(output) {
            Some(Format::DepthPng | Format::DepthTiff) => true,
            Some(Format::Npy) => contents.is_depth(),
            _ => false,
        };
        let mut outputs = Outputs { status: true, ..self.args.outputs() };
        // Depth in metres is made from points and normals; raw depth by the engine, which then gives nothing else.
        if depth_out && in_metres {
            outputs.normals = true;
        } else if depth_out {
            outputs = Outputs { status: true, ..Outputs::DEPTH };
        }
        // A raw depth image goes to the engine as it is.
        let mut depth = match &contents {
            Contents::Depth(image) => {
                Some(DepthFrame::new(self.args.camera.required(shape, input)?, image.clone()).map_err(Error::from)?)
            }
            _ => None,
        };
        let mut cloud = organized(contents, &self.args.camera, input)?;
        if !self.sensor_known {
            let of_frame = || input.display().to_string();
            self.params = self.args.smoothing.params_for(Some(&cloud)).with_context(of_frame)?;
            self.floating_noise_at_1m =
                self.args.smoothing.floating_noise_at_1m(Some(&cloud)).with_context(of_frame)?;
            self.sensor_known = true;
        }
        if let Some(noise_at_1m) = self.floating_noise_at_1m {
            let count = cloud.remove_floating(noise_at_1m);
            eprintln!("{}: {count} floating pixels became holes", input.display());
            depth.iter_mut().for_each(|depth| {
                depth.remove_floating(noise_at_1m);
            });
        }
        let frame = depth.as_ref().map_or(Frame::Cloud(&cloud), Frame::Depth);
        let depth_camera = match cloud.camera {
            _ if !depth_out => None,
            None => bail!("{}: writing depth needs the camera: add --camera FX,FY,CX,CY", output.display()),
            camera => camera,
        };

        self.open(frame, outputs)?;
        let mut times_ms = Vec::new();
        for _ in 0..self.args.repeat {
            let (smoother, ..) = self.open.as_mut().context("no engine is open")?;
            let start = Instant::now();
            let result = smoother.smooth(frame, &mut self.smoothed);
            if matches!(result, Err(Error::Engine(_))) {
                // An engine that failed is no use for the next frame.
                self.open = None;
            }
            result?;
            times_ms.push(ms_since(start));
        }
        let engine = self.engine();
        let points_in = cloud.points.valid_points();
        let result = match depth_camera {
            Some(camera) => Output::Depth { camera, in_metres },
            None => Output::Organized(cloud),
        };
        Ok((result, points_in, summarize(times_ms), engine))
    }

    fn smooth_general(&mut self, input: &Path, cloud: &PointCloud) -> Result<(SmoothTimes, Engine)> {
        let mut params = self.params;
        if self.args.smoothing.remove_floating {
            bail!("{}: the points are not organized; --remove-floating needs the pixels around each", input.display());
        }
        match self.args.smoothing.engine() {
            Engine::Auto | Engine::Reference => {}
            engine => bail!(
                "{}: the points are not organized; only --engine reference smooths those, not {}",
                input.display(),
                engine.name()
            ),
        }
        if !self.args.smoothing.has_radius() {
            let radius_m = estimate_radius_m(cloud).with_context(|| {
                format!("{}: no radius can be estimated from these points: add --radius METRES", input.display())
            })?;
            eprintln!("{}: not organized; radius {radius_m:.4} m from the spacing of the points", input.display());
            params.radius = Radius::Fixed { radius_m };
        }
        let outputs = Outputs { status: true, ..self.args.outputs() };
        let mut times_ms = Vec::new();
        for _ in 0..self.args.repeat {
            let start = Instant::now();
            smooth_points(cloud, params, outputs, self.args.smoothing.threads, &mut self.smoothed)?;
            times_ms.push(ms_since(start));
        }
        Ok((summarize(times_ms), Engine::Reference))
    }

    /// The engine that is open.
    fn engine(&self) -> Engine {
        self.open.as_ref().map_or(Engine::Auto, |(smoother, ..)| smoother.engine())
    }

    /// Why `auto` chose as it did.
    fn chosen_because(&self) -> Option<String> {
        let (smoother, ..) = self.open.as_ref()?;
        smoother.chosen_because().map(str::to_owned)
    }

    /// The GPU's name, where that is the engine.
    fn adapter(&self, engine: Engine) -> Option<String> {
        let (smoother, ..) = self.open.as_ref().filter(|_| engine == Engine::Gpu)?;
        smoother.gpu_name().map(str::to_owned)
    }

    /// Opens an engine for frames like this, if none is.
    fn open(&mut self, frame: Frame<'_>, outputs: Outputs) -> Result<()> {
        // Every frame gets what it gets alone, whatever came before it.
        let wanted = (frame.shape(), outputs, self.args.smoothing.at_resolution_of(self.params, frame));
        if self.open.as_ref().is_none_or(|(_, has)| *has != wanted) {
            let options = self.args.smoothing.options(outputs)?;
            let (shape, _, params) = wanted;
            self.open = Some((Smoother::open_with(params, &options, shape)?, wanted));
        }
        Ok(())
    }

    /// Puts the result into the cloud, with its colour as the format to write has it.
    fn apply(&self, cloud: &mut PointCloud, read: Format, written: Option<Format>) -> Result<()> {
        cloud.apply(&self.smoothed, self.args.outputs()).map_err(Error::from)?;
        match written {
            Some(Format::Ply) if read != Format::Ply => cloud.unpack_colour(),
            Some(Format::Pcd) if read == Format::Ply => cloud.pack_colour(),
            _ => {}
        }
        Ok(())
    }

    fn write(&self, output: &Path, result: &Output) -> Result<()> {
        let encoding = self.args.encoding();
        match result {
            Output::Organized(cloud) => io::write_cloud(output, CloudRef::Organized(cloud), encoding)?,
            Output::Points(cloud) => io::write_cloud(output, CloudRef::Points(cloud), encoding)?,
            Output::Depth { camera, in_metres: true } if Format::of_extension(output) == Some(Format::Npy) => {
                let depth_m = self.smoothed.to_depth_m(camera).map_err(Error::from)?;
                io::write_depth_metres(output, camera.width, &depth_m)?;
            }
            Output::Depth { camera, .. } => {
                let image = match &self.smoothed.depth {
                    Some(raw) => DepthImage { width: camera.width, height: camera.height, raw: raw.clone() },
                    None => self.smoothed.to_depth(camera).map_err(Error::from)?,
                };
                io::write_depth(output, &image)?;
            }
        }
        Ok(())
    }

    fn status_counts(&self) -> StatusCounts {
        let [hole, too_few, degenerate, plane, quadratic, cubic] = self.smoothed.status_counts().unwrap_or_default();
        StatusCounts { hole, too_few, degenerate, plane, polynomial: quadratic + cubic }
    }
}

fn summarize(mut times_ms: Vec<f64>) -> SmoothTimes {
    times_ms.sort_by(f64::total_cmp);
    let runs = times_ms.len();
    let at = |share: f64| times_ms[((runs as f64 * share) as usize).min(runs - 1)];
    SmoothTimes { median: at(0.5), p99: at(0.99), runs }
}
