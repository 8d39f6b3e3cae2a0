//! Recordings of ROS 2: into another recording, into a folder of frames, or from one.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::bag::{SmoothBagOptions, SmoothBagReport, is_bag, refuse_other_bags, smooth_bag};
use planish::ros::MessageSmoother;
use planish::source::{self, SourceFrame, SourceOptions};
use planish::stream::{self, SinkFormat, StreamEvent, StreamOptions};
use planish::{EngineError, Error, Outputs};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::super::checks::{check_not_input, is_mcap};
use super::super::stream::saving_sink;
use crate::args::{FieldArg, SmoothArgs};
use crate::exit::ExitCode;
use crate::signals::{INTERRUPTED, stop_flag};

#[derive(Serialize)]
struct Report<'a> {
    input: String,
    output: String,
    engine: Option<&'static str>,
    topics: Vec<TopicReport<'a>>,
    /// Messages of other topics.
    copied: u64,
    /// Why the recording ends before it should.
    cut_off: Option<&'a str>,
    seconds: f64,
}

#[derive(Serialize)]
struct TopicReport<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'static str,
    smoothed: u64,
    /// Copied as they were.
    failed: u64,
    first_failure: Option<&'a str>,
}

/// Smooths a recording, or a folder into one; `None` where input and output are neither.
pub fn run(args: &SmoothArgs) -> Result<Option<ExitCode>> {
    refuse_other_bags(&args.input)?;
    refuse_other_bags(&args.output)?;
    let (reads, writes) = (is_bag(&args.input), is_mcap(&args.output));
    if !(reads || writes && args.input.is_dir()) {
        if writes && !is_mcap(&args.input) {
            bail!("{}: a recording is written from a folder of frames, or from a recording", args.output.display());
        }
        if is_mcap(&args.input) && args.input.is_file() {
            bail!("{}: no recording in MCAP: it does not begin as one", args.input.display());
        }
        return Ok(None);
    }
    check_not_input(&args.input, &args.output, Some(args.overwrite))?;
    for (option, is_given) in [
        ("--encoding", args.encoding.is_some()),
        ("--repeat", args.repeat > 1),
        ("--sensor-pose", args.pose.sensor_pose.is_some()),
        ("--remove-floating", args.smoothing.remove_floating),
        ("--fields status", args.fields.contains(&FieldArg::Status)),
    ] {
        if is_given {
            bail!("{}: {option} is not for recordings", args.input.display());
        }
    }
    if reads && writes { between_recordings(args).map(Some) } else { frames(args).map(Some) }
}

