//! Stores the points of an unorganized cloud in an order that keeps neighbours together, with a tree of boxes over
//! them.
//!
//! Distinct positions are sorted along a Hilbert curve; each run of 16 is a leaf, each run of 8 nodes a node of the
//! next level. Each box is the bounds of its points, so a stray point or an uneven density does not slow down
//! searches elsewhere. Points at the same position are merged into one with a count, and their result is computed
//! once.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

use fearless_simd::{Level, Simd};
use glam::DVec3;
use rayon::prelude::*;

use super::boxes::{Bounds, BoxTree};
use super::curve::{Curve, KEYS_AT_ONCE};
use crate::frame::PointsView;
use crate::threads::ONE_THREAD;

/// Number of points in a leaf: the lanes of the widest vector.
pub(crate) const LEAF: usize = 16;
/// Maximum number of points in a cell of the curve; the points of fuller cells are sorted along a finer curve.
const CROWDED: usize = 4 * LEAF;
/// Number of points copied per task.
const TASK: usize = 1 << 14;
/// The key of a hole: beyond the end of the curve.
const NO_KEY: u64 = u64::MAX;
/// The place of a hole.
const HOLE: u32 = u32::MAX;

/// The moments of a leaf's points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LeafMoments {
    /// Number of points.
    pub(crate) count: f32,
    pub(crate) mean: [f32; 3],
    /// Sums of the products xx, xy, xz, yy, yz and zz of the points' offsets from the mean.
    pub(crate) products: [f32; 6],
}

/// The distinct positions of a cloud, sorted.
#[derive(Debug, Default)]
pub(crate) struct PointIndex {
    /// x, y and z, padded with NaN to a whole leaf.
    pub(crate) positions: [Vec<f32>; 3],
    /// Number of points of the cloud at each position.
    pub(crate) counts: Vec<f32>,
    /// Place of each point of the cloud among the positions; [`HOLE`] for a hole.
    places: Vec<AtomicU32>,
    /// The boxes of leaves and of nodes over them.
    boxes: BoxTree,
    moments: Vec<LeafMoments>,
    /// Extent of the points, as defined by [`extent_m`](super::extent_m).
    extent_m: f64,
    len: usize,
    keys: Vec<(u64, u32)>,
}

impl PointIndex {
    /// Sorts the finite points of a cloud, as f32 relative to its origin. Reuses the buffers.
    pub(crate) fn fill(&mut self, view: &PointsView<'_>) {
        let mut raw = [(); 3].map(|()| vec![0.0; view.len()]);
        copy(view, &mut raw);
        let (curve, extent_m) = Curve::of(&raw);
        let level = Level::new();
        self.extent_m = view.extent_m().unwrap_or(extent_m);
        let at = |i: u32| point_of(&raw, i as usize);
        self.keys.resize(view.len(), Default::default());
        self.keys.par_chunks_mut(KEYS_AT_ONCE).enumerate().for_each(|(chunk, keys)| {
            let first = KEYS_AT_ONCE * chunk;
            let mut points = [[0.0; KEYS_AT_ONCE]; 3];
            for (values, raw) in points.iter_mut().zip(&raw) {
                values[..keys.len()].copy_from_slice(&raw[first..first + keys.len()]);
            }
            for (k, (key, of_curve)) in keys.iter_mut().zip(curve.keys(level, &points)).enumerate() {
                let is_point = points[0][k].is_finite() & points[1][k].is_finite() & points[2][k].is_finite();
                *key = (if is_point { of_curve } else { NO_KEY }, (first + k) as u32);
            }
        });
        self.keys.retain(|&(key, _)| key != NO_KEY);
        // -0 and 0 are the same coordinate.
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
        let leaves: Vec<Bounds> = (0..self.leaves()).into_par_iter().map(leaf).collect();
        self.boxes = BoxTree::over(&leaves);
        self.moments.clear();
        let Self { positions, counts, len, moments, .. } = self;
        let leaves = (0..len.div_ceil(LEAF)).into_par_iter();
        moments.par_extend(
            leaves.map(|leaf| LeafMoments::of(positions, counts, LEAF * leaf..(LEAF * (leaf + 1)).min(*len))),
        );
    }

