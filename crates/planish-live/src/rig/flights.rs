//! Moments in flight: while a GPU smooths the frames of one moment, the next is uploaded and the previous one fused.

use std::borrow::Cow;

use super::flight::{Flight, FlightResults, RigViews, Submitted};
use super::fused::{Part, fuse_parts, rig_from_points};
use super::smoother::CameraSmoother;
use super::together::Together;
use super::voxels::InVoxels;
use super::{RigResults, RigSmoother, RigWay};
use planish_core::{
    Attribute, EngineError, Error, Frame, Outputs, PointCloud, SmoothedView,
    internal::{RigidTransform, named_fields},
};

/// Number of moments in flight if points are thinned to voxels: one is smoothed while the next is sorted into voxels.
const IN_FLIGHT_IN_VOXELS: usize = 2;

/// The transform of each camera's points into the rig's frame, and the results.
type Placed = (Vec<Option<RigidTransform>>, RigViews);

/// A moment with its results.
enum Landed {
    Views(Placed),
    InVoxels(Box<InVoxels>),
}

impl RigSmoother {
    /// Submits the frames of a moment; moments are received in the order of submission.
    ///
    /// If a GPU smooths each camera's frames separately, results are computed asynchronously; otherwise, they are
    /// computed in this call. Merged points that are thinned to voxels are only sorted into voxels here, and smoothed
    /// when the moment is received.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth); also if the maximum number of moments is in flight.
    pub fn submit(&mut self, frames: &[Option<Frame<'_>>]) -> Result<(), Error> {
        self.submit_as(frames, true)
    }

    /// Submits the frames of a moment for [`receive_fused`](Self::receive_fused): results stay on the device until
    /// they are fused.
    pub fn submit_in_place(&mut self, frames: &[Option<Frame<'_>>]) -> Result<(), Error> {
        self.submit_as(frames, false)
    }

    fn submit_as(&mut self, frames: &[Option<Frame<'_>>], is_copied: bool) -> Result<(), Error> {
        self.check_count(frames)?;
        let in_flight = self.flights.len();
        if in_flight >= self.options.gpu.slots {
            return Err(EngineError::Full { in_flight }.into());
        }
        let placed = self.cameras.iter().zip(frames);
        let placed =
            placed.map(|(camera, frame)| frame.map(|frame| rig_from_points(camera.rig_from_camera, frame)).transpose());
        let rig_from_points = placed.collect::<Result<Vec<_>, _>>()?;
        let results = self.launch(frames, is_copied);
        let results = self.closed_by_error(results)?;
        self.flights.push_back(Flight { rig_from_points, results });
        Ok(())
    }

    fn launch(&mut self, frames: &[Option<Frame<'_>>], is_copied: bool) -> Result<FlightResults, Error> {
        if self.way == RigWay::Each {
            self.open_each(frames, self.outputs_in_space())?;
            if self.engine.capabilities().pipelined {
                let (outputs, time_s) = (self.options.outputs, self.time_s);
                let cameras = self.cameras.iter_mut().zip(frames);
                let submitted = cameras.map(|(camera, frame)| match frame {
                    None => Ok(Submitted::Nothing),
                    Some(frame) => match camera.submit(*frame, is_copied) {
                        Ok(()) => Ok(Submitted::Flying(camera.look_at(*frame, time_s, outputs).map(Box::new))),
                        Err(Error::Frame(error)) => Ok(Submitted::Refused(error)),
                        Err(error) => {
                            self.failed = camera.device.clone();
                            Err(error)
                        }
                    },
                });
                return Ok(FlightResults::Submitted(submitted.collect::<Result<_, _>>()?));
            }
        }
        if let Some(size_m) = self.voxels_merged_m() {
            let mut results = self.put_together(frames)?;
            self.threads.install(|| results.bring_into_voxels(size_m))?;
            return Ok(results);
        }
        let of_view = |smoothed| SmoothedView::owned(smoothed, None);
        let results = self.smooth_now(frames)?.into_iter().map(|result| result.map(|result| result.map(of_view)));
        Ok(FlightResults::Landed(results.collect()))
    }

    /// Waits for the oldest moment in flight and returns its results; `None` if no moment is in flight.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth).
    pub fn receive(&mut self) -> Result<Option<RigResults>, Error> {
        let outputs = self.options.outputs;
        let results = match self.receive_landed()? {
            None => return Ok(None),
            Some(Landed::Views((_, views))) => {
                views.into_iter().map(|view| view.map(|view| view.map(SmoothedView::into_smoothed))).collect()
            }
            Some(Landed::InVoxels(voxels)) => {
                let given_back = self.threads.install(|| voxels.given_back(outputs));
                given_back.into_iter().map(|result| result.map(Ok)).collect()
            }
        };
        Ok(Some(results))
    }

    /// Waits for the oldest moment in flight and fuses its results into `out`, in the rig's frame: the points of all
    /// cameras, with the computed fields and a field `camera`. If points are thinned to voxels, there is one point
    /// per voxel. Frames that could not be smoothed have no points. Returns false if no moment is in flight. Reuses
    /// the memory of `out`, except with voxels.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth).
    pub fn receive_fused(&mut self, out: &mut PointCloud) -> Result<bool, Error> {
        let outputs = self.options.outputs;
        match self.receive_landed()? {
            None => return Ok(false),
            Some(Landed::Views(placed)) => self.threads.install(|| fuse_views(&placed, outputs, out)),
            Some(Landed::InVoxels(voxels)) => *out = voxels.fused(outputs),
        }
        Ok(true)
    }

    /// Submits the frames of a moment. Once the useful number of moments ([`max_in_flight`](Self::max_in_flight)) is
    /// in flight, also receives the oldest moment, as [`receive_fused`](Self::receive_fused) does, and fuses it while
    /// the new moment is uploaded. Returns false if no moment was received; at the end, call `receive_fused` for the
    /// remaining moments.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth). All moments in flight are then lost, including the oldest, and `out` may be
    /// unchanged or contain the oldest moment.
    pub fn next_fused(&mut self, frames: &[Option<Frame<'_>>], out: &mut PointCloud) -> Result<bool, Error> {
        self.check_count(frames)?;
        if let Some(size_m) = self.voxels_merged_m() {
            let next = self.next_in_voxels(frames, size_m, out);
            return self.closed_by_error(next);
        }
        if self.flights.len() < self.max_in_flight() {
            return self.submit_in_place(frames).map(|()| false);
        }
        let (outputs, threads) = (self.options.outputs, self.threads.clone());
        let landed = self.receive_landed()?;
        let fuse = || {
            if let Some(Landed::Views(placed)) = &landed {
                fuse_views(placed, outputs, out)
            }
        };
        threads.beside(fuse, || self.submit_in_place(frames))?;
        Ok(landed.is_some())
    }

    /// Receives the oldest moment if points are thinned to voxels. While it is smoothed, the second moment is sorted
    /// into voxels, and the points of the third are collected.
    fn next_in_voxels(
        &mut self,
        frames: &[Option<Frame<'_>>],
        size_m: f64,
        out: &mut PointCloud,
    ) -> Result<bool, Error> {
        if self.flights.len() < IN_FLIGHT_IN_VOXELS {
            let results = self.put_together(frames)?;
            self.flights.push_back(Flight { rig_from_points: Vec::new(), results });
            return Ok(false);
        }
        let (next, threads) = (self.placed(frames)?, self.threads.clone());
        let mut younger = self.flights.split_off(1);
        let (mut together, mut brought) = (None, Ok(()));
        let bring_on = || {
            rayon::join(
                || together = Some(Together::of(&next)),
                || brought = younger.iter_mut().try_for_each(|flight| flight.results.bring_into_voxels(size_m)),
            );
        };
        let is_received = threads.beside(bring_on, || self.receive_fused(out))?;
        brought?;
        self.flights.append(&mut younger);
        let together = together.unwrap_or_else(|| Together::of(&next));
        let results = FlightResults::Together(Box::new(together));
        self.flights.push_back(Flight { rig_from_points: Vec::new(), results });
        Ok(is_received)
    }

    fn put_together(&mut self, frames: &[Option<Frame<'_>>]) -> Result<FlightResults, Error> {
        let frames = self.placed(frames)?;
        Ok(FlightResults::Together(Box::new(self.threads.install(|| Together::of(&frames)))))
    }

    /// Returns the voxel size in metres if merged points are thinned to voxels, otherwise `None`.
    fn voxels_merged_m(&self) -> Option<f64> {
        self.general.voxel_m().filter(|_| self.way == RigWay::Merged)
    }

    /// Returns the number of moments submitted and not yet received.
    pub fn in_flight(&self) -> usize {
        self.flights.len()
    }

    /// Returns the useful number of moments in flight: one per slot if a GPU smooths each camera's frames separately,
    /// otherwise 1, since results are then not computed asynchronously. [`next_fused`](Self::next_fused) keeps two if
    /// points are thinned to voxels.
    pub fn max_in_flight(&self) -> usize {
        let is_pipelined = self.way == RigWay::Each && self.engine.capabilities().pipelined;
        if is_pipelined { self.options.gpu.slots } else { 1 }
    }

    fn receive_landed(&mut self) -> Result<Option<Landed>, Error> {
        let Some(mut flight) = self.flights.pop_front() else { return Ok(None) };
        let landed = self.land(&mut flight);
        self.closed_by_error(landed)?;
        Ok(match flight.results {
            FlightResults::Landed(views) => Some(Landed::Views((flight.rig_from_points, views))),
            FlightResults::InVoxels(voxels) => Some(Landed::InVoxels(voxels)),
            FlightResults::Submitted(_) | FlightResults::Together(_) => None,
        })
    }

    /// Waits for the results of a moment.
    fn land(&mut self, flight: &mut Flight) -> Result<(), Error> {
        if let Some(size_m) = self.voxels_merged_m() {
            self.threads.install(|| flight.results.bring_into_voxels(size_m))?;
        }
        let submitted = match &mut flight.results {
            FlightResults::Submitted(submitted) => submitted,
            FlightResults::InVoxels(voxels) => return self.with_general(|smoother| voxels.smooth(smoother)),
            FlightResults::Landed(_) | FlightResults::Together(_) => return Ok(()),
        };
        let land = |(camera, submitted): (&mut CameraSmoother, Submitted)| match submitted {
            Submitted::Nothing => Ok(None),
            Submitted::Refused(error) => Ok(Some(Err(error))),
            Submitted::Flying(sight) => match camera.receive() {
                Ok(view) => Ok(Some(Ok(camera.view_over_time(sight.as_deref(), view)?))),
                Err(Error::Frame(error)) => Ok(Some(Err(error))),
                Err(error) => {
                    self.failed = camera.device.clone();
                    Err(error)
                }
            },
        };
        let views = self.cameras.iter_mut().zip(std::mem::take(submitted)).map(land).collect::<Result<_, Error>>()?;
        flight.results = FlightResults::Landed(views);
        Ok(())
    }

    /// Waits for the results of all moments in flight and keeps them for `receive`.
    pub(super) fn land_all(&mut self) -> Result<(), Error> {
        let mut flights = std::mem::take(&mut self.flights);
        flights.iter_mut().try_for_each(|flight| self.land(flight))?;
        self.flights = flights;
        Ok(())
    }
}

/// Fuses the results of a moment in the rig's frame.
fn fuse_views((rig_from_points, views): &Placed, outputs: Outputs, out: &mut PointCloud) {
    let mut parts = Vec::with_capacity(views.len());
    for (camera, (view, rig_from_points)) in views.iter().zip(rig_from_points).enumerate() {
        if let (Some(Ok(view)), Some(rig_from_points)) = (view, *rig_from_points)
            && let Some(positions) = view.points()
        {
            let attributes = fields_of(view, outputs).into_iter().map(Cow::Owned).collect();
            parts.push(Part { camera, rig_from_points, positions, attributes });
        }
    }
    fuse_parts(&parts, out);
}

/// Returns the available outputs among `fields` as fields of a cloud.
fn fields_of(view: &SmoothedView, fields: Outputs) -> Vec<Attribute> {
    let status: Option<Vec<_>> = fields.status.then(|| view.status()).flatten().map(Iterator::collect);
    let neighbours: Option<Vec<_>> = fields.neighbours.then(|| view.neighbours()).flatten().map(Iterator::collect);
    let (normals, curvature, of_video) = (view.normals(), view.curvature(), [view.frames(), None]);
    let named = named_fields(fields, normals, curvature, status.as_deref(), neighbours.as_deref(), of_video);
    named.into_iter().map(|(name, values)| Attribute { name: name.to_owned(), count: 1, values }).collect()
}
