//! Frames of a video, which are smoothed over time after each was smoothed in space (docs/method.md, section 16).

use rayon::prelude::*;

use super::{Chosen, Session, SessionEvent};
use crate::camera::Camera;
use crate::error::Error;
use crate::frame::{Frame, FrameGeometry, RangeRule};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::Params;
use crate::pose::SensorPose;
use crate::sensor::SensorModel;
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::temporal::{CameraMotion, Surface, SurfaceRef, TemporalFilter, TemporalParams, Tracker};
use crate::threads::Threads;
use crate::view::SmoothedView;

/// A longer time between frames begins a new video, in seconds and in intervals.
const LONGEST_INTERVAL_S: f64 = 1.0;
const MOST_INTERVALS: f64 = 5.0;
/// Pixels handled by a task.
const TASK: usize = 1 << 14;

/// The geometry of a frame, and its sensor.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    geometry: FrameGeometry,
    sensor: SensorModel,
    /// For raw depth.
    camera: Option<Camera>,
    /// The requested results.
    outputs: Outputs,
    shape: (usize, usize),
    /// How it is smoothed over time.
    params: TemporalParams,
    /// Number of the video that the frame belongs to.
    video: u64,
    /// world_from_camera, if known, and whether the frame itself states it.
    pose: Option<SensorPose>,
    is_pose_of_file: bool,
    /// Whether the motion of the camera is estimated if its pose is not known.
    is_tracked: bool,
}

/// The state of a video since its first frame.
struct Begun {
    /// The sight of that frame.
    sight: Sight,
    filter: TemporalFilter,
    threads: Threads,
    /// The camera: given, or shown by the points; and whether they show none.
    camera: Option<Camera>,
    has_no_camera: bool,
    /// The last frame and what aligns others with it, if the motion of the camera is estimated.
    tracking: Option<(Tracker, Surface)>,
    /// The pose of the last frame, and whether the frame itself stated it; how the camera moved before it, if known.
    last_pose: Option<(SensorPose, bool)>,
    motion: Option<CameraMotion>,
}

/// The filter of a session, with its buffers.
#[derive(Default)]
pub(super) struct OverTime {
    begun: Option<Begun>,
    /// Number of the video that the next frame belongs to, and how many were begun because of time stamps.
    number: u64,
    gaps: u64,
    /// The pose stated for the next frames.
    pose: Option<SensorPose>,
    /// Time stamp of the last frame, and the time before it.
    last_time_s: Option<f64>,
    last_interval_s: Option<f64>,
    ranges_m: Vec<f32>,
    /// The ranges of the frame before the filter.
    single_m: Vec<f32>,
    /// The result in space.
    smoothed: Smoothed,
}

impl Session {
    /// Returns the filter's parameters if a frame is part of a video that is smoothed over time.
    pub(super) fn over_time(&self, frame: Frame<'_>) -> Option<TemporalParams> {
        match &self.chosen {
            Chosen::Settings(settings) => settings.temporal_params().filter(|_| frame.grid().is_some()),
            Chosen::Params(..) => None,
        }
    }

    /// Returns the results that an engine must compute for a frame that is then smoothed over time.
    pub(super) fn outputs_before_time(&self, frame: Frame<'_>) -> Outputs {
        let outputs = self.options.outputs;
        match self.over_time(frame) {
            Some(_) => {
                let normals = outputs.normals || self.tracks_camera();
                outputs
                    .with_points(true)
                    .with_status(true)
                    .with_normals(normals)
                    .with_depth_m(outputs.depth_m || outputs.depth)
            }
            None => outputs,
        }
    }

    fn tracks_camera(&self) -> bool {
        matches!(&self.chosen, Chosen::Settings(settings) if settings.tracks_camera())
    }

    /// Remembers how a frame is seen, for when its result is smoothed over time.
    pub(super) fn look_at(&mut self, frame: Frame<'_>, geometry: FrameGeometry, params: Params) {
        let (camera, stated) = match frame {
            Frame::Depth(depth) => (Some(*depth.camera()), None),
            Frame::Points(points) => (points.camera().copied(), Some(points.pose())),
        };
        let stated = stated.filter(|pose| !pose.is_identity());
        self.sight = match (self.over_time(frame), params) {
            (Some(over_time), Params::Frame(params)) => Some(Sight {
                shape: frame.shape(),
                params: over_time,
                geometry,
                sensor: params.sensor,
                camera,
                outputs: self.options.outputs,
                video: self.video.number,
                pose: self.video.pose.or(stated),
                is_pose_of_file: self.video.pose.is_none(),
                is_tracked: self.tracks_camera(),
            }),
            _ => None,
        };
    }

