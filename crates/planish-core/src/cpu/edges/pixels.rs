//! Derives the results of pixels from the surfaces of the cells around them (docs/method.md, section 10). One pass
//! keeps the results of the cells' points in place of their surfaces; another derives each pixel's surface from them.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::{BEND, CERTAINTY, HEIGHT, NORMAL, SurfaceRows, Surfaces, WIDTH, noise};
use crate::constants::{
    AGREEING, ALIKE, AROUND, LEAST_CERTAINTY, LEAST_MEANS, LEAST_NORMAL, LEAST_RAY_M, LEAST_SIDE, LEAST_SURFACE_WEIGHT,
    MAX_ALONG, MEAN_STAY, MEAN_WIDTH, SIDE_COSINE, STAY_WEIGHT,
};
use crate::cpu::Kernel;
use crate::cpu::channels::MAX_LANES;
use crate::cpu::output::OutputRows;
use crate::cpu::padded::PaddedFrame;
use crate::cpu::pixels::{CELL_PX, EVEN, ODD, Pixels};
use crate::cpu::plane::{Points, Surface};
use crate::cpu::project::{Projected, along_ray};
use crate::cpu::row_tasks::SplitRows;
use crate::cpu::valid_points;
use crate::cpu::vector::{Mask, Vec3, rises, splat};
use crate::cpu::window::Gate;
use crate::range::MAX_RANGE_M;

// Results of cells, in the channels of surfaces. A point without a normal gets a zero normal and thus no weight.
const RESULT_NORMAL: usize = NORMAL;
/// The status plus [`CODES`] times the number of neighbours.
const CODE: usize = HEIGHT;
const CURVATURE: usize = WIDTH;
const RESULT_POINT: usize = BEND;

/// Factor of the number of neighbours in [`CODE`]; larger than any status of a cell's point (0 to 5).
const CODES: f32 = 8.0;
/// Code of the status `Degenerate`: collinear neighbours.
const DEGENERATE: f32 = 2.0;
/// Code of the status `Plane`, the smallest code of a status with a normal.
const PLANE: f32 = 3.0;

/// The cells around a pixel along an axis: each cell's offset from the pixel's own cell, and its share, which falls
/// linearly to 0 at a distance of four pixels. The first entry is for a pixel at the start of its cell, the second for
/// one at the end.
const SHARES: [&[(isize, f32)]; CELL_PX] =
    [&[(-1, 0.5), (0, 1.0), (1, 0.5)], &[(-1, 0.25), (0, 0.75), (1, 0.75), (2, 0.25)]];
/// Like [`SHARES`], for finding the surface of the pixel's point: the shares fall to 0 at a distance of three pixels.
const FIND_SHARES: [&[(isize, f32)]; CELL_PX] =
    [&[(-1, 1.0 / 3.0), (0, 1.0), (1, 1.0 / 3.0)], &[(0, 2.0 / 3.0), (1, 2.0 / 3.0)]];
/// Sum of the products of row and column [`SHARES`].
const ALL_SHARES: f32 = 4.0;
/// Like [`SHARES`], for averaging block means: the shares fall to 0 at a distance of two pixels.
const MEAN_SHARES: [&[(isize, f32)]; CELL_PX] = [&[(0, 1.0)], &[(0, 0.5), (1, 0.5)]];

impl SurfaceRows<'_> {
    /// Stores results in place of the vector of surfaces that starts at column u of row `row` in this band.
    #[inline(always)]
    pub(in crate::cpu) fn keep<S: Simd>(
        &mut self,
        simd: S,
        (u, row): (usize, usize),
        projected: &Projected<S>,
        surface: &Surface<S>,
    ) {
        let at = self.index(row, u);
        let zero = Vec3::splat(simd, 0.0);
        let has_normal: Mask<S> = projected.status.simd_ge(splat(simd, PLANE));
        let Vec3 { x, y, z } = projected.point.or(has_normal, zero);
        // Sums over points must stay finite.
        let (least, most) = (splat(simd, -MAX_RANGE_M), splat(simd, MAX_RANGE_M));
        let point: Vec3<S> = Vec3::new(x.max(least).min(most), y.max(least).min(most), z.max(least).min(most));
        self.store_vector(RESULT_NORMAL, at, projected.normal.or(has_normal, zero));
        self.store_vector(RESULT_POINT, at, point);
        self.store::<S>(CODE, at, surface.n.mul_add(splat(simd, CODES), projected.status));
        self.store::<S>(CURVATURE, at, surface.plane.curvature);
    }

    /// Stores holes in place of the vector of surfaces that starts at column u of row `row` in this band.
    #[inline(always)]
    pub(in crate::cpu) fn keep_holes<S: Simd>(&mut self, simd: S, (u, row): (usize, usize)) {
        let at = self.index(row, u);
        let zero = Vec3::<S>::splat(simd, 0.0);
        self.store_vector(RESULT_NORMAL, at, zero);
        self.store_vector(RESULT_POINT, at, zero);
        self.store::<S>(CODE, at, zero.x);
    }
}

