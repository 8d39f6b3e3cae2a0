//! Finds neighbours in unorganized clouds, with a sorted index for the fast engines ([`PointIndex`]) and a k-d tree
//! for the reference.

mod boxes;
mod curve;
pub mod halo;
mod index;

#[cfg(feature = "kd-tree")]
mod search;

#[cfg(feature = "reference")]
use glam::DVec3;

pub(crate) use boxes::Bounds;
pub(crate) use index::{LEAF, LeafMoments, PointIndex};
#[cfg(feature = "kd-tree")]
pub use search::NeighbourSearch;

/// Maximum number of points sampled to measure an extent.
const SAMPLE: usize = 10_000;

/// Returns the smallest and the largest of a sample of values, excluding one percent of the values at either end as
/// stray. Returns `None` if no sampled value is finite.
pub fn middle(len: usize, value: impl Fn(usize) -> f64) -> Option<[f64; 2]> {
    let step = len.div_ceil(SAMPLE).max(1);
    let mut sample: Vec<f64> = (0..len).step_by(step).map(value).filter(|value| value.is_finite()).collect();
    let margin = sample.len() / 100;
    let last = sample.len().checked_sub(1)?;
    sample.sort_by(f64::total_cmp);
    Some([sample[margin], sample[last - margin]])
}

/// Returns the diagonal of the box around all points except stray ones, in metres.
#[cfg(feature = "reference")]
pub(crate) fn extent_m(points: &[DVec3]) -> f64 {
    let span = |axis: usize| middle(points.len(), |i| points[i][axis]).map_or(0.0, |[low, high]| high - low);
    DVec3::new(span(0), span(1), span(2)).length()
}

#[cfg(test)]
pub(crate) mod tests {
    /// Random numbers from 0 to 1, the same in every run.
    pub(crate) struct Random(pub(crate) u64);

    impl Random {
        pub(crate) fn next(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 40) as f32 / (1u64 << 24) as f32
        }
    }
}
