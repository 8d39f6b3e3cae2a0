//! `planish smooth`: one file, or every frame of a folder.

#[cfg(feature = "mcap")]
mod bag;
mod folder;
mod progress;
mod report;
mod tiles;

use crate::exit::ExitCode;
use std::collections::HashSet;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::io::{self, CloudRef, Contents, Encoding, FileRead, Format, ReadOptions};
use planish::{
    DepthFrame, DepthImage, Edges, Engine, EngineError, Error, FleetDevice, Frame, IntoFrame, OrganizedCloud, Outputs,
    PointCloud, PointsView, Radius, RangeRule, SensorModel, SensorPose, SmoothParams, Smoothed, Smoother,
    SmootherOptions,
};
use planish_bench::{errln, outln};

use progress::with_progress;
use report::{
    Report, SmoothTimes, StatusCounts, likely_cause, print_report, report_assumed_sensor, report_range_rule, summarize,
};

use super::checks::{
    check_not_input, check_output, check_radius, convert_fields, report_columns, report_losses, report_notes,
};
use super::{ms_since, organized};
use crate::args::{FieldArg, SmoothArgs};

pub fn run(args: &SmoothArgs) -> Result<ExitCode> {
    // For general clouds; with --sensor auto the first frame determines the parameters of all others.
    let params = args.smoothing.params_for(None)?;
    // Options that contradict each other are refused whatever the input turns out to be.
    args.smoothing.options(Outputs::POINTS)?;
    let mut worker = Worker {
        args,
        params,
        sensor_known: false,
        floating_sensor: None,
        pose: args.pose.pose()?,
        beside: 1,
        devices: args.gpus.devices(args.smoothing.engine())?,
        device: 0,
        open: None,
        smoothed: Smoothed::default(),
        noted: Arc::default(),
    };
    if args.format.as_ref().is_some_and(|extension| extension.contains(['/', '\\'])) {
        bail!("--format takes a file's extension, as ply, not a path");
    }
    if args.gpus.gpus.is_some() && !args.input.is_dir() {
        bail!(
            "{}: --gpus deals the frames of a folder; one file goes to one device (--engine gpu --adapter)",
            args.input.display()
        );
    }
    #[cfg(feature = "mcap")]
    if let Some(code) = bag::run(args)? {
        return Ok(code);
    }
    if !args.topics.topic.is_empty() || args.topics.camera_info_topic.is_some() || args.points_topic.is_some() {
        bail!(
            "{}: --topic, --camera-info-topic and --points-topic are for recordings in MCAP, which this is not",
            args.input.display()
        );
    }
    if args.input.is_dir() {
        return folder::run(&mut worker);
    }
    if args.format.is_some() {
        errln!("{}: one file, for which --format changes nothing: the output's name says it", args.input.display());
    }
    check_output(&args.output, args.encoding.is_some())?;
    check_not_input(&args.input, &args.output, Some(args.overwrite))?;
    let report = worker.smooth_file(&args.input, &args.output)?;
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print_report(&report);
    }
    Ok(ExitCode::SUCCESS)
}

/// What an engine is open for: grid, outputs, parameters.
type OpenFor = (Option<(usize, usize)>, Outputs, SmoothParams);

/// Smooths file after file, keeping the engine open while shape, outputs and parameters stay.
struct Worker<'a> {
    args: &'a SmoothArgs,
    params: SmoothParams,
    /// Whether the parameters are those of the frames' sensor.
    sensor_known: bool,
    /// The sensor whose noise decides which pixels float, if those are to be removed.
    floating_sensor: Option<SensorModel>,
    /// Instead of what the files say.
    pose: Option<SensorPose>,
    /// How many workers there are, of which each has its share of the threads and the memory.
    beside: u64,
    /// The devices that frames are dealt to, and which of them is this worker's; none for the one of the arguments.
    devices: Vec<FleetDevice>,
    device: usize,
    open: Option<(Smoother, OpenFor)>,
    smoothed: Smoothed,
    /// What was said of the inputs of all workers.
    noted: Arc<Mutex<HashSet<String>>>,
}

/// A frame needs more memory than its worker has.
#[derive(Debug)]
struct NeedsMemory(String);

