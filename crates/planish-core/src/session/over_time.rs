//! Smoothing of a video over time, after each frame was smoothed in space (docs/method.md, section 16): by the
//! session's filter, or by a GPU that keeps the video's state.

use super::clock::VideoClock;
use super::filtering::Filtering;
use super::open::Open;
use super::pending::OnReceipt;
use super::sight::{Sight, StatedPose};
use super::{Chosen, Session, SessionEvent};
use crate::engines::{Engine, SmootherOptions};
use crate::error::Error;
use crate::frame::{Frame, FrameGeometry, RangeRule};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::Params;
use crate::pose::SensorPose;
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, Video, VideoStep};
use crate::temporal::{CameraMotion, TemporalFilter, TemporalParams};
use crate::threads::ONE_THREAD;
use crate::view::SmoothedView;

/// A video whose state is on a device.
struct OnDevice {
    /// The geometry, camera and sensor of the video's first frame.
    sight: Sight,
    last_pose: StatedPose,
    /// Motion of the camera between the last two submitted frames, if known.
    motion: Option<CameraMotion>,
    /// Motion of the camera between the last two received frames, if known.
    received: Option<CameraMotion>,
}

/// The state of smoothing over time in a session, with its buffers.
#[derive(Default)]
pub(super) struct OverTime {
    filtering: Filtering,
    on_device: Option<OnDevice>,
    clock: VideoClock,
    /// The pose that the caller has set for the next frames.
    pose: Option<SensorPose>,
    /// The result before it is copied to the caller's buffers.
    smoothed: Smoothed,
    spare: Spare,
    /// Buffers that engines do not fill, for each result in flight.
    kept: Vec<Kept>,
}

/// Buffers of a result that are filled by the session instead of the engine.
#[derive(Debug, Default)]
struct Kept {
    depth: Option<Vec<u16>>,
    frames: Option<Vec<f32>>,
}

impl Kept {
    /// Takes the buffers out of a result, and keeps only the requested ones.
    fn of(smoothed: &mut Smoothed, outputs: Outputs) -> Self {
        let (depth, frames) = (smoothed.depth.take(), smoothed.frames.take());
        Self { depth: depth.filter(|_| outputs.depth), frames: frames.filter(|_| outputs.frames) }
    }

    fn give_to(self, smoothed: &mut Smoothed) {
        smoothed.depth = smoothed.depth.take().or(self.depth);
        smoothed.frames = smoothed.frames.take().or(self.frames);
    }
}

/// Buffers for results that the caller did not request.
#[derive(Debug, Default)]
struct Spare(Smoothed);

impl Spare {
    /// Swaps these buffers with those of the caller's result, for all outputs that the caller did not request.
    fn exchange(&mut self, out: &mut Smoothed, outputs: Outputs) {
        let Self(spare) = self;
        let Outputs { points, normals, status, depth_m, .. } = outputs;
        if !points {
            std::mem::swap(&mut out.points, &mut spare.points);
        }
        if !normals {
            std::mem::swap(&mut out.normals, &mut spare.normals);
        }
        if !status {
            std::mem::swap(&mut out.status, &mut spare.status);
        }
        if !depth_m {
            std::mem::swap(&mut out.depth_m, &mut spare.depth_m);
        }
    }
}

/// Returns the outputs of smoothing in space that smoothing over time needs.
pub(super) fn outputs_in_space(outputs: Outputs, tracks_camera: bool) -> Outputs {
    let normals = outputs.normals || tracks_camera;
    let depth_m = outputs.depth_m || outputs.depth;
    let outputs = outputs.with_depth(false).with_depth_m(depth_m).with_frames(false);
    outputs.with_points(true).with_status(true).with_normals(normals)
}

impl Session {
    /// Returns the filter's parameters if a frame is part of a video that is smoothed over time.
    pub(super) fn over_time(&self, frame: Frame<'_>) -> Option<TemporalParams> {
        match &self.chosen {
            Chosen::Settings(settings) => {
                settings.temporal_params().filter(|_| frame.grid().is_some() && !self.is_on_lattice)
            }
            Chosen::Params(..) => None,
        }
    }

