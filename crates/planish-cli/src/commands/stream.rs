//! `planish stream`: frames smoothed as they come.

use crate::exit::ExitCode;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::source::{self, OwnedFrame, Source, SourceOptions};
use planish::stream::{self, FolderSink, Latency, Sink, SinkFormat, StreamEvent, StreamOptions, StreamStatistics};
use planish::{DeviceError, Error, Outputs, SensorModel};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::checks::{check_is_new, check_not_input, is_mcap};
use crate::args::{LimitArgs, SourceArgs, StreamArgs, StreamFormatArg, by_option, by_option_of_error, outputs_of};
use crate::signals::stop_by;

/// What is said at the end.
#[derive(Serialize)]
struct Report {
    frames_in: u64,
    frames_out: u64,
    dropped: u64,
    unreadable: u64,
    dropped_by_sinks: u64,
    failed_sinks: u64,
    seconds: f64,
    fps: f64,
    latency_ms: LatencyMs,
    stage_ms: StageMs,
    engine: &'static str,
}

#[derive(Serialize)]
struct LatencyMs {
    p50: f64,
    p95: f64,
    p99: f64,
    max: f64,
}

/// Means of a frame.
#[derive(Serialize)]
struct StageMs {
    capture: f64,
    smooth: f64,
    sinks: f64,
}

pub fn run(args: &StreamArgs) -> Result<ExitCode> {
    if args.format.is_some() && args.save.is_none() && args.save_cameras.is_none() {
        bail!("--format says what --save writes: give a folder to save into");
    }
    #[cfg(not(feature = "rerun"))]
    if args.rerun || args.rrd.is_some() {
        bail!(
            "this planish was built without the feature rerun: build it with `cargo install --path crates/planish-cli --features rerun`"
        );
    }
    if let Some(rig) = &args.rig {
        return super::rig::stream(args, rig);
    }
    let of_rigs = [
        ("--fuse", args.fuse.is_some()),
        ("--save-cameras", args.save_cameras.is_some()),
        ("--picture", args.picture.is_some()),
        ("--registration", args.registration.is_some()),
        ("--voxel", args.voxel.is_some()),
    ];
    if let Some((name, _)) = of_rigs.iter().find(|(_, is_given)| *is_given) {
        bail!("{name} is for several cameras: give --rig, and no source beside it");
    }
    if args.source.name().ends_with("rig.json") && Path::new(args.source.name()).is_file() {
        bail!("{}: a rig is streamed by `planish stream --rig {0}`", args.source.name());
    }
    let mut settings = args.gpus.over(args.smoothing.settings()?)?;
    let mut outputs = outputs_of(&args.fields);
    let mut sinks: Vec<Box<dyn Sink>> = Vec::new();
    let format = args.sink_format();
    if args.save.is_some() && format == SinkFormat::DepthPng {
        outputs = Outputs::DEPTH;
    }
    #[cfg(feature = "rerun")]
    if args.rerun || args.rrd.is_some() {
        outputs.points = true;
    }
    settings.outputs = Some(outputs);
    // A stream removes floating pixels before it has a frame to estimate a sensor from.
    if settings.remove_floating == Some(true) {
        settings.frame_params().map_err(by_option)?;
    }
    let floating_sensor = settings.frame_floating_sensor();
    let options = StreamOptions::from_settings(settings)
        .map_err(by_option_of_error)?
        .with_max_frames(args.source.limits.frames)
        .with_max_duration(args.source.limits.max_duration()?);
    // Opening may take seconds: until then a signal ends the command at once.
    let stop = Arc::default();
    let mut source = open_source(&args.source, &stop)?;
    stop_by(&stop);
    if let Some(sensor) = floating_sensor {
        source = Box::new(WithoutFloating { source, sensor });
    }
    // After the source: one that is not there leaves no folder behind.
    if let Some(folder) = &args.save {
        check_not_input(Path::new(args.source.name()), folder, None)?;
        sinks.push(saving_sink(folder, format, outputs)?);
    }
    #[cfg(feature = "rerun")]
    if let Some(file) = &args.rrd {
        sinks.push(Box::new(stream::RerunSink::save(file)?));
    } else if args.rerun {
        sinks.push(Box::new(stream::RerunSink::spawn()?));
    }

    let line = StatusLine::new();
    let statistics = stream::run(source, &options, sinks, &stop, |event| line.tell(event))?;
    line.end();
    let report = report(&statistics);
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print_report(&report);
    }
    Ok(if statistics.failed_sinks + statistics.unreadable > 0 { ExitCode::from(1) } else { ExitCode::SUCCESS })
}

