//! The mean of the surfaces that the pixels of a block have found (docs/method.md, section 10): one pass keeps the
//! results of all pixels in place of their surfaces, another moves each onto the mean of those around it.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::{BEND, FirstPlanes, HEIGHT, NO_PLANE_FITS, NORMAL, SurfaceRows, Surfaces, WIDTH};
use crate::constants::{ALIKE, AROUND, LEAST_AVERAGED, MAX_ALONG, MEAN_WIDTH, NARROW_WIDTH};
use crate::cpu::Kernel;
use crate::cpu::output::OutputRows;
use crate::cpu::padded::PaddedFrame;
use crate::cpu::plane::{Points, Surface};
use crate::cpu::project::{Projected, along_ray};
use crate::cpu::row_tasks::SplitRows;
use crate::cpu::valid_points;
use crate::cpu::vector::{Mask, Vec3, rises, splat};
use crate::range::MAX_RANGE_M;

// Results, in the channels of surfaces. WIDTH stays. A point without a normal has a normal of 0 and thus no weight.
const RESULT_NORMAL: usize = NORMAL;
const DEPTH_SCALE: usize = HEIGHT;
const RESULT_POINT: usize = BEND;
const STATUS: usize = NO_PLANE_FITS;

/// The least status code of points with a normal.
const PLANE: f32 = 3.0;

impl SurfaceRows<'_> {
    /// Keeps results in place of the surfaces from column u of the `row`-th of these rows on.
    #[inline(always)]
    pub(in crate::cpu) fn keep<S: Simd>(&mut self, simd: S, (u, row): (usize, usize), projected: &Projected<S>) {
        let at = self.index(row, u);
        let zero = Vec3::splat(simd, 0.0);
        let has_normal: Mask<S> = projected.status.simd_ge(splat(simd, PLANE));
        let Vec3 { x, y, z } = projected.point.or(has_normal, zero);
        // Sums over points must stay finite.
        let (least, most) = (splat(simd, -MAX_RANGE_M), splat(simd, MAX_RANGE_M));
        let point: Vec3<S> = Vec3::new(x.max(least).min(most), y.max(least).min(most), z.max(least).min(most));
        self.store_vector(RESULT_NORMAL, at, projected.normal.or(has_normal, zero));
        self.store_vector(RESULT_POINT, at, point);
        self.store::<S>(DEPTH_SCALE, at, projected.depth_scale);
        self.store::<S>(STATUS, at, projected.status);
    }

    /// Keeps holes.
    #[inline(always)]
    pub(in crate::cpu) fn keep_holes<S: Simd>(&mut self, simd: S, (u, row): (usize, usize)) {
        let at = self.index(row, u);
        self.store_vector(RESULT_NORMAL, at, Vec3::splat(simd, 0.0));
        self.store_vector(RESULT_POINT, at, Vec3::splat(simd, 0.0));
    }
}

/// Moves the kept results of some rows onto the means of the surfaces around them.
#[inline(always)]
pub(in crate::cpu) fn average_surfaces<S: Simd>(
    simd: S,
    measured: &PaddedFrame,
    (first_planes, surfaces): (&FirstPlanes, &Surfaces),
    kernel: &Kernel,
    rows: &mut OutputRows<'_>,
) {
    for row in 0..rows.count() {
        for u in (0..rows.width).step_by(S::f32s::LEN) {
            let here = measured.index(u, rows.first + row);
            let p = measured.load(simd, here);
            let valid = valid_points(simd, p);
            if !valid.any_true() {
                rows.store_holes(row, u, S::f32s::LEN);
                continue;
            }
            let ray = kernel.sensor.ray(simd, p);
            let n = valid.select(first_planes.count(simd, here).abs(), splat(simd, 0.0));
            let radius = kernel.rules.radius(simd, kernel.range(simd, ray));
            let projected = surfaces.on_mean(simd, kernel, here, Points { p, ray, radius, valid }, n);
            let plane = first_planes.plane(simd, here);
            let surface = Surface { plane, n, width: None, bend: None, no_plane_fits: None };
            rows.store(row, u, kernel.sensor.depth(simd, ray), &projected, &surface);
        }
    }
}

/// Weighted sums over surfaces around points: offsets, normals, and heights over the points.
struct Around<S: Simd> {
    total: S::f32s,
    offset: Vec3<S>,
    normal: Vec3<S>,
    height: S::f32s,
}

