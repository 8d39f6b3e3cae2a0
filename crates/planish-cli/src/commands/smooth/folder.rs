//! Smooths every frame of a folder. Several workers run at once with one thread each, so reading and writing overlap
//! with smoothing. With several devices, each worker uses one of them.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use anyhow::{Context, Result, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::io::internal::create_output_folder;
use planish::io::{self, Trajectory};
use planish::{Engine, Error, FormatError, IoError, Session, Smoothed};
use planish_bench::{errln, outln};

use super::Worker;
use super::memory::NeedsMemory;
use super::report::{Failure, FolderReport, Report};
use crate::args::SmoothArgs;
use crate::exit::ExitCode;
use crate::signals::{INTERRUPTED, stop_flag};

/// Maximum file size in bytes for running several workers. If any file is larger, files are smoothed one at a time,
/// each with all threads.
const LARGEST_BESIDE_OTHERS: u64 = 64 << 20;
/// Number of workers that keep a GPU busy.
const WORKERS_OF_A_GPU: usize = 4;
/// Memory needed for a compressed frame, as a multiple of its file size.
const MEMORY_OVER_SIZE: u64 = 40;

/// Input and output path of a frame.
type Job = (PathBuf, PathBuf);

pub fn run(worker: &mut Worker<'_>) -> Result<ExitCode> {
    let args = worker.args;
    let trajectory = args.poses.read(&worker.settings, &args.input, &args.reading.read_options())?;
    let inputs = io::frame_files(&args.input).map_err(Error::from)?;
    let frames = inputs.len();
    if let Some(poses) = trajectory.as_ref().filter(|poses| !poses.has_times() && poses.len() != frames) {
        bail!(
            "--poses has {} poses without timestamps, but {} has {frames} frames; give one pose per frame",
            poses.len(),
            args.input.display()
        );
    }
    let mut poses = Poses { trajectory, unknown: 0 };
    let jobs = jobs(args, inputs)?;
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left")?;
    // Hidden automatically if standard error is not a terminal.
    let bar = ProgressBar::new(jobs.len() as u64).with_style(style);
    let told = Told { bar: &bar, errors: Mutex::default() };
    let stop = stop_flag();
    let largest =
        jobs.iter().filter_map(|(input, _)| fs::metadata(input).ok()).map(|file| file.len()).max().unwrap_or(0);
    let mut done: Vec<Option<Result<Report>>> = jobs.iter().map(|_| None).collect();
    let mut next = 0;
    while next < jobs.len() && !stop.load(Ordering::Relaxed) {
        let (input, output) = &jobs[next];
        poses.set(&mut worker.session, next, input)?;
        done[next] = Some(told.tell(worker.smooth_file(input, output), input));
        next += 1;
        // The first frames determine the sensor and the engine for all others.
        let workers = workers(worker, jobs.len() - next, largest)?;
        if workers > 1 {
            beside_each_other(worker, workers, &jobs[next..], &mut done[next..], &stop, &told);
            // A frame for which the other workers left too little memory is retried alone.
            for (job, done) in jobs[next..].iter().zip(&mut done[next..]) {
                if matches!(done, Some(Err(error)) if needs_memory(error)) {
                    let is_stopped = stop.load(Ordering::Relaxed);
                    *done = (!is_stopped).then(|| told.tell(worker.smooth_file(&job.0, &job.1), &job.0));
                }
            }
            break;
        }
    }
    bar.finish_and_clear();
    told.report();
    poses.report(&args.input);
    let mut report = FolderReport { frames: Vec::new(), failed: Vec::new(), interrupted: false };
    for ((input, _), done) in jobs.into_iter().zip(done) {
        match done {
            None => report.interrupted = true,
            Some(Ok(frame)) => report.frames.push(frame),
            Some(Err(error)) => report.failed.push(Failure { input, error: format!("{error:#}") }),
        }
    }
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        let end = if report.interrupted { "; interrupted" } else { "" };
        let frames = report.frames.len();
        let noun = if frames == 1 { "frame" } else { "frames" };
        outln!("{frames} {noun} smoothed, {} failed{end}", report.failed.len());
    }
    Ok(if report.interrupted {
        ExitCode::from(INTERRUPTED)
    } else if report.failed.is_empty() {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(1)
    })
}