fn between_recordings(args: &SmoothArgs) -> Result<ExitCode> {
    let mut smoother = MessageSmoother::new(args.smoothing.params()?, args.smoothing.options(args.outputs())?)
        .with_general(args.smoothing.general_params()?)
        .with_adapt_stride(args.smoothing.adapts_window())
        .with_read_options(args.memory.read_options());
    let options = SmoothBagOptions::default()
        .with_topics(args.topics.topic.clone())
        .with_camera_info_topic(args.topics.camera_info_topic.clone())
        .with_camera(args.camera.camera_of_any_shape()?)
        .with_points_topic(args.points_topic.clone())
        .with_read_options(args.memory.read_options());
    let bar =
        ProgressBar::new(0).with_style(ProgressStyle::with_template("{bar:40} {pos}/{len} messages, {eta} left")?);
    let mut tell = |done, total: Option<u64>| {
        bar.set_length(total.unwrap_or(done));
        bar.set_position(done);
    };
    let start = Instant::now();
    let stop = stop_flag();
    let result = smooth_bag(&args.input, &args.output, &mut smoother, &options, &stop, &mut tell);
    bar.finish_and_clear();
    let report = match result {
        Err(Error::Engine(EngineError::Stopped)) => {
            errln!("{}: stopped; nothing was written", args.output.display());
            return Ok(ExitCode::from(INTERRUPTED));
        }
        other => other?,
    };
    let engine = smoother.engine().map(|engine| engine.name());
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
            copied: report.copied,
            cut_off: report.cut_off.as_deref(),
            seconds,
        };
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        for topic in &report.topics {
            let rate = topic.smoothed as f64 / seconds.max(1e-9);
            let engine = engine.unwrap_or("none");
            outln!(
                "{}: {} messages smoothed in {seconds:.1} s, {rate:.1} a second, engine {engine}",
                topic.topic,
                topic.smoothed
            );
        }
        outln!("  {} messages of other topics copied -> {}", report.copied, args.output.display());
    }
    for topic in report.topics.iter().filter(|topic| topic.failed > 0) {
        let first = topic.first_failure.as_deref().unwrap_or_default();
        errln!("{}: {} messages copied as they were; the first: {first}", topic.topic, topic.failed);
    }
    if let Some(why) = &report.cut_off {
        errln!("{}: {why}; everything before that was written", args.input.display());
    }
    let is_clean = failed == 0 && report.cut_off.is_none();
    Ok(if is_clean { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

/// A recording into a folder, or a folder into a recording.
fn frames(args: &SmoothArgs) -> Result<ExitCode> {
    if args.points_topic.is_some() || args.topics.topic.len() > 1 {
        bail!(
            "{}: --points-topic, and more than one --topic, are for a recording out of a recording",
            args.output.display()
        );
    }
    let stop = stop_flag();
    let options = SourceOptions::default()
        .with_camera(args.camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(args.camera.depth_scale)
        .with_topics(args.topics.topic.first().cloned(), args.topics.camera_info_topic.clone());
    let name = args.input.to_string_lossy().into_owned();
    // Whether it has depth shows in the first frame.
    let is_depth = match source::open(&name, &options)?.next_frame()? {
        None => bail!("{}: has no frames", args.input.display()),
        Some(SourceFrame::Depth(_)) => true,
        Some(_) => false,
    };
    let wants = |extension: &str| args.format.as_deref().is_some_and(|format| format.eq_ignore_ascii_case(extension));
    let wants_points = wants("pcd") || wants("ply") || args.fields.iter().any(|field| *field != FieldArg::None);
    let format = match (is_depth && !wants_points, wants("ply")) {
        (true, _) => SinkFormat::DepthPng,
        (false, true) => SinkFormat::Ply,
        (false, false) => SinkFormat::Pcd,
    };
    let outputs = if format == SinkFormat::DepthPng { Outputs::DEPTH } else { args.outputs() };
    let options_of_stream = StreamOptions::new(args.smoothing.params()?, args.smoothing.options(outputs)?)
        .with_adapt_stride(args.smoothing.adapts_window());
    let sink = saving_sink(Path::new(&args.output), format, outputs)?;
    let source = source::open(&name, &options)?;
    let tell = |event: StreamEvent<'_>| {
        if let StreamEvent::Warning(warning) = event {
            errln!("warning: {warning}");
        }
    };
    let statistics = stream::run(source, &options_of_stream, vec![sink], &Arc::clone(&stop), tell)?;
    let (frames, seconds) = (statistics.frames_out, statistics.duration().as_secs_f64());
    let (engine, unreadable) = (statistics.engine.name(), statistics.unreadable);
    if args.json {
        let report = serde_json::json!({
            "input": name, "output": args.output.display().to_string(), "engine": engine, "frames": frames,
            "unreadable": unreadable, "seconds": seconds,
        });
        outln!("{report}");
    } else {
        let rate = statistics.fps();
        outln!(
            "{frames} frames smoothed in {seconds:.1} s, {rate:.1} a second, engine {engine} -> {}",
            args.output.display()
        );
    }
    Ok(if statistics.failed_sinks + unreadable > 0 { ExitCode::from(1) } else { ExitCode::SUCCESS })
}