    /// Smooths a frame in space, then over time.
    pub(super) fn smooth_over_time(&mut self, frame: Frame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let (width, height) = frame.shape();
        let mut smoothed = std::mem::take(&mut self.video.smoothed);
        smoothed.prepare(width, height, self.outputs_before_time(frame));
        let result = self.smooth_in_passes(frame, smoothed.as_mut()).and_then(|()| match self.sight {
            Some(sight) => self.filter(&sight, &mut smoothed),
            None => Ok(()),
        });
        if result.is_ok() {
            out.copy_from(&smoothed);
        }
        self.video.smoothed = smoothed;
        result
    }

    /// Smooths a received result over time.
    pub(super) fn view_over_time(&mut self, sight: &Sight, view: SmoothedView) -> Result<SmoothedView, Error> {
        let timings = view.timings();
        let mut smoothed = view.into_smoothed();
        self.filter(sight, &mut smoothed)?;
        let (width, height) = (smoothed.width, smoothed.height);
        smoothed.prepare(width, height, sight.outputs);
        Ok(SmoothedView::owned(smoothed, timings))
    }

    fn filter(&mut self, sight: &Sight, smoothed: &mut Smoothed) -> Result<(), Error> {
        // Without a position of the sensor there are no ranges.
        if matches!(sight.geometry.rule, RangeRule::Constant { .. }) {
            return Ok(());
        }
        let OverTime { begun, ranges_m, single_m, .. } = &mut self.video;
        if begun.as_ref().is_none_or(|begun| !begun.goes_on_with(sight)) {
            *begun = Some(Begun::new(*sight, self.options.threads)?);
        }
        if let Some(begun) = begun
            && begun.find_camera(sight, smoothed)
        {
            self.events.push(SessionEvent::CameraUnknown);
        }
        let Some(Begun { filter, threads, camera, tracking, last_pose, motion: last_motion, .. }) = begun else {
            return Ok(());
        };
        // Poses of the caller and those of files may be in different worlds.
        let last_pose = std::mem::replace(last_pose, sight.pose.map(|pose| (pose, sight.is_pose_of_file)));
        let last_pose = last_pose.filter(|(_, is_of_file)| *is_of_file == sight.is_pose_of_file).map(|(pose, _)| pose);
        threads.install(|| {
            let motion = match (tracking.as_mut(), last_pose, sight.pose, &*camera) {
                // Many writers state the same pose for every frame, wherever the camera is.
                (_, Some(previous), Some(current), Some(camera)) if !(sight.is_pose_of_file && previous == current) => {
                    Some(CameraMotion::between(*camera, &previous, &current)?)
                }
                (Some((tracker, previous)), ..) => sight.track(tracker, previous, smoothed),
                _ => None,
            };
            *last_motion = motion;
            sight.measure(smoothed, ranges_m);
            single_m.clone_from(ranges_m);
            match motion {
                Some(motion) => filter.smooth_moved(&motion, ranges_m)?,
                None => filter.smooth(smoothed.width, smoothed.height, ranges_m)?,
            }
            sight.apply(filter, single_m, ranges_m, smoothed);
            if let Some((_, previous)) = tracking {
                sight.keep(smoothed, previous);
            }
            Ok(())
        })
    }

    /// Sets the pose of the camera in the world (x right, y down, z forward) for the frames smoothed or submitted from
    /// now on, or `None` if it is unknown. With poses, a video of a moving camera is smoothed over time as well: each
    /// pixel follows its surface. Needs frames with a camera; only the motion from frame to frame matters.
    ///
    /// # Errors
    /// If the pose is invalid.
    pub fn set_camera_pose(&mut self, world_from_camera: Option<SensorPose>) -> Result<(), Error> {
        if let Some(pose) = &world_from_camera {
            pose.validate()?;
        }
        self.video.pose = world_from_camera;
        Ok(())
    }

