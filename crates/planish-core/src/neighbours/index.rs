//! The points of an unorganized cloud in an order that keeps neighbours together, and a tree of boxes over them.
//!
//! Distinct positions are sorted along a Hilbert curve; each run of 16 is a leaf, each run of 8 nodes a node of the
//! next level. The tree has no pointers: the indices of a node's children follow from its index. Boxes are the bounds
//! of their points, so a stray point or an uneven density is not costly elsewhere. Points at the same position become
//! one with a count, and their result is computed once.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::DVec3;
use rayon::prelude::*;

use super::middle;
use crate::frame::PointsView;
use crate::threads::ONE_THREAD;

/// Points in a leaf: the lanes of the widest vector.
pub(crate) const LEAF: usize = 16;
/// Nodes under a node.
const CHILDREN: usize = 8;
/// Enough for 2^28 points.
const MAX_LEVELS: usize = 10;
/// The curve visits 2^16 cells along each axis; points of a crowded cell are sorted along a finer curve.
const CURVE_BITS: u32 = 16;
/// More points than this in a cell of the curve are sorted once more.
const CROWDED: usize = 4 * LEAF;
/// Points handled by a task.
const TASK: usize = 1 << 14;
/// The place of a point that is a hole.
const HOLE: u32 = u32::MAX;

/// A box: the least and the largest coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) low: [f32; 3],
    pub(crate) high: [f32; 3],
}

impl Bounds {
    /// Of no point.
    pub(crate) const EMPTY: Self = Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3] };

    /// Returns the box of both.
    pub(crate) fn union(self, other: Self) -> Self {
        let of = |pick: fn(f32, f32) -> f32, [a, b]: [[f32; 3]; 2]| std::array::from_fn(|axis| pick(a[axis], b[axis]));
        // If one operand is NaN, min and max return the other.
        Self { low: of(f32::min, [self.low, other.low]), high: of(f32::max, [self.high, other.high]) }
    }

    pub(crate) fn of_point(point: [f32; 3]) -> Self {
        Self { low: point, high: point }
    }

    /// Returns the box that is larger by this on every side.
    pub(crate) fn grown(self, by: f32) -> Self {
        Self { low: self.low.map(|value| value - by), high: self.high.map(|value| value + by) }
    }

    /// Returns true if they touch.
    #[inline(always)]
    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|axis| self.low[axis] <= other.high[axis] && other.low[axis] <= self.high[axis])
    }

    /// The square of a point's distance from it.
    pub(crate) fn distance_squared(&self, point: [f32; 3]) -> f32 {
        let outside = |axis: usize| (self.low[axis] - point[axis]).max(point[axis] - self.high[axis]).max(0.0).powi(2);
        outside(0) + outside(1) + outside(2)
    }
}

/// The points of a leaf together.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LeafMoments {
    /// How many.
    pub(crate) count: f32,
    pub(crate) mean: [f32; 3],
    /// Sums of the products xx, xy, xz, yy, yz, zz of their offsets from the mean.
    pub(crate) products: [f32; 6],
}

/// The distinct positions of a cloud, sorted.
#[derive(Debug, Default)]
pub(crate) struct PointIndex {
    /// x, y and z, with NaN after the last point up to a whole leaf.
    pub(crate) positions: [Vec<f32>; 3],
    /// Number of points of the cloud at each position.
    pub(crate) counts: Vec<f32>,
    /// The place of each point of the cloud among the positions.
    places: Vec<AtomicU32>,
    /// The boxes of leaves, of nodes over them, and so on, up to eight nodes or fewer.
    levels: Vec<Vec<Bounds>>,
    moments: Vec<LeafMoments>,
    /// Extent of the points, as defined by [`extent_m`](super::extent_m).
    extent_m: f64,
    len: usize,
    keys: Vec<(u64, u32)>,
}