impl Surfaces {
    /// Moves the results from an index on, of points with n neighbours.
    #[inline(always)]
    fn on_mean<S: Simd>(&self, simd: S, kernel: &Kernel, here: usize, points: Points<S>, n: S::f32s) -> Projected<S> {
        let Points { p, ray, radius, valid } = points;
        let planes = &self.planes;
        let point = planes.vector(simd, RESULT_POINT, here);
        let status = planes.load(simd, STATUS, here);
        let has_normal: Mask<S> = valid & status.simd_ge(splat(simd, PLANE));
        let Around { total, offset, normal, height } = self.around_result(simd, kernel.block_half, here, point);
        let one = splat(simd, 1.0);
        let normal = normal.scale(one / normal.dot(normal).sqrt());
        let bend = offset.dot(normal) - height;
        // Half the width of a block gives this many places of one colour.
        let places = 2 * kernel.block_half * (kernel.block_half + 1) + 1;
        let around = rises(simd, total * splat(simd, 1.0 / places as f32), AROUND);
        let height = (around * splat(simd, 0.5)).mul_add(bend, height) / total;
        let along = along_ray(simd, height, normal, ray, radius);
        let moved = if kernel.on_ray { point.add_scaled(along, ray) } else { point.add_scaled(height, normal) };
        let own_normal = planes.vector(simd, RESULT_NORMAL, here);
        // Both steps together stay within the limits of one. False for a NaN.
        let displacement = moved.sub(p);
        let limit = radius.min(ray.dot(ray).sqrt() * splat(simd, MAX_ALONG));
        let within: Mask<S> = displacement.dot(displacement).simd_le(limit * limit);
        let moves = within & n.simd_ge(splat(simd, LEAST_AVERAGED));
        let away: Mask<S> = normal.dot(ray).simd_gt(splat(simd, 0.0));
        let normal = normal.scale(away.select(-one, one)).or(moves, own_normal);
        let near: Mask<S> = point.dot(point).simd_lt(splat(simd, MAX_RANGE_M * MAX_RANGE_M));
        let point = moved.or(moves, point.or(near, p));
        let nan = Vec3::splat(simd, f32::NAN);
        let degenerate: Mask<S> = valid & status.simd_eq(splat(simd, 2.0));
        let depth_scale = planes.load(simd, DEPTH_SCALE, here);
        Projected {
            point: point.or(has_normal, p.or(degenerate, nan)),
            normal: normal.or(has_normal, nan),
            status: valid.select(status, splat(simd, 0.0)),
            depth_scale: (has_normal & moves).select(depth_scale + along, depth_scale),
        }
    }

    /// Sums over the surfaces of a block that have the colour of its centre on a chessboard.
    #[inline(always)]
    fn around_result<S: Simd>(&self, simd: S, half: usize, here: usize, point: Vec3<S>) -> Around<S> {
        let (planes, zero, one) = (&self.planes, splat(simd, 0.0), splat(simd, 1.0));
        let own_normal = planes.vector(simd, RESULT_NORMAL, here);
        let per_width = splat(simd, NARROW_WIDTH / MEAN_WIDTH) / planes.load(simd, WIDTH, here);
        let none = Vec3::splat(simd, 0.0);
        let mut around = Around { total: zero, offset: none, normal: none, height: zero };
        for row in 0..=2 * half {
            let first = here + row * planes.row_len - half * (planes.row_len + 1);
            for column in (row % 2..=2 * half).step_by(2) {
                let at = first + column;
                let normal = planes.vector(simd, RESULT_NORMAL, at);
                let offset = planes.vector(simd, RESULT_POINT, at).sub(point);
                let height = offset.dot(normal);
                let widths = height * per_width;
                let near = (-widths).mul_add(widths, one).max(zero);
                let cosine = own_normal.dot(normal);
                let weight = near * rises(simd, cosine.abs(), ALIKE);
                // Rounding decides which side of a surface seen edge-on faces the sensor.
                let signed = weight.copysign(cosine);
                around.total += weight;
                around.height = signed.mul_add(height, around.height);
                around.offset = around.offset.add_scaled(weight, offset);
                around.normal = around.normal.add_scaled(signed, normal);
            }
        }
        around
    }
}