    /// Begins a new video with the next frame that is smoothed or submitted, as after a gap in time or when the camera
    /// was moved. Only for sessions that smooth over time.
    pub fn restart_video(&mut self) {
        self.video.number += 1;
        (self.video.last_time_s, self.video.last_interval_s) = (None, None);
    }

    /// Sets the time stamp of the next frame in seconds, if it has one. A new video begins after more than a second
    /// that is also more than five times the interval before, and when time runs backwards. Without time stamps, only
    /// [`restart_video`](Self::restart_video) does so. Nothing happens if the session does not smooth over time.
    pub fn set_frame_time(&mut self, timestamp_s: Option<f64>) {
        let is_video = self.settings().is_some_and(|settings| settings.temporal_params().is_some());
        let Some(now_s) = timestamp_s.filter(|time_s| is_video && time_s.is_finite()) else { return };
        if let Some(last_s) = self.video.last_time_s {
            let interval_s = now_s - last_s;
            let usual_s = self.video.last_interval_s.unwrap_or(0.0);
            if interval_s < 0.0 || interval_s > f64::max(LONGEST_INTERVAL_S, MOST_INTERVALS * usual_s) {
                self.restart_video();
                self.video.gaps += 1;
            }
            self.video.last_interval_s = Some(interval_s.max(0.0));
        }
        self.video.last_time_s = Some(now_s);
    }

    /// Returns how many new videos were begun because of [time stamps](Self::set_frame_time).
    pub fn gaps_in_time(&self) -> u64 {
        self.video.gaps
    }

    fn current_video(&self) -> Option<&Begun> {
        self.video.begun.as_ref().filter(|begun| begun.sight.video == self.video.number)
    }

    /// Returns how the camera moved between the last two frames that were smoothed over time, as given or estimated;
    /// `None` if that is not known. The estimate is good enough to smooth, but its errors add up over a video.
    pub fn camera_motion(&self) -> Option<CameraMotion> {
        self.current_video().and_then(|begun| begun.motion)
    }

    /// Returns the filter over time, which reports how many frames each pixel averages; `None` before the first
    /// frame, or if the session does not smooth over time.
    pub fn temporal_filter(&self) -> Option<&TemporalFilter> {
        self.current_video().map(|begun| &begun.filter)
    }
}

impl OverTime {
    /// Frees its memory.
    pub(super) fn close(&mut self) {
        self.begun = None;
        (self.ranges_m, self.single_m, self.smoothed) = Default::default();
    }
}

impl Begun {
    /// Returns true if a frame belongs to this video.
    fn goes_on_with(&self, sight: &Sight) -> bool {
        let first = &self.sight;
        let has_transform = |sight: &Sight| sight.geometry.cloud_from_sensor.is_some();
        // A sensor that moves is followed if its motion can be compensated.
        let is_followed = self.camera.is_some() && first.pose.is_some() && sight.pose.is_some();
        let is_same_place = first.geometry.cloud_from_sensor == sight.geometry.cloud_from_sensor
            || (is_followed && has_transform(first) == has_transform(sight));
        let is_same_camera = first.shape == sight.shape && first.camera == sight.camera && first.sensor == sight.sensor;
        first.video == sight.video && first.params == sight.params && is_same_camera && is_same_place
    }

    fn new(sight: Sight, threads: Option<usize>) -> Result<Self, Error> {
        let (threads, filter) = (Threads::open(threads)?, TemporalFilter::new(sight.params, sight.sensor)?);
        let (camera, tracking, last_pose, motion) = Default::default();
        Ok(Self { sight, filter, threads, camera, has_no_camera: false, tracking, last_pose, motion })
    }

