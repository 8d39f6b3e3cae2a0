//! `planish rig`: describes rigs, creates them from calibrations, and simulates them; and `planish stream --rig`.

mod evaluate;
mod simulate;

pub use evaluate::evaluate;

use std::fs;
use std::io::Read;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result, bail};
use planish::rig::{
    self, CameraStatistics, CamerasSink, FusedSink, PictureSink, Rig, RigCamera, RigEvent, RigOptions, RigSink,
    RigStatistics, RigWay, Viewpoint, calibration, rig_to_json,
};
use planish::source::Source;
use planish::stream::SinkFormat;
use planish::{Outputs, io, source};
use planish_bench::{errln, outln};
use serde::Serialize;

use super::checks::is_mcap;
use super::sources::open_named;
use super::status_line::{StatusLine, ms};
use crate::args::{LimitArgs, RigArgs, SourceArgs, StreamArgs, by_option_of_error, option_of, outputs_of};
use crate::exit::ExitCode;
use crate::signals::stop_by;

pub fn run(args: &RigArgs) -> Result<ExitCode> {
    if args.json && args.simulate.is_some() {
        bail!("--json cannot be combined with --simulate, which writes the data to rig.json");
    }
    if let (Some(cameras), Some(folder)) = (args.simulate, &args.out) {
        return simulate::simulate(args, cameras.into(), folder);
    }
    let Some(file) = &args.file else { bail!("no rig is given; expected a rig.json or a calibration") };
    let mut rig = if is_rig_file(file) {
        let of_calibrations =
            [("--base", args.base.is_some()), ("--frame", !args.frame.is_empty()), ("--scale", args.scale.is_some())];
        if let Some((name, _)) = of_calibrations.iter().find(|(_, is_given)| *is_given) {
            bail!("{}: {name} applies to calibrations, not to a rig.json", file.display());
        }
        Rig::read(file)?
    } else {
        read_calibration(args, file)?
    };
    let mut named_before: Vec<&str> = Vec::new();
    for named in &args.source {
        let pair = named.split_once('=').filter(|(_, source)| !source.is_empty());
        let (name, source) = pair.with_context(|| format!("--source {named}: expected NAME=SOURCE"))?;
        if named_before.contains(&name) {
            bail!("--source {named}: camera {name} already has a source");
        }
        named_before.push(name);
        let names: Vec<String> = rig.cameras.iter().map(|camera| camera.name.clone()).collect();
        let camera = rig
            .index_of(name)
            .with_context(|| format!("--source {named}: unknown camera; expected one of {}", names.join(", ")))?;
        rig.cameras[camera].source = Some(source.to_owned());
    }
    rig.validate().map_err(planish::Error::from)?;
    if let Some(out) = &args.out {
        if out.exists() {
            bail!("{}: already exists; choose another name or delete it", out.display());
        }
        let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let seen = rig.seen_from(folder);
        io::write_whole(out, rig_to_json(&seen).as_bytes()).with_context(|| out.display().to_string())?;
    }
    if args.json {
        outln!("{}", rig_to_json(&rig).trim_end());
    } else {
        describe(&rig);
        if let Some(out) = &args.out {
            let without = rig.cameras.iter().filter(|camera| camera.source.is_none()).count();
            let sources = if without > 0 { "; add the source of each camera, then run" } else { ";" };
            outln!("\nwritten to {}{sources} planish stream --rig {}", out.display(), out.display());
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Returns true if a file is planish's rig.json: a JSON object, unlike COLMAP's rig_config.json, which is a list.
fn is_rig_file(file: &Path) -> bool {
    /// Number of bytes to read from the file, enough for white space and the first brace.
    const HEAD_BYTES: u64 = 4096;
    let is_json = file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json"));
    let mut head = Vec::new();
    let read =
        file.is_file().then(|| fs::File::open(file).and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head)));
    let text = String::from_utf8_lossy(&head);
    let first = text.trim_start_matches('\u{feff}').trim_start().chars().next();
    matches!(read, Some(Ok(_))) && (first == Some('{') || is_json && !matches!(first, Some('[' | '<')))
}

fn read_calibration(args: &RigArgs, file: &Path) -> Result<Rig> {
    let mut options =
        calibration::CalibrationOptions::default().with_base(args.base.clone()).with_frames(args.frame.clone());
    if let Some(metres) = args.scale {
        if !(metres > 0.0 && metres.is_finite()) {
            bail!("--scale {metres}: expected a number of metres per unit above 0");
        }
        options = options.with_metres_per_unit(metres);
    }
    Ok(calibration::read(file, &options)?)
}

fn describe(rig: &Rig) {
    let frame = rig.frame.as_ref().map_or(String::new(), |frame| format!(", in the frame {frame}"));
    outln!(
        "{} cameras{frame}; timestamps within a moment differ by at most {:.0} ms",
        rig.cameras.len(),
        1e3 * rig.tolerance_s
    );
    for camera in &rig.cameras {
        let [x, y, z] = camera.pose.position_m;
        let rows = camera.pose.rotation();
        let [ahead_x, ahead_y, ahead_z] = [rows[0][2], rows[1][2], rows[2][2]];
        outln!(
            "  {:<16} at {x:.3}, {y:.3}, {z:.3} m, looking along {ahead_x:.3}, {ahead_y:.3}, {ahead_z:.3}",
            camera.name
        );
        let intrinsics = camera.camera.map(|camera| format!("fx {:.1}, fy {:.1}", camera.fx, camera.fy));
        let sensor = camera.sensor.and_then(|sensor| sensor.name());
        outln!(
            "  {:<16} source {}, intrinsics {}, sensor {}",
            "",
            camera.source.as_deref().unwrap_or("none yet"),
            intrinsics.as_deref().unwrap_or("from the source"),
            sensor.unwrap_or("from the options")
        );
    }
    for Viewpoint { pose, camera, .. } in &rig.viewpoints {
        let [x, y, z] = pose.position_m;
        outln!("  views also from   {x:.3}, {y:.3}, {z:.3} m, {}x{}", camera.width, camera.height);
    }
}

/// Report at the end of a rig's stream.
#[derive(Serialize)]
struct Report {
    moments: u64,
    complete: u64,
    dropped: u64,
    dropped_by_sinks: u64,
    failed_sinks: u64,
    seconds: f64,
    fps: f64,
    latency_ms: [f64; 3],
    engine: &'static str,
    way: &'static str,
    cameras: Vec<CameraReport>,
}

#[derive(Serialize)]
struct CameraReport {
    name: String,
    frames_in: u64,
    frames_out: u64,
    missing: u64,
    late: u64,
    out_of_order: u64,
    clock_jumps: u64,
    dropped: u64,
    unreadable: u64,
}

/// Streams a rig.
pub fn stream(args: &StreamArgs, file: &Path) -> Result<ExitCode> {
    let rig = Rig::read(file)?;
    let way: RigWay = args.fuse.map(Into::into).unwrap_or_default();
    let (outputs, format) = (rig_outputs(args), args.sink_format());
    let mut settings = args.smoothing.settings_with(&args.gpus)?;
    settings.outputs = Some(outputs);
    let options = RigOptions::from_settings(&rig, way, &settings, args.voxel).map_err(by_option_of_error)?;
    let registration_m = args.registration.map_or(options.registration_m, |mm| 1e-3 * mm);
    if args.registration.is_some() && way != RigWay::Views {
        bail!("--registration needs --fuse views");
    }
    let unused: Vec<String> = settings.unused_by_clouds_of_known_spacing().into_iter().map(option_of).collect();
    if way == RigWay::Merged && !unused.is_empty() {
        errln!("options that have no effect on merged points (an unorganized cloud): {}", unused.join(", "));
    }
    if args.voxel.is_some() && way != RigWay::Merged {
        bail!("--voxel needs --fuse merged");
    }
    let options = options
        .with_registration_m(registration_m)
        .with_max_moments(args.source.limits.frames)
        .with_max_duration(args.source.limits.max_duration()?);
    options.validate().map_err(planish::Error::from)?;
    check_outputs(args, &rig)?;
    // Opening may take seconds. Until it is done, a signal ends the command at once.
    let stop = Arc::default();
    let sources = open_sources(&rig, &args.source, &stop)?;
    stop_by(&stop);
    let mut sinks: Vec<Box<dyn RigSink>> = Vec::new();
    if let Some(folder) = &args.save {
        sinks.push(Box::new(FusedSink::create(folder, format_of_fused(args, format), &rig)?));
    }
    if let Some(folder) = &args.save_cameras {
        sinks.push(Box::new(CamerasSink::create(folder, format, outputs, &rig)?));
    }
    #[cfg(feature = "rerun")]
    if let Some(file) = &args.rrd {
        sinks.push(Box::new(rig::RigRerunSink::save(file, &rig)?));
    } else if args.rerun {
        sinks.push(Box::new(rig::RigRerunSink::spawn(&rig)?));
    }
    if let Some(file) = &args.picture {
        sinks.push(Box::new(PictureSink::create(file)));
    }
    let line = StatusLine::new();
    let tell = |event: RigEvent<'_>| match event {
        RigEvent::Warning(warning) => line.warn(&warning),
        RigEvent::Moment(statistics) => line.show("moments", &statistics.moments),
        _ => {}
    };
    let statistics =
        rig::RigStream::new(&rig, sources, options).with_sinks(sinks).with_stop(&stop).with_events(tell).run()?;
    line.end();
    let report = report(&statistics, way);
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print(&report);
    }
    if stop.load(Ordering::Relaxed) {
        errln!("stopped early; a moment still being smoothed was abandoned");
    } else if report.moments == 0 && args.source.limits.frames != Some(0) {
        errln!("warning: no moments were smoothed");
    }
    let unreadable = report.cameras.iter().any(|camera| camera.unreadable > 0);
    Ok(if report.failed_sinks > 0 || unreadable { ExitCode::from(1) } else { ExitCode::SUCCESS })
}

