//! Steps on the CPU after the engine: estimating standard errors, unless the engine has done so, and filling holes.

use super::open::Open;
use super::{Chosen, Session, SessionEvent};
use crate::error::{Error, FrameError, ParamError};
use crate::fill::{Fill, FillBuffers};
use crate::frame::{Frame, FrameGeometry, GeometryScratch};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::EngineParams;
use crate::sigma::{Sigma, SigmaBuffers};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::DeviceSteps;
use crate::threads::{ONE_THREAD, Threads};

/// The steps that finish the result of an engine.
#[derive(Debug, Clone, Copy)]
pub(super) struct Finish {
    /// The geometry of the frame; `None` if the session has no step left to apply.
    geometry: Option<FrameGeometry>,
    params: EngineParams,
    /// The requested outputs.
    outputs: Outputs,
    /// Width of the widest holes to fill, in pixels; `None` if the session fills no holes.
    fill_px: Option<u32>,
    /// Whether the session estimates standard errors because the engine has not.
    estimates_sigma: bool,
}

/// Access to the buffers and threads for finishing results. WebAssembly builds never create this trait object, which
/// keeps its code out of the module.
pub(super) trait Finishing: Send {
    fn buffers(&mut self) -> &mut FinishBuffers;
    fn threads(&self) -> Option<&(Option<usize>, Threads)>;
}

impl Finishing for FinishBuffers {
    fn buffers(&mut self) -> &mut FinishBuffers {
        self
    }

    fn threads(&self) -> Option<&(Option<usize>, Threads)> {
        self.threads.as_ref()
    }
}

/// Buffers that are kept from frame to frame.
#[derive(Default)]
pub(super) struct FinishBuffers {
    /// The result before it is copied into the caller's buffers.
    finished: Smoothed,
    /// Buffers for results that finishing needs but the caller did not request.
    spare: Smoothed,
    /// The requested number of threads, and the threads that were opened for it.
    threads: Option<(Option<usize>, Threads)>,
    sigma: SigmaBuffers,
    fill: FillBuffers,
    /// Whether the session has reported that holes cannot be filled.
    told: bool,
    /// The requested outputs, while a frame is smoothed that is finished in the same call.
    requested: Option<Outputs>,
}

impl FinishBuffers {
    /// Moves the buffers that finishing needs but the caller did not request into the caller's result, or back.
    fn exchange(&mut self, out: &mut Smoothed, outputs: Outputs) {
        let spare = &mut self.spare;
        if !outputs.points {
            std::mem::swap(&mut out.points, &mut spare.points);
        }
        if !outputs.status {
            std::mem::swap(&mut out.status, &mut spare.status);
        }
        if !outputs.neighbours {
            std::mem::swap(&mut out.neighbours, &mut spare.neighbours);
        }
        if !outputs.frames {
            std::mem::swap(&mut out.frames, &mut spare.frames);
        }
    }
}

impl Session {
    /// Returns true if the session applies steps to results after the engine.
    pub(super) fn finishes(&self) -> bool {
        !ONE_THREAD && (self.options.outputs.sigma || self.fill_px().is_some())
    }

    /// Returns the requested outputs. If holes are filled, the status is added, since it flags filled pixels.
    fn flagged_outputs(&self) -> Outputs {
        let outputs = self.options.outputs;
        outputs.with_status(outputs.status || (!ONE_THREAD && self.fill_px().is_some()))
    }

    /// Returns the outputs to request from the engine. If the frame is not smoothed over time, they include `sigma`,
    /// which the engine may estimate.
    pub(super) fn outputs_to_finish(&self, frame: Frame<'_>) -> Outputs {
        let outputs = self.options.outputs;
        if !self.finishes() {
            return outputs;
        }
        let needed = outputs.with_points(true).with_status(true);
        match (outputs.sigma, self.over_time(frame)) {
            (false, _) => needed,
            (true, None) => needed.with_neighbours(true),
            (true, Some(_)) => needed.with_sigma(false).with_neighbours(true).with_frames(true),
        }
    }

    /// Returns the steps after smoothing that an engine should compute for frames like this one if it can; `None` if
    /// there are none, or if they follow smoothing over time. `sigma` states whether the engine may estimate standard
    /// errors.
    pub(super) fn steps_of_engine(&mut self, frame: Frame<'_>, sigma: bool) -> Option<DeviceSteps> {
        let fill_px = self.fill_px();
        if !(sigma || fill_px.is_some()) || frame.grid().is_none() || self.over_time(frame).is_some() {
            return None;
        }
        let outputs = self.finish_buffers().requested.unwrap_or(self.flagged_outputs());
        Some(DeviceSteps { sigma, fill_px, outputs })
    }

    /// Returns true if the session computes nothing from the frame and its result after the open engine.
    pub(super) fn engine_finishes(&self, frame: Frame<'_>) -> bool {
        let outputs = self.options.outputs;
        let is_finished = |open: &Open| {
            open.steps().is_some_and(|steps| steps.sigma == outputs.sigma && self.is_filled_by(&steps, frame))
        };
        !self.finishes() || (self.over_time(frame).is_none() && self.open.as_ref().is_some_and(is_finished))
    }

    /// Returns true if an engine with these steps fills the holes of a frame, or holes are not filled.
    fn is_filled_by(&self, steps: &DeviceSteps, frame: Frame<'_>) -> bool {
        steps.fill_px == self.fill_px() && steps.finish(&frame)
    }

    /// Returns the width of the widest holes to fill, in pixels; `None` if holes are not filled.
    pub(super) fn fill_px(&self) -> Option<u32> {
        match &self.chosen {
            Chosen::Settings(settings) => settings.fill,
            Chosen::Params(..) => None,
        }
    }

