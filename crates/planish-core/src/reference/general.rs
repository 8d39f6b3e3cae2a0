//! Smooths unorganized clouds: all points within the radius are neighbours, found in a k-d tree (docs/method.md,
//! section 8).

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use super::edges::PLANE_REACH;
use super::general_edges::FirstPlane;
use super::window::{fading_gate, reach_m};
use super::{PointResult, Surface, smooth_point};
use crate::error::Error;
use crate::frame::FrameGeometry;
use crate::neighbours::{NeighbourSearch, extent_m};
use crate::params::{Edges, EngineParams, Radius};
use crate::progress::Progress;
use crate::range::radius_in_cloud_m;
use crate::status::Status;
use crate::threads::Threads;

/// Maximum ratio of a radius to the mean radius of the positions around it.
const MAX_RADIUS_RATIO: f64 = 1.5;

/// Minimum radius, in metres.
const MIN_RADIUS_M: f64 = 1e-12;

/// The cloud to smooth.
pub(super) struct Cloud<'a> {
    pub(super) points: &'a [DVec3],
    /// Extent of the whole cloud in metres, if this is only a part of it.
    pub(super) extent_m: Option<f64>,
    /// Number of neighbours below which a point is isolated.
    pub(super) least_neighbours: u32,
}

/// The distinct positions of a cloud, and the number of points at each.
struct Positions {
    points: Vec<DVec3>,
    counts: Vec<u32>,
    search: NeighbourSearch,
}

/// Smooths every point of the cloud. Returns one result per point, in the same order. Displacements and normals are
/// in the sensor's frame.
pub(super) fn smooth(
    params: &EngineParams,
    threads: &Threads,
    cloud: &Cloud<'_>,
    geometry: &FrameGeometry,
    progress: &Progress,
) -> Result<Vec<PointResult>, Error> {
    let &Cloud { points, extent_m: known_extent_m, least_neighbours } = cloud;
    // Points are rotated into the sensor's orientation but not translated: the sensor may be so far away that
    // translated points would lose digits.
    let turn = |p: DVec3| geometry.cloud_from_sensor.map_or(p, |transform| transform.rotation.transpose() * p);
    let sensor = turn(geometry.sensor_position());
    let (places, distinct, counts) = distinct_positions(points);
    let turned: Vec<DVec3> = distinct.iter().map(|&p| turn(p)).collect();
    let search = NeighbourSearch::new(&turned)?;
    let positions = Positions { points: turned, counts, search };
    let extent_m = known_extent_m.unwrap_or_else(|| extent_m(points));
    progress.reset();
    progress.begin(distinct.len());

    let results: Vec<PointResult> = threads.install(|| {
        let radii_m = positions.radii_m(params, sensor, extent_m);
        let first_plane = |found: &mut Vec<usize>, (&p, &radius_m): (&DVec3, &f64)| {
            FirstPlane::new(Surface::own(&positions.neighbours(p, radius_m, found), radius_m, p - sensor), radius_m)
        };
        let all = || positions.points.par_iter().zip(&radii_m);
        let keeps_edges = params.edges == Edges::Robust;
        let on_ray = geometry.is_on_rays(params.project);
        let firsts: Vec<FirstPlane> =
            if keeps_edges { all().map_init(Vec::new, first_plane).collect() } else { Vec::new() };
        let smooth = |found: &mut Vec<usize>, (i, (&p, &radius_m)): (usize, (&DVec3, &f64))| {
            if progress.is_stopped() {
                return PointResult::hole();
            }
            let offsets = positions.neighbours(p, radius_m, found);
            let surface = match firsts.get(i) {
                None => Surface::own(&offsets, radius_m, p - sensor),
                Some(first) => {
                    positions.search.within(p, reach_m(PLANE_REACH * radius_m), found);
                    let around: Vec<_> = found.iter().map(|&i| (positions.points[i] - p, &firsts[i])).collect();
                    first.surface(&around, p - sensor)
                }
            };
            let result = if surface.neighbours < least_neighbours {
                let few = PointResult { neighbours: surface.neighbours, ..PointResult::hole() };
                if params.remove_isolated { PointResult { status: Status::TooFew, ..few } } else { few.kept() }
            } else {
                smooth_point(p, sensor, &offsets, radius_m, params, &surface, on_ray)
            };
            progress.add(1);
            result
        };
        all().enumerate().map_init(Vec::new, smooth).collect()
    });
    progress.check()?;
    Ok(places.into_iter().map(|place| place.map_or_else(PointResult::hole, |place| results[place])).collect())
}