    /// Finds the camera where its motion matters; returns true once if the motion is wanted but the points show no
    /// camera.
    fn find_camera(&mut self, sight: &Sight, smoothed: &Smoothed) -> bool {
        let needs_camera = sight.is_tracked || sight.pose.is_some();
        if !needs_camera || self.camera.is_some() || self.has_no_camera {
            return false;
        }
        let is_of_camera = matches!(sight.geometry.rule, RangeRule::Depth { .. });
        self.camera = sight.camera.or_else(|| sight.camera_of(smoothed)).filter(|_| is_of_camera);
        let tracked = self.camera.filter(|_| sight.is_tracked);
        self.tracking = tracked.map(|camera| (Tracker::new(camera, sight.sensor), Surface::default()));
        // A frame of holes shows no camera; the next one may.
        let has_points = smoothed.points.z().iter().any(|z| z.is_finite());
        self.has_no_camera = self.camera.is_none() && has_points;
        self.has_no_camera && (sight.is_tracked || !sight.is_pose_of_file)
    }
}

impl Sight {
    /// Returns the camera on whose pixels the points are.
    fn camera_of(&self, smoothed: &Smoothed) -> Option<Camera> {
        let mut surface = Surface::default();
        self.keep(smoothed, &mut surface);
        Camera::of_points((smoothed.width, smoothed.height), &surface.points)
    }

    /// Estimates how the camera has moved since the frame before.
    fn track(&self, tracker: &mut Tracker, previous: &mut Surface, smoothed: &Smoothed) -> Option<CameraMotion> {
        if previous.points.is_empty() {
            return None;
        }
        let mut moved = Surface::default();
        let current = match (&self.geometry.cloud_from_sensor, &smoothed.normals) {
            (None, Some(normals)) => SurfaceRef { points: &smoothed.points, normals },
            _ => {
                self.keep(smoothed, &mut moved);
                moved.borrow()
            }
        };
        let motion = tracker.track(previous, current)?;
        let previous_from_current = SensorPose::from_transform(&motion);
        Some(CameraMotion { camera: tracker.camera(), previous_from_current })
    }

    /// Copies points and normals in the frame of the sensor.
    fn keep(&self, smoothed: &Smoothed, surface: &mut Surface) {
        surface.points.clone_from(&smoothed.points);
        match &smoothed.normals {
            Some(normals) => surface.normals.clone_from(normals),
            None => surface.normals = crate::xyz::Xyz::default(),
        }
        if let Some(transform) = &self.geometry.cloud_from_sensor {
            let to_sensor = |point: [f32; 3]| transform.to_sensor(glam::Vec3::from_array(point).as_dvec3());
            let turned = |normal: [f32; 3]| transform.rotation.transpose() * glam::Vec3::from_array(normal).as_dvec3();
            surface.points = surface.points.iter().map(|point| to_sensor(point).as_vec3().to_array()).collect();
            surface.normals = surface.normals.iter().map(|normal| turned(normal).as_vec3().to_array()).collect();
        }
    }

    /// Measures the ranges of all points.
    fn measure(&self, smoothed: &Smoothed, ranges_m: &mut Vec<f32>) {
        let [_, _, z] = smoothed.points.as_slices();
        ranges_m.resize(z.len(), 0.0);
        if self.geometry.cloud_from_sensor.is_none() && matches!(self.geometry.rule, RangeRule::Depth { .. }) {
            ranges_m.iter_mut().zip(z).for_each(|(range_m, z)| *range_m = z.abs());
            return;
        }
        ranges_m.par_chunks_mut(TASK).enumerate().for_each(|(task, ranges_m)| {
            for (k, range_m) in ranges_m.iter_mut().enumerate() {
                let point = glam::Vec3::from_array(smoothed.points.get(TASK * task + k)).as_dvec3();
                let seen = self.geometry.cloud_from_sensor.map_or(point, |transform| transform.to_sensor(point));
                *range_m = self.geometry.range_m(seen) as f32;
            }
        });
    }

