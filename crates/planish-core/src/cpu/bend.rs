//! How the surface bends: within a window, and between the planes around a point (docs/method.md, section 10).
//!
//! A bend is a symmetric tensor H in 1/m: a surface with normal n is x·Hx/2 above its tangent plane, at an offset x along
//! it. Those of windows have six components in space, to be compared and averaged; that of a surface has three in the
//! plane's [`tangents`].

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::eigen::Symmetric;
use super::plane::Plane;
use super::vector::{Mask, Vec3, share, splat};
use super::window::{Candidates, Sums, Window};
use crate::constants::{
    BEND_DAMPING, BEND_SHARED, BEND_VARIANCE, LEAST_AREA, LEAST_BEND_NEIGHBOURS, LEAST_BEND_WEIGHT, LEAST_PLACES,
    LEAST_RISE, MOST_BEND, MOST_WINDOW_BEND, WINDOW_BEND_DAMPING,
};

/// Sums over one row of a window: of the weights times powers of the column, and of the weighted offsets times such.
struct RowSums<S: Simd> {
    powers: [S::f32s; 5],
    offsets: [Vec3<S>; 3],
}

/// Sums over the columns or rows of a window.
struct LineSums<S: Simd> {
    /// Of the weights times powers of the place.
    powers: [S::f32s; 5],
    /// Of the weighted offsets times the place, and times its square.
    offsets: [Vec3<S>; 2],
}

/// Sums over a window for its bend, beyond those for its plane. Places (i, j) are columns and rows from its centre.
pub(super) struct PlaceSums<S: Simd> {
    columns: LineSums<S>,
    rows: LineSums<S>,
    /// Of the weighted offsets times i j, and of the weights times i j and its square.
    mixed: Vec3<S>,
    mixed_weights: S::f32s,
    mixed_squares: S::f32s,
}

/// Computes all sums over a window of half width `half`.
#[inline(always)]
pub(super) fn sums<S: Simd>(
    simd: S,
    window: Window<'_>,
    p: Vec3<S>,
    radius: S::f32s,
    half: usize,
) -> (Sums<S>, PlaceSums<S>) {
    let (zero, none) = (splat(simd, 0.0), Vec3::splat(simd, 0.0));
    let mut sums = Sums::zero(simd);
    let line = || LineSums { powers: [zero; 5], offsets: [none; 2] };
    let mut places = PlaceSums { columns: line(), rows: line(), mixed: none, mixed_weights: zero, mixed_squares: zero };
    for row in 0..2 * half + 1 {
        let mut of_row = RowSums::<S> { powers: [zero; 5], offsets: [none; 3] };
        let mut i = -(half as f32);
        window.neighbours(
            simd,
            p,
            radius,
            row..row + 1,
            #[inline(always)]
            |e, weight, count| {
                let weighted = sums.add_squares(e, weight, count);
                let (first, second) = (splat(simd, i), splat(simd, i * i));
                of_row.powers[0] += weight;
                of_row.powers[1] = weight.mul_add(first, of_row.powers[1]);
                of_row.powers[2] = weight.mul_add(second, of_row.powers[2]);
                of_row.powers[3] = weight.mul_add(splat(simd, i * i * i), of_row.powers[3]);
                of_row.powers[4] = weight.mul_add(splat(simd, i * i * i * i), of_row.powers[4]);
                of_row.offsets[0] = of_row.offsets[0].add(weighted);
                of_row.offsets[1] = of_row.offsets[1].add_scaled(first, weighted);
                of_row.offsets[2] = of_row.offsets[2].add_scaled(second, weighted);
                i += 1.0;
            },
        );
        let j = row as f32 - half as f32;
        sums.total += of_row.powers[0];
        sums.e = sums.e.add(of_row.offsets[0]);
        places.add_row(simd, j, &of_row);
    }
    (sums, places)
}

