//! Neighbour search with a k-d tree, for the reference and for metrics.

use std::num::NonZero;

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use crate::error::EngineError;

/// A k-d tree over the finite points of a cloud.
pub struct NeighbourSearch {
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Index in the cloud of each point in the tree.
    index: Vec<u32>,
}

impl NeighbourSearch {
    /// Builds the tree.
    pub fn new(points: &[DVec3]) -> Result<Self, EngineError> {
        let index: Vec<u32> = (0u32..).zip(points).filter(|(_, p)| p.is_finite()).map(|(i, _)| i).collect();
        let finite: Vec<[f64; 3]> = index.iter().map(|&i| points[i as usize].to_array()).collect();
        let tree = if finite.is_empty() {
            None
        } else {
            Some(ImmutableKdTree::new_from_slice(&finite).map_err(|error| EngineError::Unavailable {
                engine: "reference",
                reason: format!("cannot build a search tree of {} points: {error}", finite.len()),
            })?)
        };
        Ok(Self { tree, index })
    }

    /// Sets `found` to the indices of all points within `radius_m` of p. They are in ascending order, so that sums do
    /// not depend on the tree.
    #[cfg(feature = "reference")]
    pub fn within(&self, p: DVec3, radius_m: f64, found: &mut Vec<usize>) {
        found.clear();
        let Some(tree) = &self.tree else { return };
        let items = tree.query(&p.to_array()).within::<SquaredEuclidean<f64>>(radius_m * radius_m).unsorted().execute();
        found.extend(items.into_iter().map(|found| self.index[found.item as usize] as usize));
        found.sort_unstable();
    }

    /// Returns the indices of up to `count` points nearest to p, in ascending order.
    pub fn nearest(&self, p: DVec3, count: usize) -> Vec<usize> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        let nearest = tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        let mut found: Vec<usize> = nearest.into_iter().map(|found| self.index[found.item as usize] as usize).collect();
        found.sort_unstable();
        found
    }

    /// Returns the squared distances from p to up to `count` nearest points, in ascending order.
    #[cfg(feature = "reference")]
    pub fn nearest_squares(&self, p: DVec3, count: usize) -> Vec<f64> {
        let (Some(tree), Some(count)) = (&self.tree, NonZero::new(count)) else { return Vec::new() };
        let nearest = tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        let mut squares: Vec<f64> = nearest.into_iter().map(|found| found.distance).collect();
        squares.sort_by(f64::total_cmp);
        squares
    }
}
