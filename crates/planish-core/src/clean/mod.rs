//! Filters to run before smoothing: outlier detection, voxel thinning, cropping to a box.
//!
//! None of them needs a grid. Holes are never outliers and stay holes.

mod outliers;
mod steps;
pub(crate) mod voxel_grid;
pub(crate) mod voxels;

use rayon::prelude::*;

use crate::cloud::PointCloud;
use crate::error::ParamError;
use crate::frame::PointsView;

pub use outliers::{radius_outliers, statistical_outliers};
pub use steps::{CleanCounts, CleanSteps};
pub use voxels::voxel_downsample;

/// Marks the points outside the box from `low` to `high`, in metres in the frame of the points; points on its border
/// are inside. Points of a `PointCloud` are relative to its origin; use [`cloud_outside_box`] if the box is in the
/// frame of its file.
///
/// # Errors
/// If a lower bound exceeds the upper bound, or a bound is NaN.
pub fn outside_box(points: &PointsView<'_>, low: [f64; 3], high: [f64; 3]) -> Result<Vec<bool>, ParamError> {
    outside(points.len(), |i| points.get(i), low, high)
}

/// Marks the points outside the box from `low` to `high`, in metres in the frame of the cloud's file; points on its
/// border are inside.
///
/// # Errors
/// If a lower bound exceeds the upper bound, or a bound is NaN.
pub fn cloud_outside_box(cloud: &PointCloud, low: [f64; 3], high: [f64; 3]) -> Result<Vec<bool>, ParamError> {
    outside(cloud.len(), |i| [0, 1, 2].map(|axis| cloud.coordinate(axis, i)), low, high)
}

fn outside(
    count: usize,
    point: impl Fn(usize) -> [f64; 3] + Sync,
    low: [f64; 3],
    high: [f64; 3],
) -> Result<Vec<bool>, ParamError> {
    if !(0..3).all(|axis| low[axis] <= high[axis]) {
        let allowed = "the smallest x, y, z, then the largest";
        return Err(ParamError { field: "box", value: format!("{low:?} to {high:?}"), allowed });
    }
    let is_outside = |i: usize| {
        let p = point(i);
        p.iter().all(|value| value.is_finite()) && (0..3).any(|axis| !(low[axis]..=high[axis]).contains(&p[axis]))
    };
    Ok((0..count).into_par_iter().map(is_outside).collect())
}