impl PointIndex {
    /// Sorts the finite points of a cloud, as f32 relative to its origin; buffers are reused.
    pub(crate) fn fill(&mut self, view: &PointsView<'_>) {
        let mut raw = [(); 3].map(|()| vec![0.0; view.len()]);
        copy(view, &mut raw);
        let curve = Curve::of(&raw);
        self.extent_m = view.extent_m().unwrap_or(curve.extent_m);
        let at = |i: u32| point_of(&raw, i as usize);
        self.keys.clear();
        self.keys.par_extend((0..view.len() as u32).into_par_iter().filter_map(|i| {
            let point = at(i);
            point.iter().all(|value| value.is_finite()).then(|| (curve.key(point), i))
        }));
        // -0 and 0 are one place.
        let bits = |i: u32| {
            let [x, y, z] = at(i);
            [(x + 0.0).to_bits(), (y + 0.0).to_bits(), (z + 0.0).to_bits()]
        };
        let order =
            |a: &(u64, u32), b: &(u64, u32)| a.0.cmp(&b.0).then_with(|| (bits(a.1), a.1).cmp(&(bits(b.1), b.1)));
        if ONE_THREAD {
            self.keys.sort_unstable_by(order)
        } else {
            self.keys.par_sort_unstable_by(order)
        }
        refine_cells(&mut self.keys, &raw);

        self.places.clear();
        self.places.par_extend((0..view.len()).into_par_iter().map(|_| AtomicU32::new(HOLE)));
        let is_repeated = |i: usize| i > 0 && bits(self.keys[i].1) == bits(self.keys[i - 1].1);
        // Start of each run of equal positions; `None` if all positions differ.
        let firsts: Option<Vec<u32>> = (0..self.keys.len())
            .into_par_iter()
            .any(is_repeated)
            .then(|| (0..self.keys.len()).into_par_iter().filter(|&i| !is_repeated(i)).map(|i| i as u32).collect());
        self.len = firsts.as_ref().map_or(self.keys.len(), Vec::len);
        let first = |place: usize| {
            firsts.as_ref().map_or(place, |firsts| firsts.get(place).map_or(self.keys.len(), |&i| i as usize))
        };

        let padded = self.len.next_multiple_of(LEAF);
        for (axis, values) in self.positions.iter_mut().enumerate() {
            values.clear();
            let value = |place| if place < self.len { raw[axis][self.keys[first(place)].1 as usize] } else { f32::NAN };
            values.par_extend((0..padded).into_par_iter().map(value));
        }
        self.counts.clear();
        let count = |place| if place < self.len { (first(place + 1) - first(place)) as f32 } else { 0.0 };
        self.counts.par_extend((0..padded).into_par_iter().map(count));
        (0..self.len).into_par_iter().for_each(|place| {
            for &(_, i) in &self.keys[first(place)..first(place + 1)] {
                self.places[i as usize].store(place as u32, Ordering::Relaxed);
            }
        });
        self.build_boxes();
    }

    fn build_boxes(&mut self) {
        let leaf = |leaf: usize| {
            let points = (LEAF * leaf..LEAF * (leaf + 1)).map(|place| Bounds::of_point(self.point(place)));
            points.fold(Bounds::EMPTY, Bounds::union)
        };
        let mut levels: Vec<Vec<Bounds>> = vec![(0..self.leaves()).into_par_iter().map(leaf).collect()];
        while let Some(below) = levels.last().filter(|below| below.len() > CHILDREN) {
            let node = |children: &[Bounds]| children.iter().copied().fold(Bounds::EMPTY, Bounds::union);
            let above = below.par_chunks(CHILDREN).map(node).collect();
            levels.push(above);
        }
        self.levels = levels;
        self.moments.clear();
        let Self { positions, counts, len, moments, .. } = self;
        let leaves = (0..len.div_ceil(LEAF)).into_par_iter();
        moments.par_extend(
            leaves.map(|leaf| LeafMoments::of(positions, counts, LEAF * leaf..(LEAF * (leaf + 1)).min(*len))),
        );
    }

    /// Keeps the first `len` places and appends points without weight.
    pub(crate) fn append(&mut self, len: usize, points: &[[f32; 3]]) {
        self.len = len + points.len();
        let padded = self.len.next_multiple_of(LEAF);
        for (axis, values) in self.positions.iter_mut().enumerate() {
            values.truncate(len);
            values.extend(points.iter().map(|point| point[axis]));
            values.resize(padded, f32::NAN);
        }
        self.counts.truncate(len);
        self.counts.resize(padded, 0.0);
        self.build_boxes();
    }

    /// Returns the diagonal of the box around all points but stray ones, in metres.
    pub(crate) fn extent_m(&self) -> f32 {
        self.extent_m as f32
    }

    /// Returns the number of distinct positions.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Returns the points of a leaf together.
    #[inline(always)]
    pub(crate) fn moments(&self, leaf: usize) -> &LeafMoments {
        &self.moments[leaf]
    }

    /// Returns the box around the points of a leaf.
    pub(crate) fn leaf_bounds(&self, leaf: usize) -> Bounds {
        self.levels[0][leaf]
    }

    /// Returns the number of leaves.
    pub(crate) fn leaves(&self) -> usize {
        self.len.div_ceil(LEAF)
    }

    #[inline]
    pub(crate) fn point(&self, place: usize) -> [f32; 3] {
        point_of(&self.positions, place)
    }

    /// Returns the place of point `i` of the cloud; `None` for a hole.
    #[inline]
    pub(crate) fn place(&self, i: usize) -> Option<usize> {
        let place = self.places[i].load(Ordering::Relaxed);
        (place != HOLE).then_some(place as usize)
    }

