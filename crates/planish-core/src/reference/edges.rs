//! Edge preservation: finds the surface of a point from the planes around it, and excludes neighbours off that
//! surface (docs/method.md, section 10). Lengths are in metres.

use glam::{DMat3, DVec3};

use super::Surface;
use super::bend::{self, Bend, Slope, rises};
use super::plane::{DEGENERATE_RATIO, Plane};
use super::window::{Grid, fading_gate, sample_offset};
use crate::params::EngineParams;
use crate::sensor::SensorModel;

/// Sum of the weights of a plane's points up to which the plane is not used. A sum larger by 1 counts fully.
pub(super) const MIN_TOTAL: f64 = 5.0;
/// Minimum noise, as a share of the radius.
pub(super) const MIN_NOISE: f64 = 0.01;
/// Weight of a plane's squared distance from p, relative to its squared residual.
const DISTANCE_WEIGHT: f64 = 0.3;
/// Distance from the surface within which neighbours count, in standard deviations of the noise.
pub(super) const WIDTH: f64 = 1.0;
/// Sum of the fits of the planes around a point up to which no plane fits, and the sum from which planes suffice. A
/// plane without any residual has a fit of 1.
const FITTING: [f64; 2] = [0.6, 1.6];
/// Gate weight of a plane from which its normal counts fully in the turn of the normals.
const NEAR_ENOUGH: f64 = 0.05;
/// Amount that each missing plane among the nine around a point adds to the turn of their normals.
const MISSING_PLANE: f64 = 0.1 / 9.0;
/// Turn of the normals of the planes around a point, as 1 - cos of an angle: up to the first value, planes suffice,
/// however badly they fit; from the second on, only their fit decides.
const TURNING: [f64; 2] = [0.02, 0.07];

/// Maximum distance of another point whose plane is considered, in radii. On oblique surfaces, a window reaches this
/// far.
pub(super) const PLANE_REACH: f64 = 2.0;

/// Share of the noise's variance that is added to a plane's residual for each unit of doubt (1 for a disc), so that
/// planes that are poorly determined by their points count as noisier.
pub(super) const DOUBT_WEIGHT: f64 = 0.01;

/// Minimum cosine of the angle of incidence. An apparently steeper surface is only a row of points that are far apart.
const MIN_INCIDENCE_COSINE: f64 = 0.05;
/// Excess of the cosine over [`MIN_INCIDENCE_COSINE`] from which a plane counts fully.
const COSINE_FADE: f64 = 0.01;

/// Weight of a zero displacement of p, relative to the surrounding planes.
pub(super) const STAY_WEIGHT: f64 = 1e-3;
/// Additional weight of the normal of p's window, which defines a normal where no plane is near.
pub(super) const OWN_NORMAL_WEIGHT: f64 = 1e-12;

/// Returns the standard deviation of depth at a range.
pub(super) fn noise_m(sensor: &SensorModel, range_m: f64, radius_m: f64) -> f64 {
    sensor.sigma_m(range_m).max(MIN_NOISE * radius_m)
}

/// The first planes of a frame, one per cell, each fitted to that cell's window.
pub(super) struct FirstPlanes<'a, N> {
    pub(super) grid: &'a Grid,
    pub(super) surfaces: &'a [Option<Surface>],
    pub(super) params: &'a EngineParams,
    /// Function that returns the noise at a point, in metres.
    pub(super) noise_m: N,
}

