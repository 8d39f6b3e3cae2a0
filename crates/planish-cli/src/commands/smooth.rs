//! `planish smooth`: smooths one file, or every frame of a folder.

#[cfg(feature = "mcap")]
mod bag;
#[cfg(feature = "mcap")]
mod clouds;
mod folder;
mod memory;
mod notes;
mod prepare;
mod progress;
mod report;
mod tiles;

use crate::exit::ExitCode;
use std::collections::HashSet;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use planish::io::{self, CloudRef, Contents, Encoding, FileRead, Format, LengthUnit, ReadOptions};
use planish::{
    Camera, CloudParams, CloudRadius, DepthFrame, DepthImage, Doubt, Error, Frame, IntoFrame, OrganizedCloud, Outputs,
    PointCloud, SensorPose, Session, Settings, Smoothed,
};
use planish_bench::{errln, outln};

use progress::with_progress;
use report::{
    Report, SmoothTimes, StatusCounts, likely_cause, print_report, report_assumed_sensor, report_range_rule, summarize,
};

use super::checks::{
    check_not_beside, check_not_input, check_radius, convert_fields, report_columns, report_losses, report_notes,
    report_unit,
};
use super::{ms_since, organized_for_session, read_input};
use crate::args::{CameraArgs, FieldArg, SmoothArgs, by_option, by_option_of_error};

/// Returns an error if more than one file would be read from standard input.
fn check_one_reads_standard_input(args: &SmoothArgs) -> Result<()> {
    let is_standard_input = |path: &Path| path == Path::new("-");
    let readers = [Some(&args.input), args.smoothing.settings.as_ref(), args.camera.camera_file.as_ref()];
    if readers.into_iter().flatten().filter(|path| is_standard_input(path)).count() > 1 {
        bail!("-: only one of INPUT, --settings and --camera-file can be standard input");
    }
    Ok(())
}

pub fn run(args: &SmoothArgs) -> Result<ExitCode> {
    // Contradictory options are refused for any input.
    check_one_reads_standard_input(args)?;
    let mut settings = args.smoothing.settings_with(&args.gpus)?;
    if !args.fields.is_empty() {
        settings.outputs = Some(args.outputs());
        settings.validate().map_err(by_option)?;
    }
    let mut worker = Worker {
        args,
        session: Session::new(settings.clone())?
            .with_kept_sensor(true)
            .with_single_frame(!args.input.is_dir() && args.repeat == 1),
        settings,
        pose: args.pose.pose()?,
        beside: 1,
        smoothed: Smoothed::default(),
        renewed: Outputs::POINTS,
        unit: LengthUnit::METRE,
        noted: Arc::default(),
    };
    if args.repeat > 1 && worker.settings.temporal_params().is_some() {
        bail!(
            "--repeat cannot be combined with --temporal, which would count every repetition as a frame; remove one of \
             them"
        );
    }
    if args.format.as_ref().is_some_and(|extension| extension.contains(['/', '\\'])) {
        bail!("--format needs a file extension such as ply, not a path");
    }
    if args.gpus.gpus.is_some() && !args.input.is_dir() {
        bail!(
            "{}: --gpus applies to folders; choose the device of a single file with --engine gpu --adapter",
            args.input.display()
        );
    }
    #[cfg(feature = "mcap")]
    if let Some(code) = bag::run(args)? {
        return Ok(code);
    }
    if !args.topics.topic.is_empty() || args.topics.camera_info_topic.is_some() || args.points_topic.is_some() {
        bail!(
            "{}: --topic, --camera-info-topic and --points-topic apply only to MCAP recordings",
            args.input.display()
        );
    }
    if args.input.is_dir() {
        return folder::run(&mut worker);
    }
    if args.poses.are_given() {
        bail!("{}: --poses and --pose-topic apply to folders, recordings and streams", args.input.display());
    }
    if args.format.is_some() {
        errln!(
            "{}: --format applies to folders; the output's name determines the format of a single file",
            args.input.display()
        );
    }
    if worker.settings.temporal_params().is_some() {
        errln!("{}: --temporal and --track have no effect on a single frame", args.input.display());
    }
    args.encoding.check(&args.output)?;
    check_not_input(&args.input, &args.output, Some(args.overwrite))?;
    let beside = [&args.smoothing.settings, &args.camera.camera_file, &args.poses.poses];
    check_not_beside(beside, &args.output)?;
    let report = match worker.smooth_file(&args.input, &args.output) {
        Err(error) if error.is::<NothingLeft>() => {
            errln!("error: {error:#}");
            return Ok(ExitCode::from(1));
        }
        report => report?,
    };
    if args.json {
        outln!("{}", serde_json::to_string(&report)?);
    } else {
        print_report(&report);
    }
    Ok(ExitCode::SUCCESS)
}

