//! Smooths clouds with more points than the device can hold, part by part.
//!
//! Radii by density are known only after a part has been computed. If many of its points reach beyond the halo, the
//! part is computed again with a wider halo. If only a few do, only these points are computed again, in small groups
//! with wider halos. A radius computed with missing neighbours is too large, so a halo as wide as such a radius is
//! sufficient.

use std::collections::HashMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::buffers::Buffers;
use super::parts::{Part, Parts, Record, deal};
use super::results::repeat;
use super::{GeneralGpu, Own, extent_m, middle_of};
use crate::error::{EngineError, Error};
use crate::frame::{Frame, FrameGeometry, PointsView};
use crate::neighbours::halo::{OWN_SHARE, first_halo_m, needed_halo, reach};
use crate::outputs::SmoothedMut;
use crate::params::Radius;
use crate::smoothing_engine::AdmittedFrame;
use crate::xyz::Xyz;

/// Maximum share of a usual part's points that may reach beyond the halo before the halo is widened.
const MAY_REACH_BEYOND: f64 = 0.01;
/// Number of points reaching beyond their halo that are recomputed together, unless [`FAR_SHARE`] gives more.
const FAR_TOGETHER: usize = 64;
/// Ratio of a usual part's points to the points reaching beyond their halo that are recomputed together.
const FAR_SHARE: usize = 1024;
/// Maximum number of runs per part of the initial division. Clouds that need more are left to other engines; scans
/// need about four.
const RUNS_A_PART: usize = 24;
/// Share of a part's progress reported before its far-reaching points are done.
const FIRST_SHARE: f64 = 0.8;
/// Maximum share of a cloud's points whose neighbourhoods exceed the device's capacity; above this share, smoothing
/// fails.
const MAY_BE_INEXACT: f64 = 1e-3;
/// Maximum factor by which a halo is widened in one step.
const MOST_WIDENING: f64 = 4.0;
/// Ratio of a neighbourhood's estimated size to the device's capacity above which the neighbourhood certainly exceeds
/// it.
const SURELY_TOO_MANY: f64 = 2.0;
/// Width in metres below which a halo is not narrowed further: points closer than this count as coincident.
const LEAST_HALO_M: f64 = 1e-9;
/// Ratio of a usual part's points to those of the largest small part. A small part is not divided further; its halo is
/// narrowed instead.
const SMALL: usize = 64;
/// Factor by which the halo of one point or of a small part is narrowed if it holds too many points.
const NARROWER: f64 = 0.7;
/// Maximum ratio of a part's first halo, which follows the previous part's halo, to the halo expected from its
/// density.
const MOST_HALO_SHARE: f64 = 4.0;

/// A part to be smoothed.
struct Task {
    part: Arc<Part>,
    /// Number of progress steps reported for the part's first run.
    steps: usize,
}

/// A cloud that is being smoothed in parts.
struct Work {
    parts: Parts,
    /// Number of points in a usual part, without its halo.
    usual: usize,
    geometry: FrameGeometry,
    /// Number of points in the whole cloud, not counting holes, and the cloud's extent in metres.
    whole: (usize, f64),
    wants_radii: bool,
    /// Reach, in metres, of each point that reaches beyond its part's halo, by point index.
    far: HashMap<u32, f64>,
    far_records: Vec<Record>,
    /// Ratio of the previous part's halo to the halo expected from its density.
    last_share: f64,
    /// The points of a part, followed by the points of its halo.
    points: Xyz,
    /// Number of remaining runs.
    runs_left: usize,
    /// Number of points that may still keep an inexact result, computed with a halo narrower than their reach.
    inexact_left: usize,
}

impl Work {
    /// Takes the far-reaching points out of the work. Returns the first point at each position, in cloud order, and
    /// an index pair (first, other) for each other point at the same position.
    fn far_places(&mut self) -> (Vec<Record>, Vec<(u32, u32)>) {
        let mut records = std::mem::take(&mut self.far_records);
        // -0 and 0 are the same coordinate.
        let place = |record: &Record| record.position.map(|value| (value + 0.0).to_bits());
        records.par_sort_unstable_by_key(|record| (place(record), record.number));
        let mut repeated = Vec::new();
        for at_place in records.chunk_by(|a, b| place(a) == place(b)) {
            let [first, others @ ..] = at_place else { continue };
            repeated.extend(others.iter().map(|other| (first.number, other.number)));
            // Neighbours missing from a part make a reach too large, so the smallest reach is the most accurate.
            let reach_m = at_place.iter().filter_map(|record| self.far.get(&record.number));
            let reach_m = reach_m.copied().fold(f64::INFINITY, f64::min);
            self.far.insert(first.number, reach_m);
        }
        records.dedup_by_key(|record| place(record));
        records.par_sort_unstable_by_key(|record| record.number);
        (records, repeated)
    }
}