/// Input of the pixel pass.
#[derive(Clone, Copy)]
pub(in crate::cpu) struct Found<'a> {
    pub(in crate::cpu) pixels: &'a Pixels,
    /// The points of the cells.
    pub(in crate::cpu) cells: &'a PaddedFrame,
    /// Block means, if blocks are averaged.
    pub(in crate::cpu) means: Option<&'a PaddedFrame>,
    pub(in crate::cpu) surfaces: &'a Surfaces,
}

/// Writes the results of some rows of pixels.
#[inline(always)]
pub(in crate::cpu) fn results_of_pixels<S: Simd>(
    simd: S,
    found: Found<'_>,
    kernel: &Kernel,
    rows: &mut OutputRows<'_>,
) {
    for row in 0..rows.count() {
        let v = rows.first + row;
        for u in (0..rows.width.div_ceil(CELL_PX)).step_by(S::f32s::LEN) {
            let even = result_of_column(simd, found, kernel, (u, v), 0);
            let odd = result_of_column(simd, found, kernel, (u, v), 1);
            let [first, second] = PixelResults::interleave(even, odd);
            for (column, results) in [(CELL_PX * u, first), (CELL_PX * u + S::f32s::LEN, second)] {
                if column < rows.width {
                    rows.store(row, column, &results.projected, [results.depth, results.curvature, results.n]);
                }
            }
        }
    }
}

/// The results of a vector of pixels.
struct PixelResults<S: Simd> {
    projected: Projected<S>,
    depth: S::f32s,
    curvature: S::f32s,
    n: S::f32s,
}

impl<S: Simd> PixelResults<S> {
    #[inline(always)]
    fn holes(simd: S) -> Self {
        let (zero, nan) = (splat(simd, 0.0), splat(simd, f32::NAN));
        let none = Vec3::new(nan, nan, nan);
        let projected = Projected { point: none, normal: none, status: zero, depth_scale: nan };
        Self { projected, depth: nan, curvature: nan, n: zero }
    }

    /// Interleaves the results of even and odd columns into image order.
    #[inline(always)]
    fn interleave(even: Self, odd: Self) -> [Self; 2] {
        let [point, points] = Vec3::interleave(even.projected.point, odd.projected.point);
        let [normal, normals] = Vec3::interleave(even.projected.normal, odd.projected.normal);
        let (status, statuses) = even.projected.status.interleave(odd.projected.status);
        let (depth_scale, depth_scales) = even.projected.depth_scale.interleave(odd.projected.depth_scale);
        let (depth, depths) = even.depth.interleave(odd.depth);
        let (curvature, curvatures) = even.curvature.interleave(odd.curvature);
        let (n, ns) = even.n.interleave(odd.n);
        [
            Self { projected: Projected { point, normal, status, depth_scale }, depth, curvature, n },
            Self {
                projected: Projected { point: points, normal: normals, status: statuses, depth_scale: depth_scales },
                depth: depths,
                curvature: curvatures,
                n: ns,
            },
        ]
    }
}

