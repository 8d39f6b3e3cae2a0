//! The filter over time and its state, for results that were smoothed in space: those of a session, or of one camera
//! in a rig.

use super::sight::{Sight, StatedPose};
use crate::camera::Camera;
use crate::error::Error;
use crate::frame::RangeRule;
use crate::smoothed::Smoothed;
use crate::temporal::{CameraMotion, Surface, TemporalFilter, Tracker};
use crate::threads::Threads;

/// The state of a video since its first frame.
struct Begun {
    /// The camera, sensor and geometry of the first frame.
    sight: Sight,
    filter: TemporalFilter,
    threads: Threads,
    /// The camera, given by the frame or found from the points.
    camera: Option<Camera>,
    /// Whether no camera fits the points.
    has_no_camera: bool,
    /// The tracker, and the surface of the last frame, if the motion of the camera is estimated.
    tracking: Option<(Tracker, Surface)>,
    /// The pose of the last frame, and whether the frame itself stated it.
    last_pose: StatedPose,
    /// Motion of the camera between the last two frames, if known.
    motion: Option<CameraMotion>,
}

/// The filter over time with its state, for results that were smoothed in space.
#[derive(Default)]
pub(super) struct Filtering {
    begun: Option<Begun>,
    /// Ranges of the frame's points before the filter, in metres; empty if they are the magnitudes of z.
    ranges_m: Vec<f32>,
}

impl Filtering {
    /// Smooths a result in place, and adds the outputs derived from others. Returns true, at most once per video, if
    /// the motion of the camera is needed but no camera fits the points.
    pub(super) fn filter(
        &mut self,
        sight: &Sight,
        smoothed: &mut Smoothed,
        threads: Option<usize>,
    ) -> Result<bool, Error> {
        // Without the sensor's position, there are no ranges.
        if matches!(sight.geometry.rule, RangeRule::Constant { .. }) {
            Threads::open(threads)?.install(|| sight.finish(smoothed, None));
            return Ok(false);
        }
        let knows_camera = |begun: &Begun| begun.camera.is_some();
        if self.begun.as_ref().is_none_or(|begun| !begun.sight.goes_on_with(sight, knows_camera(begun))) {
            self.begun = Some(Begun::new(*sight, threads)?);
        }
        let Some(begun) = &mut self.begun else { return Ok(false) };
        let is_unknown = begun.find_camera(sight, smoothed);
        begun.filter(sight, smoothed, &mut self.ranges_m)?;
        Ok(is_unknown)
    }

    pub(super) fn forget(&mut self) {
        self.begun = None;
    }

    fn current(&self, video: u64) -> Option<&Begun> {
        self.begun.as_ref().filter(|begun| begun.sight.video == video)
    }

    /// Returns the motion of the camera between the last two frames; `None` if the motion is unknown or the last
    /// frame belongs to another video.
    pub(super) fn motion(&self, video: u64) -> Option<CameraMotion> {
        self.current(video)?.motion
    }

    /// Returns the filter of this video; `None` if the last frame belongs to another video.
    pub(super) fn filter_of(&self, video: u64) -> Option<&TemporalFilter> {
        self.current(video).map(|begun| &begun.filter)
    }
}

impl Begun {
    fn new(sight: Sight, threads: Option<usize>) -> Result<Self, Error> {
        let (threads, filter) = (Threads::open(threads)?, TemporalFilter::new(sight.params, sight.sensor)?);
        let (camera, tracking, last_pose, motion) = Default::default();
        Ok(Self { sight, filter, threads, camera, has_no_camera: false, tracking, last_pose, motion })
    }

    /// Finds the camera if its motion matters. Returns true, at most once per video, if the motion is needed but no
    /// camera fits the points.
    fn find_camera(&mut self, sight: &Sight, smoothed: &Smoothed) -> bool {
        let needs_camera = sight.is_tracked || sight.pose.is_some();
        if !needs_camera || self.camera.is_some() || self.has_no_camera {
            return false;
        }
        let is_of_camera = matches!(sight.geometry.rule, RangeRule::Depth { .. });
        self.camera = sight.camera.or_else(|| sight.camera_of(smoothed)).filter(|_| is_of_camera);
        let tracked = self.camera.filter(|_| sight.is_tracked);
        self.tracking = tracked.map(|camera| (Tracker::new(camera, sight.sensor), Surface::default()));
        // Whether a camera fits cannot be decided from a frame of holes; the next frame may have points.
        let has_points = smoothed.points.z().iter().any(|z| z.is_finite());
        self.has_no_camera = self.camera.is_none() && has_points;
        self.has_no_camera && (sight.is_tracked || !sight.is_pose_of_file)
    }

    fn filter(&mut self, sight: &Sight, smoothed: &mut Smoothed, ranges_m: &mut Vec<f32>) -> Result<(), Error> {
        let Self { filter, threads, camera, tracking, last_pose, motion: last_motion, .. } = self;
        threads.install(|| {
            let motion = match (sight.motion_since(last_pose, camera.as_ref())?, tracking.as_mut()) {
                (None, Some((tracker, previous))) => sight.track(tracker, previous, smoothed),
                (stated, _) => stated,
            };
            *last_motion = motion;
            sight.measure(smoothed, ranges_m);
            let shape @ (width, _) = (smoothed.width, smoothed.height);
            filter.smooth_rows(motion.as_ref(), shape, |v, row| {
                let at = v * width..(v + 1) * width;
                match ranges_m.get(at.clone()) {
                    Some(ranges_m) => row.copy_from_slice(ranges_m),
                    None => row.iter_mut().zip(&smoothed.points.z()[at]).for_each(|(range_m, z)| *range_m = z.abs()),
                }
            })?;
            sight.apply(filter, ranges_m, smoothed);
            if let Some((_, previous)) = tracking {
                sight.keep(smoothed, previous);
            }
            sight.finish(smoothed, Some(filter));
            Ok(())
        })
    }
}