impl GeneralGpu {
    /// Smooths a cloud in parts.
    pub(super) fn smooth_in_parts(
        &mut self,
        frame: &AdmittedFrame<'_>,
        view: &PointsView<'_>,
        mut out: SmoothedMut<'_>,
    ) -> Result<(), Error> {
        let most = self.most_points;
        let usual = (OWN_SHARE * most as f64).ceil() as usize;
        // The buffers are allocated first: if memory runs out, the caller tries again with smaller parts.
        let buffers = self.take_buffers(most)?;
        let mut work = Work {
            parts: Parts::of(view, usual),
            usual,
            geometry: frame.geometry,
            whole: (view.points_of_whole(), view.extent_m().unwrap_or_else(|| extent_m(&middle_of(view)))),
            wants_radii: self.is_by_density(),
            far: HashMap::new(),
            far_records: Vec::new(),
            last_share: 1.0,
            points: Xyz::default(),
            runs_left: 0,
            inexact_left: (MAY_BE_INEXACT * view.len() as f64) as usize,
        };
        if self.keeps_radii && work.wants_radii {
            self.radii.resize(view.len(), f32::NAN);
        }
        let is_crowded = match self.params.radius {
            Radius::Fixed { radius_m } => {
                let around = work.parts.most_around(reach(&self.params) * f64::from(radius_m));
                around > SURELY_TOO_MANY * most as f64
            }
            // Half of the neighbours are within the radius, unless the cloud's extent limits it.
            Radius::Neighbours { count } | Radius::SensorAndDensity { count } => count as usize / 2 > most,
            Radius::Sensor => false,
        };
        if is_crowded {
            return Err(self.crowded().into());
        }
        let first_steps = |part: &Part| (FIRST_SHARE * part.len() as f64) as usize;
        let mut tasks: Vec<_> = work.parts.all().map(|part| Task { steps: first_steps(&part), part }).collect();
        let mut steps_left = view.len() - tasks.iter().map(|task| task.steps).sum::<usize>();
        work.runs_left = RUNS_A_PART * tasks.len();
        while let Some(mut task) = tasks.pop() {
            if !self.smooth_part(&buffers, &mut work, &mut task, out.reborrow())? {
                if task.part.len() < 2 {
                    return Err(self.crowded().into());
                }
                let [first, second] = task.part.halves().map(Arc::new);
                let steps = task.steps / 2;
                tasks.push(Task { part: first, steps });
                tasks.push(Task { part: second, steps: task.steps - steps });
            }
        }
        let (far_records, repeated) = work.far_places();
        let far_count = far_records.len().max(1);
        let mut far = deal(far_records, FAR_TOGETHER.max(usual / FAR_SHARE));
        let far_steps = steps_left;
        while let Some(part) = far.pop() {
            if self.smooth_far(&buffers, &mut work, &part, out.reborrow())? {
                let steps = (part.len() * far_steps / far_count).min(steps_left);
                self.progress.add(steps);
                steps_left -= steps;
                continue;
            }
            match part.len() {
                1 => far.push(part),
                _ => far.extend(part.halves()),
            }
        }
        repeat(out, &repeated);
        if !self.radii.is_empty() {
            repeated.iter().for_each(|&(from, to)| self.radii[to as usize] = self.radii[from as usize]);
        }
        self.progress.add(steps_left);
        self.buffers = Some(buffers);
        Ok(())
    }