    /// Keeps the first `len` positions and appends points with a count of 0.
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

    /// Returns the diagonal of the box around all points except stray ones, in metres.
    pub(crate) fn extent_m(&self) -> f32 {
        self.extent_m as f32
    }

    /// Returns the number of distinct positions.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Returns the moments of a leaf's points.
    #[inline(always)]
    pub(crate) fn moments(&self, leaf: usize) -> &LeafMoments {
        &self.moments[leaf]
    }

    /// Returns the box around the points of a leaf.
    pub(crate) fn leaf_bounds(&self, leaf: usize) -> Bounds {
        self.boxes.get(0, leaf)
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

    /// Visits, in ascending order, leaves whose boxes touch a box.
    #[inline(always)]
    pub(crate) fn for_each_leaf<S: Simd>(&self, simd: S, bounds: &Bounds, visit: impl FnMut(usize, &Bounds)) {
        self.boxes.for_each_leaf(simd, bounds, visit);
    }

    /// Returns an iterator over the positions, nearest to a point first. It yields squared distances and places,
    /// which are computed on demand.
    pub(crate) fn nearest(&self, point: [f32; 3]) -> Nearest<'_> {
        let mut nearest = Nearest { index: self, point, queue: Default::default() };
        if let Some(top) = self.boxes.levels().checked_sub(1) {
            nearest.push_nodes(top, self.boxes.children(top, 0));
        }
        nearest
    }

    /// Returns the size of the buffers in bytes.
    pub(crate) fn bytes(&self) -> usize {
        let values: usize = self.positions.iter().map(Vec::capacity).sum();
        4 * (values + self.counts.capacity() + self.places.capacity())
            + self.boxes.bytes()
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
            // Offsets are relative to the mean as rounded to f32.
            let d = p - mean.as_dvec3();
            let terms = [d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z];
            products.iter_mut().zip(terms).for_each(|(product, term)| *product += count * term);
        }
        Self { count: count as f32, mean: mean.to_array(), products: products.map(|product| product as f32) }
    }
}

/// Iterator over positions, nearest first. Nodes and positions share a queue, ordered by their smallest possible
/// distance.
pub(crate) struct Nearest<'a> {
    index: &'a PointIndex,
    point: [f32; 3],
    /// Bits of the squared distance, which sort like its value; level + 1 of a node, or 0 for a position; and the
    /// number of the node or the place of the position.
    queue: std::collections::BinaryHeap<std::cmp::Reverse<(u32, u32, u32)>>,
}

impl Nearest<'_> {
    fn push_nodes(&mut self, level: usize, nodes: Range<usize>) {
        for node in nodes {
            let square = self.index.boxes.get(level, node).distance_squared(self.point);
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
                    self.push_nodes(below, self.index.boxes.children(below, number));
                }
            }
        }
    }
}

/// Returns point `i` from arrays of x, y and z. Written out, because `array::map` is not inlined in kernels; see
/// cpu/vector.rs.
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
    let curve = Curve::over(bounds.low, extent);
    let level = Level::new();
    for chunk in cell.chunks_mut(KEYS_AT_ONCE) {
        let mut points = [[0.0; KEYS_AT_ONCE]; 3];
        for (k, &(_, i)) in chunk.iter().enumerate() {
            for (values, value) in points.iter_mut().zip(at(i)) {
                values[k] = value;
            }
        }
        chunk.iter_mut().zip(curve.keys(level, &points)).for_each(|((key, _), of_curve)| *key = of_curve);
    }
    // The sort is stable: points with equal keys stay in the order of their coordinates.
    if ONE_THREAD {
        cell.sort_by_key(|&(key, _)| key)
    } else {
        cell.par_sort_by_key(|&(key, _)| key)
    }
    if cell.first().map(|first| first.0) != cell.last().map(|last| last.0) {
        refine_cells(cell, raw);
    }
}

/// Sorts the points of each crowded cell along a finer curve.
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

#[cfg(test)]
mod tests;