/// Returns, for each finite point, the index of its distinct position; the distinct positions; and the number of points
/// at each.
fn distinct_positions(points: &[DVec3]) -> (Vec<Option<usize>>, Vec<DVec3>, Vec<u32>) {
    let (mut distinct, mut counts) = (Vec::new(), Vec::new());
    let mut place_of = HashMap::new();
    let mut place = |&p: &DVec3| {
        // -0 and 0 are the same coordinate.
        let place = *place_of.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert(distinct.len());
        if place == distinct.len() {
            distinct.push(p);
            counts.push(0);
        }
        counts[place] += 1;
        place
    };
    let places = points.iter().map(|p| p.is_finite().then(|| place(p))).collect();
    (places, distinct, counts)
}

impl Positions {
    /// Returns the neighbours of p as offsets from it; `found` is a buffer for the search.
    fn neighbours(&self, p: DVec3, radius_m: f64, found: &mut Vec<usize>) -> Vec<DVec3> {
        self.search.within(p, reach_m(radius_m), found);
        let repeated = found.iter().flat_map(|&i| std::iter::repeat_n(self.points[i] - p, self.counts[i] as usize));
        repeated.filter(|&offset| fading_gate(offset, radius_m) > 0.0).collect()
    }

    /// Returns the radius at every position.
    fn radii_m(&self, params: &EngineParams, sensor: DVec3, extent_m: f64) -> Vec<f64> {
        let count = match params.radius {
            Radius::Neighbours { count } | Radius::SensorAndDensity { count } => count,
            Radius::Fixed { radius_m } => return vec![f64::from(radius_m); self.points.len()],
            // `Smoother::open` rejects this radius.
            Radius::Sensor => return vec![MIN_RADIUS_M; self.points.len()],
        };
        let own_m = |&p: &DVec3| {
            let by_density_m = self.radius_m(p, f64::from(count) / 2.0, extent_m / 2.0);
            match params.radius {
                Radius::SensorAndDensity { .. } => {
                    radius_in_cloud_m(params, (p - sensor).length(), by_density_m).min(extent_m / 2.0)
                }
                _ => by_density_m,
            }
        };
        let own_m: Vec<f64> = self.points.par_iter().map(own_m).collect();
        let limited = |(place, &radius_m): (usize, &f64)| {
            let limit_m = MAX_RADIUS_RATIO * self.mean_radius_m(place, radius_m, &own_m);
            radius_m.min(limit_m).max(MIN_RADIUS_M)
        };
        own_m.par_iter().enumerate().map(limited).collect()
    }

    /// Returns the radius for which the sum of 1 - d²/r² over the positions within it is `half`; at most `largest_m`.
    fn radius_m(&self, p: DVec3, half: f64, largest_m: f64) -> f64 {
        let mut wanted = 4 * half as usize;
        loop {
            let squares = self.search.nearest_squares(p, wanted);
            let mut sum = 0.0;
            for (i, &square) in squares.iter().enumerate() {
                // Assumes that exactly the first `n` positions are within the radius.
                sum += square;
                let n = (i + 1) as f64;
                let next = squares.get(i + 1).copied().unwrap_or(f64::INFINITY);
                let is_last = i + 1 == squares.len() && squares.len() < self.points.len();
                if n > half && !is_last && sum / (n - half) <= next {
                    return (sum / (n - half)).sqrt().min(largest_m);
                }
            }
            if squares.len() >= self.points.len() {
                return largest_m;
            }
            wanted *= 2;
        }
    }

    /// Returns the mean radius of the other positions within `radius_m` of a position, with weights 1 - d²/r²;
    /// infinite if there are no other positions.
    fn mean_radius_m(&self, place: usize, radius_m: f64, own_m: &[f64]) -> f64 {
        let mut found = Vec::new();
        self.search.within(self.points[place], radius_m, &mut found);
        let others = found.into_iter().filter(|&other| other != place);
        let (mut total, mut sum) = (0.0, 0.0);
        for other in others {
            let square = (self.points[other] - self.points[place]).length_squared();
            let weight = (1.0 - square / (radius_m * radius_m)).max(0.0);
            total += weight;
            sum += weight * own_m[other];
        }
        if total > 0.0 { sum / total } else { f64::INFINITY }
    }
}
