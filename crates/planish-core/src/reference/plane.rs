//! Fits the plane of a neighbourhood by principal component analysis (docs/method.md, section 4).
//!
//! All lengths are in metres, relative to the point p being smoothed, to avoid cancellation far from the origin.

use glam::{DMat3, DVec3};

use super::window::fading_gate;
use crate::eigen::symmetric_eigen;

/// Ratio of the middle to the largest variance up to which a neighbourhood is a line.
pub(super) const DEGENERATE_RATIO: f64 = 1e-4;

/// Maximum of [`Plane::doubt`].
const MAX_DOUBT: f64 = 1e6;

/// The plane, in coordinates relative to p.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plane {
    /// Unit normal, towards the sensor.
    pub normal: DVec3,
    /// Foot of p on the plane: o - p = (c·n) n.
    pub foot: DVec3,
    /// Mean of the neighbours, on the plane.
    pub centroid: DVec3,
    /// Variance along the normal, l0, in m².
    pub smallest_variance: f64,
    /// Uncertainty of the normal, l2/(l1 - l0): 1 for a disc, up to [`MAX_DOUBT`] for points close to a line.
    pub doubt: f64,
    /// Variance along the middle principal axis, l1, in m².
    pub middle_variance: f64,
    /// Variance along the largest principal axis, l2, in m².
    pub largest_variance: f64,
    /// Surface variation, l0/(l0+l1+l2).
    pub curvature: f64,
    /// Sum of the neighbours' gate weights.
    pub total: f64,
}

/// Fits the plane to the neighbours `offsets` = q - p within the radius; `None` if they lie on a line. `from_sensor`
/// is the ray from the sensor to p.
pub(super) fn fit(offsets: &[DVec3], radius_m: f64, from_sensor: DVec3) -> Option<Plane> {
    let weighted = || offsets.iter().map(|&offset| (fading_gate(offset, radius_m), offset));
    let total: f64 = weighted().map(|(weight, _)| weight).sum();
    let centroid = weighted().map(|(weight, offset)| weight * offset).sum::<DVec3>() / total;
    let mut covariance = DMat3::ZERO;
    for (weight, offset) in weighted() {
        let d = offset - centroid;
        covariance += weight / total * DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let ([l0, l1, l2], [axis, ..]) = symmetric_eigen(covariance);
    if l1 <= DEGENERATE_RATIO * l2 {
        return None;
    }
    let normal = if axis.dot(from_sensor) > 0.0 { -axis } else { axis };
    Some(Plane {
        normal,
        foot: centroid.dot(normal) * normal,
        centroid,
        smallest_variance: l0.max(0.0),
        doubt: (l2 / (l1 - l0)).min(MAX_DOUBT),
        middle_variance: l1,
        largest_variance: l2,
        curvature: l0.max(0.0) / (l0 + l1 + l2),
        total,
    })
}