impl<N: Fn(DVec3) -> f64> FirstPlanes<'_, N> {
    /// Returns a cell's first plane as a candidate for the surface of p. Its variance grows without limit if
    /// neighbours are too few, nearly collinear, or on a plane seen edge-on. `None` for a hole, or if the variance
    /// would be infinite.
    fn candidate(&self, u: usize, v: usize, p: DVec3, radius_m: f64) -> Option<Candidate> {
        let first = self.surfaces[v * self.grid.width + u].as_ref()?;
        let (q, plane) = (self.grid.point(u, v)?, first.plane?);
        let enough = plane.total - MIN_TOTAL;
        let off_line = plane.middle_variance / (DEGENERATE_RATIO * plane.largest_variance) - 1.0;
        let cosine = plane.normal.dot(q).abs() / q.length();
        let facing = (cosine - MIN_INCIDENCE_COSINE) / COSINE_FADE;
        let usable = [enough, off_line, facing].into_iter().map(|share| share.clamp(0.0, 1.0)).product::<f64>();
        let noise_m = (self.noise_m)(q);
        let variance = plane.smallest_variance + DOUBT_WEIGHT * plane.doubt * noise_m * noise_m;
        (usable > 0.0).then(|| Candidate {
            centroid: q - p + plane.centroid,
            plane,
            variance: variance / usable,
            nearness: fading_gate(q - p, PLANE_REACH * radius_m),
            window_bend: first.window_bend,
        })
    }

    /// Finds the surface of p from its first plane and the eight around it. If p has no plane, its first surface is
    /// returned unchanged. Distances from planes are measured from p's block mean, whose offset is `mean_offset`.
    pub(super) fn surface(
        &self,
        (u, v): (usize, usize),
        p: DVec3,
        mean_offset: DVec3,
        radius_m: f64,
    ) -> Option<Surface> {
        let own = self.surfaces[v * self.grid.width + u]?;
        let Some(own_plane) = own.plane else { return Some(own) };
        let noise_m = (self.noise_m)(p);
        let shift =
            (13 * sample_offset(self.params.window as isize, self.params) as usize + 6 * self.params.cell_px()) / 12;
        let mut around = Vec::with_capacity(9);
        for dv in [-1, 0, 1].map(|step| step * shift as isize) {
            for du in [-1, 0, 1].map(|step| step * shift as isize) {
                let Some(column) = u.checked_add_signed(du).filter(|&u| u < self.grid.width) else { continue };
                let Some(row) = v.checked_add_signed(dv).filter(|&v| v < self.grid.height) else { continue };
                around.extend(self.candidate(column, row, p, radius_m));
            }
        }
        let voters = Voters { around, own_normal: own_plane.normal, mean_offset, noise_m };
        let vote = voters.vote();
        // Heights are measured along the mean normal of the planes, before it is turned towards the sensor.
        let side = side_to_sensor(vote.normal, p);
        let normal = side * vote.normal.normalize();
        let bend = Bend::between(&voters.slopes(&vote), normal, radius_m, noise_m);
        // The mean of disagreeing planes may be farther away than a point may move.
        let height_m = side * (voters.height_m(&vote, bend.tensor) / vote.total).clamp(-radius_m, radius_m);
        // The normal applies to the middle of the planes, where the slope differs from that at p.
        let normal = bend.normal_at_p(normal);
        let tensor = bend.along(normal);
        // A flipped normal with the opposite tensor describes the same surface.
        let side = side_to_sensor(normal, p);
        let foot = height_m * normal;
        // The curvature and the extent that scales the fit are those of the cell's own window.
        let plane = Plane { normal: side * normal, foot, ..own_plane };
        let no_plane_fits = (1.0 - rises(vote.fitting, FITTING)) * rises(vote.turning, TURNING);
        let certainty = (vote.total - STAY_WEIGHT) / vote.total;
        let (width_m, bend) = (WIDTH * noise_m, side * tensor);
        Some(Surface { plane: Some(plane), width_m, bend, no_plane_fits, certainty, ..own })
    }
}

/// Returns the sign that turns a normal towards the sensor.
fn side_to_sensor(normal: DVec3, p: DVec3) -> f64 {
    if normal.dot(p) > 0.0 { -1.0 } else { 1.0 }
}

/// A first plane that may be the surface of p. Offsets are from p.
struct Candidate {
    centroid: DVec3,
    plane: Plane,
    /// Variance of the plane's points about the plane, plus the plane's uncertainty, in m².
    variance: f64,
    nearness: f64,
    window_bend: f64,
}

/// The planes that decide on the surface of p.
struct Voters {
    around: Vec<Candidate>,
    own_normal: DVec3,
    /// Offset from p to its block mean.
    mean_offset: DVec3,
    noise_m: f64,
}

/// The vote of the planes: weighted sums, not yet divided by the total.
struct Vote {
    normal: DVec3,
    total: f64,
    /// Weights of the candidates around p.
    weights: Vec<f64>,
    /// Sum of the candidates' fits to their own points, F of (10.17) in docs/method.md.
    fitting: f64,
    /// Turn of the candidates' normals, increased for missing candidates: T of (10.17) in docs/method.md.
    turning: f64,
}

impl Voters {
    fn vote(&self) -> Vote {
        let (mut normal, mut total, mut fitting) = (OWN_NORMAL_WEIGHT * self.own_normal, STAY_WEIGHT, 0.0);
        let mut weights = Vec::with_capacity(self.around.len());
        let (mut normals, mut count) = (DVec3::ZERO, 0.0);
        for candidate in &self.around {
            let n = candidate.plane.normal;
            let from_mean_m = (candidate.centroid - self.mean_offset).dot(n);
            let residual = candidate.variance + DISTANCE_WEIGHT * from_mean_m * from_mean_m;
            let fit = |variance: f64| candidate.nearness * (1.0 + variance / (self.noise_m * self.noise_m)).powi(-4);
            let weight = fit(residual);
            fitting += fit(candidate.variance);
            let near = (candidate.nearness / NEAR_ENOUGH).min(1.0);
            normals += near * n;
            count += near;
            normal += weight * n;
            total += weight;
            weights.push(weight);
        }
        let turning = 1.0 - normals.length() / count.max(NEAR_ENOUGH) + MISSING_PLANE * (9.0 - count);
        Vote { normal, total, weights, fitting, turning }
    }

    /// Returns the weighted sum of the distances from p, along the planes' normals, to a surface with the bend
    /// `tensor`.
    fn height_m(&self, vote: &Vote, tensor: DMat3) -> f64 {
        let height_m = |candidate: &Candidate| {
            candidate.centroid.dot(candidate.plane.normal) + bend::rise_m(tensor, candidate.centroid, &candidate.plane)
        };
        self.around.iter().zip(&vote.weights).map(|(candidate, weight)| weight * height_m(candidate)).sum()
    }

    fn slopes(&self, vote: &Vote) -> Vec<Slope> {
        let slope = |(candidate, &weight): (&Candidate, &f64)| Slope {
            weight,
            offset: candidate.centroid,
            normal: candidate.plane.normal,
            window_bend: candidate.window_bend,
        };
        self.around.iter().zip(&vote.weights).map(slope).collect()
    }
}
