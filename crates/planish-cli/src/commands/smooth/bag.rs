//! Smooths a ROS 2 recording into another or into a folder of frames, or a folder of frames into a recording.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::bag::{BagSink, SmoothBagOptions, SmoothBagReport, file_of, is_bag, refuse_other_bags, smooth_bag};
use planish::io::printable_line;
use planish::ros::MessageSmoother;
use planish::source::{self, OwnedFrame, SourceOptions};
use planish::stream::{self, FolderSink, Sink, SinkFormat, StreamEvent, StreamOptions};
use planish::{EngineError, Error, Outputs};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::super::checks::{check_not_beside, check_not_input, is_mcap};
use super::clouds::smooth_clouds;
use crate::args::{FieldArg, SmoothArgs};
use crate::exit::ExitCode;
use crate::signals::{INTERRUPTED, stop_flag};

#[derive(Serialize)]
struct Report<'a> {
    input: String,
    output: String,
    engine: Option<&'static str>,
    topics: Vec<TopicReport<'a>>,
    /// Number of messages without a pose, if poses were given.
    without_pose: u64,
    /// Number of copied messages on other topics.
    copied: u64,
    /// Number of chunks with a wrong checksum.
    damaged_chunks: u64,
    /// Reason why the recording ends early.
    cut_off: Option<&'a str>,
    seconds: f64,
}

#[derive(Serialize)]
struct TopicReport<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'static str,
    smoothed: u64,
    /// Number of messages copied unchanged because they could not be smoothed.
    failed: u64,
    first_failure: Option<&'a str>,
}

/// Maximum number of frames to try until one is readable.
const FRAMES_TRIED: usize = 1000;

/// Smooths a recording, or a folder into a recording; returns `None` if neither input nor output is a recording.
pub fn run(args: &SmoothArgs) -> Result<Option<ExitCode>> {
    refuse_other_bags(&args.input)?;
    let input = file_of(&args.input)?;
    let (reads, writes) = (is_bag(&input), is_mcap(&args.output));
    if !(reads || writes && input.is_dir()) {
        if !(writes || is_mcap(&input)) {
            return Ok(None);
        }
        if !input.exists() {
            bail!("{}: no such file or folder", input.display());
        }
        if is_mcap(&input) {
            bail!("{}: not an MCAP recording: its signature is missing", input.display());
        }
        bail!("{}: a recording can be written only from a folder of frames or from a recording", args.output.display());
    }
    check_not_input(&input, &args.output, Some(args.overwrite))?;
    check_not_beside([&args.smoothing.settings, &args.camera.camera_file, &args.poses.poses], &args.output)?;
    if !writes && !args.output.is_dir() && args.output.extension().is_some() {
        bail!(
            "{}: the output of a recording cannot be a single file; choose a folder, or a name that ends in .mcap",
            args.output.display()
        );
    }
    for (option, is_given) in [
        ("--encoding", args.encoding.is_given()),
        ("--repeat", args.repeat > 1),
        ("--gpus", args.gpus.gpus.is_some()),
        ("--sensor-pose", args.pose.sensor_pose.is_some()),
        ("--remove-floating", args.smoothing.remove_floating == Some(true)),
        ("--decimate", args.smoothing.decimate.is_some()),
        ("--min-range", args.smoothing.min_range.is_some()),
        ("--max-range", args.smoothing.max_range.is_some()),
        ("--format", writes && args.format.is_some()),
        ("--unit", args.reading.unit.is_some()),
        ("--columns", args.reading.columns.is_some()),
        ("--depth-units-per-metre", reads && args.camera.depth_units_per_metre.is_some()),
    ] {
        if is_given {
            bail!("{}: {option} cannot be used with recordings", input.display());
        }
    }
    if reads && writes { between_recordings(args, &input).map(Some) } else { frames(args, &input).map(Some) }
}

