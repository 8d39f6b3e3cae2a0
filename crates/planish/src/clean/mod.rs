//! What people run before smoothing: outliers found, clouds thinned to voxels, a box cut out.
//!
//! Nothing here needs a grid. Holes are never outliers: they stay what they are.

mod outliers;
pub(crate) mod voxel_grid;
pub(crate) mod voxels;

use rayon::prelude::*;

use crate::error::ParamError;
use crate::frame::PointsView;

pub use outliers::{radius_outliers, statistical_outliers};
pub use voxels::voxel_downsample;

/// Marks the points outside the box from `low` to `high`, in metres in the cloud's frame; its borders are inside.
///
/// # Errors
/// If the box is empty or not of numbers.
pub fn outside_box(points: &PointsView<'_>, low: [f64; 3], high: [f64; 3]) -> Result<Vec<bool>, ParamError> {
    if !(0..3).all(|axis| low[axis] <= high[axis]) {
        let allowed = "the least x, y, z and then the largest";
        return Err(ParamError { field: "box", value: format!("{low:?} to {high:?}"), allowed });
    }
    let is_outside = |i: usize| {
        let p = points.get(i);
        p.iter().all(|value| value.is_finite()) && (0..3).any(|axis| !(low[axis]..=high[axis]).contains(&p[axis]))
    };
    Ok((0..points.len()).into_par_iter().map(is_outside).collect())
}