impl<S: Simd> PlaceSums<S> {
    #[inline(always)]
    fn add_row(&mut self, simd: S, j: f32, row: &RowSums<S>) {
        let (first, second) = (splat(simd, j), splat(simd, j * j));
        let (third, fourth) = (splat(simd, j * j * j), splat(simd, j * j * j * j));
        let [weights, by_i, by_i2, by_i3, by_i4] = row.powers;
        let columns = &mut self.columns.powers;
        columns[0] += weights;
        columns[1] += by_i;
        columns[2] += by_i2;
        columns[3] += by_i3;
        columns[4] += by_i4;
        let rows = &mut self.rows.powers;
        rows[0] += weights;
        rows[1] = weights.mul_add(first, rows[1]);
        rows[2] = weights.mul_add(second, rows[2]);
        rows[3] = weights.mul_add(third, rows[3]);
        rows[4] = weights.mul_add(fourth, rows[4]);
        let [offsets, offsets_i, offsets_i2] = row.offsets;
        self.columns.offsets[0] = self.columns.offsets[0].add(offsets_i);
        self.columns.offsets[1] = self.columns.offsets[1].add(offsets_i2);
        self.rows.offsets[0] = self.rows.offsets[0].add_scaled(first, offsets);
        self.rows.offsets[1] = self.rows.offsets[1].add_scaled(second, offsets);
        self.mixed = self.mixed.add_scaled(first, offsets_i);
        self.mixed_weights = by_i.mul_add(first, self.mixed_weights);
        self.mixed_squares = by_i2.mul_add(second, self.mixed_squares);
    }

    /// Returns how the surface in a window of half width `half` bends.
    #[inline(always)]
    pub(super) fn bend(&self, simd: S, half: usize, radius: S::f32s, sums: &Sums<S>, plane: &Plane<S>) -> Symmetric<S> {
        let zero = splat(simd, 0.0);
        let whole = WholeWindow::new(half);
        let total = sums.total.max(splat(simd, f32::MIN_POSITIVE));
        let (columns, right) = self.columns.along(simd, &whole, total, sums.e, plane);
        let (rows, down) = self.rows.along(simd, &whole, total, sums.e, plane);
        let n = plane.normal;
        let heights = self.mixed.dot(n) - plane.height * self.mixed_weights;
        let mixed = heights / (self.mixed_squares + splat(simd, WINDOW_BEND_DAMPING * whole.mixed));
        let area = right.cross(down).dot(n);
        let least = radius * radius * splat(simd, LEAST_AREA);
        let bends: Mask<S> = area.abs().simd_gt(least) & sums.n.simd_ge(splat(simd, LEAST_BEND_NEIGHBOURS));
        let per_area = splat(simd, 1.0) / bends.select(area, splat(simd, 1.0));
        // Gradients of the place along the plane.
        let (c, r) = (down.cross(n).scale(per_area), n.cross(right).scale(per_area));
        let (cc, cr) = (c.scale(columns).add(r.scale(mixed)), c.scale(mixed).add(r.scale(rows)));
        let bend = Symmetric::<S> {
            xx: cc.x.mul_add(c.x, cr.x * r.x),
            xy: cc.x.mul_add(c.y, cr.x * r.y),
            xz: cc.x.mul_add(c.z, cr.x * r.z),
            yy: cc.y.mul_add(c.y, cr.y * r.y),
            yz: cc.y.mul_add(c.z, cr.y * r.z),
            zz: cc.z.mul_add(c.z, cr.z * r.z),
        };
        let size = bend.square().sqrt() * radius;
        let limit = splat(simd, MOST_WINDOW_BEND) / size.max(splat(simd, MOST_WINDOW_BEND));
        bend.scale(bends.select(limit, zero))
    }
}

/// Sums over a window in which every pixel counts 1.
struct WholeWindow {
    /// Mean of i².
    mean_square: f32,
    /// Of (i² - mean)².
    squares: f32,
    /// Of (i j)².
    mixed: f32,
}