fn between_recordings(args: &SmoothArgs, input: &Path) -> Result<ExitCode> {
    let mut settings = args.smoothing.settings()?;
    settings.outputs = Some(args.outputs());
    let poses = args.poses.of_recording(&settings, &args.reading.read_options())?;
    let mut smoother = MessageSmoother::new(settings)?.with_read_options(args.reading.read_options());
    let options = SmoothBagOptions::default()
        .with_topics(args.topics.topic.clone())
        .with_camera_info_topic(args.topics.camera_info_topic.clone())
        .with_camera(args.camera.camera_of_any_shape()?)
        .with_points_topic(args.points_topic.clone())
        .with_poses(poses)
        .with_read_options(args.reading.read_options());
    let bar =
        ProgressBar::new(0).with_style(ProgressStyle::with_template("{bar:40} {pos}/{len} messages, {eta} left")?);
    let mut tell = |done, total: Option<u64>| {
        bar.set_length(total.unwrap_or(done));
        bar.set_position(done);
    };
    let start = Instant::now();
    let stop = stop_flag();
    let result = smooth_bag(input, &args.output, &mut smoother, &options, &stop, &mut tell);
    bar.finish_and_clear();
    let report = match result {
        Err(Error::Engine(EngineError::Stopped)) => {
            errln!("{}: stopped; nothing was written", args.output.display());
            return Ok(ExitCode::from(INTERRUPTED));
        }
        other => other?,
    };
    let engine = smoother.engine().map(|engine| engine.name());
    let has_clouds = report.topics.iter().any(|topic| topic.kind == planish::bag::MessageKind::PointCloud2);
    if !args.fields.is_empty() && !has_clouds && args.points_topic.is_none() {
        errln!("warning: --fields has no effect on depth images; add clouds with --points-topic");
    }
    show(args, &report, engine, start.elapsed().as_secs_f64())
}

