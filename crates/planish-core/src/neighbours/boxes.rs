//! A tree of boxes without pointers: the indices of a node's children follow from its index.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase, SimdMask, f32x8};
use rayon::prelude::*;

/// Number of children of a node.
pub(super) const CHILDREN: usize = 8;
/// Maximum number of levels: enough for 2^32 points in 2^28 leaves.
const MAX_LEVELS: usize = 10;

/// A box, given by its smallest and largest coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) low: [f32; 3],
    pub(crate) high: [f32; 3],
}

impl Bounds {
    /// The box of no points.
    pub(crate) const EMPTY: Self = Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3] };

    /// Returns the smallest box that contains both boxes.
    pub(crate) fn union(self, other: Self) -> Self {
        let of = |pick: fn(f32, f32) -> f32, [a, b]: [[f32; 3]; 2]| std::array::from_fn(|axis| pick(a[axis], b[axis]));
        // If one operand is NaN, min and max return the other.
        Self { low: of(f32::min, [self.low, other.low]), high: of(f32::max, [self.high, other.high]) }
    }

    pub(crate) fn of_point(point: [f32; 3]) -> Self {
        Self { low: point, high: point }
    }

    /// Returns the box enlarged by `by` on every side.
    pub(crate) fn grown(self, by: f32) -> Self {
        Self { low: self.low.map(|value| value - by), high: self.high.map(|value| value + by) }
    }

    /// Returns the squared distance from a point to the box; 0 inside it.
    pub(crate) fn distance_squared(&self, point: [f32; 3]) -> f32 {
        let outside = |axis: usize| (self.low[axis] - point[axis]).max(point[axis] - self.high[axis]).max(0.0).powi(2);
        outside(0) + outside(1) + outside(2)
    }
}

/// The boxes of a node's children, stored by coordinate, so that one comparison tests all children.
#[derive(Debug, Clone, Copy)]
struct Boxes {
    low: [[f32; CHILDREN]; 3],
    high: [[f32; CHILDREN]; 3],
}

impl Boxes {
    fn of(children: &[Bounds]) -> Self {
        let child = |i: usize| children.get(i).copied().unwrap_or(Bounds::EMPTY);
        let of =
            |value: fn(Bounds) -> [f32; 3]| std::array::from_fn(|axis| std::array::from_fn(|i| value(child(i))[axis]));
        Self { low: of(|bounds| bounds.low), high: of(|bounds| bounds.high) }
    }

    #[inline(always)]
    fn get(&self, i: usize) -> Bounds {
        let Self { low, high } = self;
        Bounds { low: [low[0][i], low[1][i], low[2][i]], high: [high[0][i], high[1][i], high[2][i]] }
    }

    /// Returns a bit mask of the children whose boxes touch another box. The axes are written out for the reason
    /// given in cpu/vector.rs.
    #[inline(always)]
    fn touching<S: Simd>(&self, simd: S, Bounds { low, high }: &Bounds) -> u64 {
        let x = is_touched(simd, &self.low[0], &self.high[0], low[0], high[0]);
        let y = is_touched(simd, &self.low[1], &self.high[1], low[1], high[1]);
        let z = is_touched(simd, &self.low[2], &self.high[2], low[2], high[2]);
        (x & y & z).to_bitmask()
    }
}

/// Returns the mask of ranges, each from a low to a high value, that touch the range from `from` to `to`.
#[inline(always)]
fn is_touched<S: Simd>(
    simd: S,
    low: &[f32; CHILDREN],
    high: &[f32; CHILDREN],
    from: f32,
    to: f32,
) -> <f32x8<S> as SimdBase<S>>::Mask {
    let (low, high) = (f32x8::from_slice(simd, low), f32x8::from_slice(simd, high));
    low.simd_le(f32x8::splat(simd, to)) & high.simd_ge(f32x8::splat(simd, from))
}

/// The boxes of leaves, of the nodes over them, and so on up to a level of at most eight nodes.
#[derive(Debug, Default)]
pub(super) struct BoxTree {
    leaves: usize,
    levels: Vec<Vec<Boxes>>,
}

impl BoxTree {
    /// Builds the tree over the boxes of leaves.
    pub(super) fn over(leaves: &[Bounds]) -> Self {
        let mut levels: Vec<Vec<Boxes>> = Vec::new();
        let mut below = leaves.to_vec();
        while !below.is_empty() {
            levels.push(below.par_chunks(CHILDREN).map(Boxes::of).collect());
            let node = |children: &[Bounds]| children.iter().copied().fold(Bounds::EMPTY, Bounds::union);
            let is_top = below.len() <= CHILDREN;
            below = if is_top { Vec::new() } else { below.par_chunks(CHILDREN).map(node).collect() };
        }
        Self { leaves: leaves.len(), levels }
    }

    /// Returns the number of levels; 0 without leaves. The highest has at most eight nodes.
    pub(super) fn levels(&self) -> usize {
        self.levels.len()
    }

    /// Returns the box of a node; level 0 contains the leaves.
    #[inline(always)]
    pub(super) fn get(&self, level: usize, node: usize) -> Bounds {
        self.levels[level][node / CHILDREN].get(node % CHILDREN)
    }

    /// Returns the nodes of a level that are children of a node in the level above. For the highest level and node 0,
    /// returns all nodes of the level.
    pub(super) fn children(&self, level: usize, node: usize) -> Range<usize> {
        let nodes = if level == 0 { self.leaves } else { self.levels[level - 1].len() };
        CHILDREN * node..(CHILDREN * (node + 1)).min(nodes)
    }

    /// Visits, in ascending order, the leaves whose boxes touch a box.
    #[inline(always)]
    pub(super) fn for_each_leaf<S: Simd>(&self, simd: S, bounds: &Bounds, mut visit: impl FnMut(usize, &Bounds)) {
        let Some(top) = self.levels.len().checked_sub(1) else { return };
        // For each level, the node whose children are being visited, and a bit mask of the children still to visit.
        let mut parents = [0; MAX_LEVELS];
        let mut waiting = [0; MAX_LEVELS];
        waiting[top] = self.levels[top][0].touching(simd, bounds);
        let mut level = top;
        loop {
            if waiting[level] == 0 {
                if level == top {
                    return;
                }
                level += 1;
                continue;
            }
            let child = waiting[level].trailing_zeros() as usize;
            waiting[level] &= waiting[level] - 1;
            let node = CHILDREN * parents[level] + child;
            if level == 0 {
                visit(node, &self.levels[0][parents[0]].get(child));
            } else {
                level -= 1;
                parents[level] = node;
                waiting[level] = self.levels[level][node].touching(simd, bounds);
            }
        }
    }

    /// Returns the size of the buffers in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.levels.iter().map(Vec::capacity).sum::<usize>() * size_of::<Boxes>()
    }
}