/// A worker that smooths files one after another.
struct Worker<'a> {
    args: &'a SmoothArgs,
    settings: Settings,
    session: Session,
    /// Sensor pose that replaces the one stated in the files.
    pose: Option<SensorPose>,
    /// Number of workers, which share threads and memory equally.
    beside: u64,
    smoothed: Smoothed,
    /// Outputs that replace fields of the file.
    renewed: Outputs,
    /// Unit of the current cloud.
    unit: LengthUnit,
    /// Notes already printed, shared by all workers.
    noted: Arc<Mutex<HashSet<String>>>,
}

/// The output, to be written after smoothing.
enum Output {
    Organized(OrganizedCloud),
    General(PointCloud),
    /// The points of a depth image with this camera.
    Points(Camera),
    /// A depth image with `width` columns and `height` rows.
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
        let (file, camera) = read_input(input, &self.read_options(), &self.args.camera)?;
        let FileRead { format, encoding, mut contents, mut notes, .. } = file;
        let read_ms = ms_since(start);
        // In a folder, each note is printed once.
        notes.retain(|note| self.noted.lock().is_ok_and(|mut noted| noted.insert(note.clone())));
        report_notes(input, &notes);
        match &mut contents {
            Contents::Organized(cloud) if !is_depth(output) => {
                convert_fields(&mut cloud.points, format, output, self.args.encoding.precision());
                self.renew_fields(input, &cloud.points);
                io::check_writable(output, &*cloud, self.outputs())?;
            }
            Contents::General(cloud) => {
                convert_fields(cloud, format, output, self.args.encoding.precision());
                self.renew_fields(input, cloud);
                io::check_writable(output, &*cloud, self.outputs())?;
            }
            _ => {}
        }
        self.set_pose(input, &mut contents)?;

        let (mut result, points, times_ms) = match contents {
            Contents::General(cloud) => {
                report_columns(input, format, &cloud);
                let (points, times_ms) = self.smooth_general(input, output, &cloud)?;
                (Output::General(cloud), points, times_ms)
            }
            contents => self.smooth_organized(input, output, contents, &camera)?,
        };
        match &mut result {
            Output::Organized(cloud) => self.apply(&mut cloud.points)?,
            Output::General(cloud) => self.apply(cloud)?,
            &mut Output::Points(camera) => {
                let (width, height) = (self.smoothed.width, self.smoothed.height);
                let points = self.smoothed.points.clone();
                let mut cloud = OrganizedCloud::from_positions(width, height, points).map_err(Error::from)?;
                cloud.camera = Some(camera);
                self.apply(&mut cloud.points)?;
                result = Output::Organized(cloud);
            }
            Output::Depth { .. } => {}
        }