impl WholeWindow {
    #[inline(always)]
    fn new(half: usize) -> Self {
        let half = half as f32;
        // Sums of i² and of i⁴ over a row.
        let second = half * (half + 1.0) * (2.0 * half + 1.0) / 3.0;
        let fourth = second * (3.0 * half * (half + 1.0) - 1.0) / 5.0;
        let side = 2.0 * half + 1.0;
        let mean_square = second / side;
        Self { mean_square, squares: side * fourth - second * second, mixed: second * second }
    }
}

impl<S: Simd> LineSums<S> {
    /// Returns the second derivative, by the place, of the distance from the plane, and the offset of one stride.
    #[inline(always)]
    fn along(&self, simd: S, whole: &WholeWindow, total: S::f32s, e: Vec3<S>, plane: &Plane<S>) -> (S::f32s, Vec3<S>) {
        let zero = splat(simd, 0.0);
        let [_, first, second, third, fourth] = self.powers;
        let [offsets, offsets_2] = self.offsets;
        let mean_square = splat(simd, whole.mean_square);
        let mean_place = first / total;
        // Of the places, of i² - mean, of its square, and of its product with i.
        let places = (second - mean_place * first).max(total * splat(simd, LEAST_PLACES));
        let square = second - mean_square * total;
        let squares = fourth - mean_square * (second + square);
        let both = third - mean_square * first - mean_place * square;
        let unexplained = (squares - square * square / total - both * both / places).max(zero)
            + splat(simd, WINDOW_BEND_DAMPING * whole.squares);
        let heights = (offsets_2.dot(plane.normal) - mean_square * e.dot(plane.normal)) - plane.height * square;
        let stride = offsets.add_scaled(-mean_place, e).scale(splat(simd, 1.0) / places);
        (heights * splat(simd, 2.0) / unexplained, stride)
    }
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
    fn add_scaled(&mut self, factor: S::f32s, other: &Self) {
        self.xx = factor.mul_add(other.xx, self.xx);
        self.xy = factor.mul_add(other.xy, self.xy);
        self.xz = factor.mul_add(other.xz, self.xz);
        self.yy = factor.mul_add(other.yy, self.yy);
        self.yz = factor.mul_add(other.yz, self.yz);
        self.zz = factor.mul_add(other.zz, self.zz);
    }

    #[inline(always)]
    fn scale(&self, factor: S::f32s) -> Self {
        Self {
            xx: self.xx * factor,
            xy: self.xy * factor,
            xz: self.xz * factor,
            yy: self.yy * factor,
            yz: self.yz * factor,
            zz: self.zz * factor,
        }
    }

    /// The sum of the squares of all entries.
    #[inline(always)]
    fn square(&self) -> S::f32s {
        let twice = self.xy.mul_add(self.xy, self.xz.mul_add(self.xz, self.yz * self.yz));
        self.xx.mul_add(self.xx, self.yy.mul_add(self.yy, self.zz.mul_add(self.zz, twice + twice)))
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

    #[inline(always)]
    pub(super) fn trace(&self) -> S::f32s {
        self.uu + self.vv
    }

    /// The sum of the squares of all entries.
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

    /// Returns the same tensor along other tangents, given those of this one.
    #[inline(always)]
    pub(super) fn turned(&self, (u, v): (Vec3<S>, Vec3<S>), (to_u, to_v): (Vec3<S>, Vec3<S>)) -> Self {
        let (uu, uv, vu, vv) = (to_u.dot(u), to_u.dot(v), to_v.dot(u), to_v.dot(v));
        let (x, y) = self.times(vu, vv);
        Self { uu: self.of(uu, uv), uv: uu.mul_add(x, uv * y), vv: self.of(vu, vv) }
    }
}

/// Weighted sums over the planes around a point.
pub(super) struct Around<S: Simd> {
    pub(super) total: S::f32s,
    /// Of the normals.
    pub(super) normal: Vec3<S>,
    /// Of the offsets x of their centroids from the point, and of x x^T.
    offset: Vec3<S>,
    offsets: Symmetric<S>,
    /// Of n x^T + x n^T, with the normals n.
    slopes: Symmetric<S>,
    /// Of the bends in their windows.
    windows: Symmetric<S>,
}

impl<S: Simd> Around<S> {
    #[inline(always)]
    pub(super) fn nothing(simd: S) -> Self {
        let (zero, none) = (splat(simd, 0.0), Vec3::splat(simd, 0.0));
        Self {
            total: zero,
            normal: none,
            offset: none,
            offsets: Symmetric::zero(simd),
            slopes: Symmetric::zero(simd),
            windows: Symmetric::zero(simd),
        }
    }