    /// Smooths a part, and records its points that reach beyond the halo. Returns false if the device cannot hold the
    /// part with its halo.
    fn smooth_part(
        &mut self,
        buffers: &Buffers,
        work: &mut Work,
        task: &mut Task,
        mut out: SmoothedMut<'_>,
    ) -> Result<bool, Error> {
        let part = &*task.part;
        let by_density_m = first_halo_m(&self.params, part.len() as u64, part.area_m2());
        let mut halo_m = work.last_share * by_density_m;
        let reach = reach(&self.params);
        let (mut may_widen, is_small) = (true, work.wants_radii && part.len() <= (work.usual / SMALL).max(1));
        loop {
            self.progress.check()?;
            if !work.parts.gather(part, halo_m, self.most_points, &mut work.points) {
                if !is_small || halo_m < LEAST_HALO_M {
                    return Ok(false);
                }
                (halo_m, may_widen) = (NARROWER * halo_m, false);
                continue;
            }
            let steps = std::mem::take(&mut task.steps);
            self.run_part(buffers, work, Own { points: part.len(), steps, largest_radius_m: f32::INFINITY })?;
            let radii = self.take_results(buffers, work, part, out.reborrow())?;
            let own = radii.iter().zip(part.own());
            let reach_m = |radius_m: f32| reach * f64::from(radius_m);
            let needed_m = |(&radius_m, record): (&f32, &Record)| reach_m(radius_m) - part.to_border_m(record.position);
            let needed_m: Vec<f64> = radii.par_iter().zip(part.own()).map(needed_m).collect();
            let needed = needed_halo(halo_m, &needed_m, MAY_REACH_BEYOND * work.usual as f64);
            if !(needed.is_wider && may_widen) {
                for ((&radius_m, record), _) in own.zip(&needed_m).filter(|(_, needed_m)| **needed_m > halo_m) {
                    work.far.insert(record.number, reach_m(radius_m));
                    work.far_records.push(*record);
                }
                if !needed_m.is_empty() && by_density_m > 0.0 {
                    work.last_share = (needed.halo_m / by_density_m).clamp(1.0, MOST_HALO_SHARE);
                }
                return Ok(true);
            }
            // The widening is limited, since a radius found with most neighbours missing is unreliable.
            let base_m = halo_m.max(by_density_m);
            halo_m = if base_m > 0.0 { needed.halo_m.min(MOST_WIDENING * base_m) } else { needed.halo_m };
        }
    }

    /// Smooths points that reach beyond the halo of their part. Returns false if they must be smoothed again: several
    /// points in two halves, a single point with its new reach.
    fn smooth_far(
        &mut self,
        buffers: &Buffers,
        work: &mut Work,
        part: &Part,
        out: SmoothedMut<'_>,
    ) -> Result<bool, Error> {
        let reach_m = part.own().iter().filter_map(|record| work.far.get(&record.number));
        let reach_m = reach_m.copied().fold(0.0, f64::max);
        let mut halo_m = reach_m;
        while !work.parts.gather(part, halo_m, self.most_points, &mut work.points) {
            self.progress.check()?;
            if part.len() > 1 {
                return Ok(false);
            }
            if halo_m < LEAST_HALO_M {
                return Err(self.crowded().into());
            }
            halo_m *= NARROWER;
        }
        self.run_part(buffers, work, Own { points: part.len(), steps: 0, largest_radius_m: halo_m as f32 })?;
        let radii = self.take_results(buffers, work, part, out)?;
        let (Some(&radius_m), Some(record)) = (radii.first(), part.own().first()) else { return Ok(true) };
        // With more points around it than in its part, the point's radius is smaller than before. If it is only
        // slightly smaller, the point keeps this result.
        let smaller_m = reach(&self.params) * f64::from(radius_m);
        let is_left = halo_m == reach_m || smaller_m > NARROWER * reach_m;
        work.far.insert(record.number, smaller_m);
        if is_left && halo_m < reach_m {
            work.inexact_left = work.inexact_left.checked_sub(1).ok_or_else(|| self.crowded())?;
        }
        Ok(is_left)
    }

    /// Returns the error for clouds whose neighbourhoods exceed the device's capacity, or that have so many wide
    /// neighbourhoods that their parts would take too long.
    fn crowded(&self) -> EngineError {
        EngineError::Crowded { device: self.gpu.name.clone(), points_at_once: self.most_points as u64 }
    }

    /// Runs all passes on the gathered points.
    fn run_part(&mut self, buffers: &Buffers, work: &mut Work, own: Own) -> Result<(), Error> {
        work.runs_left = work.runs_left.checked_sub(1).ok_or_else(|| self.crowded())?;
        let [x, y, z] = work.points.as_slices();
        let view = PointsView::from_planes(x, y, z)?.as_part_of(work.whole.0, work.whole.1);
        let frame = AdmittedFrame::new(Frame::Points(view), work.geometry);
        Ok(self.run(buffers, &frame, &view, work.wants_radii, own)?)
    }

    /// Copies the results of a part's own points into the cloud's results. Returns these points' radii by density, or
    /// an empty vector if they have none.
    fn take_results(
        &mut self,
        buffers: &Buffers,
        work: &Work,
        part: &Part,
        out: SmoothedMut<'_>,
    ) -> Result<Vec<f32>, EngineError> {
        let own = part.own();
        let radii = self.with_results(buffers, work.points.len(), |results| {
            results.scatter_into(own, out);
            let has_radii = work.wants_radii && part.has_neighbours();
            if has_radii { results.radii[..own.len()].to_vec() } else { Vec::new() }
        })?;
        if self.keeps_radii {
            for (record, &radius_m) in own.iter().zip(&radii) {
                self.radii[record.number as usize] = radius_m;
            }
        }
        Ok(radii)
    }
}
