//! Neighbours in general clouds: sorted for the fast engines ([`PointIndex`]), and a k-d tree for the reference.

mod index;

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::num::NonZero;

use crate::error::EngineError;

pub(crate) use index::{Bounds, LEAF, LeafMoments, PointIndex};

/// Points from which an extent is taken.
const SAMPLE: usize = 10_000;

/// The least and the largest of some values, but for stray ones: one of a hundred on either side. `None` if none is finite.
pub(crate) fn middle(len: usize, value: impl Fn(usize) -> f64) -> Option<[f64; 2]> {
    let step = len.div_ceil(SAMPLE).max(1);
    let mut sample: Vec<f64> = (0..len).step_by(step).map(value).filter(|value| value.is_finite()).collect();
    let margin = sample.len() / 100;
    let last = sample.len().checked_sub(1)?;
    sample.sort_by(f64::total_cmp);
    Some([sample[margin], sample[last - margin]])
}

/// The diagonal of the box around all points but stray ones, in metres.
pub(crate) fn extent_m(points: &[DVec3]) -> f64 {
    let span = |axis: usize| middle(points.len(), |i| points[i][axis]).map_or(0.0, |[low, high]| high - low);
    DVec3::new(span(0), span(1), span(2)).length()
}

/// A k-d tree over the finite points of a cloud.
pub(crate) struct NeighbourSearch {
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Index in the cloud of each point in the tree.
    index: Vec<u32>,
}

impl NeighbourSearch {
    pub(crate) fn new(points: &[DVec3]) -> Result<Self, EngineError> {
        let index: Vec<u32> = (0u32..).zip(points).filter(|(_, p)| p.is_finite()).map(|(i, _)| i).collect();
        let finite: Vec<[f64; 3]> = index.iter().map(|&i| points[i as usize].to_array()).collect();
        let tree = if finite.is_empty() {
            None
        } else {
            Some(ImmutableKdTree::new_from_slice(&finite).map_err(|error| EngineError::Unavailable {
                engine: "reference",
                reason: format!("no search tree over {} points: {error}", finite.len()),
            })?)
        };
        Ok(Self { tree, index })
    }

    /// Indices of all points within `radius_m` of p, ascending, so that sums do not depend on the tree.
    pub(crate) fn within(&self, p: DVec3, radius_m: f64, found: &mut Vec<usize>) {
        found.clear();
        let Some(tree) = &self.tree else { return };
        let items = tree.query(&p.to_array()).within::<SquaredEuclidean<f64>>(radius_m * radius_m).unsorted().execute();
        found.extend(items.into_iter().map(|found| self.index[found.item as usize] as usize));
        found.sort_unstable();
    }

    /// Indices of so many points nearest to p or fewer, ascending.
    #[cfg(feature = "evaluate")]
    pub(crate) fn nearest(&self, p: DVec3, count: usize) -> Vec<usize> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        let nearest = tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        let mut found: Vec<usize> = nearest.into_iter().map(|found| self.index[found.item as usize] as usize).collect();
        found.sort_unstable();
        found
    }

    /// The squares of the distances from p to so many nearest points or fewer, ascending.
    pub(crate) fn nearest_squares(&self, p: DVec3, count: usize) -> Vec<f64> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        let nearest = tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        let mut squares: Vec<f64> = nearest.into_iter().map(|found| found.distance).collect();
        squares.sort_by(f64::total_cmp);
        squares
    }
}

#[cfg(test)]
pub(crate) mod tests {
    /// Numbers from 0 to 1, the same in every run.
    pub(crate) struct Random(pub(crate) u64);

    impl Random {
        pub(crate) fn next(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 40) as f32 / (1u64 << 24) as f32
        }
    }
}