    /// Adds a plane at an offset x with a normal; only to the total and the normal if the bend is `KNOWN`.
    #[inline(always)]
    pub(super) fn add<const KNOWN: bool>(
        &mut self,
        weight: S::f32s,
        x: Vec3<S>,
        normal: Vec3<S>,
        window: &Symmetric<S>,
    ) {
        self.total += weight;
        let n = normal.scale(weight);
        self.normal = self.normal.add(n);
        if KNOWN {
            return;
        }
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
        self.windows.add_scaled(weight, window);
    }

    /// Returns the bend of the surface along the tangents `frame`, and the mean place of the planes along them.
    #[inline(always)]
    pub(super) fn bend(
        &self,
        simd: S,
        (u, v): (Vec3<S>, Vec3<S>),
        radius: S::f32s,
        noise: S::f32s,
    ) -> (Bend<S>, [S::f32s; 2]) {
        let (zero, one, tiny) = (splat(simd, 0.0), splat(simd, 1.0), splat(simd, f32::MIN_POSITIVE));
        let enough: Mask<S> = self.total.simd_gt(splat(simd, LEAST_BEND_WEIGHT));
        let per_total = enough.select(one / self.total.max(tiny), zero);
        // In units of the radius, whose square may be as small as 1e-24 m².
        let per_radius = one / radius;
        let scale = per_total * per_radius;
        // A plane's place, and its slope, the sine of its angle: on a circle the slope grows with the place by 1/r.
        let (t0, t1) = (self.offset.dot(u) * scale, self.offset.dot(v) * scale);
        let (s0, s1) = (-(self.normal.dot(u) * per_total), -(self.normal.dot(v) * per_total));
        let places = self.offsets.along(u, v).scale(scale * per_radius);
        let slopes = self.slopes.along(u, v).scale(scale);
        let damping = splat(simd, BEND_DAMPING);
        // The symmetric H that minimises the mean of |s - H t|² plus damping |H|², by Cramer's rule for
        // [[a, b, 0], [b, a + c, b], [0, b, c]] (uu, uv, vv) = (p, q, r).
        let a = (places.uu - t0 * t0).max(zero) + damping;
        let b = places.uv - t0 * t1;
        let c = (places.vv - t1 * t1).max(zero) + damping;
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
        let size = size_squared.sqrt();
        let within = self.windows.along(u, v).scale(radius * per_total);
        let product = bend.uu.mul_add(within.uu, bend.vv.mul_add(within.vv, bend.uv * (within.uv + within.uv)));
        let [from, to] = BEND_SHARED;
        let shared = product / size_squared.max(tiny);
        let shared = share(simd, (shared - splat(simd, from)) * splat(simd, 1.0 / (to - from)));
        let rise = size * radius / (noise * splat(simd, 8.0 * LEAST_RISE));
        let limit = (splat(simd, MOST_BEND) / size.max(tiny)).min(one);
        let factor = shared * share(simd, rise - one) * limit * per_radius;
        (bend.scale(enough.select(factor, zero)), [t0 * radius, t1 * radius])
    }
}

/// Returns the variance that a bend adds to a plane's points, whose variances along the plane sum to `spread`, in m².
#[inline(always)]
pub(super) fn variance<S: Simd>(simd: S, bend: &Bend<S>, spread: S::f32s) -> S::f32s {
    bend.square() * (spread * spread) * splat(simd, BEND_VARIANCE)
}
