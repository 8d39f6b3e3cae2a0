//! Fits the plane of a neighbourhood by principal component analysis (docs/method.md, section 4).
//!
//! Lengths are in metres, relative to the point p being smoothed.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::bend::Bend;
use super::eigen::{Symmetric, smallest_eigenvector};
use super::vector::{Mask, Vec3, splat};
use super::window::Sums;
use crate::constants::{DEGENERATE_RATIO, MAX_DOUBT};

pub(super) struct Plane<S: Simd> {
    /// Unit normal, towards the sensor.
    pub(super) normal: Vec3<S>,
    /// Height of the plane over p along the normal, c·n, in metres.
    pub(super) height: S::f32s,
    /// The mean of the neighbours, c.
    pub(super) centroid: Vec3<S>,
    /// The sum of the variances along the plane, l1 + l2, in m².
    pub(super) spread: S::f32s,
    /// Variance along the normal, l0, in m².
    pub(super) residual: S::f32s,
    /// Uncertainty of the normal, l2/(l1 - l0), at most [`MAX_DOUBT`].
    pub(super) doubt: S::f32s,
    /// Four times the largest variance, 4 l2, in m²: the square of the neighbourhood's in-plane extent.
    pub(super) extent_squared: S::f32s,
    /// Surface variation l0/(l0+l1+l2).
    pub(super) curvature: S::f32s,
    /// Excess of l1 over its limit for a line, relative to the limit: l1/(1e-4 l2) - 1.
    pub(super) off_line: S::f32s,
    /// True if the neighbours lie on a line; the other fields are then meaningless.
    pub(super) degenerate: Mask<S>,
}

/// Points to be smoothed, one per lane.
#[derive(Clone, Copy)]
pub(super) struct Points<S: Simd> {
    pub(super) p: Vec3<S>,
    /// Ray from the sensor to p.
    pub(super) ray: Vec3<S>,
    /// Radius of the neighbourhood of p, in metres.
    pub(super) radius: S::f32s,
    /// False for holes.
    pub(super) valid: Mask<S>,
}

/// The surface that points lie on.
pub(super) struct Surface<S: Simd> {
    pub(super) plane: Plane<S>,
    /// The number of neighbours.
    pub(super) n: S::f32s,
    /// Distance from the plane within which neighbours count, in metres; infinite without a plane, `None` if edges
    /// are not kept.
    pub(super) width: Option<S::f32s>,
    /// Bend along the tangents of the plane's normal; `None` for a flat surface.
    pub(super) bend: Option<Bend<S>>,
    /// Degree to which no plane around the point fits, from 0 to 1; `None` if planes fit everywhere, or edges are not
    /// kept.
    pub(super) no_plane_fits: Option<S::f32s>,
}

/// Fits planes to the neighbours of points; `ray` leads from the sensor to p.
// Not inlined in web builds, which makes them smaller.
#[cfg_attr(target_family = "wasm", inline(never))]
#[cfg_attr(not(target_family = "wasm"), inline(always))]
pub(super) fn fit<S: Simd>(simd: S, ray: Vec3<S>, sums: &Sums<S>) -> Plane<S> {
    let inverse_total = splat(simd, 1.0) / sums.total.max(splat(simd, f32::MIN_POSITIVE));
    let c = sums.e.scale(inverse_total);
    let matrix = Symmetric {
        xx: covariance(sums.xx, inverse_total, c.x, c.x),
        xy: covariance(sums.xy, inverse_total, c.x, c.y),
        xz: covariance(sums.xz, inverse_total, c.x, c.z),
        yy: covariance(sums.yy, inverse_total, c.y, c.y),
        yz: covariance(sums.yz, inverse_total, c.y, c.z),
        zz: covariance(sums.zz, inverse_total, c.z, c.z),
    };
    let eigen = smallest_eigenvector(simd, &matrix);
    let [l0, l1, l2] = eigen.values;
    let residual = l0.max(splat(simd, 0.0));
    let curvature = residual / (l0 + l1 + l2).max(splat(simd, f32::MIN_POSITIVE));
    let line = l2 * splat(simd, DEGENERATE_RATIO);
    let degenerate = l1.simd_le(line);
    let off_line = l1 / line.max(splat(simd, f32::MIN_POSITIVE)) - splat(simd, 1.0);
    let away: Mask<S> = eigen.vector.dot(ray).simd_gt(splat(simd, 0.0));
    let normal = eigen.vector.scale(away.select(splat(simd, -1.0), splat(simd, 1.0)));
    let doubt = (l2 / (l1 - residual).max(splat(simd, f32::MIN_POSITIVE))).min(splat(simd, MAX_DOUBT));
    let extent_squared = l2 * splat(simd, 4.0);
    Plane {
        normal,
        height: c.dot(normal),
        centroid: c,
        spread: l1 + l2,
        residual,
        doubt,
        extent_squared,
        curvature,
        off_line,
        degenerate,
    }
}

/// Returns the mean of a product minus the product of the means. Both scale with the neighbourhood, so little
/// precision is lost to cancellation.
#[inline(always)]
fn covariance<V: SimdFloat<S>, S: Simd>(product_sum: V, inverse_total: V, mean_a: V, mean_b: V) -> V {
    product_sum.mul_add(inverse_total, -(mean_a * mean_b))
}