    /// Moves every point along its ray, from the range of the single frame to that over time. `single_m` becomes the
    /// ratio of the two.
    fn apply(&self, filter: &TemporalFilter, single_m: &mut [f32], ranges_m: &[f32], smoothed: &mut Smoothed) {
        let width = smoothed.width;
        let sensor = self.geometry.sensor_position().as_vec3().to_array();
        let ranges = single_m.par_chunks_mut(width).zip(ranges_m.par_chunks(width));
        let statuses = smoothed.status.as_deref_mut().unwrap_or_default().par_chunks_mut(width);
        let [x, y, z] = smoothed.points.as_mut_slices();
        let points = x.par_chunks_mut(width).zip(y.par_chunks_mut(width)).zip(z.par_chunks_mut(width));
        points.zip(statuses).zip(ranges).enumerate().for_each(|(row, (((xy, z), statuses), (ratios, ranges_m)))| {
            for (ratio, range_m) in ratios.iter_mut().zip(ranges_m) {
                *ratio = range_m / *ratio;
                // Holes stay as they are.
                *ratio = if ratio.is_finite() { *ratio } else { 1.0 };
            }
            if filter.has_carried(row) {
                for (u, (ratio, status)) in ratios.iter_mut().zip(statuses).enumerate() {
                    match (filter.is_carried(row * width + u), status.has_normal()) {
                        (true, true) => *status = Status::Carried,
                        // Its status must tell that it has no normal, so the point stays as measured.
                        (true, false) => *ratio = 1.0,
                        (false, _) => {}
                    }
                }
            }
            for (values, sensor) in [xy.0, xy.1, z].into_iter().zip(sensor) {
                values.iter_mut().zip(&*ratios).for_each(|(value, ratio)| *value = sensor + (*value - sensor) * ratio);
            }
        });
        let Some(depth_m) = &mut smoothed.depth_m else { return };
        depth_m.par_chunks_mut(width).zip(single_m.par_chunks(width)).for_each(|(depth_m, ratios)| {
            depth_m.iter_mut().zip(ratios).for_each(|(depth_m, ratio)| *depth_m *= ratio);
        });
        if let (Some(raw), Some(camera)) = (&mut smoothed.depth, &self.camera) {
            raw.par_chunks_mut(width).zip(depth_m.par_chunks(width)).for_each(|(raw, depth_m)| {
                raw.iter_mut().zip(depth_m).for_each(|(raw, depth_m)| *raw = camera.raw_depth(*depth_m));
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xyz::Xyz;

    /// Smooths frames of 8x8 pixels at 2 m, the last of which has another range at one pixel.
    fn last_of_video(status: Status, last_m: f32) -> Smoothed {
        let geometry = FrameGeometry { cloud_from_sensor: None, rule: RangeRule::Depth { pitch_at_1m: None } };
        let outputs = Outputs::POINTS;
        let sight = Sight {
            shape: (8, 8),
            params: TemporalParams::STEADY,
            geometry,
            sensor: SensorModel::KINECT_V1,
            camera: None,
            outputs,
            video: 0,
            pose: None,
            is_pose_of_file: false,
            is_tracked: false,
        };
        let mut filter = TemporalFilter::new(TemporalParams::STEADY, SensorModel::KINECT_V1).unwrap();
        let mut last = Smoothed::default();
        for t in 0..6 {
            let range_m = |i: usize| if t == 5 && i == 27 { last_m } else { 2.0 };
            let points: Xyz = (0..64).map(|i| [0.1 * range_m(i), -0.2 * range_m(i), range_m(i)]).collect();
            last = Smoothed { width: 8, height: 8, points, status: Some(vec![status; 64]), ..Smoothed::default() };
            let (mut single_m, mut ranges_m) = (Vec::new(), Vec::new());
            sight.measure(&last, &mut single_m);
            ranges_m.clone_from(&single_m);
            filter.smooth(8, 8, &mut ranges_m).unwrap();
            sight.apply(&filter, &mut single_m, &ranges_m, &mut last);
        }
        last
    }

    #[test]
    fn a_value_that_was_carried_over_says_so() {
        let last = last_of_video(Status::Polynomial2, 1.5);
        let status = last.status.as_ref().unwrap();
        assert_eq!((status[27], status[26]), (Status::Carried, Status::Polynomial2));
        assert!(last.points.get(27).iter().zip([0.2, -0.4, 2.0]).all(|(a, b)| (a - b).abs() < 1e-6));
        // Its status cannot tell both, so it is not carried.
        let last = last_of_video(Status::Degenerate, 1.5);
        assert_eq!(last.status.as_ref().unwrap()[27], Status::Degenerate);
        assert_eq!(last.points.get(27)[2], 1.5);
        // A hole stays one.
        let last = last_of_video(Status::Hole, f32::NAN);
        assert!(last.points.get(27)[2].is_nan() && last.status.as_ref().unwrap()[27] == Status::Hole);
    }
}