impl std::fmt::Display for NeedsMemory {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for NeedsMemory {}

/// What is written, once the input has been smoothed.
enum Output {
    Organized(OrganizedCloud),
    General(PointCloud),
    /// Depth of so many columns and rows.
    Depth {
        width: usize,
        height: usize,
    },
}

impl Worker<'_> {
    fn smooth_file(&mut self, input: &Path, output: &Path) -> Result<Report> {
        if let Some(report) = self.smooth_in_tiles(input, output)? {
            return Ok(report);
        }
        let start = Instant::now();
        let FileRead { format, encoding, mut contents, mut notes, .. } = io::read_file(input, &self.read_options())?;
        let read_ms = ms_since(start);
        // Of the frames of a folder each is said once.
        notes.retain(|note| self.noted.lock().is_ok_and(|mut noted| noted.insert(note.clone())));
        report_notes(input, &notes);
        match &mut contents {
            Contents::Organized(cloud) if !is_depth(output) => {
                convert_fields(&mut cloud.points, format, output);
                io::check_writable(output, &*cloud, self.args.outputs())?;
            }
            Contents::General(cloud) => {
                convert_fields(cloud, format, output);
                io::check_writable(output, &*cloud, self.args.outputs())?;
            }
            _ => {}
        }
        let (width, height) = contents.shape();
        self.set_pose(input, &mut contents)?;

        let (mut result, points, times_ms) = match contents {
            Contents::General(cloud) => {
                report_columns(input, format, &cloud);
                let (points, times_ms) = self.smooth_general(input, output, &cloud)?;
                (Output::General(cloud), points, times_ms)
            }
            contents => self.smooth_organized(input, output, contents)?,
        };
        match &mut result {
            Output::Organized(cloud) => self.apply(&mut cloud.points)?,
            Output::General(cloud) => self.apply(cloud)?,
            Output::Depth { .. } => {}
        }

        let start = Instant::now();
        self.write(output, &result, self.args.encoding().or(encoding).unwrap_or_default())?;
        let (smoother, ..) = self.open.as_ref().context("no engine is open")?;
        Ok(Report {
            input: input.to_path_buf(),
            output: output.to_path_buf(),
            engine: smoother.engine().name(),
            adapter: smoother.gpu_name().map(str::to_owned),
            engine_reason: smoother.chosen_because().map(ToString::to_string),
            width,
            height,
            points_in: points.valid,
            points_lost: points.lost,
            status: self.status_counts(),
            tiles: None,
            read_ms,
            smooth_ms: times_ms,
            write_ms: ms_since(start),
        })
    }

    /// The limit for this worker.
    fn read_options(&self) -> ReadOptions {
        let options = self.args.memory.read_options();
        options.with_max_memory_bytes(options.max_memory_bytes / self.beside)
    }

    fn options(&self, outputs: Outputs) -> Result<SmootherOptions> {
        let options = self.args.smoothing.options(outputs)?;
        let options = if self.beside > 1 { options.with_threads(Some(1)) } else { options };
        Ok(self.devices.get(self.device).map_or(options.clone(), |device| device.options(&options)))
    }

    /// Puts the user's pose in place of the file's.
    fn set_pose(&self, input: &Path, contents: &mut Contents) -> Result<()> {
        let Some(pose) = self.pose else { return Ok(()) };
        match contents {
            Contents::Organized(cloud) => cloud.points.pose = pose,
            Contents::General(cloud) => cloud.pose = pose,
            _ => bail!("{}: depth is in its camera's own frame; --sensor-pose is for clouds", input.display()),
        }
        Ok(())
    }