/// Checks the outputs before anything is written. Result folders must be empty and separate; the picture must be
/// writable and not part of the input.
fn check_outputs(args: &StreamArgs, rig: &Rig) -> Result<()> {
    for folder in [&args.save, &args.save_cameras].into_iter().flatten() {
        if is_mcap(folder) {
            bail!("{}: the clouds of a rig cannot be saved as a recording; give a folder", folder.display());
        }
        if fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
            bail!(
                "{}: the folder is not empty; choose a new or an empty folder for the results of a rig",
                folder.display()
            );
        }
    }
    if let (Some(fused), Some(cameras)) = (&args.save, &args.save_cameras)
        && let (Ok(fused), Ok(cameras)) = (std::path::absolute(fused), std::path::absolute(cameras))
        && (fused.starts_with(&cameras) || cameras.starts_with(&fused))
    {
        bail!("--save and --save-cameras need separate folders, neither inside the other");
    }
    let Some(picture) = &args.picture else { return Ok(()) };
    if !picture.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
        bail!("{}: unsupported picture extension; expected .png", picture.display());
    }
    let folder = picture.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if picture.is_dir() || !folder.is_dir() {
        bail!(
            "{}: cannot write the picture; the path is a folder, or its parent folder does not exist",
            picture.display()
        );
    }
    let sources = rig.cameras.iter().filter_map(|camera| Path::new(camera.source.as_ref()?).canonicalize().ok());
    let folder = folder.canonicalize().with_context(|| folder.display().to_string())?;
    if sources
        .into_iter()
        .any(|source| folder.starts_with(&source) || picture.canonicalize().is_ok_and(|picture| picture == source))
    {
        bail!("{}: the picture would replace part of the input; choose another name", picture.display());
    }
    Ok(())
}