/// Returns the results of a vector of pixels in row v, one pixel per cell, starting at cell column u. `column` selects
/// the first (0) or second (1) column of each cell.
// Inlining propagates the constant `column`; web builds do not inline it, because a single copy is smaller.
#[cfg_attr(target_family = "wasm", inline(never))]
#[cfg_attr(not(target_family = "wasm"), inline(always))]
fn result_of_column<S: Simd>(
    simd: S,
    found: Found<'_>,
    kernel: &Kernel,
    (u, v): (usize, usize),
    column: usize,
) -> PixelResults<S> {
    let Found { pixels, cells, surfaces, .. } = found;
    let p = pixels.load(simd, if column == 0 { EVEN } else { ODD }, pixels.index(u, v));
    let valid = valid_points(simd, p);
    if !valid.any_true() {
        return PixelResults::holes(simd);
    }
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let ray = kernel.sensor.ray(simd, p);
    let range = kernel.range(simd, ray);
    let radius = kernel.rules.radius(simd, range);
    let noise = noise(simd, &kernel.rules, range, radius);
    let points = Points { p, ray, radius, valid };
    let cell = cells.index(u, v / CELL_PX);
    let around = |shares: [&'static [(isize, f32)]; CELL_PX]| Around {
        cell,
        rows: shares[v % CELL_PX],
        columns: shares[column],
    };
    let to_mean = found.offset_to_mean(simd, kernel, cell, p, range, (column, v % CELL_PX));
    let Voted { total, certain, normal, height, best, code, curvature } =
        surfaces.surface_of(simd, around(FIND_SHARES), points, to_mean, noise);
    let on_one: Mask<S> = total.simd_gt(splat(simd, LEAST_SURFACE_WEIGHT));
    // The normal is divided by the total, so that its square does not underflow.
    let normal = normal.scale(one / on_one.select(total, one));
    let square = on_one.select(normal.dot(normal), one);
    // Normals of equal surfaces that face opposite sides cancel.
    let vague: Mask<S> = square.simd_lt(splat(simd, LEAST_NORMAL * LEAST_NORMAL));
    let normal = if vague.any_true() {
        let mut distances = [0.0; MAX_LANES];
        best.store_slice(&mut distances[..S::f32s::LEN]);
        let [x, y, z] = surfaces.normals_at(cell, &distances[..S::f32s::LEN]).map(
            #[inline(always)]
            |values| S::f32s::from_slice(simd, &values[..S::f32s::LEN]),
        );
        Vec3::new(x, y, z).or(vague, normal)
    } else {
        normal
    };
    let (agreeing, length) = (square.sqrt(), vague.select(one, square.sqrt()));
    let agreeing = (agreeing * splat(simd, 1.0 / AGREEING)).min(one);
    let trust = agreeing * agreeing;
    let height = height * trust / certain.max(splat(simd, f32::MIN_POSITIVE));
    let normal = normal.scale(one / length);
    let along = along_ray(simd, height, normal, ray, radius);
    let first = step(kernel, along, ray, height, normal);
    let mean = surfaces.mean_around(simd, around(SHARES), p.add(first), normal, noise);
    let height = mean.height * trust;
    let more = along_ray(simd, height, mean.normal, ray, radius);
    let second = step(kernel, more, ray, height, mean.normal);
    let limit = radius.min(ray.dot(ray).sqrt() * splat(simd, MAX_ALONG));
    let left = (limit - first.dot(first).sqrt()).max(zero);
    let share = left / second.dot(second).sqrt().max(left).max(splat(simd, f32::MIN_POSITIVE));
    let point = p.add(first.add_scaled(share, second));
    let along = more.mul_add(share, along);
    let normal = mean.normal;
    let own_code = surfaces.planes.load(simd, CODE, cell);
    // The squares of more distant points overflow f32.
    let near: Mask<S> = p.dot(p).simd_lt(splat(simd, MAX_RANGE_M * MAX_RANGE_M));
    let (own_n, own_status) = decode(simd, own_code);
    let own_has_normal: Mask<S> = own_status.simd_ge(splat(simd, PLANE));
    let stays: Mask<S> = valid & !near & own_has_normal;
    let (n, status) = decode(simd, stays.select(own_code, code));
    let away: Mask<S> = normal.dot(ray).simd_gt(zero);
    let normal = normal.scale(away.select(-one, one));
    let normal = surfaces.planes.vector(simd, RESULT_NORMAL, cell).or(stays, normal);
    let has_normal: Mask<S> = valid & ((on_one & near) | stays);
    let degenerate: Mask<S> = own_status.simd_eq(splat(simd, DEGENERATE));
    let nan = Vec3::splat(simd, f32::NAN);
    let unmoved = valid & (stays | (degenerate & !has_normal));
    let few: Mask<S> = own_status.simd_lt(splat(simd, PLANE));
    let status = has_normal.select(status, degenerate.select(own_status, one));
    PixelResults {
        projected: Projected {
            point: p.or(unmoved, point.or(has_normal, nan)),
            normal: normal.or(has_normal, nan),
            status: valid.select(status, zero),
            depth_scale: unmoved.select(one, has_normal.select(along + one, splat(simd, f32::NAN))),
        },
        depth: kernel.sensor.depth(simd, ray),
        curvature: stays.select(surfaces.planes.load(simd, CURVATURE, cell), curvature),
        n: valid.select(has_normal.select(n, few.select(own_n, zero)), zero),
    }
}

/// Returns the displacement onto surfaces: a share of the ray, or a height along the normal.
#[inline(always)]
fn step<S: Simd>(kernel: &Kernel, along: S::f32s, ray: Vec3<S>, height: S::f32s, normal: Vec3<S>) -> Vec3<S> {
    if kernel.on_ray { ray.scale(along) } else { normal.scale(height) }
}