    /// Smooths an organized cloud or a depth image.
    fn smooth_organized(
        &mut self,
        input: &Path,
        output: &Path,
        contents: Contents,
    ) -> Result<(Output, PointCounts, SmoothTimes)> {
        let shape = contents.shape();
        let in_metres = matches!(contents, Contents::DepthMetres { .. });
        let depth_out = is_depth(output) || (Format::of_extension(output) == Some(Format::Npy) && contents.is_depth());
        if in_metres && self.args.camera.depth_scale.is_some() {
            bail!("{}: depth as floats is in metres; --depth-scale is for 16-bit images", input.display());
        }
        let has_fields = self.args.fields.iter().any(|field| *field != FieldArg::None);
        if has_fields && (depth_out || Format::of_extension(output) == Some(Format::Npy)) {
            bail!("{}: has no place for --fields; write .pcd or .ply", output.display());
        }
        let mut outputs = self.args.outputs().with_status(true);
        if depth_out {
            let stays_in_metres = in_metres && Format::of_extension(output) == Some(Format::Npy);
            let only = Outputs::DEPTH.with_depth(!stays_in_metres).with_depth_m(stays_in_metres);
            outputs = only.with_status(true);
        }
        // A raw depth image goes to the engine as it is.
        let mut depth = match &contents {
            Contents::Depth(image) => {
                let camera = self.args.camera.required(shape, input)?;
                Some(DepthFrame::from_image(camera, image.clone()).map_err(Error::from)?)
            }
            _ => None,
        };
        // Depth that goes out as depth needs no points.
        let needs_points = depth.is_none() || !depth_out || !self.sensor_known || self.floating_sensor.is_some();
        let mut cloud = if needs_points { Some(organized(contents, &self.args.camera, input)?) } else { None };
        if !self.sensor_known {
            let of_frame = || input.display().to_string();
            self.params = self.args.smoothing.params_for(cloud.as_ref()).with_context(of_frame)?;
            self.floating_sensor = self.args.smoothing.floating_sensor(cloud.as_ref()).with_context(of_frame)?;
            self.sensor_known = true;
        }
        if let (Some(sensor), Some(cloud)) = (self.floating_sensor, &mut cloud) {
            let view = PointsView::from_organized(cloud).map_err(Error::from)?;
            if matches!(view.range_rule(), RangeRule::Constant { .. }) {
                bail!("{}: --remove-floating needs the sensor's position: give --sensor-pose", input.display());
            }
            let count = cloud.remove_floating(&sensor);
            errln!("{}: {count} floating pixels became holes", input.display());
            depth.iter_mut().for_each(|depth| {
                depth.remove_floating(&sensor);
            });
        }
        let of_input = |error| anyhow::Error::new(error).context(input.display().to_string());
        let frame = match (&depth, &cloud) {
            (Some(depth), _) => depth.into_frame(),
            (None, Some(cloud)) => cloud.into_frame(),
            (None, None) => bail!("{}: neither depth nor points", input.display()),
        };
        let frame = frame.map_err(of_input)?;
        report_range_rule(input, frame, self.pose.is_some());
        if depth_out && frame.camera().is_none() {
            bail!("{}: writing depth needs the camera: add --camera FX,FY,CX,CY", output.display());
        }
        // Every frame gets what it gets alone, whatever came before it.
        let params = self.args.smoothing.at_resolution_of(self.params, frame);
        let (points, times_ms) = self.smooth(output, frame, outputs, params)?;
        let result = match cloud {
            Some(cloud) if !depth_out => Output::Organized(cloud),
            _ => Output::Depth { width: shape.0, height: shape.1 },
        };
        Ok((result, points, times_ms))
    }

    fn smooth_general(
        &mut self,
        input: &Path,
        output: &Path,
        cloud: &PointCloud,
    ) -> Result<(PointCounts, SmoothTimes)> {
        let params = self.general_params(input)?;
        let engine = self.args.smoothing.engine();
        if !engine.capabilities().general {
            bail!("{}: a general cloud, which --engine {} does not smooth", input.display(), engine.name());
        }
        if let (Radius::Fixed { radius_m }, false) = (params.radius, self.args.force) {
            check_radius(input, cloud, radius_m)?;
        }
        let outputs = self.args.outputs().with_status(true);
        let of_input = |error| anyhow::Error::new(error).context(input.display().to_string());
        let frame = cloud.into_frame().map_err(of_input)?;
        let is_stated = !cloud.pose.is_identity() || cloud.scanners_m().is_some();
        if let (Frame::Points(points), true) = (frame, outputs.normals && !is_stated) {
            report_assumed_sensor(input, points.assumed_sensor_m());
        }
        self.smooth(output, frame, outputs, params)
    }