fn show(args: &SmoothArgs, report: &SmoothBagReport, engine: Option<&'static str>, seconds: f64) -> Result<ExitCode> {
    let failed: u64 = report.topics.iter().map(|topic| topic.failed).sum();
    if args.json {
        let topics = report.topics.iter().map(|topic| TopicReport {
            topic: &topic.topic,
            type_name: topic.kind.type_name(),
            smoothed: topic.smoothed,
            failed: topic.failed,
            first_failure: topic.first_failure.as_deref(),
        });
        let report = Report {
            input: args.input.display().to_string(),
            output: args.output.display().to_string(),
            engine,
            topics: topics.collect(),
            without_pose: report.without_pose,
            copied: report.copied,
            damaged_chunks: report.damaged_chunks,
            cut_off: report.cut_off.as_deref(),
            seconds,
        };
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        for topic in &report.topics {
            let rate = topic.smoothed as f64 / seconds.max(1e-9);
            let engine = engine.unwrap_or("none");
            outln!(
                "{}: {} smoothed in {seconds:.1} s, {rate:.1} per second, engine {engine}",
                printable_line(&topic.topic),
                count(topic.smoothed, "message")
            );
        }
        outln!("  {} of other topics copied -> {}", count(report.copied, "message"), args.output.display());
    }
    for topic in report.topics.iter().filter(|topic| topic.failed > 0) {
        let first = printable_line(topic.first_failure.as_deref().unwrap_or_default());
        errln!(
            "{}: {} copied unchanged because of errors; first error: {first}",
            printable_line(&topic.topic),
            count(topic.failed, "message")
        );
    }
    report_unknown_poses(args, report.without_pose);
    if !report.not_chosen.is_empty() {
        let topics = report.not_chosen.join(", ");
        let topics = printable_line(&topics);
        errln!(
            "{}: depth on {topics} was copied unchanged; select topics with --topic, which may be repeated",
            args.input.display()
        );
    }
    if let Some(warning) = &report.warning {
        errln!("warning: {}", printable_line(warning));
    }
    if report.damaged_chunks > 0 {
        let chunks = count(report.damaged_chunks, "chunk");
        errln!("{}: wrong checksum in {chunks}; messages in them may be damaged", args.input.display());
    }
    if let Some(why) = &report.cut_off {
        errln!("{}: {why}; everything before that was written", args.input.display());
    }
    let is_clean = failed == 0 && report.damaged_chunks == 0 && report.cut_off.is_none();
    Ok(if is_clean { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

/// Reports how many frames had no pose.
fn report_unknown_poses(args: &SmoothArgs, without_pose: u64) {
    if without_pose > 0 {
        errln!(
            "{}: no pose is known for {}, so the camera was assumed to stand still; poses must be at most 0.2 s apart",
            args.input.display(),
            count(without_pose, "frame")
        );
    }
}

/// Returns a number with its noun, in the plural unless the number is 1.
fn count(number: u64, what: &str) -> String {
    if number == 1 { format!("1 {what}") } else { format!("{number} {what}s") }
}

/// Smooths a recording into a folder, or a folder into a recording.
fn frames(args: &SmoothArgs, input: &Path) -> Result<ExitCode> {
    if args.points_topic.is_some() || args.topics.topic.len() > 1 {
        bail!(
            "{}: --points-topic, and more than one --topic, need a recording as both input and output",
            args.output.display()
        );
    }
    let wants = |extension: &str| args.format.as_deref().is_some_and(|format| format.eq_ignore_ascii_case(extension));
    if args.format.is_some() && !["png", "pcd", "ply"].into_iter().any(wants) {
        bail!("--format: unsupported format for the frames of a recording; expected png, pcd or ply");
    }
    if is_bag(input) && !is_mcap(&args.output) {
        let mut settings = args.smoothing.settings()?;
        settings.outputs = Some(args.outputs());
        if let Some(code) = smooth_clouds(args, input, &settings)? {
            return Ok(code);
        }
    }
    let stop = stop_flag();
    let options = SourceOptions::default()
        .with_camera(args.camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(args.camera.depth_units_per_metre)
        .with_topics(args.topics.topic.first().cloned(), args.topics.camera_info_topic.clone())
        .with_read_options(args.reading.read_options());
    let name = input.to_string_lossy().into_owned();
    let has_points = args.fields.iter().any(|field| *field != FieldArg::None) || wants("pcd") || wants("ply");
    let format = match (holds_depth(&name, &options, wants("png"))? && !has_points, wants("ply")) {
        (true, _) => SinkFormat::DepthPng,
        (false, true) => SinkFormat::Ply,
        (false, false) => SinkFormat::Pcd,
    };
    if wants("png") && format != SinkFormat::DepthPng {
        bail!(
            "{}: clouds without a camera, or with --fields, cannot be written as depth images; use --format pcd or ply",
            input.display()
        );
    }
    let outputs = if format == SinkFormat::DepthPng { Outputs::DEPTH } else { args.outputs() };
    let mut settings = args.smoothing.settings()?;
    settings.outputs = Some(outputs);
    let topic = args.topics.topic.first().map(String::as_str);
    let poses = args.poses.read_in(&settings, input, topic, &args.reading.read_options())?;
    let options_of_stream = StreamOptions::from_settings(settings)?.with_poses(poses);
    let sink: Box<dyn Sink> = if is_mcap(&args.output) {
        Box::new(BagSink::create(&args.output, outputs)?.discarding_if(Arc::clone(&stop)))
    } else {
        Box::new(FolderSink::create(&args.output, format, outputs)?)
    };
    let source = source::open(&name, &options)?;
    let tell = |event: StreamEvent<'_>| {
        if let StreamEvent::Warning(warning) = event {
            errln!("warning: {}", printable_line(&warning));
        }
    };
    let statistics = stream::Stream::new(source, options_of_stream)
        .with_sinks(vec![sink])
        .with_stop(&stop)
        .with_events(tell)
        .run()?;
    if stop.load(Ordering::Relaxed) {
        let left =
            if is_mcap(&args.output) { "nothing was written" } else { "the frames smoothed so far were written" };
        errln!("{}: stopped; {left}", args.output.display());
        return Ok(ExitCode::from(INTERRUPTED));
    }
    report_unknown_poses(args, statistics.without_pose);
    let (frames, seconds) = (statistics.frames_out, statistics.duration().as_secs_f64());
    let (engine, unreadable) = (statistics.engine.name(), statistics.unreadable);
    if args.json {
        let report = serde_json::json!({
            "input": name, "output": args.output.display().to_string(), "engine": engine, "frames": frames,
            "unreadable": unreadable, "seconds": seconds,
        });
        outln!("{report}");
    } else if frames > 0 {
        let rate = statistics.fps();
        outln!(
            "{} smoothed in {seconds:.1} s, {rate:.1} per second, engine {engine} -> {}",
            count(frames, "frame"),
            args.output.display()
        );
    }
    if frames == 0 {
        errln!("{}: no frame could be smoothed; nothing was written", input.display());
    }
    Ok(if statistics.failed_sinks + unreadable > 0 || frames == 0 { ExitCode::from(1) } else { ExitCode::SUCCESS })
}

/// Returns true if the first readable frame is a depth image, or, if `wants_depth` is set, a cloud with a camera.
fn holds_depth(name: &str, options: &SourceOptions, wants_depth: bool) -> Result<bool> {
    let mut source = source::open(name, options)?;
    let mut failure = None;
    // The limit ends the search if the source has failed permanently.
    for _ in 0..FRAMES_TRIED {
        match source.next_frame() {
            Ok(None) => break,
            Ok(Some(OwnedFrame::Depth(_))) => return Ok(true),
            Ok(Some(OwnedFrame::Cloud { cloud, .. })) => return Ok(wants_depth && cloud.camera.is_some()),
            Err(error) => failure = failure.or(Some(error)),
        }
    }
    match failure {
        Some(error) => Err(error.into()),
        None => bail!("{name}: the input has no frames"),
    }
}