/// The poses of the camera, if given.
struct Poses {
    trajectory: Option<Trajectory>,
    /// Number of frames without a pose.
    unknown: usize,
}

impl Poses {
    /// Sets the session's camera pose for a frame.
    fn set(&mut self, session: &mut Session, number: usize, input: &Path) -> Result<()> {
        if let Some(trajectory) = &self.trajectory {
            let name = input.file_stem().map(|name| name.to_string_lossy());
            let pose = trajectory.pose(number as u64, None, name.as_deref());
            self.unknown += usize::from(pose.is_none());
            session.set_camera_pose(pose)?;
        }
        Ok(())
    }

    fn report(&self, folder: &Path) {
        if self.unknown > 0 {
            errln!(
                "{}: --poses has no pose for {} frames, which were smoothed as if the camera stood still; poses must \
                 be at most 0.2 s apart, and files must be named by their time in seconds",
                folder.display(),
                self.unknown
            );
        }
    }
}

/// Reporter of the workers' results: prints each kind of error once, and advances the progress bar.
struct Told<'a> {
    bar: &'a ProgressBar,
    /// Number of occurrences by error text, from which the name of the frame is removed.
    errors: Mutex<BTreeMap<String, usize>>,
}

impl Told<'_> {
    fn tell(&self, result: Result<Report>, input: &Path) -> Result<Report> {
        if let Err(error) = &result {
            let text = format!("{error:#}");
            let kind = text.replace(&input.display().to_string(), "");
            let mut errors = self.errors.lock().unwrap_or_else(PoisonError::into_inner);
            let count = errors.entry(kind).or_default();
            *count += 1;
            if *count == 1 {
                self.bar.suspend(|| errln!("error: {text}"));
            }
        }
        self.bar.inc(1);
        result
    }

    /// Reports how many more frames had the same errors.
    fn report(&self) {
        for (kind, &count) in &*self.errors.lock().unwrap_or_else(PoisonError::into_inner) {
            if count > 1 {
                let more = count - 1;
                let frames = if more == 1 { "frame" } else { "frames" };
                errln!("{more} more {frames}: {}", kind.trim_start_matches([':', ' ']));
            }
        }
    }
}

/// Creates the output folder and returns the jobs. Refuses to overwrite an input or to write two results to one file.
fn jobs(args: &SmoothArgs, inputs: Vec<PathBuf>) -> Result<Vec<Job>> {
    if inputs.is_empty() {
        bail!("{}: the folder has no frames (.pcd, .ply, .png, .tiff, .npy)", args.input.display());
    }
    if args.output.is_file() {
        bail!("{}: the output is a file; choose a folder for the results of a folder", args.output.display());
    }
    create_output_folder(&args.output)
        .with_context(|| format!("cannot create the folder {}", args.output.display()))?;
    let outputs: Vec<PathBuf> = inputs.iter().map(|input| output_path(args, input)).collect();
    outputs.iter().try_for_each(|output| args.encoding.check(output))?;
    let originals: HashSet<PathBuf> = inputs.iter().filter_map(|input| input.canonicalize().ok()).collect();
    let is_input = |output: &&PathBuf| output.canonicalize().is_ok_and(|output| originals.contains(&output));
    if let Some(output) = outputs.iter().find(is_input).filter(|_| !args.overwrite) {
        bail!("{}: the output is one of the inputs; choose another folder, or add --overwrite", output.display());
    }
    if args.overwrite {
        io::replace_read_only_files();
    } else if let Some(output) = outputs.iter().find(|output| io::is_read_only(output)) {
        bail!("{}: the file is read-only; choose another folder, or add --overwrite", output.display());
    }
    let mut seen = HashMap::new();
    for (input, output) in inputs.iter().zip(&outputs) {
        if let Some(other) = seen.insert(output, input) {
            bail!(
                "{} and {} would both be written to {}; smooth them into different folders",
                other.display(),
                input.display(),
                output.display()
            );
        }
    }
    Ok(inputs.into_iter().zip(outputs).collect())
}

/// Returns the output path of a frame of the input folder.
fn output_path(args: &SmoothArgs, input: &Path) -> PathBuf {
    let path = args.output.join(input.file_name().unwrap_or_default());
    match &args.format {
        Some(extension) => path.with_extension(extension.trim_start_matches('.')),
        None => path,
    }
}