    /// The parameters for a general cloud; says what is assumed, and what changes nothing.
    fn general_params(&self, input: &Path) -> Result<SmoothParams> {
        let params = self.args.smoothing.general_params()?;
        if self.args.smoothing.remove_floating {
            bail!("{}: a general cloud; --remove-floating needs the pixels around each point", input.display());
        }
        if let (Radius::Neighbours { count }, None) = (params.radius, self.args.smoothing.neighbours) {
            errln!(
                "{}: a general cloud, smoothed with about {count} neighbours of each point (--neighbours or --radius to change that{})",
                input.display(),
                if params.edges == Edges::Robust { "" } else { "; --edges robust keeps edges sharp" }
            );
        }
        let mut unused = self.args.smoothing.unused_by_general_clouds();
        let given = [
            ("--camera", self.args.camera.camera.is_some() || self.args.camera.camera_file.is_some()),
            ("--depth-scale", self.args.camera.depth_scale.is_some()),
        ];
        unused.extend(given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name));
        if !unused.is_empty() {
            let verb = if unused.len() == 1 { "changes" } else { "change" };
            errln!("{}: a general cloud, for which {} {verb} nothing", input.display(), unused.join(", "));
        }
        Ok(params)
    }

    /// Smooths a frame as many times as requested, and reports if many points were lost.
    fn smooth(
        &mut self,
        output: &Path,
        frame: Frame<'_>,
        outputs: Outputs,
        params: SmoothParams,
    ) -> Result<(PointCounts, SmoothTimes)> {
        let mut times_ms = Vec::new();
        while times_ms.len() < self.args.repeat as usize {
            if let Err(error) = self.open(frame, outputs, params) {
                if matches!(error.downcast_ref(), Some(Error::Engine(engine)) if self.leaves_device(engine, output)) {
                    continue;
                }
                return Err(error).with_context(|| output.display().to_string());
            }
            let (smoother, ..) = self.open.as_mut().context("no engine is open")?;
            let start = Instant::now();
            let progress = smoother.progress().filter(|_| self.beside == 1);
            let result = with_progress(progress, || smoother.smooth(frame, &mut self.smoothed));
            if let Err(Error::Engine(error)) = &result {
                // An engine that failed is no use for the next frame.
                self.open = None;
                if self.leaves_device(error, output) {
                    continue;
                }
            }
            if let (Err(Error::Engine(error)), Engine::Auto) = (&result, self.args.smoothing.engine())
                && error.is_too_large()
            {
                // How large a general cloud is, is known after auto has chosen.
                errln!("{}: {error}; smoothed on the CPU", output.display());
                let options = self.options(outputs)?.with_engine(Engine::Cpu);
                let cpu = Smoother::open_with(params, &options, frame.grid())?;
                self.open = Some((cpu, (frame.grid(), outputs, params)));
                continue;
            }
            result?;
            times_ms.push(ms_since(start));
        }
        let StatusCounts { too_few: lost, isolated, .. } = self.status_counts();
        let valid = frame.valid_points();
        for (count, became) in [(lost, "became holes"), (isolated, "stay where they are")] {
            if count as f64 > LOST_SHARE_TOLD * valid as f64 {
                let share = 100.0 * count as f64 / valid as f64;
                let cause = likely_cause(frame, &params);
                errln!(
                    "{}: {count} of {valid} valid points ({share:.1} %) {became}: they have too few neighbours. {cause}",
                    output.display()
                );
            }
        }
        Ok((PointCounts { valid, lost }, summarize(times_ms)))
    }

    /// After an error of the engine: whether there is another device, which the worker goes on with.
    fn leaves_device(&mut self, error: &EngineError, output: &Path) -> bool {
        if self.devices.len() < 2 || matches!(error, EngineError::Limit { .. } | EngineError::Crowded { .. }) {
            return false;
        }
        errln!("{}: {error}; another device goes on", output.display());
        self.devices.remove(self.device);
        (self.device, self.open) = (0, None);
        true
    }

    /// Opens an engine for frames like this, if none is.
    fn open(&mut self, frame: Frame<'_>, outputs: Outputs, params: SmoothParams) -> Result<()> {
        let wanted = (frame.grid(), outputs, params);
        let (width, height) = frame.shape();
        let points = width * height;
        let needed = points as u64 * ENGINE_BYTES_A_POINT;
        let allowed = self.read_options().max_memory_bytes;
        if needed > allowed {
            let text = format!(
                "{points} points need {} MiB of memory, and {} MiB are allowed: raise --max-memory if there is as much",
                needed.div_ceil(1 << 20),
                allowed >> 20
            );
            return Err(NeedsMemory(text).into());
        }
        if self.open.as_ref().is_none_or(|(_, has)| *has != wanted) {
            let options = self.options(outputs)?;
            self.open = Some((Smoother::open_with(params, &options, frame.grid())?, wanted));
        }
        Ok(())
    }

    /// Puts the result into the cloud.
    fn apply(&self, cloud: &mut PointCloud) -> Result<()> {
        Ok(cloud.apply(&self.smoothed, self.args.outputs()).map_err(Error::from)?)
    }

    fn write(&self, output: &Path, result: &Output, encoding: Encoding) -> Result<()> {
        match result {
            Output::Organized(cloud) => {
                report_losses(output, &cloud.points);
                io::write_cloud(output, CloudRef::Organized(cloud), encoding)?;
            }
            Output::General(cloud) => {
                report_losses(output, cloud);
                io::write_cloud(output, CloudRef::General(cloud), encoding)?;
            }
            &Output::Depth { width, height } => {
                if let Some(depth_m) = &self.smoothed.depth_m {
                    io::write_depth_metres(output, width, depth_m)?;
                } else {
                    let raw = self.smoothed.depth.clone().context("no depth was computed")?;
                    io::write_depth(output, &DepthImage { width, height, raw })?;
                }
            }
        }
        Ok(())
    }

    fn status_counts(&self) -> StatusCounts {
        StatusCounts::of(self.smoothed.status_counts().unwrap_or_default())
    }
}

/// Whether a file is an image of depth by its name.
fn is_depth(path: &Path) -> bool {
    matches!(Format::of_extension(path), Some(Format::DepthPng | Format::DepthTiff))
}

/// What an engine and its results take at most for each point (the default setting and all outputs: 130 to 150 bytes).
const ENGINE_BYTES_A_POINT: u64 = 200;

/// How many points came in, and how many of those became holes.
struct PointCounts {
    valid: usize,
    lost: usize,
}

/// A larger share of lost points than this is reported.
const LOST_SHARE_TOLD: f64 = 0.01;