        let start = Instant::now();
        self.write(output, &result, self.args.encoding.encoding().or(encoding).unwrap_or_default())?;
        Ok(Report {
            input: input.to_path_buf(),
            output: output.to_path_buf(),
            engine: self.session.engine().unwrap_or_default().name(),
            adapter: self.session.gpu_name().map(str::to_owned),
            engine_reason: self.session.chosen_because().map(ToString::to_string),
            width: self.smoothed.width,
            height: self.smoothed.height,
            points_in: points.valid,
            points_lost: points.lost,
            status: self.status_counts(),
            tiles: None,
            cloud: self.session.cloud_choice(),
            rebuilt_grid: self.session.rebuilt_grid().map(|(width, height)| [width, height]),
            read_ms,
            smooth_ms: times_ms,
            write_ms: ms_since(start),
        })
    }

    /// Returns the read options with this worker's share of the memory limit.
    fn read_options(&self) -> ReadOptions {
        let options = self.args.reading.read_options();
        options.with_max_memory_bytes(options.max_memory_bytes / self.beside)
    }

    /// Replaces the file's pose with the user's pose, if one is given.
    fn set_pose(&self, input: &Path, contents: &mut Contents) -> Result<()> {
        let Some(pose) = self.pose else { return Ok(()) };
        match contents {
            Contents::Organized(cloud) => cloud.points.pose = pose,
            Contents::General(cloud) => cloud.pose = pose,
            _ => bail!("{}: --sensor-pose applies to clouds; depth is in its camera's frame", input.display()),
        }
        Ok(())
    }

    /// Smooths an organized cloud or a depth image.
    fn smooth_organized(
        &mut self,
        input: &Path,
        output: &Path,
        contents: Contents,
        camera: &CameraArgs,
    ) -> Result<(Output, PointCounts, SmoothTimes)> {
        let shape = contents.shape();
        let in_metres = matches!(contents, Contents::DepthMetres { .. });
        let depth_out = is_depth(output) || (Format::of_extension(output) == Some(Format::Npy) && contents.is_depth());
        let has_fields = self.args.fields.iter().any(|field| *field != FieldArg::None);
        if has_fields && (depth_out || Format::of_extension(output) == Some(Format::Npy)) {
            bail!("{}: cannot store --fields; write .pcd or .ply", output.display());
        }
        let mut outputs = self.outputs().with_status(true);
        if depth_out {
            let stays_in_metres = in_metres && Format::of_extension(output) == Some(Format::Npy);
            let only = Outputs::DEPTH.with_depth(!stays_in_metres).with_depth_m(stays_in_metres);
            outputs = only.with_status(true);
        }
        // A raw depth image is passed to the engine unchanged.
        let (mut depth, mut cloud) = match contents {
            Contents::Depth(image) => {
                let camera = camera.required(shape, input)?;
                (Some(DepthFrame::from_image(camera, image).map_err(Error::from)?), None)
            }
            contents => (None, Some(organized_for_session(contents, camera, input)?)),
        };
        self.prepare(input, &mut depth, &mut cloud)?;
        let shape = match (&depth, &cloud) {
            (Some(depth), _) => (depth.camera.width, depth.camera.height),
            (_, Some(cloud)) => (cloud.width(), cloud.height()),
            _ => shape,
        };
        let of_input = |error| anyhow::Error::new(error).context(input.display().to_string());
        let frame = match (&depth, &cloud) {
            (Some(depth), _) => depth.into_frame(),
            (None, Some(cloud)) => cloud.into_frame(),
            (None, None) => bail!("{}: contains neither depth nor points", input.display()),
        };
        let frame = frame.map_err(of_input)?;
        if depth_out && frame.camera().is_none() {
            bail!("{}: writing depth needs the camera's intrinsics; add --camera FX,FY,CX,CY", output.display());
        }
        let fields = cloud.as_ref().map_or(0, |cloud| cloud.points.field_bytes_per_point());
        let (mut points, times_ms) = self.smooth(input, output, (frame, fields), outputs)?;
        if let Some((lost, note)) = frame.camera().and_then(|camera| self.smoothed.out_of_depth(camera)) {
            points.lost += lost;
            // In a folder, only the first frame's note is printed.
            if self.noted.lock().is_ok_and(|mut noted| noted.insert("out of depth".to_owned())) {
                report_notes(output, &[note]);
            }
        }
        report_range_rule(input, frame, self.session.range_rule(), self.pose.is_some());
        for setting in self.settings.unused_by_frames() {
            errln!("{}: {setting} has no effect on frames on a grid", input.display());
        }
        let result = match (depth, cloud) {
            (_, Some(cloud)) if !depth_out => Output::Organized(cloud),
            (Some(depth), None) if !depth_out => Output::Points(depth.camera),
            _ => Output::Depth { width: shape.0, height: shape.1 },
        };
        Ok((result, points, times_ms))
    }

    /// Selects the existing normals and curvature of a cloud for recomputation, since they change with the points.
    fn renew_fields(&mut self, input: &Path, cloud: &PointCloud) {
        self.renewed = Outputs::POINTS;
        let (wanted, renewed) = (self.outputs(), self.outputs().renewing(cloud));
        if renewed != wanted {
            errln!("{}: normals and curvature are recomputed for the smoothed points", input.display());
            self.renewed = renewed;
        }
    }

    /// Returns the fields to write: those of `--fields` or, without that option, of the settings, the recomputed fields
    /// of the file, and the status if holes are filled.
    fn outputs(&self) -> Outputs {
        let outputs = self.wanted_outputs();
        let Outputs { normals, curvature, .. } = self.renewed;
        let outputs = outputs.with_status(outputs.status || self.settings.fill.is_some());
        outputs.with_normals(outputs.normals || normals).with_curvature(outputs.curvature || curvature)
    }

    fn wanted_outputs(&self) -> Outputs {
        match self.settings.outputs.filter(|_| self.args.fields.is_empty()) {
            Some(Outputs { normals, curvature, status, frames, sigma, .. }) => {
                let outputs = Outputs::POINTS.with_normals(normals).with_curvature(curvature);
                outputs.with_status(status).with_frames(frames).with_sigma(sigma)
            }
            None => self.args.outputs(),
        }
    }

    fn smooth_general(
        &mut self,
        input: &Path,
        output: &Path,
        cloud: &PointCloud,
    ) -> Result<(PointCounts, SmoothTimes)> {
        let params = self.general_params(input)?;
        report_unit(input, cloud);
        self.unit = LengthUnit::of_cloud(cloud);
        if let (CloudRadius::Fixed { radius_m }, false) = (params.radius, self.args.force) {
            check_radius(input, cloud, radius_m)?;
        }
        let outputs = self.outputs().with_status(true);
        let of_input = |error| anyhow::Error::new(error).context(input.display().to_string());
        let frame = cloud.into_frame().map_err(of_input)?;
        let is_stated = !cloud.pose.is_identity() || cloud.scanners_m().is_some();
        if let (Frame::Points(points), true) = (frame, outputs.normals && !is_stated) {
            report_assumed_sensor(input, points.assumed_sensor_m());
        }
        self.smooth(input, output, (frame, cloud.field_bytes_per_point()), outputs)
    }

    /// Returns the parameters for an unorganized cloud.
    fn general_params(&self, input: &Path) -> Result<CloudParams> {
        self.settings.cloud_params().map_err(by_option).with_context(|| input.display().to_string())
    }

    /// Smooths a frame as many times as requested, and reports if many points were lost.
    fn smooth(
        &mut self,
        input: &Path,
        output: &Path,
        (frame, field_bytes): (Frame<'_>, usize),
        outputs: Outputs,
    ) -> Result<(PointCounts, SmoothTimes)> {
        self.check_memory(frame, field_bytes).with_context(|| output.display().to_string())?;
        if let (Some(doubt), false) = (planish::doubts(frame).first(), self.args.force) {
            let hint = match doubt {
                Doubt::Range { units: None, .. } => {
                    "give the unit with --unit, or add --force if the values are correct"
                }
                _ => "add --force if this is correct",
            };
            bail!("{}: {doubt} ({hint})", input.display());
        }
        self.session.set_outputs(outputs);
        let mut times_ms = Vec::new();
        while times_ms.len() < self.args.repeat as usize {
            let prepared = self.session.prepare(frame);
            self.report_events(output);
            prepared.map_err(by_option_of_error).with_context(|| input.display().to_string())?;
            if times_ms.is_empty() && frame.grid().is_none() && self.session.rebuilt_grid().is_none() {
                self.report_unused_by_clouds(input);
            }
            let start = Instant::now();
            let progress = self.session.watch().progress().filter(|_| self.beside == 1);
            let Self { session, smoothed, .. } = self;
            let result = with_progress(progress, || session.smooth(frame, smoothed));
            self.report_events(output);
            result?;
            times_ms.push(ms_since(start));
        }
        let StatusCounts { too_few: lost, isolated, .. } = self.status_counts();
        let valid = frame.valid_points();
        for (count, became) in [(lost, "became holes"), (isolated, "were left unchanged")] {
            if count as f64 > LOST_SHARE_TOLD * valid as f64 {
                let share = 100.0 * count as f64 / valid as f64;
                let cause = match self.session.rebuilt_grid() {
                    Some(_) => "They are probably isolated between holes; try --grid off".to_owned(),
                    None => {
                        let params = self.session.params_for(frame)?.0;
                        likely_cause(frame, &params, self.settings.sensor.is_some())
                    }
                };
                errln!(
                    "{}: {count} of {valid} valid points ({share:.1} %) {became}: they have too few neighbours. \
                     {cause}",
                    output.display()
                );
            }
        }
        if lost + isolated == valid && valid > 0 {
            let reason = match isolated {
                0 => "every point became a hole, since none has enough neighbours; nothing is written",
                _ => {
                    "no point has enough neighbours to be smoothed; nothing is written. Check the unit of the \
                     coordinates (--unit)"
                }
            };
            return Err(NothingLeft(format!("{}: {reason}", input.display())).into());
        }
        Ok((PointCounts { valid, lost }, summarize(times_ms)))
    }

    /// Applies the result to the cloud.
    fn apply(&self, cloud: &mut PointCloud) -> Result<()> {
        Ok(cloud.apply(&self.smoothed, self.outputs()).map_err(Error::from)?)
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
            Output::Points(_) => {}
            &Output::Depth { width, height } => {
                if self.settings.flags_origins() {
                    io::write_origin_mask(output, &self.smoothed)?;
                } else if io::origin_mask_of(output).exists() {
                    errln!("{}: left over from an earlier result; delete it", io::origin_mask_of(output).display());
                }
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

/// Returns true if the file name has the extension of a depth image.
fn is_depth(path: &Path) -> bool {
    matches!(Format::of_extension(path), Some(Format::DepthPng | Format::DepthTiff))
}

/// The error of a frame without points that can be smoothed.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct NothingLeft(String);

/// Number of valid input points, and of points that became holes.
struct PointCounts {
    valid: usize,
    lost: usize,
}

/// Share of lost or unchanged points above which a warning is printed.
const LOST_SHARE_TOLD: f64 = 0.01;
