//! The candidates of a vector of points: everything within reach of one of them.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdMask};

use super::super::vector::{Mask, Vec3, splat};
use super::super::window::{Candidates, Gate};
use crate::neighbours::{Bounds, LEAF, PointIndex};

/// Candidates copied together, in the order of their places.
#[derive(Default)]
pub(super) struct Gathered {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// How many points are at each.
    counts: Vec<f32>,
    places: Vec<u32>,
    len: usize,
}

impl Gathered {
    /// Gathers every position within `reach` of its lane's point p, for some lane. Lanes whose reach is NaN reach nothing.
    #[inline(always)]
    pub(super) fn fill<S: Simd>(&mut self, simd: S, index: &PointIndex, p: Vec3<S>, reach: S::f32s) {
        self.len = 0;
        let around = bounds_of(p, reach);
        let reach_squared = reach * reach;
        index.for_each_leaf(
            #[inline(always)]
            |bounds| bounds.overlaps(&around) && is_reached(simd, bounds, p, reach_squared),
            #[inline(always)]
            |leaf| {
                if self.x.len() < self.len + LEAF {
                    let room = 2 * (self.len + LEAF);
                    for values in [&mut self.x, &mut self.y, &mut self.z, &mut self.counts] {
                        values.resize(room, 0.0);
                    }
                    self.places.resize(room, 0);
                }
                let at = self.len..self.len + LEAF;
                let (x, y, z) = (&mut self.x[at.clone()], &mut self.y[at.clone()], &mut self.z[at.clone()]);
                let (counts, places) = (&mut self.counts[at.clone()], &mut self.places[at]);
                let mut taken = 0;
                for place in LEAF * leaf..LEAF * (leaf + 1) {
                    let [q_x, q_y, q_z] = index.point(place);
                    let e = Vec3::<S>::new(splat(simd, q_x), splat(simd, q_y), splat(simd, q_z)).sub(p);
                    let near: Mask<S> = e.length_squared().simd_le(reach_squared);
                    // Written always and kept if it is near: without a branch.
                    (x[taken], y[taken], z[taken]) = (q_x, q_y, q_z);
                    (counts[taken], places[taken]) = (index.counts[place], place as u32);
                    taken += usize::from(near.any_true());
                }
                self.len += taken;
            },
        );
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    /// The squares of the distances of candidate `i`.
    #[inline(always)]
    pub(super) fn square<S: Simd>(&self, simd: S, p: Vec3<S>, i: usize) -> S::f32s {
        Vec3::<S>::new(splat(simd, self.x[i]), splat(simd, self.y[i]), splat(simd, self.z[i])).sub(p).length_squared()
    }

    /// The places of the candidates.
    pub(super) fn places(&self) -> &[u32] {
        &self.places[..self.len]
    }
}

/// Whether a box is within reach of some lane's point.
#[inline(always)]
fn is_reached<S: Simd>(simd: S, bounds: &Bounds, p: Vec3<S>, reach_squared: S::f32s) -> bool {
    let Bounds { low, high } = bounds;
    let outside = Vec3::<S>::new(
        outside(simd, low[0], high[0], p.x),
        outside(simd, low[1], high[1], p.y),
        outside(simd, low[2], high[2], p.z),
    );
    let reached: Mask<S> = outside.length_squared().simd_le(reach_squared);
    reached.any_true()
}

/// How far values are below `low` or above `high`.
#[inline(always)]
fn outside<S: Simd>(simd: S, low: f32, high: f32, values: S::f32s) -> S::f32s {
    (splat(simd, low) - values).max(values - splat(simd, high)).max(splat(simd, 0.0))
}

/// The box of all points with their reaches.
#[inline(always)]
fn bounds_of<S: Simd>(p: Vec3<S>, reach: S::f32s) -> Bounds {
    Bounds {
        low: [least::<S>(p.x - reach), least::<S>(p.y - reach), least::<S>(p.z - reach)],
        high: [largest::<S>(p.x + reach), largest::<S>(p.y + reach), largest::<S>(p.z + reach)],
    }
}

/// The least value that is a number.
#[inline(always)]
fn least<S: Simd>(values: S::f32s) -> f32 {
    values.as_slice().iter().copied().fold(f32::INFINITY, f32::min)
}

/// The largest value that is a number.
#[inline(always)]
fn largest<S: Simd>(values: S::f32s) -> f32 {
    values.as_slice().iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

impl<S: Simd> Candidates<S> for &Gathered {
    fn rows(&self) -> usize {
        self.len
    }

    fn row_len(&self) -> usize {
        1
    }

    #[inline(always)]
    fn neighbours(
        &self,
        simd: S,
        p: Vec3<S>,
        radius: S::f32s,
        rows: Range<usize>,
        mut visit: impl FnMut(Vec3<S>, S::f32s, S::f32s),
    ) {
        let gate = Gate::new(simd, radius);
        let zero = splat(simd, 0.0);
        let positions = self.x[rows.clone()].iter().zip(&self.y[rows.clone()]).zip(&self.z[rows.clone()]);
        for (((&x, &y), &z), &count) in positions.zip(&self.counts[rows]) {
            let q = Vec3::new(splat(simd, x), splat(simd, y), splat(simd, z));
            let (e, weight, near) = gate.apply(simd, q.sub(p));
            let count = splat(simd, count);
            visit(e, weight * count, near.select(count, zero));
        }
    }
}
