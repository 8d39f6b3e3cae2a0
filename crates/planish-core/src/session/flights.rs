//! The frames in flight of a session: how they are submitted, received, and smoothed again if their device is lost.

use std::sync::Arc;

use super::Session;
use super::pending::{AnyFrame, OnReceipt, Pending};
use crate::error::{EngineError, Error, ParamError};
use crate::fleet::SharedFrame;
use crate::frame::{Frame, IntoFrame};
use crate::outputs::Outputs;
use crate::smoothed::Smoothed;
use crate::smoothing_engine::AdmittedFrame;
use crate::threads::ONE_THREAD;
use crate::view::SmoothedView;

impl Session {
    /// Submits a frame; [`receive`](Self::receive) returns the results in the order of submission. If a device is lost,
    /// its frames are smoothed again. Unorganized clouds in flight are smoothed in one pass, with the parameters of
    /// [`Settings::cloud_params`](crate::Settings::cloud_params).
    ///
    /// # Errors
    /// If the maximum number of frames is in flight, the frame is malformed, or the engine fails and no other may
    /// take over. Also if holes are to be filled but the status is not among the outputs.
    pub fn submit<F: SharedFrame>(&mut self, frame: Arc<F>, buffer: Smoothed) -> Result<(), Error> {
        let frame: AnyFrame = frame;
        self.check_room()?;
        let is_cloud = frame.frame()?.grid().is_none();
        self.check_can_finish(frame.frame()?)?;
        self.check_flags()?;
        let failed = match self.submit_now(&frame, buffer) {
            Ok(()) => None,
            Err(error @ Error::Engine(_)) => Some(error),
            Err(error) => return Err(error),
        };
        let on_receipt = self.on_receipt();
        let finish = self.to_finish(frame.frame()?);
        let outputs = self.options.outputs;
        self.pending.push_back(Pending { frame: Some(frame), is_cloud, on_receipt, finish, outputs });
        failed.map_or(Ok(()), |error| self.smooth_again(error))
    }

