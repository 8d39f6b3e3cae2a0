//! A first pass over a noisy cloud (docs/method.md, section 8).

use super::{Chosen, Session};
use crate::error::Error;
use crate::frame::Frame;
use crate::outputs::{Outputs, SmoothedMut};
use crate::smoother::check_frame;

impl Session {
    /// Runs a first pass with few neighbours over a cloud, if its noise or the settings call for it. Returns true if
    /// the pass ran; `self.first_pass` then contains its points.
    pub(super) fn smooth_first(&mut self, frame: Frame<'_>) -> Result<bool, Error> {
        if frame.grid().is_some() {
            return Ok(false);
        }
        self.check_idle()?;
        check_frame(frame, self.options.outputs, None)?;
        let Chosen::Settings(settings) = &self.chosen else { return Ok(false) };
        if settings.chooses_neighbours() && self.estimates_clouds {
            self.resolve(frame)?;
        }
        let Chosen::Settings(settings) = &self.chosen else { return Ok(false) };
        let estimate = self.cloud_estimate.filter(|_| settings.chooses_neighbours() && self.estimates_clouds);
        let Some(params) = settings.first_pass(estimate) else { return Ok(false) };
        let mut smoothed = std::mem::take(&mut self.first_pass);
        let outputs = std::mem::replace(&mut self.options.outputs, Outputs::POINTS);
        std::mem::swap(&mut self.open, &mut self.open_for_first);
        self.is_first = Some(params);
        let (width, height) = frame.shape();
        smoothed.prepare(width, height, Outputs::POINTS);
        let result = self.one_at_a_time(frame, smoothed.as_mut());
        self.is_first = None;
        std::mem::swap(&mut self.open, &mut self.open_for_first);
        (self.options.outputs, self.first_pass) = (outputs, smoothed);
        result.map(|()| true)
    }

    /// Smooths a frame or cloud; a noisy cloud gets a first pass beforehand.
    pub(super) fn smooth_in_passes(&mut self, frame: Frame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let points = match frame {
            Frame::Points(points) if self.smooth_first(frame)? => points,
            _ => return self.one_at_a_time(frame, out),
        };
        let smoothed = std::mem::take(&mut self.first_pass);
        let result = self.one_at_a_time(Frame::Points(points.moved_to(&smoothed.points)), out);
        self.first_pass = smoothed;
        result
    }
}