    /// Returns the outputs that an engine must compute for a frame. If the frame is smoothed over time, they exclude
    /// raw depth and the number of averaged frames, which are computed after the filter.
    pub(super) fn outputs_before_time(&self, frame: Frame<'_>) -> Outputs {
        let outputs = self.outputs_to_finish(frame);
        match self.over_time(frame) {
            Some(_) => outputs_in_space(outputs, self.tracks_camera()),
            None => outputs,
        }
    }

    /// Returns the video of the last examined frame, if an engine may smooth it over time itself; otherwise `None`.
    pub(super) fn video_of_engine(&self, options: &SmootherOptions, uses_fleet: bool) -> Option<Video> {
        if ONE_THREAD {
            return None;
        }
        // An open engine without its own filter serves every video, so it is not reopened.
        if let Some(open) = self.open.as_ref().filter(|open| open.engine() != Engine::Gpu) {
            return open.open_for().video;
        }
        let is_possible = !uses_fleet && matches!(options.engine, Engine::Gpu | Engine::Auto);
        let sight = self.sight.as_ref().filter(|_| is_possible)?;
        let is_depth =
            sight.geometry.cloud_from_sensor.is_none() && matches!(sight.geometry.rule, RangeRule::Depth { .. });
        // Poses need a camera without distortion, since shaders do not support distortion; tracking needs the results
        // in space.
        let has_camera = sight.camera.is_some_and(|camera| camera.distortion.is_none());
        let is_possible = is_depth && !sight.is_tracked && (sight.pose.is_none() || has_camera);
        let Sight { params, sensor, outputs, pose, .. } = *sight;
        // An engine opened for a moving camera is kept if some poses are missing.
        let opened = self.open.as_ref().and_then(|open| open.open_for().video);
        let moves = pose.is_some() || opened.is_some_and(|video| video.moves);
        is_possible.then_some(Video { params, sensor, outputs, moves })
    }

    /// Returns the camera, sensor and geometry of the last examined frame, if the session must smooth its result over
    /// time.
    pub(super) fn sight_to_filter(&self) -> Option<Sight> {
        self.sight.filter(|_| !self.is_over_time_on_device())
    }

    /// If the session is to smooth the result over time, sets aside the buffers that engines do not fill. They are kept
    /// until the result is received.
    pub(super) fn keep_buffers(&mut self, buffer: &mut Smoothed) {
        if ONE_THREAD {
            return;
        }
        if self.pending.is_empty() {
            self.video.kept.clear();
        }
        if self.sight_to_filter().is_some() {
            self.video.kept.push(Kept::of(buffer, self.options.outputs));
        }
    }

    fn is_over_time_on_device(&self) -> bool {
        !ONE_THREAD && self.open.as_ref().is_some_and(Open::is_over_time)
    }