impl StreamArgs {
    /// What is written into folders.
    pub fn sink_format(&self) -> SinkFormat {
        match self.format {
            None | Some(StreamFormatArg::Pcd) => SinkFormat::Pcd,
            Some(StreamFormatArg::Ply) => SinkFormat::Ply,
            Some(StreamFormatArg::Png) => SinkFormat::DepthPng,
        }
    }
}

/// A sink that writes a folder, or a recording where the name ends in .mcap.
pub fn saving_sink(output: &Path, format: SinkFormat, outputs: Outputs) -> Result<Box<dyn Sink>> {
    if is_mcap(output) {
        check_is_new(output)?;
        #[cfg(feature = "mcap")]
        return Ok(Box::new(planish::bag::BagSink::create(output, outputs)?));
        #[cfg(not(feature = "mcap"))]
        bail!("{}: this planish was built without the feature mcap", output.display());
    }
    Ok(Box::new(FolderSink::create(output, format, outputs)?))
}

/// Opens a source; one that is to come back is waited for until `stop` is set.
pub fn open_source(args: &SourceArgs, stop: &Arc<AtomicBool>) -> Result<Box<dyn Source>> {
    let SourceArgs { topics, camera, align, mode, limits, .. } = args;
    if topics.topic.len() > 1 {
        bail!("--topic: a stream has one topic; `planish smooth` takes several");
    }
    let options = SourceOptions::default()
        .with_topics(topics.topic.first().cloned(), topics.camera_info_topic.clone())
        .with_camera(camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(camera.depth_units_per_metre)
        .with_alignment(align.map(Into::into))
        .with_mode(*mode)
        .with_fps(limits.fps)
        .with_frames(limits.frames);
    if limits.reconnect && !source::is_camera(args.name()) {
        bail!("--reconnect waits for a camera; {} is none", args.name());
    }
    open_named(args.name(), options, limits, stop)
}

impl SourceArgs {
    /// The source; empty where a rig stands instead.
    pub fn name(&self) -> &str {
        self.name.as_deref().unwrap_or_default()
    }
}

/// Opens a source by its name; one that is to come back is waited for until `stop` is set.
pub fn open_named(
    name: &str,
    options: SourceOptions,
    limits: &LimitArgs,
    stop: &Arc<AtomicBool>,
) -> Result<Box<dyn Source>> {
    if name == "synthetic" || name.starts_with("synthetic:") {
        errln!("{name}: rendering its frames first");
    }
    let source = match source::open(name, &options) {
        Err(Error::Device(error @ DeviceError::NotFound { .. })) if limits.reconnect => {
            errln!("{error}; waiting for it");
            None
        }
        opened => Some(opened?),
    };
    if let Some(description) = source.as_ref().and_then(|source| source.description()) {
        errln!("{description}");
    }
    // Beyond what the clock can count there is no limit.
    let until = limits.max_duration()?.and_then(|longest| Instant::now().checked_add(longest));
    let source = match source {
        Some(source) if !limits.reconnect => return Ok(source),
        source => source,
    };
    let name = name.to_owned();
    let open = move || source::open(&name, &options);
    let retry = Duration::from_secs(1);
    let (stop, ended) = (Arc::clone(stop), Arc::default());
    Ok(Box::new(Reconnecting { open, source, stop, ended, until, retry, dropped_before: 0 }))
}

/// A source whose floating pixels are holes.
pub struct WithoutFloating {
    pub source: Box<dyn Source>,
    pub sensor: SensorModel,
}

impl Source for WithoutFloating {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        self.source.end_with(ended);
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let mut frame = self.source.next_frame()?;
        match &mut frame {
            Some(OwnedFrame::Depth(depth)) => {
                depth.remove_floating(&self.sensor);
            }
            Some(OwnedFrame::Cloud { cloud, .. }) => {
                cloud.remove_floating(&self.sensor);
            }
            _ => {}
        }
        Ok(frame)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.frame_name()
    }

    fn dropped(&self) -> u64 {
        self.source.dropped()
    }

    fn is_live(&self) -> bool {
        self.source.is_live()
    }
}

