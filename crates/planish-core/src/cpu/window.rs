//! Finds the neighbours of a vector of pixels, with a strided window and a gate on distance (docs/method.md, sections
//! 2 and 3).
//!
//! Offsets e = q - p are in metres. Holes and infinite coordinates fail the gate by comparison: neither NaN nor an
//! infinite distance is within it. A hole has 0 neighbours; it does not count itself.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::Kernel;
use super::padded::PaddedFrame;
use super::vector::{Mask, Vec3, splat};
use crate::constants::GATE_FADE;
use crate::params::EngineParams;

/// The candidates around a vector of pixels.
#[derive(Clone, Copy)]
pub(super) struct Window<'a> {
    /// The samples: the measured points, or their block means.
    samples: &'a PaddedFrame,
    /// Index of the first lane's pixel or cell.
    centre: usize,
    /// Offsets of the window's columns from the centre, in pixels or cells. Its rows have the same offsets.
    offsets: &'a [isize],
}

/// A gate on distance that fades out around its radius, so that weights change continuously.
pub(super) struct Gate<S: Simd> {
    /// Slope of the weight over the squared distance, in 1/m².
    slope: S::f32s,
}

impl<S: Simd> Gate<S> {
    #[inline(always)]
    pub(super) fn new(simd: S, radius: S::f32s) -> Self {
        Self { slope: splat(simd, -GATE_FADE) / (radius * radius) }
    }

    /// Returns the weight of each offset, and the mask of lanes within the gate (false for NaN).
    #[inline(always)]
    pub(super) fn weight(&self, simd: S, e: Vec3<S>) -> (S::f32s, Mask<S>) {
        let weight = e.dot(e).mul_add(self.slope, splat(simd, GATE_FADE + 0.5));
        (weight.min(splat(simd, 1.0)), weight.simd_gt(splat(simd, 0.0)))
    }

    /// Returns the offset (zero outside the gate), its weight, and the mask of lanes within the gate.
    #[inline(always)]
    pub(super) fn apply(&self, simd: S, e: Vec3<S>) -> (Vec3<S>, S::f32s, Mask<S>) {
        let zero = splat(simd, 0.0);
        let (weight, near) = self.weight(simd, e);
        (e.or(near, Vec3::splat(simd, 0.0)), near.select(weight, zero), near)
    }
}

/// Sums over the neighbours, relative to p.
pub(super) struct Sums<S: Simd> {
    /// Number of neighbours.
    pub(super) n: S::f32s,
    /// Sum of the weights.
    pub(super) total: S::f32s,
    pub(super) e: Vec3<S>,
    pub(super) xx: S::f32s,
    pub(super) xy: S::f32s,
    pub(super) xz: S::f32s,
    pub(super) yy: S::f32s,
    pub(super) yz: S::f32s,
    pub(super) zz: S::f32s,
}

/// Candidates for neighbours of the points of a vector, in rows.
pub(super) trait Candidates<S: Simd>: Copy {
    fn rows(&self) -> usize;

    /// Returns the number of candidates in a row.
    fn row_len(&self) -> usize;

    /// Visits the candidates of some rows in order. `visit` receives each candidate's slot, its offset from p (zero
    /// outside the gate), its gate weight, and the number of neighbours that it counts as.
    ///
    /// `slots` must have one element for each candidate. Slots avoid bounds checks on an array of results.
    fn neighbours<T>(
        &self,
        simd: S,
        p: Vec3<S>,
        radius: S::f32s,
        rows: Range<usize>,
        slots: &mut [T],
        visit: impl FnMut(&mut T, Vec3<S>, S::f32s, S::f32s),
    );

    /// First pass: returns the sums over the neighbours.
    #[inline(always)]
    fn sums(&self, simd: S, p: Vec3<S>, radius: S::f32s) -> Sums<S> {
        self.sums_of_rows(simd, p, radius, 0..self.rows())
    }

    /// Returns the sums over the neighbours among the candidates of some rows.
    #[inline(always)]
    fn sums_of_rows(&self, simd: S, p: Vec3<S>, radius: S::f32s, rows: Range<usize>) -> Sums<S> {
        let mut sums = Sums::zero(simd);
        self.neighbours(
            simd,
            p,
            radius,
            rows.clone(),
            &mut vec![(); rows.len() * self.row_len()],
            #[inline(always)]
            |(), e, weight, count| sums.add(e, weight, count),
        );
        sums
    }
}

