//! `planish evaluate --sequence`: measures how steady and how prompt smoothing over time is.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use planish::evaluate::{VideoDepth, VideoEvaluation, VideoRange, VideoReport};
use planish::io::internal::create_output_folder;
use planish::io::write_animated_png;
use planish::io::{self, Contents, RgbImage, camera_to_json, write_depth, write_whole};
use planish::render::{difference_normals, half_size, relief, side_by_side};
use planish::simulate::{DepthNoise, Event, Sequence, Truth};
use planish::source::{OwnedFrame, SourceOptions};
use planish::{
    Camera, DepthImage, Error, Frame, FrameParams, IntoFrame, Outputs, Params, SensorPose, Session, Settings, Smoothed,
    Status, TemporalChoice, Xyz,
};
use planish_bench::{out, outln};
use serde::Serialize;

use super::{percent, read_measured, sensor_of};
use crate::args::{EvaluateArgs, MemoryArgs, SequenceArg};
use crate::commands::ms_since;
use crate::exit::ExitCode;

/// Default number of frames of a simulated video.
const FRAMES: u64 = 60;
/// Maximum number of frames in an animated picture, which shows the end of the video.
const PICTURED_FRAMES: usize = 24;
/// Frame rate of an animated picture, in frames per second.
const PICTURED_PER_SECOND: u16 = 15;

/// Report on a video.
#[derive(Serialize)]
struct Video {
    video: String,
    frames: u64,
    ways: Vec<VideoReport>,
    /// Number of frames whose camera motion since the previous frame was known, by method. Only methods with a moving
    /// camera are included.
    moved_frames: BTreeMap<&'static str, u64>,
    /// Median time per frame in milliseconds, by method.
    frame_ms: BTreeMap<&'static str, f64>,
}

/// A method of smoothing a video.
struct Way {
    name: &'static str,
    session: Session,
    uses_pose: bool,
    smoothed: Smoothed,
    carried: Vec<bool>,
    times_ms: Vec<f64>,
    /// Number of frames whose camera motion since the previous frame was known.
    moved: u64,
}

