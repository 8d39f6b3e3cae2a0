//! Edge preservation: finds the surface of a point from the planes around it, and excludes neighbours off that surface
//! (docs/method.md, section 10). Metres.

use glam::DVec3;

use super::Surface;
use super::plane::{DEGENERATE_RATIO, Plane};
use super::window::{Grid, fading_gate};
use crate::params::{EngineParams, edge_shift_px};
use crate::sensor::SensorModel;

/// A plane whose points count less than this together is not used, and wholly from one more on.
pub(super) const MIN_TOTAL: f64 = 5.0;
/// The noise is at least this share of the radius.
pub(super) const MIN_NOISE: f64 = 0.01;
/// Weight of a plane's squared distance from p, relative to its squared residual.
const DISTANCE_WEIGHT: f64 = 0.3;
/// Neighbours count up to this many standard deviations of the noise from the surface.
pub(super) const WIDTH: f64 = 1.0;

/// Planes of points up to this many radii away are considered: on oblique surfaces a window reaches as far.
pub(super) const PLANE_REACH: f64 = 2.0;

/// A plane that its points hardly determine counts as noisier: by this share of the noise's variance for a disc.
pub(super) const DOUBT_WEIGHT: f64 = 0.01;

/// No camera measures a surface steeper than this; what looks like one is a row of points far apart.
const MIN_INCIDENCE_COSINE: f64 = 0.05;
/// Beyond this excess, the plane counts fully.
const COSINE_FADE: f64 = 0.01;

/// Weight of a zero displacement of p, relative to the surrounding planes.
pub(super) const STAY_WEIGHT: f64 = 1e-3;
/// Additional weight of the normal of p's window, which defines a normal where no plane is near.
pub(super) const OWN_NORMAL_WEIGHT: f64 = 1e-12;

/// Returns the standard deviation of depth at a range.
pub(super) fn noise_m(sensor: &SensorModel, range_m: f64, radius_m: f64) -> f64 {
    sensor.sigma_m(range_m).max(MIN_NOISE * radius_m)
}

/// The first planes of a frame, one per pixel, each fitted to that pixel's window.
pub(super) struct FirstPlanes<'a, N> {
    pub(super) grid: &'a Grid,
    pub(super) surfaces: &'a [Option<Surface>],
    pub(super) params: &'a EngineParams,
    /// The noise at a point.
    pub(super) noise_m: N,
}

impl<N: Fn(DVec3) -> f64> FirstPlanes<'_, N> {
    /// Returns the point of a pixel, its first plane, and the variance of its points about it plus its uncertainty, in
    /// m². The variance grows without limit if neighbours are too few, nearly collinear, or on a plane seen edge-on.
    /// `None` for a hole, or at the limit.
    fn usable(&self, u: usize, v: usize) -> Option<(DVec3, &Plane, f64)> {
        let first = self.surfaces[v * self.grid.width + u].as_ref()?;
        let (p, plane) = (self.grid.point(u, v)?, first.plane.as_ref()?);
        let enough = plane.total - MIN_TOTAL;
        let off_line = plane.middle_variance / (DEGENERATE_RATIO * plane.largest_variance) - 1.0;
        let cosine = plane.normal.dot(p).abs() / p.length();
        let facing = (cosine - MIN_INCIDENCE_COSINE) / COSINE_FADE;
        let usable = [enough, off_line, facing].into_iter().map(|share| share.clamp(0.0, 1.0)).product::<f64>();
        let noise_m = (self.noise_m)(p);
        let variance = plane.smallest_variance + DOUBT_WEIGHT * plane.doubt * noise_m * noise_m;
        (usable > 0.0).then(|| (p, plane, variance / usable))
    }

    /// Finds the surface of p from its first plane and the eight around it; without neighbours, its first plane.
    /// `mean_offset`, the offset of p's block mean, is used to measure its distance from planes.
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
        let shift = edge_shift_px(self.params.reach_px()) as isize;
        let (mut normal, mut height_m, mut total) = (OWN_NORMAL_WEIGHT * own_plane.normal, 0.0, STAY_WEIGHT);
        for dv in [-shift, 0, shift] {
            for du in [-shift, 0, shift] {
                let Some(column) = u.checked_add_signed(du).filter(|&u| u < self.grid.width) else { continue };
                let Some(row) = v.checked_add_signed(dv).filter(|&v| v < self.grid.height) else { continue };
                let Some((at, plane, own_residual)) = self.usable(column, row) else { continue };
                let offset = at - p;
                // Distances to the plane along its normal, from p and from the mean.
                let to_plane_m = (offset + plane.foot).dot(plane.normal);
                let from_mean_m = to_plane_m - mean_offset.dot(plane.normal);
                let residual = own_residual + DISTANCE_WEIGHT * from_mean_m * from_mean_m;
                let nearness = fading_gate(offset, PLANE_REACH * radius_m);
                let weight = nearness * (1.0 + residual / (noise_m * noise_m)).powi(-4);
                normal += weight * plane.normal;
                height_m += weight * to_plane_m;
                total += weight;
            }
        }
        // Planes that disagree may lie further away than a point may move.
        let height_m = (height_m / total).clamp(-radius_m, radius_m);
        // The foot is the same whichever way the normal points.
        let foot = height_m * normal.normalize();
        let normal = if normal.dot(p) > 0.0 { -normal.normalize() } else { normal.normalize() };
        // Curvature and the extent that scales the fit come from the pixel's window.
        let plane = Plane { normal, foot, ..own_plane };
        Some(Surface { plane: Some(plane), width_m: WIDTH * noise_m, ..own })
    }
}