impl<S: Simd> Sums<S> {
    #[inline(always)]
    pub(super) fn zero(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        let e = Vec3::splat(simd, 0.0);
        Self { n: zero, total: zero, e, xx: zero, xy: zero, xz: zero, yy: zero, yz: zero, zz: zero }
    }

    /// Adds a candidate: its offset, its weight and the number of neighbours that it counts as.
    #[inline(always)]
    pub(super) fn add(&mut self, e: Vec3<S>, weight: S::f32s, count: S::f32s) {
        let weighted = e.scale(weight);
        self.n += count;
        self.total += weight;
        self.e = self.e.add(weighted);
        self.xx = weighted.x.mul_add(e.x, self.xx);
        self.xy = weighted.x.mul_add(e.y, self.xy);
        self.xz = weighted.x.mul_add(e.z, self.xz);
        self.yy = weighted.y.mul_add(e.y, self.yy);
        self.yz = weighted.y.mul_add(e.z, self.yz);
        self.zz = weighted.z.mul_add(e.z, self.zz);
    }
}

impl<'a> Window<'a> {
    /// Returns the windows of the vector of pixels or cells that starts at (u, v).
    #[inline(always)]
    pub(super) fn at(samples: &'a PaddedFrame, kernel: &'a Kernel, u: usize, v: usize) -> Self {
        Self { samples, centre: samples.index(u, v), offsets: kernel.offsets.all() }
    }

    /// Returns the inner part of the window, which is half as wide.
    #[inline(always)]
    pub(super) fn middle(&self, kernel: &'a Kernel) -> Self {
        Self { offsets: kernel.offsets.middle(), ..*self }
    }
}

/// Number of columns of the widest window.
const MAX_SIDE: usize = 15;

/// Offsets of a window's columns from the centre, in pixels or cells.
pub(super) struct Offsets {
    values: [isize; MAX_SIDE],
    len: usize,
    /// Ratio of the columns' mean squared distance from the centre in the inner part of the window to that in the
    /// whole window.
    pub(super) middle_share: f32,
}

impl Offsets {
    pub(super) fn new(params: &EngineParams) -> Self {
        let half = params.window as isize;
        let offset = |i: isize| i.signum() * params.sample_offset(i.unsigned_abs()) as isize;
        let mut offsets = Self { values: [0; MAX_SIDE], len: 2 * half as usize + 1, middle_share: 0.0 };
        offsets.values.iter_mut().zip(-half..=half).for_each(|(value, i)| *value = offset(i));
        let mean_square = |values: &[isize]| values.iter().map(|x| x * x).sum::<isize>() as f32 / values.len() as f32;
        offsets.middle_share = mean_square(offsets.middle()) / mean_square(offsets.all());
        offsets
    }

    #[inline(always)]
    fn all(&self) -> &[isize] {
        &self.values[..self.len]
    }

    /// Returns the offsets of a window half as wide.
    #[inline(always)]
    fn middle(&self) -> &[isize] {
        let half = self.len / 2;
        &self.values[half - half / 2..=half + half / 2]
    }
}

impl<S: Simd> Candidates<S> for Window<'_> {
    #[inline(always)]
    fn rows(&self) -> usize {
        self.offsets.len()
    }

    #[inline(always)]
    fn row_len(&self) -> usize {
        self.offsets.len()
    }

    #[inline(always)]
    fn neighbours<T>(
        &self,
        simd: S,
        p: Vec3<S>,
        radius: S::f32s,
        rows: Range<usize>,
        slots: &mut [T],
        mut visit: impl FnMut(&mut T, Vec3<S>, S::f32s, S::f32s),
    ) {
        let gate = Gate::new(simd, radius);
        let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
        let row_len = self.samples.row_len as isize;
        let [.., reach] = *self.offsets else { return };
        let reach = reach as usize * (self.samples.row_len + 1);
        let part = self.samples.part(self.centre - reach, self.centre + reach);
        debug_assert_eq!(slots.len(), rows.len() * self.offsets.len());
        for (row, slots) in self.offsets[rows].iter().zip(slots.chunks_exact_mut(self.offsets.len())) {
            let start = self.centre.wrapping_add_signed(row * row_len);
            for (column, slot) in self.offsets.iter().zip(slots) {
                // SAFETY: the part extends as far from the centre as the last column and row, which are the farthest.
                let q = unsafe { part.vector(simd, 0, start.wrapping_add_signed(*column)) };
                let (e, weight, near) = gate.apply(simd, q.sub(p));
                visit(slot, e, weight, near.select(one, zero));
            }
        }
    }
}
