//! Bending of the surface, within a window and between the planes around a point (docs/method.md, section 10).
//!
//! A bend is a symmetric tensor H in 1/m along the plane's [`tangents`](super::eigen::tangents): at an offset x along
//! its tangent plane, the surface is x·Hx/2 above that plane. For a window, only the trace of H is known.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::Kernel;
use super::eigen::Symmetric;
use super::plane::Plane;
use super::vector::{Mask, Vec3, rises, share, splat};
use super::window::{Candidates, Window};
use crate::constants::{
    BEND_DAMPING, BEND_EXPLAINED, BEND_SHARED, LEAST_BEND_WEIGHT, LEAST_SPREAD, LEAST_TURN, MOST_BEND, MOST_WINDOW_BEND,
};

/// Returns the sum of each window's principal curvatures in 1/m (docs/method.md, (10.13)). It is computed from the
/// mean height of the neighbours in the inner part of the window over the plane fitted to all neighbours.
#[inline(always)]
pub(super) fn of_window<S: Simd>(
    simd: S,
    (window, kernel): (Window<'_>, &Kernel),
    p: Vec3<S>,
    radius: S::f32s,
    plane: &Plane<S>,
) -> S::f32s {
    let middle = window.middle(kernel);
    let rows = Candidates::<S>::rows(&middle);
    let (mut total, mut height) = (splat(simd, 0.0), splat(simd, 0.0));
    middle.neighbours(
        simd,
        p,
        radius,
        0..rows,
        &mut vec![(); rows * rows],
        #[inline(always)]
        |(), e, weight, _| {
            total += weight;
            height = weight.mul_add(e.dot(plane.normal) - plane.height, height);
        },
    );
    let spread = plane.spread.max(radius * radius * splat(simd, LEAST_SPREAD));
    let bend =
        height * splat(simd, -4.0 / (1.0 - kernel.offsets.middle_share)) / (total.max(splat(simd, 1.0)) * spread);
    let most = splat(simd, MOST_WINDOW_BEND) / radius;
    bend.max(-most).min(most)
}

/// The bend of a surface along its plane's tangents, in 1/m.
pub(super) struct Bend<S: Simd> {
    pub(super) uu: S::f32s,
    pub(super) uv: S::f32s,
    pub(super) vv: S::f32s,
}

impl<S: Simd> Clone for Bend<S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Bend<S> {}

impl<S: Simd> Symmetric<S> {
    #[inline(always)]
    pub(super) fn zero(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        Self { xx: zero, xy: zero, xz: zero, yy: zero, yz: zero, zz: zero }
    }

    #[inline(always)]
    fn along(&self, u: Vec3<S>, v: Vec3<S>) -> Bend<S> {
        let (by_u, by_v) = (self.times(u), self.times(v));
        Bend { uu: u.dot(by_u), uv: u.dot(by_v), vv: v.dot(by_v) }
    }
}

impl<S: Simd> Bend<S> {
    #[inline(always)]
    pub(super) fn none(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        Self { uu: zero, uv: zero, vv: zero }
    }

    #[inline(always)]
    pub(super) fn scale(self, factor: S::f32s) -> Self {
        Self { uu: self.uu * factor, uv: self.uv * factor, vv: self.vv * factor }
    }

    /// Returns the bend in lanes where `counts` is true, and zero elsewhere.
    #[inline(always)]
    pub(super) fn or_none(self, simd: S, counts: Mask<S>) -> Self {
        let zero = splat(simd, 0.0);
        Self { uu: counts.select(self.uu, zero), uv: counts.select(self.uv, zero), vv: counts.select(self.vv, zero) }
    }

    #[inline(always)]
    pub(super) fn trace(&self) -> S::f32s {
        self.uu + self.vv
    }

    /// Returns the sum of the squares of all entries.
    #[inline(always)]
    pub(super) fn square(&self) -> S::f32s {
        self.uu.mul_add(self.uu, self.vv.mul_add(self.vv, self.uv * (self.uv + self.uv)))
    }

    /// Returns H (a, b).
    #[inline(always)]
    pub(super) fn times(&self, a: S::f32s, b: S::f32s) -> (S::f32s, S::f32s) {
        (self.uu.mul_add(a, self.uv * b), self.uv.mul_add(a, self.vv * b))
    }

    /// Returns (a, b)·H (a, b).
    #[inline(always)]
    pub(super) fn of(&self, a: S::f32s, b: S::f32s) -> S::f32s {
        let (x, y) = self.times(a, b);
        x.mul_add(a, y * b)
    }

    /// Converts the tensor from the tangents `(u, v)` to the tangents `(to_u, to_v)`.
    #[inline(always)]
    pub(super) fn turned(&self, (u, v): (Vec3<S>, Vec3<S>), (to_u, to_v): (Vec3<S>, Vec3<S>)) -> Self {
        let (uu, uv, vu, vv) = (to_u.dot(u), to_u.dot(v), to_v.dot(u), to_v.dot(v));
        let (x, y) = self.times(vu, vv);
        Self { uu: self.of(uu, uv), uv: uu.mul_add(x, uv * y), vv: self.of(vu, vv) }
    }
}

/// Weighted sums over the planes around a point, from which the bend between the planes is computed.
pub(super) struct Around<S: Simd> {
    /// Sum of x, the offset of a plane's centroid from the point.
    offset: Vec3<S>,
    /// Sum of x x^T.
    offsets: Symmetric<S>,
    /// Sum of n x^T + x n^T, where n is the normal.
    slopes: Symmetric<S>,
    /// Sum of the bends measured within each plane's window.
    windows: S::f32s,
    /// Sum of the planes' spreads, in m².
    spreads: S::f32s,
}

/// The bend measured between the planes around a point, along the tangents of their mean normal.
pub(super) struct Measured<S: Simd> {
    pub(super) bend: Bend<S>,
    /// Mean position of the planes along the tangents, in metres. The mean normal is the normal at this position.
    pub(super) centre: [S::f32s; 2],
    /// Weighted sum, over the planes, of the bent surface's height at the point above each plane, in metres.
    pub(super) rise: S::f32s,
}

/// Variation of the normals of the planes around a point.
pub(super) struct Turn<S: Simd> {
    per_total: S::f32s,
    mean_normal: Vec3<S>,
    /// The variance of the normals.
    pub(super) variance: S::f32s,
    /// Degree to which the variance exceeds that caused by noise, from 0 to 1.
    pub(super) certain: S::f32s,
}

impl<S: Simd> Turn<S> {
    /// Computes the variation from the sums of the weights and of the normals.
    #[inline(always)]
    pub(super) fn new(simd: S, total: S::f32s, normals: Vec3<S>, radius: S::f32s, noise: S::f32s) -> Self {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let enough: Mask<S> = total.simd_gt(splat(simd, LEAST_BEND_WEIGHT));
        let per_total = enough.select(one / enough.select(total, one), zero);
        let mean_normal = normals.scale(per_total);
        let variance = enough.select((one - mean_normal.dot(mean_normal)).max(zero), zero);
        let turns = variance.sqrt() * radius / (noise * splat(simd, LEAST_TURN));
        Self { per_total, mean_normal, variance, certain: share(simd, turns - one) }
    }
}

impl<S: Simd> Around<S> {
    #[inline(always)]
    pub(super) fn nothing(simd: S) -> Self {
        let (zero, none) = (splat(simd, 0.0), Vec3::splat(simd, 0.0));
        Self {
            offset: none,
            offsets: Symmetric::zero(simd),
            slopes: Symmetric::zero(simd),
            windows: zero,
            spreads: zero,
        }
    }

    /// Adds a plane with its centroid at offset x, its spread and the bend of its window.
    #[inline(always)]
    pub(super) fn add(
        &mut self,
        weight: S::f32s,
        x: Vec3<S>,
        normal: Vec3<S>,
        (spread, window_bend): (S::f32s, S::f32s),
    ) {
        let n = normal.scale(weight);
        let wx = x.scale(weight);
        self.offset = self.offset.add(wx);
        let (sums, slopes) = (&mut self.offsets, &mut self.slopes);
        sums.xx = wx.x.mul_add(x.x, sums.xx);
        sums.xy = wx.x.mul_add(x.y, sums.xy);
        sums.xz = wx.x.mul_add(x.z, sums.xz);
        sums.yy = wx.y.mul_add(x.y, sums.yy);
        sums.yz = wx.y.mul_add(x.z, sums.yz);
        sums.zz = wx.z.mul_add(x.z, sums.zz);
        slopes.xx = n.x.mul_add(x.x + x.x, slopes.xx);
        slopes.xy = n.x.mul_add(x.y, n.y.mul_add(x.x, slopes.xy));
        slopes.xz = n.x.mul_add(x.z, n.z.mul_add(x.x, slopes.xz));
        slopes.yy = n.y.mul_add(x.y + x.y, slopes.yy);
        slopes.yz = n.y.mul_add(x.z, n.z.mul_add(x.y, slopes.yz));
        slopes.zz = n.z.mul_add(x.z + x.z, slopes.zz);
        self.windows = weight.mul_add(window_bend, self.windows);
        self.spreads = weight.mul_add(spread, self.spreads);
    }

    /// Returns the bend of the surface along the tangents of the normal.
    #[inline(always)]
    pub(super) fn bend(&self, simd: S, turn: &Turn<S>, (u, v): (Vec3<S>, Vec3<S>), radius: S::f32s) -> Measured<S> {
        let (zero, one, tiny) = (splat(simd, 0.0), splat(simd, 1.0), splat(simd, f32::MIN_POSITIVE));
        let per_total = turn.per_total;
        // Lengths are in units of the radius, since its square may be as small as 1e-24 m².
        let per_radius = one / radius;
        let scale = per_total * per_radius;
        // The mean position t and the mean slope s of the planes. A slope is the sine of an angle; on a circle of
        // radius r, it changes by 1/r per unit of position.
        let (t0, t1) = (self.offset.dot(u) * scale, self.offset.dot(v) * scale);
        let (s0, s1) = (-turn.mean_normal.dot(u), -turn.mean_normal.dot(v));
        let squares: Bend<S> = self.offsets.along(u, v);
        let places = squares.scale(scale * per_radius);
        let slopes = self.slopes.along(u, v).scale(scale);
        let damping = splat(simd, BEND_DAMPING);
        // The symmetric H that minimises the mean of |s - H t|² plus damping |H|², by Cramer's rule for
        // [[a, b, 0], [b, a + c, b], [0, b, c]] (uu, uv, vv) = (p, q, r).
        let (var_0, var_1) = ((places.uu - t0 * t0).max(zero), (places.vv - t1 * t1).max(zero));
        let (a, b, c) = (var_0 + damping, places.uv - t0 * t1, var_1 + damping);
        let p = -(slopes.uu * splat(simd, 0.5)) - s0 * t0;
        let q = -slopes.uv - s0 * t1 - s1 * t0;
        let r = -(slopes.vv * splat(simd, 0.5)) - s1 * t1;
        let (bb, sum) = (b * b, a + c);
        let per_determinant = one / (sum * (a * c - bb));
        // H times the radius.
        let bend = Bend::<S> {
            uu: ((sum * c - bb) * p - b * c * q + bb * r) * per_determinant,
            uv: (a * c * q - b * c * p - a * b * r) * per_determinant,
            vv: (bb * p - a * b * q + (sum * a - bb) * r) * per_determinant,
        };
        let size_squared: S::f32s = bend.square();
        // Covariance of H t with the slopes, and the variance of H t.
        let with_slopes = bend.uu.mul_add(p, bend.uv.mul_add(q, bend.vv * r));
        let across = bend.uv * bend.trace() * (b + b);
        let of_places = bend.uu * bend.uu * var_0 + bend.uv * bend.uv * (var_0 + var_1) + bend.vv * bend.vv * var_1;
        let explained = with_slopes * with_slopes / ((of_places + across) * turn.variance).max(tiny);
        let trace = bend.trace();
        let within = self.windows * (radius * per_total);
        let shared = within * trace / (trace * trace).max(size_squared * splat(simd, 0.5)).max(tiny);
        let limit = (splat(simd, MOST_BEND) / size_squared.sqrt().max(tiny)).min(one);
        let counts = turn.certain * rises(simd, explained, BEND_EXPLAINED) * rises(simd, shared, BEND_SHARED);
        let bend = bend.scale(counts * limit * per_radius);
        let twice = bend.uu.mul_add(squares.uu, bend.vv.mul_add(squares.vv, bend.uv * (squares.uv + squares.uv)));
        let rise = twice * splat(simd, 0.5) - self.spreads * bend.trace() * splat(simd, 0.25);
        Measured { bend, centre: [t0 * radius, t1 * radius], rise }
    }
}
