//! Edge preservation in unorganized clouds: finds the surface of a point from the first planes of the positions
//! around it (docs/method.md, section 10). Lengths are in metres.

use glam::DVec3;

use super::Surface;
use super::edges::{DOUBT_WEIGHT, MIN_NOISE, MIN_TOTAL, OWN_NORMAL_WEIGHT, PLANE_REACH, STAY_WEIGHT, WIDTH};
use super::plane::{DEGENERATE_RATIO, Plane};
use super::window::fading_gate;

/// Distance, as a share of the radius, within which positions are averaged to give the point from which distances to
/// planes are measured.
const MEAN_REACH: f64 = 0.4;

/// Weight of the squared distance from a plane to the mean of the positions, relative to the plane's squared
/// residual.
const DISTANCE_WEIGHT: f64 = 0.2;

/// Cosine between the normals of a plane and of p's own plane below which the plane counts less, since it is unclear
/// which side it faces.
const FACING_COSINE: f64 = 0.1;

/// First plane of a position, fitted to its neighbours.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstPlane {
    pub(super) surface: Surface,
    pub(super) radius_m: f64,
    /// Combined misfit and uncertainty of the plane, R of (10.22) in docs/method.md, in m²; infinite for too few or
    /// collinear points.
    residual: f64,
}

impl FirstPlane {
    pub(super) fn new(surface: Surface, radius_m: f64) -> Self {
        let residual = surface.plane.as_ref().map_or(f64::INFINITY, |plane| residual(plane, radius_m));
        Self { surface, radius_m, residual }
    }

    /// Finds the surface of position p from the first planes `around` it, including its own, each with its offset
    /// from p.
    pub(super) fn surface(&self, around: &[(DVec3, &Self)], from_sensor: DVec3) -> Surface {
        let Some(own_plane) = self.surface.plane else { return self.surface };
        let radius_squared = self.radius_m * self.radius_m;
        let gate = |offset: DVec3| fading_gate(offset, PLANE_REACH * self.radius_m);
        // The noise is the harmonic mean of the residuals, which is dominated by planes that fit well.
        let (mut total, mut inverse) = (0.0, 0.0);
        let (mut near, mut mean) = (0.0, DVec3::ZERO);
        for &(offset, first) in around {
            total += gate(offset);
            inverse += gate(offset) * radius_squared / first.residual;
            let nearness = fading_gate(offset, MEAN_REACH * self.radius_m);
            near += nearness;
            mean += nearness * offset;
        }
        if inverse <= 0.0 {
            return self.surface;
        }
        let mean = mean / near;
        let noise_squared = (radius_squared * total / inverse).max(MIN_NOISE * MIN_NOISE * radius_squared);

        let (mut normal, mut height_m, mut total) = (OWN_NORMAL_WEIGHT * own_plane.normal, 0.0, STAY_WEIGHT);
        for &(offset, first) in around {
            let Some(plane) = first.surface.plane.filter(|_| first.residual.is_finite()) else { continue };
            // Distances to the plane along its normal, from p and from the mean.
            let to_plane_m = (offset + plane.foot).dot(plane.normal);
            let from_mean_m = to_plane_m - mean.dot(plane.normal);
            let residual = first.residual + DISTANCE_WEIGHT * from_mean_m * from_mean_m;
            let weight = gate(offset) * (1.0 + residual / noise_squared).powi(-4);
            // Normals that oppose the normal of p's own plane are flipped.
            let facing = (plane.normal.dot(own_plane.normal) / FACING_COSINE).clamp(-1.0, 1.0);
            normal += weight * facing * plane.normal;
            height_m += weight * facing * to_plane_m;
            total += weight * facing.abs();
        }
        // The mean of disagreeing planes may be farther away than a point may move.
        let height_m = (height_m / total).clamp(-self.radius_m, self.radius_m);
        // The foot is the same whichever way the normal points.
        let foot = height_m * normal.normalize();
        let normal = if normal.dot(from_sensor) > 0.0 { -normal.normalize() } else { normal.normalize() };
        // The curvature, and the extent that scales the fit, come from the position's own neighbours.
        let plane = Plane { normal, foot, ..own_plane };
        Surface { plane: Some(plane), width_m: WIDTH * noise_squared.sqrt(), ..self.surface }
    }
}

fn residual(plane: &Plane, radius_m: f64) -> f64 {
    let enough = (plane.total - MIN_TOTAL).clamp(0.0, 1.0);
    let off_line = plane.middle_variance / (DEGENERATE_RATIO * plane.largest_variance) - 1.0;
    let variance = plane.smallest_variance + (MIN_NOISE * radius_m).powi(2);
    variance * (1.0 + DOUBT_WEIGHT * plane.doubt) / (enough * off_line.clamp(0.0, 1.0))
}