pub fn evaluate(args: &EvaluateArgs, videos: SequenceArg) -> Result<ExitCode> {
    if args.smoothing.settings()?.temporal == Some(TemporalChoice::Off) {
        bail!("--sequence measures --temporal steady; remove --temporal off");
    }
    if let Some(input) =
        args.input.as_ref().filter(|input| input.is_file() && io::Format::of_extension(input).is_some())
    {
        bail!(
            "{}: the input is a single frame; --sequence needs a folder of frames, a data set or a recording",
            input.display()
        );
    }
    for folder in [&args.out, &args.export].into_iter().flatten() {
        create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    }
    let videos = match &args.input {
        Some(input) if videos == SequenceArg::All => vec![on_input(args, input)?],
        Some(_) => bail!("--sequence: the name of a simulated video cannot be combined with --input; omit the name"),
        None => on_simulated(args, videos)?,
    };
    if args.export.is_some() {
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(folder) = &args.out {
        let file = folder.join("report.json");
        write_whole(&file, serde_json::to_string_pretty(&videos)?.as_bytes())
            .with_context(|| file.display().to_string())?;
    }
    if args.json {
        outln!("{}", serde_json::to_string(&videos)?);
    } else {
        videos.iter().for_each(print);
    }
    Ok(ExitCode::SUCCESS)
}

/// Evaluates the video given by `--input`.
fn on_input(args: &EvaluateArgs, input: &Path) -> Result<Video> {
    if args.export.is_some() {
        bail!("--export cannot be combined with --input; it exports only simulated videos");
    }
    let options = SourceOptions::default()
        .with_camera(args.camera.camera_of_any_shape()?)
        .with_tum_units_per_metre(args.camera.depth_units_per_metre)
        .with_frames(args.frames)
        .with_read_options(args.memory.options());
    let mut source = planish::source::open(&input.display().to_string(), &options)?;
    if source.is_live() {
        bail!(
            "{}: a live source delivers each frame only once; record it first with `planish record`",
            input.display()
        );
    }
    let mut settings = args.smoothing.settings()?;
    settings.temporal = Some(TemporalChoice::Steady);
    let poses = args.poses.read_in(&settings, input, None, &args.memory.options())?;
    let mut evaluated = Evaluated::new(args, None, &[])?;
    let bar = progress(args.frames)?;
    while args.frames.is_none_or(|most| evaluated.frames < most) {
        let Some(frame) = source.next_frame()? else { break };
        let name = source.frame_name();
        evaluated.time_s = frame.timestamp_s();
        evaluated.pose =
            poses.as_ref().and_then(|poses| poses.pose(evaluated.frames, frame.timestamp_s(), name.as_deref()));
        match &frame {
            OwnedFrame::Depth(depth) => {
                let raw_m: Vec<f32> = depth.raw.iter().map(|&raw| depth.camera.depth_m(raw)).collect();
                evaluated.add(depth.into_frame().map_err(Error::from)?, &raw_m, Some(&depth.camera), None)?;
            }
            OwnedFrame::Cloud { cloud, .. } => {
                let raw_m = depth_of(cloud.positions(), &cloud.points.pose)?;
                evaluated.sensor_pose = cloud.points.pose;
                evaluated.add(cloud.into_frame().map_err(Error::from)?, &raw_m, cloud.camera.as_ref(), None)?;
            }
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let frames = evaluated.frames;
    if let Some(poses) =
        poses.filter(|poses| !poses.has_times() && args.frames.is_none() && poses.len() as u64 != frames)
    {
        bail!(
            "--poses has {} poses without timestamps, but {} has {frames} frames; give one pose per frame",
            poses.len(),
            input.display()
        );
    }
    if evaluated.frames < 2 {
        bail!("{}: the input has {} frames; a video needs at least 2", input.display(), evaluated.frames);
    }
    evaluated.finish(args, &input.display().to_string(), "video")
}

/// Evaluates the simulated videos.
fn on_simulated(args: &EvaluateArgs, videos: SequenceArg) -> Result<Vec<Video>> {
    if args.poses.are_given() {
        bail!("--poses and --pose-topic need --input; simulated cameras have poses of their own");
    }
    let sensor = sensor_of(args)?;
    let frames = args.frames.unwrap_or(FRAMES);
    let events = match videos {
        SequenceArg::All => Event::ALL.to_vec(),
        SequenceArg::One(event) => vec![event],
    };
    let bar = progress(Some(frames * events.len() as u64))?;
    let mut videos = Vec::new();
    for event in events {
        let camera = Camera::kinect_v1();
        let mut sequence = Sequence::new(event, camera, DepthNoise::of_sensor(&sensor), args.seed.unwrap_or(1));
        let name = event.name();
        let results: Vec<PathBuf> = args.results.iter().map(|folder| folder.join(name)).collect();
        let mut evaluated = Evaluated::new(args, Some(event), &results)?;
        for number in 0..frames {
            let seen = sequence.frame(number).map_err(Error::from)?;
            if let Some(folder) = &args.export {
                export(&folder.join(name), number, &seen.frame.camera, &seen.frame.raw)?;
                bar.inc(1);
                continue;
            }
            evaluated.pose = Some(seen.pose.sensor_pose().map_err(Error::from)?);
            let raw_m: Vec<f32> = seen.frame.raw.iter().map(|&raw| camera.depth_m(raw)).collect();
            let frame = (&seen.frame).into_frame().map_err(Error::from)?;
            evaluated.add(frame, &raw_m, Some(&camera), Some((seen.truth, seen.object)))?;
            bar.inc(1);
        }
        if args.export.is_none() {
            videos.push(evaluated.finish(args, name, name)?);
        }
    }
    bar.finish_and_clear();
    if let Some(folder) = &args.export {
        outln!("The videos are in {}. Smooth them, keep their names, and measure with --results.", folder.display());
    }
    Ok(videos)
}

fn progress(frames: Option<u64>) -> Result<ProgressBar> {
    let bar = frames.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    Ok(bar.with_style(ProgressStyle::with_template("{bar:30} frame {pos} of {len}, {eta} left")?))
}

/// Writes a frame and its camera.
fn export(folder: &Path, number: u64, camera: &Camera, raw: &[u16]) -> Result<()> {
    create_output_folder(folder).with_context(|| format!("cannot create the folder {}", folder.display()))?;
    let image = DepthImage { width: camera.width, height: camera.height, raw: raw.to_vec() };
    write_depth(&folder.join(format!("{number:04}.png")), &image)?;
    let file = folder.join("camera.json");
    write_whole(&file, camera_to_json(camera).as_bytes()).with_context(|| file.display().to_string())
}

/// A video under evaluation.
struct Evaluated {
    frames: u64,
    ways: Vec<Way>,
    /// For each result folder of another program: its name, and the files of its frames.
    others: Vec<(String, Vec<PathBuf>)>,
    memory: MemoryArgs,
    evaluation: Option<VideoEvaluation>,
    /// The pose of the camera at the current frame.
    pose: Option<SensorPose>,
    /// The timestamp of the current frame, in seconds.
    time_s: Option<f64>,
    /// The pose of the sensor in the coordinate frame of the points.
    sensor_pose: SensorPose,
    pictures: Vec<RgbImage>,
    draws: bool,
}

impl Evaluated {
    fn new(args: &EvaluateArgs, event: Option<Event>, results: &[PathBuf]) -> Result<Self> {
        let settings = args.smoothing.settings()?;
        let tracks = settings.tracks_camera();
        let with = |temporal| {
            let mut settings = settings.clone();
            settings.temporal = Some(temporal);
            settings.track = None;
            settings
        };
        let (alone, steady) = (with(TemporalChoice::Off), with(TemporalChoice::Steady));
        let mut ways = vec![Way::new("frame by frame", alone, false)?, Way::new("steady", steady.clone(), false)?];
        if event == Some(Event::MovingCamera) || tracks {
            let mut tracked = steady.clone();
            tracked.track = Some(true);
            ways.push(Way::new("steady, tracked", tracked, false)?);
        }
        if event == Some(Event::MovingCamera) {
            ways.push(Way::new("steady, true poses", steady, true)?);
        } else if args.poses.are_given() {
            ways.push(Way::new("steady, poses", steady, true)?);
        }
        let folders: Vec<&PathBuf> =
            if event.is_some() { results.iter().collect() } else { args.results.iter().collect() };
        let others = folders.into_iter().map(|folder| {
            let files = io::frame_files(folder).map_err(Error::from)?;
            let name = match event {
                Some(_) => folder.parent().and_then(Path::file_name),
                None => folder.file_name(),
            };
            Ok((name.unwrap_or_default().to_string_lossy().into_owned(), files))
        });
        Ok(Self {
            frames: 0,
            ways,
            others: others.collect::<Result<_>>()?,
            memory: args.memory,
            evaluation: None,
            pose: None,
            time_s: None,
            sensor_pose: SensorPose::IDENTITY,
            pictures: Vec::new(),
            draws: args.out.is_some(),
        })
    }

    fn add(
        &mut self,
        frame: Frame<'_>,
        raw_m: &[f32],
        camera: Option<&Camera>,
        truth: Option<(&Truth, Option<u16>)>,
    ) -> Result<()> {
        for way in &mut self.ways {
            way.session.set_frame_time(self.time_s);
            way.smooth(frame, self.pose)?;
        }
        if self.evaluation.is_none() {
            let (params, _) = self.ways[0].session.params_for(frame)?;
            let Params::Frame(FrameParams { sensor, .. }) = params else {
                bail!("the frames are unorganized clouds; videos need depth images or organized clouds");
            };
            let ways = self.ways.iter().skip(1).map(|way| way.name);
            let others = self.others.iter().map(|(name, _)| &**name);
            let names: Vec<&str> = ["frame by frame", "raw"].into_iter().chain(ways).chain(others).collect();
            self.evaluation = Some(VideoEvaluation::new(sensor, &names));
        }
        let number = self.frames as usize;
        let mut others_m = Vec::new();
        for (name, files) in &self.others {
            let file = files.get(number).with_context(|| format!("{name}: the result has no frame {number}"))?;
            others_m.push(depth_in(&self.memory, file, camera, raw_m.len())?);
        }
        let depth = |way: &Way| depth_of(&way.smoothed.points, &self.sensor_pose);
        let ways_m = self.ways.iter().map(depth).collect::<Result<Vec<_>>>()?;
        let mut depths =
            vec![VideoDepth { depth_m: &ways_m[0], carried: &[] }, VideoDepth { depth_m: raw_m, carried: &[] }];
        depths.extend(
            self.ways.iter().zip(&ways_m).skip(1).map(|(way, depth_m)| VideoDepth { depth_m, carried: &way.carried }),
        );
        depths.extend(others_m.iter().map(|depth_m| VideoDepth { depth_m, carried: &[] }));
        if let Some(evaluation) = &mut self.evaluation {
            if let Some(camera) = camera {
                evaluation.add_flatness(camera, &depths);
            }
            evaluation.add(&depths, truth);
        }
        if self.draws {
            let last = ways_m.last().map_or(raw_m, |last| last);
            self.pictures.push(picture(frame.shape(), camera, [raw_m, &ways_m[0], last]));
            if self.pictures.len() > PICTURED_FRAMES {
                self.pictures.remove(0);
            }
        }
        self.frames += 1;
        Ok(())
    }

    fn finish(self, args: &EvaluateArgs, name: &str, file: &str) -> Result<Video> {
        let mut ways = self.evaluation.map(VideoEvaluation::reports).unwrap_or_default();
        if ways.len() > 1 {
            ways.swap(0, 1);
        }
        if let Some(folder) = &args.out {
            write_animated_png(&folder.join(format!("{file}.png")), &self.pictures, PICTURED_PER_SECOND)?;
        }
        let is_moving = |way: &&Way| way.uses_pose || way.moved > 0;
        let moved = self.ways.iter().filter(is_moving).map(|way| (way.name, way.moved));
        let moved_frames = moved.collect();
        let median_ms = |way: Way| {
            let Way { name, mut times_ms, .. } = way;
            times_ms.sort_by(f64::total_cmp);
            Some((name, *times_ms.get(times_ms.len() / 2)?))
        };
        let frame_ms = self.ways.into_iter().filter_map(median_ms).collect();
        Ok(Video { video: name.to_owned(), frames: self.frames, ways, moved_frames, frame_ms })
    }
}

impl Way {
    fn new(name: &'static str, settings: Settings, uses_pose: bool) -> Result<Self> {
        let mut session = Session::new(settings)?.with_kept_window(true).with_kept_sensor(true);
        session.set_outputs(Outputs::POINTS.with_status(true));
        Ok(Self {
            name,
            session,
            uses_pose,
            smoothed: Smoothed::default(),
            carried: Vec::new(),
            times_ms: Vec::new(),
            moved: 0,
        })
    }

    fn smooth(&mut self, frame: Frame<'_>, pose: Option<SensorPose>) -> Result<()> {
        if self.uses_pose {
            self.session.set_camera_pose(pose)?;
        }
        let start = std::time::Instant::now();
        self.session.smooth(frame, &mut self.smoothed)?;
        self.times_ms.push(ms_since(start));
        self.moved += u64::from(self.session.camera_motion().is_some());
        let statuses = self.smoothed.status.as_deref().unwrap_or_default();
        self.carried = statuses.iter().map(|status| *status == Status::Carried).collect();
        Ok(())
    }
}

/// Returns the depth of points in their sensor's coordinate frame, in metres.
fn depth_of(points: &Xyz, sensor_pose: &SensorPose) -> Result<Vec<f32>> {
    if sensor_pose.is_identity() {
        return Ok(points.z().to_vec());
    }
    let transform = sensor_pose.transform().map_err(Error::from)?;
    Ok(points.iter().map(|point| transform.to_sensor(point.map(f64::from).into()).z as f32).collect())
}

/// Reads another program's depth in metres.
fn depth_in(memory: &MemoryArgs, file: &Path, camera: Option<&Camera>, len: usize) -> Result<Vec<f32>> {
    let depth_m: Vec<f32> = match read_measured(memory, file)? {
        Contents::Depth(image) => {
            let camera = camera
                .with_context(|| format!("{}: the depth unit is unknown; add --camera FX,FY,CX,CY", file.display()))?;
            image.raw.iter().map(|&raw| camera.depth_m(raw)).collect()
        }
        Contents::DepthMetres { depth_m, .. } => depth_m,
        Contents::Organized(cloud) => cloud.positions().z().to_vec(),
        _ => bail!("{}: contains neither a depth image nor an organized cloud", file.display()),
    };
    // Zero, negative and infinite depths are holes as well.
    let is_depth = |depth_m: &f32| *depth_m > 0.0 && depth_m.is_finite();
    let depth_m: Vec<f32> =
        depth_m.into_iter().map(|depth_m| if is_depth(&depth_m) { depth_m } else { f32::NAN }).collect();
    if depth_m.len() != len {
        bail!("{}: the result has {} pixels, but the frames have {len}", file.display(), depth_m.len());
    }
    Ok(depth_m)
}

/// Draws reliefs of the measured depth and of two smoothed depths, side by side and at half size.
fn picture((width, height): (usize, usize), camera: Option<&Camera>, depths_m: [&[f32]; 3]) -> RgbImage {
    let camera = camera
        .copied()
        .unwrap_or_else(|| Camera::new((width, height), [width as f64; 2], [width as f64 / 2.0, height as f64 / 2.0]));
    let reliefs = depths_m.map(|depth_m| {
        let points = camera.deproject_m(depth_m.iter().copied());
        half_size(&relief(width, height, &difference_normals(width, height, &points)))
    });
    side_by_side(&reliefs)
}

fn print(video: &Video) {
    outln!("{}, {} frames", video.video, video.frames);
    out!("  {:<58}", "");
    for way in &video.ways {
        out!("{:>20}", way.name);
    }
    outln!();
    let line = |name: &str, value: &dyn Fn(&VideoReport) -> Option<String>| {
        let values: Vec<Option<String>> = video.ways.iter().map(value).collect();
        if values.iter().all(Option::is_none) {
            return;
        }
        out!("  {name:<58}");
        values.into_iter().for_each(|value| out!("{:>20}", value.as_deref().unwrap_or("-")));
        outln!();
    };
    let mm = |value: Option<f64>| value.map(|value| format!("{value:.2}"));
    let both = |of: fn(&VideoRange) -> Option<f64>| {
        move |way: &VideoReport| {
            let [near, far] = [&way.near, &way.far].map(|range| mm(of(range)));
            let either = near.is_some() || far.is_some();
            either.then(|| format!("{} / {}", near.as_deref().unwrap_or("-"), far.as_deref().unwrap_or("-")))
        }
    };
    line("below 0.9 m / beyond 2 m: distance to the truth, RMS, mm", &both(|range| range.rms_mm));
    line("  jitter, median of still pixels, mm", &both(|range| range.jitter_mm));
    line("  jitter of the noisiest 5 %, mm", &both(|range| range.jitter_95_mm));
    line("  wander (deviation while still), median, mm", &both(|range| range.wander_mm));
    line("  wander of the noisiest 5 %, mm", &both(|range| range.wander_95_mm));
    let share = |value: Option<f64>| value.map(percent);
    line("distance from the plane of 8x8 pixels, median, mm", &|way| mm(way.flatness_mm));
    line("pixels of a moving object that show it", &|way| share(way.found_share));
    line("surfaces that have just appeared, but do not show", &|way| share(way.late_share));
    line("pixels that an object has just left, but still show it", &|way| share(way.left_share));
    line("lag of moving surfaces, mean, mm", &|way| mm(way.lag_mm));
    line("frames before which the camera's motion is known", &|way| {
        video.moved_frames.get(&*way.name).map(u64::to_string)
    });
    line("points carried over from earlier frames, and marked", &|way| share(Some(way.carried_share)));
    line("  of which off by over 5 %", &|way| share(way.carried_wrong_share));
    line("time per frame, median, ms", &|way| video.frame_ms.get(&*way.name).map(|ms| format!("{ms:.1}")));
    outln!();
}