    /// Visits, in ascending order, leaves whose box and all enclosing nodes are `wanted`.
    #[inline(always)]
    pub(crate) fn for_each_leaf(&self, mut wanted: impl FnMut(&Bounds) -> bool, mut visit: impl FnMut(usize, &Bounds)) {
        let Some(top) = self.levels.len().checked_sub(1) else { return };
        let mut level = top;
        let mut next = [0; MAX_LEVELS];
        let mut end = [0; MAX_LEVELS];
        end[top] = self.levels[top].len();
        loop {
            if next[level] == end[level] {
                if level == top {
                    return;
                }
                level += 1;
                continue;
            }
            let node = next[level];
            next[level] += 1;
            let bounds = &self.levels[level][node];
            if !wanted(bounds) {
                continue;
            }
            if level == 0 {
                visit(node, bounds);
            } else {
                level -= 1;
                next[level] = CHILDREN * node;
                end[level] = (CHILDREN * (node + 1)).min(self.levels[level].len());
            }
        }
    }

    /// Returns the squared distances from a point to the positions, and their places, nearest first: computed on
    /// demand.
    pub(crate) fn nearest(&self, point: [f32; 3]) -> Nearest<'_> {
        let mut nearest = Nearest { index: self, point, queue: Default::default() };
        if let Some(top) = self.levels.len().checked_sub(1) {
            nearest.push_nodes(top, 0..self.levels[top].len());
        }
        nearest
    }

    /// Bytes of its buffers.
    pub(crate) fn bytes(&self) -> usize {
        let boxes: usize = self.levels.iter().map(Vec::capacity).sum();
        let values: usize = self.positions.iter().map(Vec::capacity).sum();
        4 * (values + self.counts.capacity() + self.places.capacity())
            + boxes * size_of::<Bounds>()
            + self.moments.capacity() * size_of::<LeafMoments>()
            + self.keys.capacity() * size_of::<(u64, u32)>()
    }
}

impl LeafMoments {
    fn of(positions: &[Vec<f32>; 3], counts: &[f32], places: Range<usize>) -> Self {
        let at = |place: usize| DVec3::from_array(positions.each_ref().map(|values| f64::from(values[place])));
        let weighted = || places.clone().map(|place| (f64::from(counts[place]), at(place)));
        let count: f64 = weighted().map(|(count, _)| count).sum();
        let sum = weighted().map(|(count, p)| count * p).sum::<DVec3>();
        let mean = (sum / count.max(f64::MIN_POSITIVE)).as_vec3();
        let mut products = [0.0; 6];
        for (count, p) in weighted() {
            // Relative to the mean as rounded to f32.
            let d = p - mean.as_dvec3();
            let terms = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
            products.iter_mut().zip(terms).for_each(|(product, term)| *product += count * term);
        }
        Self { count: count as f32, mean: mean.to_array(), products: products.map(|product| product as f32) }
    }
}

/// The nearest positions first: nodes and positions wait in one queue, by how near they can be.
pub(crate) struct Nearest<'a> {
    index: &'a PointIndex,
    point: [f32; 3],
    /// Bits of a square (which sort as its value does), level + 1, number; level 0 is a position.
    queue: std::collections::BinaryHeap<std::cmp::Reverse<(u32, u32, u32)>>,
}

impl Nearest<'_> {
    fn push_nodes(&mut self, level: usize, nodes: Range<usize>) {
        for node in nodes {
            let square = self.index.levels[level][node].distance_squared(self.point);
            self.queue.push(std::cmp::Reverse((square.to_bits(), level as u32 + 1, node as u32)));
        }
    }
}

impl Iterator for Nearest<'_> {
    type Item = (f32, u32);

    fn next(&mut self) -> Option<(f32, u32)> {
        loop {
            let std::cmp::Reverse((bits, level, number)) = self.queue.pop()?;
            let place = number;
            let number = number as usize;
            match level {
                0 => return Some((f32::from_bits(bits), place)),
                1 => {
                    for place in LEAF * number..(LEAF * (number + 1)).min(self.index.len) {
                        let square = Bounds::of_point(self.index.point(place)).distance_squared(self.point);
                        self.queue.push(std::cmp::Reverse((square.to_bits(), 0, place as u32)));
                    }
                }
                _ => {
                    let below = level as usize - 2;
                    let end = (CHILDREN * (number + 1)).min(self.index.levels[below].len());
                    self.push_nodes(below, CHILDREN * number..end);
                }
            }
        }
    }
}

/// A point of three channels. Written out, since `array::map` is called out of line in kernels; see cpu/vector.rs.
#[inline]
fn point_of([x, y, z]: &[Vec<f32>; 3], i: usize) -> [f32; 3] {
    [x[i], y[i], z[i]]
}

