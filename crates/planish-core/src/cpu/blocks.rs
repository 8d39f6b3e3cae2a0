//! Block means (docs/method.md, section 2): each sample of a window is the mean of its pixel's block. With edges kept,
//! only points on the pixel's surface are averaged (section 10).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::padded::{PaddedFrame, PaddedRows};
use super::plane::Plane;
use super::row_tasks::SplitRows;
use super::vector::{Mask, Vec3, splat};
use super::window::Gate;
use super::{Kernel, valid_points};
use crate::constants::{BLOCK_WIDTH, MIN_BLOCK_WEIGHT};

/// The block of a vector of pixels.
pub(super) struct Block<'a, S: Simd> {
    measured: &'a PaddedFrame,
    half: usize,
    here: usize,
    p: Vec3<S>,
    gate: Gate<S>,
}

impl<'a, S: Simd> Block<'a, S> {
    /// Computes means around the points p from an index on, given their ranges.
    #[inline(always)]
    pub(super) fn around(
        simd: S,
        measured: &'a PaddedFrame,
        kernel: &Kernel,
        here: usize,
        p: Vec3<S>,
        range: S::f32s,
    ) -> Self {
        Self { measured, half: kernel.block_half, here, p, gate: Gate::new(simd, kernel.rules.block_gate(simd, range)) }
    }

    /// Averages its points, each weighted by the gate and by `weigh` of its offset from p.
    #[inline(always)]
    fn mean(&self, simd: S, weigh: impl Fn(Vec3<S>) -> S::f32s) -> Vec3<S> {
        let row_len = self.measured.row_len;
        let first = self.here - self.half * (row_len + 1);
        let side = 2 * self.half + 1;
        self.measured.assert_within(first, first + 2 * self.half * (row_len + 1));
        let (mut sum, mut total) = (Vec3::splat(simd, 0.0), splat(simd, 0.0));
        for row in 0..side {
            for column in 0..side {
                // SAFETY: checked above for the first and the last point.
                let q = unsafe { self.measured.load_within(simd, first + row * row_len + column) };
                let e = q.sub(self.p);
                let (gate, near) = self.gate.weight(simd, e);
                let weight = gate * weigh(e);
                // A point beyond the gate may be NaN and must not change the sum.
                sum = sum.add_scaled(weight, e).or(near, sum);
                total = near.select(total + weight, total);
            }
        }
        // p itself has a weight.
        self.p.add_scaled(splat(simd, 1.0) / total, sum)
    }

    /// Returns the mean of the points that are on the surface of p: they count by how far they are from its plane, in
    /// widths, of which there are `per_width` in a metre.
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

/// The means of some rows.
#[inline(always)]
pub(super) fn average<S: Simd>(simd: S, measured: &PaddedFrame, kernel: &Kernel, rows: &mut PaddedRows<'_>) {
    for row in 0..rows.count() {
        for u in (0..measured.width).step_by(S::f32s::LEN) {
            let here = measured.index(u, rows.first + row);
            let p = measured.load(simd, here);
            let valid: Mask<S> = valid_points(simd, p);
            let mut mean = p;
            if valid.any_true() {
                let range = kernel.range(simd, kernel.sensor.ray(simd, p));
                let one = splat(simd, 1.0);
                mean = Block::around(simd, measured, kernel, here, p, range).mean(simd, |_| one);
            }
            rows.store(rows.index(row, u), mean.or(valid, Vec3::splat(simd, f32::NAN)));
        }
    }
}
