//! Gathers the candidates of a vector of points: all positions within reach of any of the points, and some others
//! nearby.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdMask};

use super::super::vector::{Mask, Vec3, splat};
use super::super::window::{Candidates, Gate, Sums};
use crate::neighbours::{Bounds, LEAF, LeafMoments, PointIndex};

/// Squared distance in m² beyond which leaves are never summed as a whole, since their moments may overflow f32.
const LARGEST_SQUARE: f32 = 1e24;
/// The lane numbers.
const LANES: [u32; LEAF] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// Copies of the candidates of a vector of points.
#[derive(Default)]
pub(super) struct Gathered {
    /// Points of leaves that are fully within the gate of every lane, so they need no gate.
    whole: Copied,
    /// Sums over the points of each leaf in `whole`.
    moments: Vec<LeafMoments>,
    /// Points of all other leaves within reach of at least one lane, if they are in the bounding box of all lanes'
    /// reaches.
    others: Copied,
}

/// Positions in the order of their places.
#[derive(Default)]
struct Copied {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// Number of points at each position.
    counts: Vec<f32>,
    places: Vec<u32>,
    len: usize,
}

/// Reach of the points of a vector.
#[derive(Clone, Copy)]
pub(super) struct Reach<S: Simd> {
    /// Distance in metres beyond which there are no candidates; NaN for lanes without a point.
    pub(super) outer: S::f32s,
    /// Distance in metres up to which candidates count fully. Never NaN: the minimum of a NaN and a number is
    /// unspecified.
    pub(super) inner: S::f32s,
}

impl Gathered {
    /// Gathers all positions within reach of at least one lane's point p, and others near them.
    // Not inlined in web builds, to keep them small.
    #[cfg_attr(target_family = "wasm", inline(never))]
    #[cfg_attr(not(target_family = "wasm"), inline(always))]
    pub(super) fn fill<S: Simd>(&mut self, simd: S, index: &PointIndex, p: Vec3<S>, reach: Reach<S>) {
        let Self { whole, moments, others } = self;
        (whole.len, others.len) = (0, 0);
        moments.clear();
        let around = bounds_of(p, reach.outer);
        let outer_squared = reach.outer * reach.outer;
        let inner_squared = (reach.inner * reach.inner).min(splat(simd, LARGEST_SQUARE));
        // Lanes whose reach is NaN are ignored.
        let idle: Mask<S> = reach.outer.simd_ne(reach.outer);
        index.for_each_leaf(
            simd,
            &around,
            #[inline(always)]
            |leaf, bounds| {
                if !is_reached(simd, bounds, p, outer_squared) {
                    return;
                }
                let inside: Mask<S> = farthest_squared(simd, bounds, p).simd_le(inner_squared);
                if (inside | idle).all_true() {
                    whole.push_leaf(index, leaf);
                    moments.push(*index.moments(leaf));
                } else {
                    others.push_inside(simd, index, leaf, &around);
                }
            },
        );
    }

    pub(super) fn len(&self) -> usize {
        self.whole.len + self.others.len
    }

    /// Returns the squared distances of all candidates from p, stored in `buffer`.
    #[inline(always)]
    pub(super) fn squares<'a, S: Simd>(&self, simd: S, p: Vec3<S>, buffer: &'a mut Vec<S::f32s>) -> &'a [S::f32s] {
        if buffer.len() < self.len() {
            buffer.resize(2 * self.len(), splat(simd, 0.0));
        }
        let squares = &mut buffer[..self.len()];
        let (of_whole, of_others) = squares.split_at_mut(self.whole.len);
        for (Copied { x, y, z, len, .. }, squares) in [(&self.whole, of_whole), (&self.others, of_others)] {
            let positions = x[..*len].iter().zip(&y[..*len]).zip(&z[..*len]);
            for (((&x, &y), &z), square) in positions.zip(squares) {
                let q = Vec3::<S>::new(splat(simd, x), splat(simd, y), splat(simd, z));
                *square = q.sub(p).length_squared();
            }
        }
        squares
    }

    /// Visits the offset from p and the place of each candidate.
    #[inline(always)]
    pub(super) fn for_each_offset<S: Simd>(&self, simd: S, p: Vec3<S>, mut visit: impl FnMut(Vec3<S>, usize)) {
        for Copied { x, y, z, places, len, .. } in [&self.whole, &self.others] {
            let positions = x[..*len].iter().zip(&y[..*len]).zip(&z[..*len]);
            for (((&x, &y), &z), &place) in positions.zip(&places[..*len]) {
                let q = Vec3::<S>::new(splat(simd, x), splat(simd, y), splat(simd, z));
                visit(q.sub(p), place as usize);
            }
        }
    }
}