/// Sorts the points of a crowded cell along a curve through their bounding box, unless they coincide.
fn refine(cell: &mut [(u64, u32)], raw: &[Vec<f32>; 3]) {
    if cell.len() <= CROWDED {
        return;
    }
    let at = |i: u32| point_of(raw, i as usize);
    let bounds = cell.iter().map(|&(_, i)| Bounds::of_point(at(i))).fold(Bounds::EMPTY, Bounds::union);
    if bounds.low == bounds.high {
        return;
    }
    let extent = (0..3).map(|axis| bounds.high[axis] - bounds.low[axis]).fold(0.0, f32::max);
    let cells_per_metre = ((1u32 << CURVE_BITS) as f32 / extent).min(f32::MAX);
    let curve = Curve { low: bounds.low, cells_per_metre, extent_m: 0.0 };
    cell.iter_mut().for_each(|(key, i)| *key = curve.key(at(*i)));
    // Equal keys stay in the order of coordinates that they are in.
    if ONE_THREAD {
        cell.sort_by_key(|&(key, _)| key)
    } else {
        cell.par_sort_by_key(|&(key, _)| key)
    }
    if cell.first().map(|first| first.0) != cell.last().map(|last| last.0) {
        refine_cells(cell, raw);
    }
}

/// Sorts the points of each cell.
fn refine_cells(keys: &mut [(u64, u32)], raw: &[Vec<f32>; 3]) {
    if ONE_THREAD {
        keys.chunk_by_mut(|a, b| a.0 == b.0).for_each(|cell| refine(cell, raw));
    } else {
        keys.par_chunk_by_mut(|a, b| a.0 == b.0).for_each(|cell| refine(cell, raw));
    }
}

fn copy(view: &PointsView<'_>, to: &mut [Vec<f32>; 3]) {
    let [x, y, z] = to;
    let tasks = x.par_chunks_mut(TASK).zip(y.par_chunks_mut(TASK)).zip(z.par_chunks_mut(TASK));
    tasks.enumerate().for_each(|(task, ((x, y), z))| view.copy_to(TASK * task..TASK * task + x.len(), x, y, z));
}

/// A Hilbert curve through the box of most points.
struct Curve {
    low: [f32; 3],
    cells_per_metre: f32,
    extent_m: f64,
}

impl Curve {
    /// Covers all points except strays: the middle of a sample, and its width again on either side. Points outside are
    /// moved to the border, which affects only the order.
    fn of(raw: &[Vec<f32>; 3]) -> Self {
        let middle = raw.each_ref().map(|values| middle(values.len(), |i| f64::from(values[i])).unwrap_or_default());
        let extent_m = middle.iter().map(|[low, high]| (high - low).powi(2)).sum::<f64>().sqrt();
        let range = middle.map(|[low, high]| [low - 0.5 * (high - low), high + 0.5 * (high - low)]);
        let extent = range.iter().map(|[low, high]| high - low).fold(f64::from(f32::MIN_POSITIVE), f64::max);
        let cells_per_metre = (f64::from(1u32 << CURVE_BITS) / extent).min(f64::from(f32::MAX)) as f32;
        Self { low: range.map(|[low, _]| low as f32), cells_per_metre, extent_m }
    }

    /// Returns the position of a point's cell along the curve: Skilling's transposition ("Programming the Hilbert
    /// curve", 2004).
    fn key(&self, point: [f32; 3]) -> u64 {
        let largest = (1u32 << CURVE_BITS) - 1;
        // The cast saturates.
        let mut cell: [u32; 3] =
            std::array::from_fn(|axis| (((point[axis] - self.low[axis]) * self.cells_per_metre) as u32).min(largest));
        // Without branches, since half of them would be mispredicted.
        for bit in (1..CURVE_BITS).rev() {
            let below = (1 << bit) - 1;
            for axis in 0..3 {
                let inverts = ((cell[axis] >> bit) & 1).wrapping_neg();
                let exchanged = (cell[0] ^ cell[axis]) & below & !inverts;
                cell[0] ^= exchanged ^ (below & inverts);
                cell[axis] ^= exchanged;
            }
        }
        cell[1] ^= cell[0];
        cell[2] ^= cell[1];
        // Each bit is the parity of those over it.
        let mut flips = cell[2] >> 1;
        for shift in [1, 2, 4, 8] {
            flips ^= flips >> shift;
        }
        let [x, y, z] = cell;
        (spread(x ^ flips) << 2) | (spread(y ^ flips) << 1) | spread(z ^ flips)
    }
}

/// Returns the low 16 bits, each after two zeros.
fn spread(value: u32) -> u64 {
    let value = u64::from(value & 0xffff);
    let value = (value | (value << 16)) & 0xff00_00ff;
    let value = (value | (value << 8)) & 0x00f0_0f00_f00f;
    let value = (value | (value << 4)) & 0x0c30_c30c_30c3;
    (value | (value << 2)) & 0x2492_4924_9249
}

#[cfg(test)]
mod tests;