/// Returns the outputs to compute; includes depth if each camera's depth images are saved.
fn rig_outputs(args: &StreamArgs) -> Outputs {
    let outputs = outputs_of(&args.fields);
    if args.save_cameras.is_some() && args.sink_format() == SinkFormat::DepthPng {
        outputs.with_depth(true)
    } else {
        outputs
    }
}

/// Returns the format of fused clouds, which cannot be depth images.
fn format_of_fused(args: &StreamArgs, format: SinkFormat) -> SinkFormat {
    if format == SinkFormat::DepthPng && args.save_cameras.is_some() { SinkFormat::Pcd } else { format }
}

fn open_sources(rig: &Rig, args: &SourceArgs, stop: &Arc<AtomicBool>) -> Result<Vec<Box<dyn Source>>> {
    let limits = &args.limits;
    let names = || rig.cameras.iter().filter_map(|camera| camera.source.as_deref());
    let has_camera = names().any(source::is_camera);
    if limits.reconnect && !has_camera {
        bail!("--reconnect applies to cameras, but the rig has recordings");
    }
    let open = |camera: &RigCamera| {
        let name = camera.source.as_deref();
        let name = name.with_context(|| format!("camera {}: no source is set; add \"source\"", camera.name))?;
        let is_camera = source::is_camera(name);
        let options = camera
            .source_options()
            .with_fps(limits.fps.filter(|_| !is_camera))
            .with_frames(limits.frames)
            .with_read_options(args.memory.options());
        let limits = LimitArgs { reconnect: limits.reconnect && is_camera, ..*limits };
        if has_camera && !is_camera && limits.fps.is_none() {
            bail!("camera {}: a recording among live cameras needs --fps", camera.name);
        }
        open_named(name, options, &limits, stop).with_context(|| format!("camera {}", camera.name))
    };
    rig.cameras.iter().map(open).collect()
}