/// A camera that is opened again when it comes back.
struct Reconnecting<Open> {
    open: Open,
    source: Option<Box<dyn Source>>,
    /// Set by the user, who wants no more frames.
    stop: Arc<AtomicBool>,
    /// Set by the stream, which has ended.
    ended: Arc<AtomicBool>,
    /// It is not waited for longer than this.
    until: Option<Instant>,
    /// How long to wait before it is looked for again.
    retry: Duration,
    /// Frames that the camera dropped before it went.
    dropped_before: u64,
}

impl<Open: FnMut() -> Result<Box<dyn Source>, Error> + Send> Source for Reconnecting<Open> {
    fn end_with(&mut self, ended: Arc<AtomicBool>) {
        if let Some(source) = &mut self.source {
            source.end_with(Arc::clone(&ended));
        }
        self.ended = ended;
    }

    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        let is_set = |flag: &AtomicBool| flag.load(Ordering::Relaxed);
        while !is_set(&self.stop) && !is_set(&self.ended) && self.until.is_none_or(|until| Instant::now() < until) {
            if let Some(source) = &mut self.source {
                match source.next_frame() {
                    Err(Error::Device(DeviceError::Gone { what })) => {
                        errln!("{what}; waiting for it to come back");
                        self.dropped_before += source.dropped();
                        self.source = None;
                    }
                    other => return other,
                }
            }
            match (self.open)() {
                Ok(mut source) => {
                    errln!("{}", source.description().unwrap_or_else(|| "the camera is there".to_owned()));
                    source.end_with(Arc::clone(&self.ended));
                    self.source = Some(source);
                }
                Err(_) => std::thread::sleep(self.retry),
            }
        }
        Ok(None)
    }

    fn frame_name(&self) -> Option<String> {
        self.source.as_ref().and_then(|source| source.frame_name())
    }

    fn dropped(&self) -> u64 {
        self.dropped_before + self.source.as_ref().map_or(0, |source| source.dropped())
    }

    fn is_live(&self) -> bool {
        true
    }
}

impl LimitArgs {
    pub fn max_duration(&self) -> Result<Option<Duration>> {
        let duration = |seconds| {
            let duration = Duration::try_from_secs_f64(seconds).ok();
            duration.with_context(|| format!("--duration {seconds:?}: a number of seconds is needed, 0 or more"))
        };
        self.duration.map(duration).transpose()
    }
}

/// One line on a terminal, or a plain line every 5 s.
pub struct StatusLine {
    bar: ProgressBar,
    last: std::cell::Cell<Instant>,
}

impl StatusLine {
    const PLAIN_EVERY: Duration = Duration::from_secs(5);

    pub fn new() -> Self {
        let bar = ProgressBar::new_spinner().with_style(ProgressStyle::default_spinner());
        Self { bar, last: std::cell::Cell::new(Instant::now()) }
    }

    fn tell(&self, event: StreamEvent<'_>) {
        match event {
            StreamEvent::Warning(warning) => self.warn(&warning),
            StreamEvent::Frame(statistics) => self.show("frames", statistics),
            _ => {}
        }
    }

    pub fn warn(&self, warning: &str) {
        self.bar.suspend(|| errln!("warning: {warning}"));
    }

    /// Shows how the stream goes, if it is time.
    pub fn show(&self, what: &str, statistics: &StreamStatistics) {
        let every = if self.bar.is_hidden() { Self::PLAIN_EVERY } else { Duration::from_millis(200) };
        if self.last.get().elapsed() < every {
            return;
        }
        self.last.set(Instant::now());
        let Latency { p50, p99, .. } = statistics.latency();
        let text = format!(
            "{} {what}, {:.1} a second, {:.1} ms (p99 {:.1}), {}",
            statistics.frames_out,
            statistics.fps(),
            ms(p50),
            ms(p99),
            statistics.engine.name()
        );
        if self.bar.is_hidden() {
            errln!("{text}");
        } else {
            self.bar.set_message(text);
            self.bar.tick();
        }
    }