impl Copied {
    /// Makes room for the points of one more leaf.
    #[inline(always)]
    fn reserve(&mut self) {
        if self.x.len() < self.len + LEAF {
            let room = 2 * (self.len + LEAF);
            for values in [&mut self.x, &mut self.y, &mut self.z, &mut self.counts] {
                values.resize(room, 0.0);
            }
            self.places.resize(room, 0);
        }
    }

    /// Appends the points of a leaf.
    #[inline(always)]
    fn push_leaf(&mut self, index: &PointIndex, leaf: usize) {
        self.reserve();
        // The last leaf may be padded with NaN.
        let from = LEAF * leaf..(LEAF * (leaf + 1)).min(index.len());
        let to = self.len..self.len + from.len();
        let [x, y, z] = &index.positions;
        self.x[to.clone()].copy_from_slice(&x[from.clone()]);
        self.y[to.clone()].copy_from_slice(&y[from.clone()]);
        self.z[to.clone()].copy_from_slice(&z[from.clone()]);
        self.counts[to.clone()].copy_from_slice(&index.counts[from.clone()]);
        self.places[to].iter_mut().zip(from.clone()).for_each(|(to, place)| *to = place as u32);
        self.len += from.len();
    }

    /// Appends the points of a leaf that are in a box.
    #[inline(always)]
    fn push_inside<S: Simd>(&mut self, simd: S, index: &PointIndex, leaf: usize, bounds: &Bounds) {
        self.reserve();
        let Bounds { low, high } = bounds;
        for place in (LEAF * leaf..LEAF * (leaf + 1)).step_by(S::f32s::LEN) {
            let Vec3 { x, y, z } = load(simd, index, place);
            let inside = is_between(simd, x, low[0], high[0])
                & is_between(simd, y, low[1], high[1])
                & is_between(simd, z, low[2], high[2]);
            let counts = S::f32s::from_slice(simd, &index.counts[place..place + S::f32s::LEN]);
            let places = S::u32s::from_slice(simd, &LANES[..S::f32s::LEN]) + S::u32s::splat(simd, place as u32);
            let at = self.len..self.len + S::f32s::LEN;
            x.compress(inside).store_slice(&mut self.x[at.clone()]);
            y.compress(inside).store_slice(&mut self.y[at.clone()]);
            z.compress(inside).store_slice(&mut self.z[at.clone()]);
            counts.compress(inside).store_slice(&mut self.counts[at.clone()]);
            places.compress(inside).store_slice(&mut self.places[at]);
            self.len += inside.to_bitmask().count_ones() as usize;
        }
    }
}

/// Returns the mask of values from `low` to `high`; false for NaN.
#[inline(always)]
fn is_between<S: Simd>(simd: S, values: S::f32s, low: f32, high: f32) -> Mask<S> {
    values.simd_ge(splat(simd, low)) & values.simd_le(splat(simd, high))
}

/// Returns true if a box is within reach of at least one lane's point.
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

/// Returns the distance of each value from the range `low` to `high`; 0 within it.
#[inline(always)]
fn outside<S: Simd>(simd: S, low: f32, high: f32, values: S::f32s) -> S::f32s {
    (splat(simd, low) - values).max(values - splat(simd, high)).max(splat(simd, 0.0))
}

/// Returns the squared distance from each point to the farthest corner of a box.
#[inline(always)]
fn farthest_squared<S: Simd>(simd: S, bounds: &Bounds, p: Vec3<S>) -> S::f32s {
    let Bounds { low, high } = bounds;
    Vec3::<S>::new(
        farther(simd, low[0], high[0], p.x),
        farther(simd, low[1], high[1], p.y),
        farther(simd, low[2], high[2], p.z),
    )
    .length_squared()
}