    /// Returns an error if holes are to be filled but the outputs lack the status, which flags filled pixels.
    pub(super) fn check_flags(&self) -> Result<(), ParamError> {
        match self.fill_px() {
            Some(width_px) if !self.options.outputs.status && !ONE_THREAD => {
                let allowed = "only if status is among the outputs, since it flags filled pixels";
                Err(ParamError { field: "fill", value: width_px.to_string(), allowed })
            }
            _ => Ok(()),
        }
    }

    /// Returns an error if standard errors are requested for a frame without rays: one without a grid, or one whose
    /// sensor's position is unknown.
    pub(super) fn check_can_finish(&self, frame: Frame<'_>) -> Result<(), Error> {
        match frame {
            _ if ONE_THREAD || !self.options.outputs.sigma => Ok(()),
            Frame::Points(points) if points.grid().is_none() => {
                let allowed = "only for frames on a grid";
                Err(ParamError { field: "outputs", value: "sigma".into(), allowed }.into())
            }
            Frame::Points(points) if points.seen_from().is_none() => Err(FrameError::UnknownSensor.into()),
            _ => Ok(()),
        }
    }

    /// Smooths a frame, then estimates standard errors and fills holes as requested.
    pub(super) fn smooth_and_finish(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        self.check_can_finish(frame)?;
        let (requested, outputs) = (self.options.outputs, self.flagged_outputs());
        let over_time = self.over_time(frame).is_some();
        let sigma_m = if over_time { out.sigma.take() } else { None };
        // The session lends buffers for results that were not requested.
        self.finish_buffers().exchange(out, outputs);
        self.options.outputs = self.outputs_to_finish(frame);
        self.finish_buffers().requested = Some(outputs);
        let result = self.smooth_unfinished(frame, out);
        self.finish_buffers().requested = None;
        self.options.outputs = requested;
        if over_time {
            out.sigma = sigma_m;
        }
        let result = result.and_then(|()| match self.to_finish(frame) {
            Some(finish) => self.finish(frame, out, &finish),
            None => Ok(()),
        });
        self.finish_buffers().exchange(out, outputs);
        // Clears results left from earlier calls with other outputs.
        let (width, height) = frame.shape();
        out.prepare(width, height, outputs);
        result
    }

    /// Same as [`smooth_and_finish`](Self::smooth_and_finish), into the caller's buffers.
    pub(super) fn smooth_and_finish_into(&mut self, frame: Frame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let mut finished = std::mem::take(&mut self.finish_buffers().finished);
        let result = self.smooth_and_finish(frame, &mut finished);
        if result.is_ok() {
            out.copy_from(&finished);
        }
        self.finish_buffers().finished = finished;
        result
    }

    /// Applies the remaining steps to a received result.
    pub(super) fn finish_received(
        &mut self,
        frame: Frame<'_>,
        smoothed: &mut Smoothed,
        finish: &Finish,
    ) -> Result<(), Error> {
        self.finish(frame, smoothed, finish)?;
        let (width, height) = frame.shape();
        smoothed.prepare(width, height, finish.outputs);
        Ok(())
    }

    /// Returns the steps that finish the result of the frame that an engine was last opened for; `None` if the
    /// session does not finish results.
    pub(super) fn to_finish(&self, frame: Frame<'_>) -> Option<Finish> {
        if !self.finishes() {
            return None;
        }
        let open = self.open.as_ref()?;
        let (outputs, steps) = (self.options.outputs, open.steps());
        let estimates_sigma = outputs.sigma && !steps.is_some_and(|steps| steps.sigma);
        let is_filled = steps.is_some_and(|steps| self.is_filled_by(&steps, frame));
        let fill_px = self.fill_px().filter(|_| !is_filled);
        let is_left = estimates_sigma || fill_px.is_some();
        let geometry = is_left.then(|| FrameGeometry::of(frame, true, &mut GeometryScratch::default()));
        Some(Finish { geometry, params: open.open_for().params, outputs, fill_px, estimates_sigma })
    }

    fn finish(&mut self, frame: Frame<'_>, smoothed: &mut Smoothed, finish: &Finish) -> Result<(), Error> {
        let Finish { geometry: Some(geometry), params, fill_px, estimates_sigma, .. } = *finish else { return Ok(()) };
        let threads = self.threads_to_finish()?;
        let buffers = self.finish_buffers();
        if estimates_sigma {
            Sigma { geometry, params }.estimate(frame, smoothed, &threads, &mut buffers.sigma);
        }
        let Some(width_px) = fill_px else { return Ok(()) };
        let fill = Fill { width_px, geometry, sensor: params.sensor, frame };
        let has_camera = fill.apply(smoothed, &mut buffers.fill, &threads);
        if !has_camera && !std::mem::replace(&mut buffers.told, true) {
            self.events.push(SessionEvent::NotFilled);
        }
        Ok(())
    }

    fn finish_buffers(&mut self) -> &mut FinishBuffers {
        self.finish.get_or_insert_with(|| Box::<FinishBuffers>::default()).buffers()
    }

    /// Returns the threads that finish results, kept from frame to frame.
    fn threads_to_finish(&mut self) -> Result<Threads, Error> {
        let wanted = self.options.threads;
        match self.finish.as_deref().and_then(Finishing::threads) {
            Some((threads, open)) if *threads == wanted => Ok(open.clone()),
            _ => {
                let open = Threads::open(wanted)?;
                self.finish_buffers().threads = Some((wanted, open.clone()));
                Ok(open)
            }
        }
    }
}
