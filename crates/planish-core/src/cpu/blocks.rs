//! Block means (docs/method.md, section 2): each sample of a window is the mean of the block around its pixel, or its
//! cell. With edges kept, only points on the cell's surface are averaged (section 10).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::padded::{PaddedFrame, PaddedRows};
use super::plane::Plane;
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, splat};
use super::window::Gate;
use super::{Kernel, valid_points};
use crate::constants::{BLOCK_WIDTH, MIN_BLOCK_WEIGHT};

/// The blocks around a vector of pixels or cells.
pub(super) struct Block<'a, S: Simd, P> {
    pixels: &'a P,
    half: usize,
    /// Column and row of the first pixel or cell.
    place: (usize, usize),
    p: Vec3<S>,
    gate: Gate<S>,
}

/// Pixels from which blocks are formed.
pub(super) trait BlockPixels {
    /// Visits the points of the blocks around a vector of pixels or cells, the first at `place`. A block is the pixel
    /// or cell plus `half` pixels on each side.
    fn visit_block<S: Simd>(&self, simd: S, place: (usize, usize), half: usize, visit: impl FnMut(Vec3<S>));
}

impl BlockPixels for PaddedFrame {
    #[inline(always)]
    fn visit_block<S: Simd>(&self, simd: S, (u, v): (usize, usize), half: usize, mut visit: impl FnMut(Vec3<S>)) {
        let first = self.index(u, v) - half * (self.row_len + 1);
        let side = 2 * half + 1;
        let part = self.part(first, first + 2 * half * (self.row_len + 1));
        for row in 0..side {
            for column in 0..side {
                // SAFETY: the part extends from the first to the last point of the block.
                visit(unsafe { part.vector(simd, 0, first + row * self.row_len + column) });
            }
        }
    }
}

impl<'a, S: Simd, P: BlockPixels> Block<'a, S, P> {
    /// Returns the blocks around a vector of pixels or cells, the first at `place`, given their points p and ranges.
    #[inline(always)]
    pub(super) fn around(
        simd: S,
        pixels: &'a P,
        kernel: &Kernel,
        place: (usize, usize),
        p: Vec3<S>,
        range: S::f32s,
    ) -> Self {
        Self { pixels, half: kernel.block_half, place, p, gate: Gate::new(simd, kernel.rules.block_gate(simd, range)) }
    }

    /// Averages the block's points, each weighted by the gate and by the value of `weigh` at its offset from p.
    #[inline(always)]
    fn mean(&self, simd: S, weigh: impl Fn(Vec3<S>) -> S::f32s) -> Vec3<S> {
        let (mut sum, mut total) = (Vec3::splat(simd, 0.0), splat(simd, 0.0));
        self.pixels.visit_block(
            simd,
            self.place,
            self.half,
            #[inline(always)]
            |q| {
                let e = q.sub(self.p);
                let (gate, near) = self.gate.weight(simd, e);
                let weight = gate * weigh(e);
                // A point beyond the gate may be NaN and must not change the sum.
                sum = sum.add_scaled(weight, e).or(near, sum);
                total = near.select(total + weight, total);
            },
        );
        // The total is not 0, since p itself has a weight.
        self.p.add_scaled(splat(simd, 1.0) / total, sum)
    }

    /// Returns the mean of the points on the surface of p. Points are weighted by their distance from the plane,
    /// measured in widths; `per_width` is the number of widths per metre.
    #[inline(always)]
    pub(super) fn mean_on_surface(&self, simd: S, plane: &Plane<S>, per_width: S::f32s) -> Vec3<S> {
        let one = splat(simd, 1.0);
        let per_width = splat(simd, 1.0 / BLOCK_WIDTH) * per_width;
        let normal = plane.normal.scale(per_width);
        let height = plane.height * per_width;
        self.mean(
            simd,
            #[inline(always)]
            |e| {
                let f = e.dot(normal) - height;
                let on = (-f).mul_add(f, one).max(splat(simd, MIN_BLOCK_WEIGHT));
                on * on
            },
        )
    }
}

/// Computes the block means around the points of some rows.
#[inline(always)]
pub(super) fn average<S: Simd, P: BlockPixels>(
    simd: S,
    pixels: &P,
    points: &PaddedFrame,
    kernel: &Kernel,
    means: &mut PaddedRows<'_>,
) {
    for row in 0..means.count() {
        for u in (0..points.width).step_by(S::f32s::LEN) {
            let place = (u, means.first + row);
            let p = points.load(simd, points.index(place.0, place.1));
            let valid: Mask<S> = valid_points(simd, p);
            let mut mean = p;
            if valid.any_true() {
                let range = kernel.range(simd, kernel.sensor.ray(simd, p));
                let one = splat(simd, 1.0);
                mean = Block::around(simd, pixels, kernel, place, p, range).mean(simd, |_| one);
            }
            means.store(means.index(row, u), mean.or(valid, Vec3::splat(simd, f32::NAN)));
        }
    }
}