fn report(statistics: &RigStatistics, way: RigWay) -> Report {
    let moments = &statistics.moments;
    let latency = moments.latency();
    let camera = |camera: &CameraStatistics| CameraReport {
        name: camera.name.clone(),
        frames_in: camera.frames_in,
        frames_out: camera.frames_out,
        missing: camera.missing,
        late: camera.late,
        out_of_order: camera.out_of_order,
        clock_jumps: camera.jumps,
        dropped: camera.dropped,
        unreadable: camera.unreadable,
    };
    Report {
        moments: moments.frames_out,
        complete: statistics.complete,
        dropped: moments.dropped,
        dropped_by_sinks: moments.dropped_by_sinks,
        failed_sinks: moments.failed_sinks,
        seconds: moments.duration().as_secs_f64(),
        fps: moments.fps(),
        latency_ms: [latency.p50, latency.p95, latency.p99].map(ms),
        engine: moments.engine.name(),
        way: way.name(),
        cameras: statistics.cameras.iter().map(camera).collect(),
    }
}

fn print(report: &Report) {
    let Report { moments, complete, dropped, seconds, fps, latency_ms: [p50, p95, p99], engine, way, cameras, .. } =
        report;
    let s = if *moments == 1 { "" } else { "s" };
    outln!(
        "{moments} moment{s} in {seconds:.1} s, {way}, engine {engine}; {fps:.1} per second from the first to the last"
    );
    outln!("  {complete} of them with every camera; {dropped} replaced by newer ones");
    outln!("  from frame to result: {p50:.1} ms, 95 % within {p95:.1}, 99 % within {p99:.1}");
    for camera in cameras {
        let CameraReport { name, frames_in, frames_out, missing, late, out_of_order, clock_jumps, dropped, unreadable } =
            camera;
        outln!(
            "  {name:<16} {frames_out} of {frames_in} frames smoothed; missing from {missing} moments, {late} late, \
             {out_of_order} out of \
             order, {clock_jumps} clock jumps, {dropped} dropped, {unreadable} unreadable"
        );
    }
}
