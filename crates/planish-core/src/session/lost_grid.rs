//! Unorganized clouds that are frames without their grid: a session rebuilds the grid and smooths them on it.

use super::event::SessionEvent;
use super::{Chosen, Session};
use crate::error::Error;
use crate::frame::{Frame, Lattice, PointsView};
use crate::outputs::SmoothedMut;

impl Session {
    /// Smooths a cloud as a frame on its rebuilt grid.
    pub(super) fn smooth_on_lattice(
        &mut self,
        lattice: Lattice,
        points: &PointsView<'_>,
        mut out: SmoothedMut<'_>,
    ) -> Result<(), Error> {
        let (width, height) = lattice.shape();
        let mut on_grid = std::mem::take(&mut self.on_grid);
        on_grid.prepare(width, height, self.options.outputs);
        self.is_on_lattice = true;
        let result = self.one_at_a_time(Frame::Points(lattice.view(points)), on_grid.as_mut());
        self.is_on_lattice = false;
        if result.is_ok() {
            out.take_from(points.len(), &on_grid, |i| lattice.pixel(i));
            out.keep_isolated(points);
        }
        (self.on_grid, self.lattice) = (on_grid, Some(lattice));
        result
    }

    /// Rebuilds the grid of an unorganized cloud that is a frame without its grid, if the settings allow that. After
    /// [`prepare`](Self::prepare), returns the stored grid if it belongs to this cloud.
    pub(super) fn take_lattice<'a>(&mut self, frame: Frame<'a>) -> Option<(Lattice, PointsView<'a>)> {
        let known = self.lattice.take();
        let Frame::Points(points) = frame else { return None };
        let Chosen::Settings(settings) = &self.chosen else { return None };
        if points.grid().is_some() || !settings.rebuilds_grid() || !self.estimates_clouds {
            return None;
        }
        if self.is_prepared && self.known_points == points.len() {
            match known {
                None => return None,
                Some(lattice) if lattice.is_of(&points) => return Some((lattice, points)),
                // The prepared cloud was another one with the same number of points.
                Some(_) => self.is_prepared = false,
            }
        }
        let has_sensor = settings.sensor.is_some();
        let lattice = Lattice::of(&points).filter(|lattice| has_sensor || lattice.may_be_in_metres())?;
        let (width, height) = lattice.shape();
        (self.cloud_params, self.cloud_estimate) = (None, None);
        self.events.push(SessionEvent::GridRebuilt { width, height });
        self.known_points = points.len();
        Some((lattice, points))
    }

    /// Calls `use_frame` with a frame, or with a cloud on its rebuilt grid.
    pub(super) fn on_its_grid<T>(&mut self, frame: Frame<'_>, use_frame: impl FnOnce(&mut Self, Frame<'_>) -> T) -> T {
        let Some((lattice, points)) = self.take_lattice(frame) else { return use_frame(self, frame) };
        self.is_on_lattice = true;
        let result = use_frame(self, Frame::Points(lattice.view(&points)));
        self.is_on_lattice = false;
        self.lattice = Some(lattice);
        result
    }
}