    /// Adds a frame's position in its video, if the video's state is on the device.
    pub(super) fn with_step<'a>(&mut self, admitted: AdmittedFrame<'a>) -> Result<AdmittedFrame<'a>, Error> {
        let (Some(sight), true) = (self.sight, self.is_over_time_on_device()) else { return Ok(admitted) };
        // The session's own filter is out of date from here on.
        self.video.filtering.forget();
        let on_device = &mut self.video.on_device;
        let starts =
            on_device.as_ref().is_none_or(|video| !video.sight.goes_on_with(&sight, video.sight.camera.is_some()));
        if starts {
            *on_device = None;
        }
        let video = on_device.get_or_insert(OnDevice { sight, last_pose: None, motion: None, received: None });
        video.motion = sight.motion_since(&mut video.last_pose, sight.camera.as_ref())?;
        Ok(AdmittedFrame { step: VideoStep { starts, motion: video.motion }, ..admitted })
    }

    /// Returns the smoothing over time that the last submitted frame needs when it is received.
    pub(super) fn on_receipt(&self) -> OnReceipt {
        match (self.sight, self.is_over_time_on_device()) {
            // Settings for videos are refused in a browser, to keep the WebAssembly module small.
            _ if ONE_THREAD => OnReceipt::Nothing,
            (None, _) => OnReceipt::Nothing,
            (Some(sight), false) => OnReceipt::Filter(sight),
            (Some(sight), true) => {
                OnReceipt::Filtered(sight, self.video.on_device.as_ref().and_then(|video| video.motion))
            }
        }
    }

    /// Calls `smooth` for a frame in flight, with the pose, video and outputs of its submission. Returns the result
    /// of `smooth`, and the smoothing over time that the frame needs when it is received.
    pub(super) fn as_submitted<T>(
        &mut self,
        before: &OnReceipt,
        smooth: impl FnOnce(&mut Self) -> T,
    ) -> (T, OnReceipt) {
        let (pose, clock, outputs) = (self.video.pose, self.video.clock, self.options.outputs);
        if let (false, OnReceipt::Filter(sight) | OnReceipt::Filtered(sight, _)) = (ONE_THREAD, before) {
            self.video.pose = sight.pose.filter(|_| !sight.is_pose_of_file);
            self.video.clock.set_video(sight.video);
            self.options.outputs = sight.outputs;
        }
        let result = smooth(self);
        let on_receipt = self.on_receipt();
        (self.video.pose, self.video.clock, self.options.outputs) = (pose, clock, outputs);
        (result, on_receipt)
    }

    /// Smooths a received result over time, unless the device has already done so.
    pub(super) fn received(&mut self, view: SmoothedView, on_receipt: OnReceipt) -> Result<SmoothedView, Error> {
        match on_receipt {
            _ if ONE_THREAD => Ok(view),
            OnReceipt::Nothing => Ok(view),
            OnReceipt::Filter(sight) => self.view_over_time(&sight, view),
            OnReceipt::Filtered(_, motion) => {
                if let Some(video) = &mut self.video.on_device {
                    video.received = motion;
                }
                Ok(view)
            }
        }
    }

    fn tracks_camera(&self) -> bool {
        matches!(&self.chosen, Chosen::Settings(settings) if settings.tracks_camera())
    }

    /// Stores the camera, sensor and geometry of a frame, which are needed to smooth its result over time.
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
                outputs: self.outputs_to_finish(frame),
                video: self.video.clock.video(),
                pose: self.video.pose.or(stated),
                is_pose_of_file: self.video.pose.is_none(),
                is_tracked: self.tracks_camera(),
            }),
            _ => None,
        };
    }

    /// Smooths a frame in space, then over time.
    pub(super) fn smooth_over_time(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        // The session lends buffers for results that the filter needs but the caller did not request.
        let outputs = self.options.outputs;
        let mut spare = std::mem::take(&mut self.video.spare);
        spare.exchange(out, outputs);
        let result = self.smooth_in_time(frame, out, None);
        spare.exchange(out, outputs);
        self.video.spare = spare;
        // Clears results left from earlier calls with other outputs.
        let (width, height) = frame.shape();
        out.prepare(width, height, outputs);
        result
    }

    /// Smooths a frame in space, then over time, into the caller's buffers.
    pub(super) fn smooth_over_time_into(&mut self, frame: Frame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let mut smoothed = std::mem::take(&mut self.video.smoothed);
        let result = self.smooth_in_time(frame, &mut smoothed, Some(&mut out));
        self.video.smoothed = smoothed;
        result
    }

    /// Smooths a frame over time: on the device, or in space into `smoothed` and then with the session's filter. The
    /// result is written to `out` if given, otherwise to `smoothed`.
    fn smooth_in_time(
        &mut self,
        frame: Frame<'_>,
        smoothed: &mut Smoothed,
        mut out: Option<&mut SmoothedMut<'_>>,
    ) -> Result<(), Error> {
        self.check_idle()?;
        let (width, height) = frame.shape();
        loop {
            let result =
                self.open_for(frame, false).and_then(|admitted| self.with_step(admitted)).and_then(|admitted| {
                    let is_on_device = self.is_over_time_on_device();
                    if let (true, Some(out)) = (is_on_device, &mut out) {
                        return self.smoother()?.smooth_admitted(&admitted, out.reborrow());
                    }
                    let outputs = if is_on_device { self.options.outputs } else { self.outputs_before_time(frame) };
                    let kept = if is_on_device { Kept::default() } else { Kept::of(smoothed, self.options.outputs) };
                    smoothed.prepare(width, height, outputs);
                    self.smoother()?.smooth_admitted(&admitted, smoothed.as_mut())?;
                    kept.give_to(smoothed);
                    Ok(())
                });
            match result {
                Err(error) => self.recover(error, frame.grid().is_none(), false)?,
                Ok(()) => break,
            }
        }
        if let Some(sight) = self.sight_to_filter() {
            self.filter(&sight, smoothed)?;
            if let Some(out) = out {
                out.copy_from(smoothed);
            }
        } else if let Some(video) = &mut self.video.on_device {
            video.received = video.motion;
        }
        Ok(())
    }

    /// Smooths a received result over time.
    fn view_over_time(&mut self, sight: &Sight, view: SmoothedView) -> Result<SmoothedView, Error> {
        let timings = view.timings();
        let mut smoothed = view.into_smoothed();
        self.video.kept.pop().unwrap_or_default().give_to(&mut smoothed);
        self.filter(sight, &mut smoothed)?;
        let (width, height) = (smoothed.width, smoothed.height);
        smoothed.prepare(width, height, sight.outputs);
        Ok(SmoothedView::owned(smoothed, timings))
    }

    fn filter(&mut self, sight: &Sight, smoothed: &mut Smoothed) -> Result<(), Error> {
        if self.video.filtering.filter(sight, smoothed, self.options.threads)? {
            self.events.push(SessionEvent::CameraUnknown);
        }
        Ok(())
    }

    /// Sets the pose of the camera in the world (x right, y down, z forward) for all later frames, or `None` if it is
    /// unknown. With poses, a video of a moving camera is smoothed over time as well, because each pixel follows its
    /// surface. Needs frames with a camera; only the motion from frame to frame matters.
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

    /// Begins a new video with the next frame that is smoothed or submitted, for example after a gap in time or after
    /// the camera was moved. Only for sessions that smooth over time.
    pub fn restart_video(&mut self) {
        self.video.clock.restart();
    }

    /// Sets the timestamp of the next frame in seconds, if it has one. A new video begins if the time since the
    /// previous frame exceeds both one second and five times the interval before the previous frame, or if the
    /// timestamp is earlier than the previous one. Without timestamps, only [`restart_video`](Self::restart_video)
    /// begins a new video. Has no effect unless the session smooths over time.
    pub fn set_frame_time(&mut self, timestamp_s: Option<f64>) {
        let is_video = self.settings().is_some_and(|settings| settings.temporal_params().is_some());
        if is_video {
            self.video.clock.set_time(timestamp_s);
        }
    }

    /// Returns the number of videos begun because of [timestamps](Self::set_frame_time).
    pub fn gaps_in_time(&self) -> u64 {
        self.video.clock.gaps()
    }

    /// Returns the motion of the camera between the last two frames that were smoothed over time, as given or
    /// estimated; `None` if it is unknown. The estimate is accurate enough for smoothing, but its errors accumulate
    /// over a video.
    pub fn camera_motion(&self) -> Option<CameraMotion> {
        let number = self.video.clock.video();
        let on_device = self.video.on_device.as_ref().filter(|video| video.sight.video == number);
        self.video.filtering.motion(number).or_else(|| on_device.and_then(|video| video.received))
    }

    /// Returns the session's filter over time; `None` before the first frame, if the session does not smooth over
    /// time, or if the GPU smooths over time itself. With every engine, [`Outputs::frames`] is the number of frames
    /// that each pixel averages.
    pub fn temporal_filter(&self) -> Option<&TemporalFilter> {
        self.video.filtering.filter_of(self.video.clock.video())
    }
}

impl OverTime {
    /// Forgets the video whose state is on a device.
    pub(super) fn leave_device(&mut self) {
        self.on_device = None;
    }

    /// Drops the state of the current video and frees the buffers.
    pub(super) fn close(&mut self) {
        self.on_device = None;
        (self.filtering, self.smoothed, self.spare, self.kept) = Default::default();
    }
}