/// Returns the number of workers for `frames` frames, the largest of which has `largest` bytes: one per thread,
/// limited by the number of frames and by memory. The reference engine uses all threads for one frame.
fn workers(worker: &Worker<'_>, frames: usize, largest: u64) -> Result<usize> {
    let engine = worker.session.engine();
    let is_fast = engine.is_some_and(|engine| engine != Engine::Reference);
    let settings = &worker.settings;
    let is_sensor_open = settings.estimates_sensor() && worker.session.estimated_sensor().is_none();
    // Each frame of a video depends on those before it.
    let is_video = settings.temporal_params().is_some();
    if !is_fast || is_sensor_open || is_video || worker.args.repeat > 1 || largest > LARGEST_BESIDE_OTHERS {
        return Ok(1);
    }
    let threads = settings.threads.unwrap_or_else(|| thread::available_parallelism().map_or(1, usize::from));
    // Each worker has buffers on the device.
    let devices = worker.session.devices().len().max(1);
    let threads = if engine == Some(Engine::Gpu) { threads.min(WORKERS_OF_A_GPU * devices) } else { threads };
    let in_memory = worker.args.reading.read_options().max_memory_bytes / (MEMORY_OVER_SIZE * largest.max(1));
    Ok(threads.min(frames / 2).min(usize::try_from(in_memory).unwrap_or(usize::MAX)))
}

/// Returns true if a frame failed for lack of memory and might succeed with more.
fn needs_memory(error: &anyhow::Error) -> bool {
    let is_too_large = |error: &IoError| matches!(error.problem, FormatError::TooLarge { .. });
    error.chain().any(|cause| {
        cause.is::<NeedsMemory>()
            || cause.downcast_ref::<IoError>().is_some_and(is_too_large)
            || matches!(cause.downcast_ref::<Error>(), Some(Error::Io(error)) if is_too_large(error))
    })
}

/// Smooths frames with several workers, which use the settings of `like`. Frames that fail for lack of memory are
/// left for a retry, and are neither reported nor counted.
fn beside_each_other(
    like: &Worker<'_>,
    workers: usize,
    jobs: &[Job],
    done: &mut [Option<Result<Report>>],
    stop: &AtomicBool,
    told: &Told<'_>,
) {
    let next = AtomicUsize::new(0);
    let results = Mutex::new(done);
    let Worker { args, pose, ref settings, ref noted, .. } = *like;
    // The sensor and the devices found for the first frames apply to all others.
    let mut settings = settings.clone();
    settings.threads = Some(1);
    let sensor = like.session.estimated_sensor();
    let devices = like.session.devices();
    let work = |number: usize| {
        let Ok(session) = Session::new(settings.clone()) else { return };
        let mut worker = Worker {
            args,
            settings: settings.clone(),
            session: session.with_estimated_sensor(sensor).with_devices(devices.to_vec()).with_device(number),
            pose,
            beside: workers as u64,
            smoothed: Smoothed::default(),
            renewed: planish::Outputs::POINTS,
            unit: planish::io::LengthUnit::METRE,
            noted: Arc::clone(noted),
        };
        while !stop.load(Ordering::Relaxed) {
            let at = next.fetch_add(1, Ordering::Relaxed);
            let Some((input, output)) = jobs.get(at) else { break };
            // A panic on one frame is a bug, but must not lose the others.
            let smooth = AssertUnwindSafe(|| worker.smooth_file(input, output));
            let result = catch_unwind(smooth).unwrap_or_else(|_| {
                worker.session.close();
                Err(anyhow!("{}: planish panicked (please report this bug)", input.display()))
            });
            let may_be_tried_again = matches!(&result, Err(error) if needs_memory(error));
            let result = if may_be_tried_again { result } else { told.tell(result, input) };
            results.lock().unwrap_or_else(PoisonError::into_inner)[at] = Some(result);
        }
    };
    thread::scope(|scope| {
        // The first worker runs on this thread, since the system may refuse to start others.
        for number in 1..workers {
            let work = &work;
            let _ = thread::Builder::new().spawn_scoped(scope, move || work(number));
        }
        work(0);
    });
}