    pub fn end(&self) {
        self.bar.finish_and_clear();
    }
}

pub fn ms(duration: Duration) -> f64 {
    1e3 * duration.as_secs_f64()
}

fn report(statistics: &StreamStatistics) -> Report {
    let Latency { p50, p95, p99, max, .. } = statistics.latency();
    Report {
        frames_in: statistics.frames_in,
        frames_out: statistics.frames_out,
        dropped: statistics.dropped,
        unreadable: statistics.unreadable,
        dropped_by_sinks: statistics.dropped_by_sinks,
        failed_sinks: statistics.failed_sinks,
        seconds: statistics.duration().as_secs_f64(),
        fps: statistics.fps(),
        latency_ms: LatencyMs { p50: ms(p50), p95: ms(p95), p99: ms(p99), max: ms(max) },
        stage_ms: StageMs {
            capture: ms(statistics.time_capturing) / statistics.frames_in.max(1) as f64,
            smooth: ms(statistics.time_smoothing) / statistics.frames_out.max(1) as f64,
            sinks: ms(statistics.time_in_sinks) / statistics.frames_out.max(1) as f64,
        },
        engine: statistics.engine.name(),
    }
}

fn print_report(report: &Report) {
    let Report { frames_in, frames_out, dropped, unreadable, seconds, fps, latency_ms, engine, .. } = report;
    outln!("{frames_out} frames in {seconds:.1} s, {fps:.1} a second, engine {engine}");
    outln!("  {frames_in} frames received, {dropped} dropped for newer ones, {unreadable} unreadable");
    let LatencyMs { p50, p95, p99, max } = latency_ms;
    outln!("  from frame to result: {p50:.1} ms, 95 % within {p95:.1}, 99 % within {p99:.1}, all within {max:.1}");
    let StageMs { capture, smooth, sinks } = report.stage_ms;
    outln!("  a frame's mean: {capture:.1} ms in the source, {smooth:.1} in the engine, {sinks:.1} in the sinks");
}

#[cfg(test)]
mod tests {
    use planish::{Camera, DepthFrame};

    use super::*;

    /// Gives some frames, then is unplugged.
    struct Unplugged {
        frames: u32,
    }

    impl Source for Unplugged {
        fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
            if self.frames == 0 {
                return Err(DeviceError::Gone { what: "the test's camera".into() }.into());
            }
            self.frames -= 1;
            let camera = Camera::kinect_v1().with_shape((4, 3));
            Ok(Some(OwnedFrame::Depth(DepthFrame::new(camera, vec![1000; 12]).unwrap())))
        }
    }

    #[test]
    fn a_camera_that_comes_back_goes_on_and_one_that_does_not_is_waited_for_until_the_end() {
        let mut attempts = 0;
        let open = move || -> Result<Box<dyn Source>, Error> {
            attempts += 1;
            match attempts {
                // Not there at the first look, back at the second, and never again after that.
                2 => Ok(Box::new(Unplugged { frames: 3 })),
                _ => Err(DeviceError::Failed { what: "no camera".into() }.into()),
            }
        };
        let stop = Arc::new(AtomicBool::new(false));
        let mut source = Reconnecting {
            open,
            source: Some(Box::new(Unplugged { frames: 2 })),
            stop: Arc::clone(&stop),
            ended: Arc::default(),
            until: Some(Instant::now() + Duration::from_millis(300)),
            retry: Duration::from_millis(5),
            dropped_before: 0,
        };
        for _ in 0..5 {
            assert!(source.next_frame().unwrap().is_some());
        }
        assert!(source.next_frame().unwrap().is_none());
        source.until = None;
        stop.store(true, Ordering::Relaxed);
        assert!(source.next_frame().unwrap().is_none());
        stop.store(false, Ordering::Relaxed);
        source.end_with(Arc::new(AtomicBool::new(true)));
        assert!(source.next_frame().unwrap().is_none());
    }
}
