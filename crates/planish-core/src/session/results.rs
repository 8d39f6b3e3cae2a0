//! Smoothing over time for results that were smoothed in space elsewhere, such as the frames of a rig.

use super::clock::VideoClock;
use super::filtering::Filtering;
use super::over_time::outputs_in_space;
use super::sight::Sight;
use crate::error::Error;
use crate::frame::{Frame, FrameGeometry, GeometryScratch};
use crate::outputs::Outputs;
use crate::sensor::SensorModel;
use crate::smoothed::Smoothed;
use crate::temporal::TemporalParams;

/// Smooths the results of one camera over time.
pub struct ResultFilter {
    params: TemporalParams,
    tracks_camera: bool,
    filtering: Filtering,
    clock: VideoClock,
    scratch: GeometryScratch,
    is_camera_unknown: bool,
}

/// The geometry and sensor of a frame whose result is smoothed over time later.
#[derive(Debug, Clone, Copy)]
pub struct ResultSight(Sight);

impl ResultFilter {
    /// Creates a filter. The filter estimates the motion of the camera if `tracks_camera` is set.
    pub fn new(params: TemporalParams, tracks_camera: bool) -> Self {
        let (filtering, clock, scratch) = Default::default();
        Self { params, tracks_camera, filtering, clock, scratch, is_camera_unknown: false }
    }

    /// Returns the outputs of smoothing in space that [`filter`](Self::filter) needs to compute `outputs`.
    pub fn outputs_in_space(outputs: Outputs, tracks_camera: bool) -> Outputs {
        outputs_in_space(outputs, tracks_camera)
    }

    /// Begins a new video with the next frame.
    pub fn restart(&mut self) {
        self.clock.restart();
    }

    /// Examines a frame before it is smoothed in space. Must be called in the order of the video; gaps in timestamps
    /// begin a new video. Returns `None` for a frame without a grid.
    pub fn look_at(
        &mut self,
        frame: Frame<'_>,
        time_s: Option<f64>,
        sensor: SensorModel,
        outputs: Outputs,
    ) -> Option<ResultSight> {
        frame.grid()?;
        self.clock.set_time(time_s);
        let geometry = FrameGeometry::of(frame, true, &mut self.scratch);
        let camera = match frame {
            Frame::Depth(depth) => Some(*depth.camera()),
            Frame::Points(points) => points.camera().copied(),
        };
        Some(ResultSight(Sight {
            geometry,
            sensor,
            camera,
            outputs,
            shape: frame.shape(),
            params: self.params,
            video: self.clock.video(),
            pose: None,
            is_pose_of_file: false,
            is_tracked: self.tracks_camera,
        }))
    }

    /// Smooths the result of a frame over time, and keeps only the requested outputs. Must be called in the order of
    /// the video.
    ///
    /// # Errors
    /// If the parameters are outside their ranges.
    pub fn filter(&mut self, ResultSight(sight): &ResultSight, smoothed: &mut Smoothed) -> Result<(), Error> {
        self.is_camera_unknown |= self.filtering.filter(sight, smoothed, None)?;
        let (width, height) = sight.shape;
        smoothed.prepare(width, height, sight.outputs);
        Ok(())
    }

    /// Returns true if the motion of the camera is needed but no camera fits the points; false in later calls, until
    /// this happens in another video.
    pub fn take_camera_unknown(&mut self) -> bool {
        std::mem::take(&mut self.is_camera_unknown)
    }
}