/// Returns the larger of the distances from `low` and `high`.
#[inline(always)]
fn farther<S: Simd>(simd: S, low: f32, high: f32, values: S::f32s) -> S::f32s {
    (values - splat(simd, low)).max(splat(simd, high) - values)
}

/// Returns the box around the reaches of all points, ignoring NaN.
#[inline(always)]
fn bounds_of<S: Simd>(p: Vec3<S>, reach: S::f32s) -> Bounds {
    Bounds {
        low: [least::<S>(p.x - reach), least::<S>(p.y - reach), least::<S>(p.z - reach)],
        high: [largest::<S>(p.x + reach), largest::<S>(p.y + reach), largest::<S>(p.z + reach)],
    }
}

/// Returns the smallest value, ignoring NaN.
#[inline(always)]
fn least<S: Simd>(values: S::f32s) -> f32 {
    values.as_slice().iter().copied().fold(f32::INFINITY, f32::min)
}

/// Returns the largest value, ignoring NaN.
#[inline(always)]
fn largest<S: Simd>(values: S::f32s) -> f32 {
    values.as_slice().iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

impl<S: Simd> Candidates<S> for &Gathered {
    fn rows(&self) -> usize {
        self.len()
    }

    fn row_len(&self) -> usize {
        1
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
        let Gathered { whole, others, .. } = self;
        let wholly = rows.start.min(whole.len)..rows.end.min(whole.len);
        let positions = whole.x[wholly.clone()].iter().zip(&whole.y[wholly.clone()]).zip(&whole.z[wholly.clone()]);
        let (wholly_slots, slots) = slots.split_at_mut(wholly.len());
        for ((((&x, &y), &z), &count), slot) in positions.zip(&whole.counts[wholly]).zip(wholly_slots) {
            let q = Vec3::<S>::new(splat(simd, x), splat(simd, y), splat(simd, z));
            let count = splat(simd, count);
            visit(slot, q.sub(p), count, count);
        }
        let gate = Gate::new(simd, radius);
        let zero = splat(simd, 0.0);
        let rows = rows.start.saturating_sub(whole.len)..rows.end.saturating_sub(whole.len);
        let positions = others.x[rows.clone()].iter().zip(&others.y[rows.clone()]).zip(&others.z[rows.clone()]);
        for ((((&x, &y), &z), &count), slot) in positions.zip(&others.counts[rows]).zip(slots) {
            let q = Vec3::new(splat(simd, x), splat(simd, y), splat(simd, z));
            let (e, weight, near) = gate.apply(simd, q.sub(p));
            let count = splat(simd, count);
            visit(slot, e, weight * count, near.select(count, zero));
        }
    }

    /// First pass: returns the sums over the neighbours. Leaves whose points all count fully contribute their
    /// moments.
    #[inline(always)]
    fn sums(&self, simd: S, p: Vec3<S>, radius: S::f32s) -> Sums<S> {
        let mut sums = self.sums_of_rows(simd, p, radius, self.whole.len..self.len());
        for LeafMoments { count, mean: [x, y, z], products } in &self.moments {
            let e = Vec3::<S>::new(splat(simd, *x), splat(simd, *y), splat(simd, *z)).sub(p);
            let count = splat(simd, *count);
            sums.add(e, count, count);
            let [xx, xy, xz, yy, yz, zz] = *products;
            sums.xx += splat(simd, xx);
            sums.xy += splat(simd, xy);
            sums.xz += splat(simd, xz);
            sums.yy += splat(simd, yy);
            sums.yz += splat(simd, yz);
            sums.zz += splat(simd, zz);
        }
        sums
    }
}

/// Returns the vector of points that starts at a place; NaN after the last point.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, index: &PointIndex, place: usize) -> Vec3<S> {
    let [x, y, z] = &index.positions;
    let lanes = place..place + S::f32s::LEN;
    Vec3::new(
        S::f32s::from_slice(simd, &x[lanes.clone()]),
        S::f32s::from_slice(simd, &y[lanes.clone()]),
        S::f32s::from_slice(simd, &z[lanes]),
    )
}
