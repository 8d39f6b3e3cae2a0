//! Even spacing of the points of unorganized clouds after smoothing.

use super::{Chosen, Session};
use crate::error::Error;
use crate::even::space_evenly;
use crate::frame::{Frame, PointsView};
use crate::outputs::{Outputs, SmoothedMut};
use crate::threads::Threads;

impl Session {
    /// Returns the cloud if the settings request even spacing; otherwise `None`.
    pub(super) fn to_space_evenly<'a>(&self, frame: Frame<'a>) -> Option<PointsView<'a>> {
        let Chosen::Settings(settings) = &self.chosen else { return None };
        match frame {
            Frame::Points(points) if points.grid().is_none() && settings.spaces_evenly() => Some(points),
            _ => None,
        }
    }

    /// Returns the outputs that the engine must compute for a frame.
    pub(super) fn outputs_of_engine(&self, frame: Frame<'_>) -> Outputs {
        match self.to_space_evenly(frame) {
            Some(_) => self.options.outputs.with_points(true).with_normals(true),
            None => self.options.outputs,
        }
    }

    /// Smooths a cloud and spaces its points evenly.
    pub(super) fn smooth_evenly(&mut self, points: &PointsView<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let threads = Threads::open(self.options.threads)?;
        let outputs = self.options.outputs;
        self.options.outputs = self.outputs_of_engine(Frame::Points(*points));
        let mut smoothed = std::mem::take(&mut self.before_even);
        smoothed.prepare(points.len(), 1, self.options.outputs);
        let result = self.smooth_in_passes(Frame::Points(*points), smoothed.as_mut());
        self.options.outputs = outputs;
        if result.is_ok() {
            threads.install(|| space_evenly(points, &mut smoothed));
            out.take_from(points.len(), &smoothed, Some);
        }
        self.before_even = smoothed;
        result
    }
}