    /// Submits a frame that the caller does not share. The frame is copied unless it is computed during this call,
    /// and it is lost if its device is lost. The result stays where the device wrote it.
    ///
    /// # Errors
    /// Same as [`submit`](Self::submit). Also if `sigma` is requested or holes are to be filled, but no GPU does so: it
    /// needs frames that are not smoothed over time and, to fill holes, depth without colours and lens distortion.
    pub fn submit_in_place<'a>(&mut self, frame: impl IntoFrame<'a>) -> Result<(), Error> {
        let frame = frame.into_frame()?;
        self.check_room()?;
        self.check_can_finish(frame)?;
        self.check_flags()?;
        // Checked before the frame becomes part of a video.
        if self.finishes() && self.over_time(frame).is_some() {
            return Err(self.needs_frame().into());
        }
        let admitted = self.open_in_flight(frame, false)?;
        if !self.engine_finishes(frame) {
            return Err(self.needs_frame().into());
        }
        if let Err(error) = self.smoother()?.submit_admitted(&admitted, None) {
            self.video.leave_device();
            return Err(error);
        }
        let on_receipt = self.on_receipt();
        let (is_cloud, outputs) = (frame.grid().is_none(), self.options.outputs);
        self.pending.push_back(Pending { frame: None, is_cloud, on_receipt, finish: None, outputs });
        Ok(())
    }

    /// Returns true if [`submit_in_place`](Self::submit_in_place) supports a frame with the engine that is open, for
    /// example after [`prepare`](Self::prepare).
    ///
    /// # Errors
    /// If the frame is malformed.
    pub fn can_submit_in_place<'a>(&self, frame: impl IntoFrame<'a>) -> Result<bool, Error> {
        Ok(self.engine_finishes(frame.into_frame()?))
    }

    /// Returns the error for outputs that the session computes from both the frame and its result.
    fn needs_frame(&self) -> ParamError {
        let allowed = "only for shared frames (submit), since it is computed from both the frame and the result";
        let (field, value) = match self.fill_px() {
            Some(width_px) => ("fill", width_px.to_string()),
            None => ("outputs", "sigma".to_owned()),
        };
        ParamError { field, value, allowed }
    }

    /// Opens the smoother or fleet for a frame in flight. Unorganized clouds are not examined, because a new number of
    /// neighbours would reopen the engine after waiting for all frames in flight.
    fn open_in_flight<'a>(&mut self, frame: Frame<'a>, uses_fleet: bool) -> Result<AdmittedFrame<'a>, Error> {
        if self.to_space_evenly(frame).is_some() {
            let allowed = "only for clouds that are smoothed one by one, not for streams or rigs";
            return Err(ParamError { field: "even", value: "true".into(), allowed }.into());
        }
        let estimates_clouds = std::mem::replace(&mut self.estimates_clouds, false);
        (self.lattice, self.is_prepared) = (None, false);
        let admitted = self.open_for(frame, uses_fleet);
        self.estimates_clouds = estimates_clouds;
        self.with_step(admitted?)
    }

    fn check_room(&self) -> Result<(), EngineError> {
        match (self.in_flight(), self.max_in_flight()) {
            // Frames in flight are finished before another engine is opened, so a first frame always fits.
            (in_flight, most) if in_flight >= most && in_flight > 0 => Err(EngineError::Full { in_flight }),
            _ => Ok(()),
        }
    }

    fn submit_now(&mut self, frame: &AnyFrame, mut buffer: Smoothed) -> Result<(), Error> {
        let admitted = self.open_in_flight(frame.frame()?, true)?;
        self.keep_buffers(&mut buffer);
        let submitted = match self.open.as_mut().filter(|open| open.is_fleet()) {
            Some(open) => open.submit_shared(frame, Some(buffer)),
            None => self.smoother()?.submit_admitted(&admitted, Some(buffer)),
        };
        if submitted.is_err() {
            // The video's state on the device lacks this frame.
            self.video.leave_device();
        }
        submitted
    }

    /// Waits for the oldest frame in flight and returns its result; `None` if no frame is in flight.
    ///
    /// # Errors
    /// If that frame cannot be smoothed, or the engine fails and no other may take over.
    pub fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        self.forget_other_process();
        match self.receive_in_space()? {
            Some((view, pending)) => {
                let view = self.received(view, pending.on_receipt)?;
                let (Some(finish), Some(frame), false) = (pending.finish, &pending.frame, ONE_THREAD) else {
                    return Ok(Some(view));
                };
                let timings = view.timings();
                let mut smoothed = view.into_smoothed();
                self.finish_received(frame.frame()?, &mut smoothed, &finish)?;
                Ok(Some(SmoothedView::owned(smoothed, timings)))
            }
            None => Ok(None),
        }
    }

    /// Returns the oldest result as computed by the engine, and the steps that finish it.
    fn receive_in_space(&mut self) -> Result<Option<(SmoothedView, Pending)>, Error> {
        if self.ready.is_empty() {
            let Some(open) = &mut self.open else { return Ok(None) };
            match open.receive().transpose() {
                Some(Err(error @ Error::Engine(_))) => self.smooth_again(error)?,
                Some(result) => self.ready.push_back(result),
                None => {}
            }
        }
        match (self.ready.pop_front(), self.pending.pop_front()) {
            (Some(result), Some(pending)) => result.map(|view| Some((view, pending))),
            _ => Ok(None),
        }
    }

    /// Smooths all frames in flight again, one by one, with the engine that takes over after this error. Returns the
    /// error if one of these frames is not shared.
    fn smooth_again(&mut self, error: Error) -> Result<(), Error> {
        let mut error = error;
        loop {
            let is_cloud = self.pending.front().is_some_and(|pending| pending.is_cloud);
            let is_shared = self.pending.iter().all(|pending| pending.frame.is_some());
            if !is_shared {
                self.close();
                return Err(error);
            }
            self.recover(error, is_cloud, true)?;
            match self.smooth_pending() {
                Ok(()) => return Ok(()),
                Err(again) => error = again,
            }
        }
    }

    /// Smooths the frames in flight that have no result yet.
    fn smooth_pending(&mut self) -> Result<(), Error> {
        let frames: Vec<(AnyFrame, OnReceipt, Outputs)> = self
            .pending
            .iter()
            .skip(self.ready.len())
            .filter_map(|pending| Some((pending.frame.clone()?, pending.on_receipt, pending.outputs)))
            .collect();
        for (frame, before, outputs) in frames {
            // The outputs may have changed since the frame was submitted.
            let outputs_now = std::mem::replace(&mut self.options.outputs, outputs);
            let (result, on_receipt) =
                self.as_submitted(&before, |session| session.submit_now(&frame, Smoothed::default()));
            let finish = self.to_finish(frame.frame()?);
            self.options.outputs = outputs_now;
            // If the new engine does not smooth over time, the session must do so.
            if let Some(pending) = self.pending.get_mut(self.ready.len()) {
                (pending.on_receipt, pending.finish) = (on_receipt, finish);
            }
            let result = result.and_then(|()| match &mut self.open {
                Some(open) => open.receive(),
                None => Ok(None),
            });
            match result {
                Ok(Some(view)) => self.ready.push_back(Ok(view)),
                Ok(None) => {}
                Err(error @ Error::Engine(_)) => return Err(error),
                Err(error) => self.ready.push_back(Err(error)),
            }
        }
        Ok(())
    }

    /// Waits for all frames in flight and stores their results, which no longer need the engine.
    pub(super) fn finish_flights(&mut self) -> Result<(), Error> {
        while self.ready.len() < self.pending.len() {
            let Some(open) = &mut self.open else { return Ok(()) };
            match open.receive().transpose() {
                Some(Err(error @ Error::Engine(_))) => self.smooth_again(error)?,
                Some(result) => self.ready.push_back(result),
                None => return Ok(()),
            }
        }
        Ok(())
    }

    /// Returns the number of frames that were submitted but not yet received.
    pub fn in_flight(&self) -> usize {
        self.pending.len()
    }

    /// Returns the maximum number of frames in flight, beyond which only the latency would grow; 1 before the first
    /// frame.
    pub fn max_in_flight(&self) -> usize {
        self.open.as_ref().map_or(1, |open| open.max_in_flight(self.is_live))
    }
}
