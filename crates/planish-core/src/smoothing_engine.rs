//! The trait that every engine implements.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::error::{EngineError, Error};
use crate::frame::{Frame, FrameGeometry};
use crate::outputs::{Outputs, SmoothedMut};
use crate::progress::Progress;
use crate::sensor::SensorModel;
use crate::smoothed::Smoothed;
use crate::temporal::{CameraMotion, TemporalParams};
use crate::timings::FrameTimings;
use crate::view::SmoothedView;

/// A frame that fits the open smoother, and its geometry.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AdmittedFrame<'a> {
    pub(crate) frame: Frame<'a>,
    pub(crate) geometry: FrameGeometry,
    /// The frame's position in a video, for an engine that also smooths over time.
    #[cfg_attr(not(feature = "gpu"), allow(dead_code))]
    pub(crate) step: VideoStep,
}

/// A video that an engine may itself smooth over time (docs/method.md, section 16). Its frames are seen by a sensor
/// at the origin, and their ranges are depths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Video {
    pub(crate) params: TemporalParams,
    pub(crate) sensor: SensorModel,
    /// The outputs of smoothing over time.
    pub(crate) outputs: Outputs,
    /// True if the camera may move between frames.
    pub(crate) moves: bool,
}

/// A frame's position in a video.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct VideoStep {
    /// True for the first frame of a video.
    pub(crate) starts: bool,
    /// The camera's motion since the previous frame, if known.
    pub(crate) motion: Option<CameraMotion>,
}

/// Steps after smoothing that an engine may compute itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DeviceSteps {
    /// Whether to estimate standard errors (docs/method.md, section 17).
    pub(crate) sigma: bool,
    /// Maximum width in pixels of the holes to fill (docs/method.md, section 18).
    pub(crate) fill_px: Option<u32>,
    /// The outputs that the user requested. The engine is opened for the outputs that the steps need.
    pub(crate) outputs: Outputs,
}

impl DeviceSteps {
    /// Returns true if the steps finish a frame. Otherwise, the session must fill the frame's holes, because the frame
    /// is not a depth image, its lens is distorted, or it has colours.
    pub(crate) fn finish(&self, frame: &Frame<'_>) -> bool {
        let is_pinhole = matches!(frame, Frame::Depth(depth) if depth.camera().distortion.is_none());
        self.fill_px.is_none() || (is_pinhole && frame.colours().is_none())
    }
}

impl<'a> AdmittedFrame<'a> {
    /// Creates a frame that is not part of a video.
    pub(crate) fn new(frame: Frame<'a>, geometry: FrameGeometry) -> Self {
        Self { frame, geometry, step: VideoStep::default() }
    }
}

/// An open engine with its buffers. Callers guarantee that frames have the shape that the engine was opened for, and
/// that buffers have one entry per pixel or point and are only for outputs that the engine was opened for.
pub(crate) trait SmoothingEngine: Send {
    /// Smooths one frame.
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error>;

