//! `planish stream`: smooths frames as they arrive.

use crate::exit::ExitCode;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Result, bail};
use planish::Outputs;
use planish::stream::{self, FolderSink, Latency, Sink, SinkFormat, StreamOptions, StreamStatistics};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::checks::{check_is_new, check_not_input, is_mcap};
use super::sources::open_source;
use super::status_line::{StatusLine, ms};
use crate::args::{StreamArgs, StreamFormatArg, by_option_of_error, outputs_of};
use crate::signals::stop_by;

/// Report at the end of a stream.
#[derive(Serialize)]
struct Report {
    frames_in: u64,
    frames_out: u64,
    dropped: u64,
    unreadable: u64,
    dropped_by_sinks: u64,
    failed_sinks: u64,
    /// Number of frames without a pose, with --poses.
    without_pose: u64,
    /// Number of time gaps after which smoothing over time restarted.
    gaps: u64,
    seconds: f64,
    fps: f64,
    latency_ms: LatencyMs,
    stage_ms: StageMs,
    engine: &'static str,
    /// Mean changes from frame to frame, with --temporal.
    #[serde(skip_serializing_if = "Option::is_none")]
    over_time: Option<OverTime>,
}

/// Mean changes from one frame to the next.
#[derive(Serialize)]
struct OverTime {
    jitter_measured_mm: f64,
    jitter_mm: f64,
    restarted_share: f64,
    carried_share: f64,
}

#[derive(Serialize)]
struct LatencyMs {
    p50: f64,
    p95: f64,
    p99: f64,
    max: f64,
}

/// Mean times per frame in milliseconds.
#[derive(Serialize)]
struct StageMs {
    capture: f64,
    smooth: f64,
    sinks: f64,
}

pub fn run(args: &StreamArgs) -> Result<ExitCode> {
    #[cfg(not(feature = "rerun"))]
    if args.rerun || args.rrd.is_some() {
        bail!(
            "this planish was built without the feature rerun; build it with `cargo install --path crates/planish-cli \
             --features rerun`"
        );
    }
    let of_rigs = [
        ("--fuse", args.fuse.is_some()),
        ("--save-cameras", args.save_cameras.is_some()),
        ("--picture", args.picture.is_some()),
        ("--registration", args.registration.is_some()),
        ("--voxel", args.voxel.is_some()),
    ];
    if let Some((name, _)) = of_rigs.iter().find(|(_, is_given)| *is_given) {
        bail!("{name} applies only to rigs; give --rig instead of a source");
    }
    if args.source.name().ends_with("rig.json") && Path::new(args.source.name()).is_file() {
        bail!("{}: the source is a rig; run `planish stream --rig {0}`", args.source.name());
    }
    let mut settings = args.smoothing.settings_with(&args.gpus)?;
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
    let (name, topics) = (Path::new(args.source.name()), &args.source.topics.topic);
    let topic = topics.first().map(String::as_str);
    let poses = args.poses.read_in(&settings, name, topic, &args.source.memory.options())?;
    let follows = settings.tracks_camera() || poses.is_some();
    let options = StreamOptions::from_settings(settings)
        .map_err(by_option_of_error)?
        .with_poses(poses)
        .with_max_frames(args.source.limits.frames)
        .with_max_duration(args.source.limits.max_duration()?);
    // Opening may take seconds. Until it is done, a signal ends the command at once.
    let stop = Arc::default();
    let source = open_source(&args.source, &stop)?;
    stop_by(&stop);
    // The sink is created after the source, so that a missing source leaves no folder behind.
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
    let statistics = stream::Stream::new(source, options)
        .with_sinks(sinks)
        .with_stop(&stop)
        .with_events(|event| line.tell(event))
        .run()?;
    line.end();
    let report = report(&statistics);
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print_report(&report);
        if !follows && statistics.flicker.is_some_and(|flicker| flicker.looks_like_a_moving_camera()) {
            outln!("  many points restart in every frame; if the camera moves, add --track");
        }
    }
    let is_empty = args.save.is_some() && statistics.frames_out == 0 && !stop.load(Ordering::Relaxed);
    if is_empty {
        errln!("{}: the source delivered no frames; nothing was written", args.source.name());
    }
    let has_failed = statistics.failed_sinks + statistics.unreadable > 0 || is_empty;
    Ok(if has_failed { ExitCode::from(1) } else { ExitCode::SUCCESS })
}

impl StreamArgs {
    /// Returns the format of the files in an output folder.
    pub fn sink_format(&self) -> SinkFormat {
        match self.format {
            None | Some(StreamFormatArg::Pcd) => SinkFormat::Pcd,
            Some(StreamFormatArg::Ply) => SinkFormat::Ply,
            Some(StreamFormatArg::Png) => SinkFormat::DepthPng,
        }
    }
}

/// Returns a sink that writes a folder, or a recording if the name ends in .mcap.
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

fn report(statistics: &StreamStatistics) -> Report {
    let Latency { p50, p95, p99, max, .. } = statistics.latency();
    Report {
        frames_in: statistics.frames_in,
        frames_out: statistics.frames_out,
        dropped: statistics.dropped,
        unreadable: statistics.unreadable,
        dropped_by_sinks: statistics.dropped_by_sinks,
        failed_sinks: statistics.failed_sinks,
        without_pose: statistics.without_pose,
        gaps: statistics.gaps,
        seconds: statistics.duration().as_secs_f64(),
        fps: statistics.fps(),
        latency_ms: LatencyMs { p50: ms(p50), p95: ms(p95), p99: ms(p99), max: ms(max) },
        stage_ms: StageMs {
            capture: ms(statistics.time_capturing) / statistics.frames_in.max(1) as f64,
            smooth: ms(statistics.time_smoothing) / statistics.frames_out.max(1) as f64,
            sinks: ms(statistics.time_in_sinks) / statistics.frames_out.max(1) as f64,
        },
        engine: statistics.engine.name(),
        over_time: statistics.flicker.map(|flicker| OverTime {
            jitter_measured_mm: 1e3 * flicker.measured_m,
            jitter_mm: 1e3 * flicker.smoothed_m,
            restarted_share: flicker.restarted,
            carried_share: flicker.carried,
        }),
    }
}

fn print_report(report: &Report) {
    let Report { frames_in, frames_out, dropped, unreadable, seconds, fps, latency_ms, engine, .. } = report;
    outln!("{frames_out} frames in {seconds:.1} s, {fps:.1} per second, engine {engine}");
    outln!("  {frames_in} frames received, {dropped} replaced by newer ones, {unreadable} unreadable");
    if report.without_pose > 0 {
        outln!("  {} frames without a pose, smoothed as if the camera stood still", report.without_pose);
    }
    if report.gaps > 0 {
        outln!("  {} time gaps; smoothing over time restarted after each", report.gaps);
    }
    let LatencyMs { p50, p95, p99, max } = latency_ms;
    outln!("  from frame to result: {p50:.1} ms, 95 % within {p95:.1}, 99 % within {p99:.1}, all within {max:.1}");
    if let Some(OverTime { jitter_measured_mm, jitter_mm, restarted_share, carried_share }) = report.over_time {
        outln!(
            "  over time: jitter {jitter_measured_mm:.2} mm as measured, {jitter_mm:.2} smoothed; {:.1} % of the points \
             restarted, {:.1} % carried over",
            1e2 * restarted_share,
            1e2 * carried_share
        );
    }
    let StageMs { capture, smooth, sinks } = report.stage_ms;
    outln!("  mean per frame: {capture:.1} ms in the source, {smooth:.1} in the engine, {sinks:.1} in the sinks");
}
