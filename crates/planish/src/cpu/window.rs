//! The neighbours of a vector of pixels: a strided window and a gate on distance (docs/method.md, sections 2 and 3).
//!
//! Offsets e = q - p in metres. A hole or an infinity anywhere fails the gate by comparison: NaN is not within, nor is an
//! infinite distance. A hole has no neighbours at all, not even itself.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::Kernel;
use super::padded::PaddedFrame;
use super::vector::{Mask, Vec3, splat};

/// Most candidates a window has: 15 x 15.
pub(super) const MAX_CANDIDATES: usize = 225;

/// The candidates around a vector of pixels.
#[derive(Clone, Copy)]
pub(super) struct Window<'a> {
    padded: &'a PaddedFrame,
    /// Index of the first candidate of the first lane.
    first: usize,
    pub(super) side: usize,
    stride: usize,
}

/// Which candidates are neighbours.
pub(super) enum Gate<'a, S: Simd> {
    /// As the first pass found: a bit for each lane of each candidate.
    Known(&'a [u16; MAX_CANDIDATES]),
    /// Those within the radius.
    Radius(S::f32s),
}

/// Sums over the neighbours, relative to p.
pub(super) struct Sums<S: Simd> {
    pub(super) n: S::f32s,
    pub(super) e: Vec3<S>,
    pub(super) xx: S::f32s,
    pub(super) xy: S::f32s,
    pub(super) xz: S::f32s,
    pub(super) yy: S::f32s,
    pub(super) yz: S::f32s,
    pub(super) zz: S::f32s,
}

impl<'a> Window<'a> {
    /// The window around the pixels from (u, v) on.
    #[inline(always)]
    pub(super) fn at(padded: &'a PaddedFrame, kernel: &Kernel, u: usize, v: usize) -> Self {
        Self { padded, first: v * padded.row_len + u, side: kernel.side, stride: kernel.stride }
    }

    /// Where the first centre pixel is in the padded frame.
    #[inline(always)]
    pub(super) fn centre_index(&self) -> usize {
        let half = self.side / 2 * self.stride;
        self.first + half * self.padded.row_len + half
    }

    /// The points of the centre pixels themselves.
    #[inline(always)]
    pub(super) fn centre<S: Simd>(&self, simd: S) -> Vec3<S> {
        self.load(simd, self.centre_index())
    }

    /// The points of the pixels from an index on.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, at: usize) -> Vec3<S> {
        let lanes = at..at + S::f32s::LEN;
        Vec3::new(
            S::f32s::from_slice(simd, &self.padded.x[lanes.clone()]),
            S::f32s::from_slice(simd, &self.padded.y[lanes.clone()]),
            S::f32s::from_slice(simd, &self.padded.z[lanes]),
        )
    }

    /// Runs over the candidates of some rows of the window, in row order.
    #[inline(always)]
    fn for_each<S: Simd>(&self, simd: S, rows: Range<usize>, mut visit: impl FnMut(usize, Vec3<S>)) {
        let mut index = rows.start * self.side;
        for row in rows {
            let start = self.first + row * self.stride * self.padded.row_len;
            for column in 0..self.side {
                visit(index, self.load(simd, start + column * self.stride));
                index += 1;
            }
        }
    }

    /// First pass: the sums over the neighbours and, if asked to keep it, which candidates those are: a bit for each lane in `gates`.
    #[inline(always)]
    pub(super) fn sums<S: Simd, const KEEPS_GATES: bool>(
        &self,
        simd: S,
        p: Vec3<S>,
        radius: S::f32s,
        gates: &mut [u16; MAX_CANDIDATES],
    ) -> Sums<S> {
        let zero = splat(simd, 0.0);
        let one = splat(simd, 1.0);
        let radius_squared = radius * radius;
        let mut sums =
            Sums { n: zero, e: Vec3::splat(simd, 0.0), xx: zero, xy: zero, xz: zero, yy: zero, yz: zero, zz: zero };
        self.for_each(
            simd,
            0..self.side,
            #[inline(always)]
            |index, q| {
                let e = q.sub(p);
                let gate: Mask<S> = e.dot(e).simd_le(radius_squared);
                if KEEPS_GATES {
                    gates[index] = gate.to_bitmask() as u16;
                }
                let e = e.or(gate, Vec3::splat(simd, 0.0));
                sums.n += gate.select(one, zero);
                sums.e = sums.e.add(e);
                sums.xx = e.x.mul_add(e.x, sums.xx);
                sums.xy = e.x.mul_add(e.y, sums.xy);
                sums.xz = e.x.mul_add(e.z, sums.xz);
                sums.yy = e.y.mul_add(e.y, sums.yy);
                sums.yz = e.y.mul_add(e.z, sums.yz);
                sums.zz = e.z.mul_add(e.z, sums.zz);
            },
        );
        sums
    }

    /// Second pass: the offset of every candidate in some rows of the window, zero where it is no neighbour, and the gate.
    #[inline(always)]
    pub(super) fn neighbours<S: Simd>(
        &self,
        simd: S,
        p: Vec3<S>,
        gate: &Gate<'_, S>,
        rows: Range<usize>,
        mut visit: impl FnMut(Vec3<S>, Mask<S>),
    ) {
        let zero = Vec3::splat(simd, 0.0);
        // The choice is outside of the loops.
        match *gate {
            Gate::Known(gates) => self.for_each(
                simd,
                rows,
                #[inline(always)]
                |index, q| {
                    let gate = Mask::<S>::from_bitmask(simd, u64::from(gates[index]));
                    visit(q.sub(p).or(gate, zero), gate);
                },
            ),
            Gate::Radius(radius) => {
                let radius_squared = radius * radius;
                self.for_each(
                    simd,
                    rows,
                    #[inline(always)]
                    |_, q| {
                        let e = q.sub(p);
                        let gate: Mask<S> = e.dot(e).simd_le(radius_squared);
                        visit(e.or(gate, zero), gate);
                    },
                );
            }
        }
    }
}