    /// Smooths several frames.
    fn smooth_batch(&mut self, frames: &[AdmittedFrame<'_>], out: &mut [Smoothed]) -> Result<(), Error>;

    /// Submits a frame. Results are received in the order of submission. If `buffer` is given, the result is stored
    /// in it.
    fn submit(&mut self, frame: &AdmittedFrame<'_>, buffer: Option<Smoothed>) -> Result<(), Error>;

    /// Waits for the oldest frame in flight and returns its result; `None` if no frame is in flight.
    fn receive(&mut self) -> Result<Option<SmoothedView>, Error>;

    /// Enables smoothing over time for all later frames; returns false if the engine does not support it. Later
    /// results have the outputs of the video, and [`AdmittedFrame::step`] is used.
    fn smooth_over_time(&mut self, _: &Video) -> Result<bool, Error> {
        Ok(false)
    }

    /// Adds steps to all later frames; returns false, without changes, if the engine does not support them. Frames that
    /// [`DeviceSteps::finish`] then have only the requested outputs.
    fn take_steps(&mut self, _: &DeviceSteps) -> Result<bool, Error> {
        Ok(false)
    }

    /// Prepares for several frames in flight, so that the second frame need not wait for the preparation.
    fn prepare_in_flight(&mut self) {}

    fn in_flight(&self) -> usize;

    fn max_in_flight(&self) -> usize;

    /// Returns the time spent in each stage of the last call of `smooth` or `smooth_batch`; `None` if times were not
    /// requested.
    fn timings(&self) -> Option<FrameTimings>;

    /// Returns the size in bytes of the buffers kept between frames.
    fn buffer_bytes(&self) -> u64;

    /// Returns the name of the device that the engine computes on, if it has one.
    fn device_name(&self) -> Option<&str> {
        None
    }

    /// Returns the progress of the current frame; `None` for engines that are always fast.
    fn progress(&self) -> Option<Arc<Progress>> {
        None
    }

    /// Makes the engine store the density-based radii of later clouds, unless it stores them anyway.
    fn keep_radii(&mut self) {}

    /// Returns the density-based radius of point `i` of the last cloud in metres, before it was limited; `None` if
    /// the point has no such radius, or radii were not stored.
    fn own_radius_m(&self, _: usize) -> Option<f32> {
        None
    }
}

/// An engine that computes each frame within the call that passes the frame.
pub(crate) trait ImmediateEngine: Send {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error>;

    /// Returns the time spent in each stage of the last frame, if measured.
    fn timings(&self) -> Option<FrameTimings> {
        None
    }

    fn buffer_bytes(&self) -> u64 {
        0
    }

    /// Returns the progress of the current frame; `None` for engines that are always fast.
    fn progress(&self) -> Option<Arc<Progress>> {
        None
    }

    /// Returns the name of the device that the engine computes on, if it has one.
    fn device_name(&self) -> Option<&str> {
        None
    }

    /// Makes the engine store the density-based radii of later clouds, unless it stores them anyway.
    fn keep_radii(&mut self) {}

    /// Returns the density-based radius of point `i` of the last cloud in metres, before it was limited; `None` if
    /// the point has no such radius, or radii were not stored.
    fn own_radius_m(&self, _: usize) -> Option<f32> {
        None
    }
}

/// Adapts an [`ImmediateEngine`] to [`SmoothingEngine`]: frames in flight are results waiting to be received.
pub(crate) struct Immediate<E> {
    engine: E,
    outputs: Outputs,
    submitted: VecDeque<(Smoothed, Option<FrameTimings>)>,
    slots: usize,
    /// Times of the last call, if requested.
    timings: Option<FrameTimings>,
    wants_timings: bool,
}

impl<E: ImmediateEngine> Immediate<E> {
    pub(crate) fn new(engine: E, outputs: Outputs, slots: usize, wants_timings: bool) -> Self {
        Self { engine, outputs, submitted: VecDeque::new(), slots, timings: None, wants_timings }
    }

    /// Smooths a frame; returns its times if they were requested.
    fn smooth_to(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<Option<FrameTimings>, Error> {
        self.engine.smooth(frame, out)?;
        Ok(self.engine.timings().filter(|_| self.wants_timings))
    }

    fn smooth_owned(&mut self, frame: &AdmittedFrame<'_>, out: &mut Smoothed) -> Result<Option<FrameTimings>, Error> {
        let (width, height) = frame.frame.shape();
        out.prepare(width, height, self.outputs);
        self.smooth_to(frame, out.as_mut())
    }
}

impl<E: ImmediateEngine> SmoothingEngine for Immediate<E> {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        self.timings = self.smooth_to(frame, out)?;
        Ok(())
    }

    fn smooth_batch(&mut self, frames: &[AdmittedFrame<'_>], out: &mut [Smoothed]) -> Result<(), Error> {
        let mut timings = None::<FrameTimings>;
        for (frame, out) in frames.iter().zip(out) {
            if let Some(more) = self.smooth_owned(frame, out)? {
                *timings.get_or_insert_default() += more;
            }
        }
        self.timings = timings;
        Ok(())
    }

    fn submit(&mut self, frame: &AdmittedFrame<'_>, buffer: Option<Smoothed>) -> Result<(), Error> {
        let in_flight = self.submitted.len();
        if in_flight >= self.slots {
            return Err(EngineError::Full { in_flight }.into());
        }
        let mut smoothed = buffer.unwrap_or_default();
        let timings = self.smooth_owned(frame, &mut smoothed)?;
        self.submitted.push_back((smoothed, timings));
        Ok(())
    }

    fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        Ok(self.submitted.pop_front().map(|(smoothed, timings)| SmoothedView::owned(smoothed, timings)))
    }

    fn in_flight(&self) -> usize {
        self.submitted.len()
    }

    fn max_in_flight(&self) -> usize {
        self.slots
    }

    fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    fn buffer_bytes(&self) -> u64 {
        self.engine.buffer_bytes()
    }

    fn progress(&self) -> Option<Arc<Progress>> {
        self.engine.progress()
    }

    fn device_name(&self) -> Option<&str> {
        self.engine.device_name()
    }

    fn keep_radii(&mut self) {
        self.engine.keep_radii();
    }

    fn own_radius_m(&self, i: usize) -> Option<f32> {
        self.engine.own_radius_m(i)
    }
}
