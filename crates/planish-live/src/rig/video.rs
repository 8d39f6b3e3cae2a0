//! Smooths each camera's results over time, after they were smoothed in space.

use rayon::prelude::*;

use super::smoother::CameraSmoother;
use super::{RigResults, RigSmoother};
use planish_core::internal::{ResultFilter, ResultSight};
use planish_core::{Error, Frame, FrameError, Outputs, Smoothed, SmoothedView, TemporalParams};

/// The result of a camera.
type CameraResult = Option<Result<Smoothed, FrameError>>;

impl RigSmoother {
    /// Also smooths each camera's results over time (docs/method.md, section 16), on the CPU, with one state per
    /// camera; `None` smooths in space only. `tracks_cameras` estimates the motion of each camera. Not supported for
    /// points thinned to voxels.
    pub fn with_temporal(mut self, params: Option<TemporalParams>, tracks_cameras: bool) -> Self {
        for camera in &mut self.cameras[..self.of_rig] {
            camera.video = params.map(|params| ResultFilter::new(params, tracks_cameras));
        }
        self.tracks_cameras = tracks_cameras;
        self
    }

    /// Sets the timestamp of the next moment in seconds, or `None` for a moment without one. Smoothing over time
    /// restarts for a camera whose last frame was earlier by more than one second and more than five frame intervals.
    pub fn set_moment_time(&mut self, time_s: Option<f64>) {
        self.time_s = time_s;
    }

    /// Restarts smoothing over time with the next moment, for all cameras, for example after the rig was moved.
    pub fn restart_videos(&mut self) {
        self.videos().for_each(ResultFilter::restart);
    }

    /// Takes the indices of the cameras whose motion cannot be estimated because the intrinsics for their points are
    /// unknown; each camera once per video.
    pub(super) fn take_unknown_cameras(&mut self) -> Vec<usize> {
        let unknown = self.cameras.iter_mut().map(|camera| camera.video.as_mut()?.take_camera_unknown().then_some(()));
        unknown.enumerate().filter_map(|(i, unknown)| unknown.map(|()| i)).collect()
    }

    fn videos(&mut self) -> impl Iterator<Item = &mut ResultFilter> {
        self.cameras.iter_mut().filter_map(|camera| camera.video.as_mut())
    }

    /// Returns the outputs that smoothing in space must compute.
    pub(super) fn outputs_in_space(&self) -> Outputs {
        let outputs = self.options.outputs;
        let is_video = self.cameras.iter().any(|camera| camera.video.is_some());
        if is_video { ResultFilter::outputs_in_space(outputs, self.tracks_cameras) } else { outputs }
    }

    /// Smooths the results of a moment over time.
    pub(super) fn over_time(
        &mut self,
        frames: &[Option<Frame<'_>>],
        mut results: RigResults,
    ) -> Result<RigResults, Error> {
        let (time_s, outputs) = (self.time_s, self.options.outputs);
        type Of<'a, 'b, 'c> = ((&'a mut CameraSmoother, &'b Option<Frame<'c>>), &'a mut CameraResult);
        let filter = |((camera, frame), result): Of<'_, '_, '_>| {
            let (Some(frame), Some(Ok(smoothed))) = (frame, result) else { return Ok(()) };
            let sight = camera.look_at(*frame, time_s, outputs);
            if camera.video.is_some() && sight.is_none() {
                // Points without a grid are not smoothed over time.
                let (width, height) = (smoothed.width, smoothed.height);
                smoothed.frames = outputs.frames.then(|| vec![1.0; width * height]);
                smoothed.prepare(width, height, outputs);
            }
            camera.result_over_time(sight.as_ref(), smoothed)
        };
        let of_cameras = self.cameras.par_iter_mut().zip(frames).zip(&mut results).map(filter);
        self.threads.install(|| of_cameras.collect::<Result<(), Error>>())?;
        Ok(results)
    }
}

impl CameraSmoother {
    /// Prepares for smoothing the result of a frame over time, before the frame is smoothed in space. Returns `None` if
    /// the result is not smoothed over time.
    pub(super) fn look_at(&mut self, frame: Frame<'_>, time_s: Option<f64>, outputs: Outputs) -> Option<ResultSight> {
        self.video.as_mut()?.look_at(frame, time_s, self.params.sensor, outputs)
    }

    fn result_over_time(&mut self, sight: Option<&ResultSight>, smoothed: &mut Smoothed) -> Result<(), Error> {
        match (&mut self.video, sight) {
            (Some(video), Some(sight)) => video.filter(sight, smoothed),
            _ => Ok(()),
        }
    }

    pub(super) fn view_over_time(
        &mut self,
        sight: Option<&ResultSight>,
        view: SmoothedView,
    ) -> Result<SmoothedView, Error> {
        if sight.is_none() {
            return Ok(view);
        }
        let timings = view.timings();
        let mut smoothed = view.into_smoothed();
        self.result_over_time(sight, &mut smoothed)?;
        Ok(SmoothedView::owned(smoothed, timings))
    }
}
