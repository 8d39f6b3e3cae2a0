//! Neighbours in general clouds, by a k-d tree over the finite points.

mod spacing;

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::num::NonZero;

use crate::error::EngineError;

pub use spacing::estimate_radius_m;

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

    /// Distance in metres from p to its `n`-th nearest point, p itself not counted if it is one of them.
    pub(crate) fn distance_to_nth(&self, p: DVec3, n: usize) -> Option<f64> {
        let count = NonZero::new(n + 1)?;
        let nearest = self.tree.as_ref()?.query(&p.to_array()).nearest_n::<SquaredEuclidean<f64>>(count).execute();
        nearest.get(n).map(|found| found.distance.sqrt())
    }
}