/// Splits codes into numbers of neighbours and status codes.
#[inline(always)]
fn decode<S: Simd>(simd: S, code: S::f32s) -> (S::f32s, S::f32s) {
    let n = (code * splat(simd, 1.0 / CODES)).floor();
    (n, n.mul_add(splat(simd, -CODES), code))
}

/// The cells around a vector of pixels.
#[derive(Clone, Copy)]
struct Around {
    /// Index of the first pixel's cell.
    cell: usize,
    rows: &'static [(isize, f32)],
    columns: &'static [(isize, f32)],
}

impl Around {
    /// Returns the indices of the first and the last of the cells.
    #[inline(always)]
    fn limits(self, row_len: usize) -> (usize, usize) {
        let index = |row: isize, column: isize| self.cell.wrapping_add_signed(row * row_len as isize + column);
        let (rows, columns) = (self.rows, self.columns);
        (index(rows[0].0, columns[0].0), index(rows[rows.len() - 1].0, columns[columns.len() - 1].0))
    }

    /// Visits the index and the share of each cell.
    #[inline(always)]
    fn visit(self, row_len: usize, mut visit: impl FnMut(usize, f32)) {
        for &(row, down) in self.rows {
            let start = self.cell.wrapping_add_signed(row * row_len as isize);
            for &(column, across) in self.columns {
                visit(start.wrapping_add_signed(column), down * across);
            }
        }
    }
}

/// Sums over the surfaces around points, weighted by how well the surfaces fit.
struct Voted<S: Simd> {
    total: S::f32s,
    /// Sum of weight times certainty times |side|, the divisor of `height`.
    certain: S::f32s,
    normal: Vec3<S>,
    height: S::f32s,
    /// Index of the cell with the largest weight, relative to the point's own cell.
    best: S::f32s,
    /// [`CODE`] of the cell with the largest weight.
    code: S::f32s,
    /// Curvature of the cell with the largest weight.
    curvature: S::f32s,
}

/// The mean of those surfaces around each point that are like the point's own.
struct Mean<S: Simd> {
    normal: Vec3<S>,
    height: S::f32s,
}

impl Found<'_> {
    /// Returns the offsets from points to the means of the block means around them.
    #[inline(always)]
    fn offset_to_mean<S: Simd>(
        &self,
        simd: S,
        kernel: &Kernel,
        cell: usize,
        p: Vec3<S>,
        range: S::f32s,
        (column, row): (usize, usize),
    ) -> Vec3<S> {
        let none = Vec3::splat(simd, 0.0);
        let Some(means) = self.means else { return none };
        let gate = kernel.rules.block_gate(simd, range);
        let (one, zero, per_square) = (splat(simd, 1.0), splat(simd, 0.0), splat(simd, 1.0) / (gate * gate));
        let (mut sum, mut total) = (none, splat(simd, 0.0));
        let around = Around { cell, rows: MEAN_SHARES[row], columns: MEAN_SHARES[column] };
        around.visit(
            means.row_len,
            #[inline(always)]
            |at, share| {
                let offset = means.load(simd, at).sub(p);
                let weight = (-offset.dot(offset)).mul_add(per_square, one);
                // False for a hole.
                let counts: Mask<S> = weight.simd_gt(zero);
                let weight = counts.select(weight * splat(simd, share), zero);
                sum = sum.add_scaled(weight, offset.or(counts, none));
                total += weight;
            },
        );
        sum.scale(one / total.max(splat(simd, LEAST_MEANS)))
    }
}

impl Surfaces {
    /// Returns one cell's normal for each lane, as x, y and z. Lane i's cell is at `cell` + i + `distances[i]`.
    #[cold]
    fn normals_at(&self, cell: usize, distances: &[f32]) -> [[f32; MAX_LANES]; 3] {
        let mut normals = [[0.0; MAX_LANES]; 3];
        for (lane, &distance) in distances.iter().enumerate() {
            let at = (cell + lane).wrapping_add_signed(distance as isize);
            for (k, values) in normals.iter_mut().enumerate() {
                values[lane] = self.planes.channels.value(RESULT_NORMAL + k, at);
            }
        }
        normals
    }

    /// Derives the surfaces of points from the surfaces of the cells around them.
    #[inline(always)]
    fn surface_of<S: Simd>(
        &self,
        simd: S,
        around: Around,
        points: Points<S>,
        to_mean: Vec3<S>,
        noise: S::f32s,
    ) -> Voted<S> {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let none = Vec3::splat(simd, 0.0);
        let gate = Gate::new(simd, points.radius);
        let per_noise = one / noise;
        let length = points.ray.dot(points.ray).sqrt();
        let no_direction: Mask<S> = length.simd_lt(splat(simd, LEAST_RAY_M));
        let towards = points.ray.scale(splat(simd, -1.0 / SIDE_COSINE) / no_direction.select(one, length));
        let mut voted =
            Voted { total: zero, certain: zero, normal: none, height: zero, best: zero, code: zero, curvature: zero };
        let mut most = zero;
        let (first, last) = around.limits(self.planes.row_len);
        let cells = self.planes.channels.part(first, last);
        around.visit(
            self.planes.row_len,
            #[inline(always)]
            |at, share| {
                // SAFETY: the part extends from the first to the last of the visited cells.
                let [normal, place] = [RESULT_NORMAL, RESULT_POINT].map(
                    #[inline(always)]
                    |channel| unsafe { cells.vector(simd, channel, at) },
                );
                // SAFETY: as above.
                let [code, curvature, certainty] = [CODE, CURVATURE, CERTAINTY].map(
                    #[inline(always)]
                    |channel| unsafe { cells.load(simd, channel, at) },
                );
                let offset = place.sub(points.p);
                let (near, within) = gate.weight(simd, offset);
                let counts: Mask<S> = within & normal.dot(normal).simd_gt(zero);
                let height = offset.dot(normal);
                let from_mean = (height - to_mean.dot(normal)) * per_noise;
                let badness = from_mean.mul_add(from_mean, one);
                let square = badness * badness;
                // The product of side and normal does not depend on which way the normal faces, unless the normal is
                // exactly perpendicular to the ray.
                let side = no_direction.select(one, normal.dot(towards));
                let side = side.abs().min(one).max(splat(simd, LEAST_SIDE)).copysign(side);
                let fits = counts.select(near * splat(simd, share) / (square * square), zero);
                let certain = fits * certainty * side;
                let weight = fits * (certainty + splat(simd, LEAST_CERTAINTY));
                let best: Mask<S> = weight.simd_gt(most);
                most = weight.max(most);
                voted.best = best.select(splat(simd, at as f32 - around.cell as f32), voted.best);
                voted.code = best.select(code, voted.code);
                voted.curvature = best.select(curvature, voted.curvature);
                voted.total += fits;
                voted.certain += certain.abs();
                voted.normal = voted.normal.add_scaled(weight * side, normal);
                voted.height = counts.select(certain.mul_add(height, voted.height), voted.height);
            },
        );
        voted
    }

    /// Averages those surfaces around each point that are like the point's own, whose normal is `own_normal`.
    #[inline(always)]
    fn mean_around<S: Simd>(
        &self,
        simd: S,
        around: Around,
        point: Vec3<S>,
        own_normal: Vec3<S>,
        noise: S::f32s,
    ) -> Mean<S> {
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let none = Vec3::splat(simd, 0.0);
        let per_width = one / (noise * splat(simd, MEAN_WIDTH));
        let (mut total, mut heights, mut offsets) = (zero, zero, none);
        let mut normals = own_normal.scale(splat(simd, STAY_WEIGHT));
        let (first, last) = around.limits(self.planes.row_len);
        let cells = self.planes.channels.part(first, last);
        around.visit(
            self.planes.row_len,
            #[inline(always)]
            |at, share| {
                // SAFETY: the part extends from the first to the last of the visited cells.
                let [normal, place] = [RESULT_NORMAL, RESULT_POINT].map(
                    #[inline(always)]
                    |channel| unsafe { cells.vector(simd, channel, at) },
                );
                // SAFETY: as above.
                let certainty = unsafe { cells.load(simd, CERTAINTY, at) };
                let offset = place.sub(point);
                let height = offset.dot(normal);
                let widths = height * per_width;
                let near = (-widths).mul_add(widths, splat(simd, 1.0)).max(zero);
                let cosine = own_normal.dot(normal);
                let weight = near * rises(simd, cosine.abs(), ALIKE) * (certainty * splat(simd, share));
                let signed = weight.copysign(cosine);
                total += weight;
                heights = signed.mul_add(height, heights);
                offsets = offsets.add_scaled(weight, offset);
                normals = normals.add_scaled(signed, normal);
            },
        );
        let normal = normals.scale(one / normals.dot(normals).sqrt());
        let bend = offsets.dot(normal) - heights;
        let around = rises(simd, total * splat(simd, 1.0 / ALL_SHARES), AROUND);
        let total = total + splat(simd, MEAN_STAY);
        Mean { normal, height: (around * splat(simd, 0.5)).mul_add(bend, heights) / total }
    }
}
