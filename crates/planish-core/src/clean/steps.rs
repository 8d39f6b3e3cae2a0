//! Cleaning steps, applied in order.

use super::{cloud_outside_box, radius_outliers, statistical_outliers, voxel_downsample};
use crate::cloud::PointCloud;
use crate::doubts::about_resolution;
use crate::error::{Error, FrameError, ParamError};
use crate::frame::PointsView;

/// Cleaning steps, applied in the order of these fields; `None` skips a step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CleanSteps {
    /// Box to keep: smallest and largest x, y, z in metres, in the frame of the cloud's file.
    pub crop_m: Option<[[f64; 3]; 2]>,
    /// Size of voxels in metres; one point is kept per voxel, and the grid is lost.
    pub voxel_m: Option<f64>,
    /// Statistical test: the number of nearest neighbours, and the maximum excess of a point's mean distance to these
    /// neighbours over the average of all points, in standard deviations.
    pub statistical: Option<(usize, f32)>,
    /// Radius test: the radius in metres, and the minimum number of neighbours within the radius.
    pub radius: Option<(f32, usize)>,
}

/// The number of points before and after cleaning, and the number removed by each step; `None` for a skipped step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub struct CleanCounts {
    /// Number of points in the input, excluding holes.
    pub points_in: usize,
    /// Number of holes in an unorganized cloud, which are dropped.
    pub holes_dropped: usize,
    /// Number of points outside the box.
    pub outside_box: Option<usize>,
    /// Number of points merged into another point of the same voxel.
    pub merged: Option<usize>,
    /// Number of statistical outliers.
    pub statistical_outliers: Option<usize>,
    /// Number of points with too few neighbours within the radius.
    pub radius_outliers: Option<usize>,
    /// Number of points that remain.
    pub points_out: usize,
}

impl CleanSteps {
    /// Returns true if no step is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Applies the steps. On a grid (width and height), removed points become holes. Without a grid, removed points
    /// and holes are dropped. With voxels, `grid` becomes `None`.
    ///
    /// # Errors
    /// If a value is outside its range; `field` names the step and the value: `crop`, `voxel`,
    /// `statistical.neighbours`, `statistical.deviations`, `radius.radius_m`, `radius.neighbours`. Also if f32 rounds
    /// the coordinates of the points in the box too coarsely ([`Doubt::Coarse`](crate::Doubt::Coarse)).
    pub fn apply(&self, points: &mut PointCloud, grid: &mut Option<(usize, usize)>) -> Result<CleanCounts, Error> {
        let points_in = points.valid_points();
        let mut counts = CleanCounts { points_in, ..CleanCounts::default() };
        if grid.is_none() && points_in < points.len() {
            counts.holes_dropped = points.len() - points_in;
            let is_hole: Vec<bool> = (0..points.len()).map(|i| !points.positions.is_finite(i)).collect();
            remove(points, &is_hole, false);
        }
        if let Some([low, high]) = self.crop_m {
            let is_outside = cloud_outside_box(points, low, high).map_err(named(|_| "crop"))?;
            counts.outside_box = Some(remove(points, &is_outside, grid.is_some()));
        }
        // A cloud with too many points for a view skips this check, so that it can still be cropped and thinned.
        let view = PointsView::from_cloud(points).ok();
        if let Some(doubt) = view.as_ref().and_then(about_resolution) {
            return Err(FrameError::TooCoarse(doubt.to_string()).into());
        }
        if let Some(size_m) = self.voxel_m {
            let before = points.valid_points();
            *points = voxel_downsample(points, size_m).map_err(named(|_| "voxel"))?;
            *grid = None;
            counts.merged = Some(before - points.len());
        }
        if let Some((neighbours, deviations)) = self.statistical {
            let is_outlier = statistical_outliers(&PointsView::from_cloud(points)?, neighbours, deviations);
            let is_outlier = is_outlier.map_err(named(|field| match field {
                "neighbours" => "statistical.neighbours",
                _ => "statistical.deviations",
            }))?;
            counts.statistical_outliers = Some(remove(points, &is_outlier, grid.is_some()));
        }
        if let Some((radius_m, least)) = self.radius {
            let is_outlier = radius_outliers(&PointsView::from_cloud(points)?, radius_m, least);
            let is_outlier = is_outlier.map_err(named(|field| match field {
                "neighbours" => "radius.neighbours",
                _ => "radius.radius_m",
            }))?;
            counts.radius_outliers = Some(remove(points, &is_outlier, grid.is_some()));
        }
        counts.points_out = points.valid_points();
        Ok(counts)
    }
}

/// Returns a function that sets the field of an error to the name of its step.
fn named(name: impl Fn(&str) -> &'static str) -> impl Fn(ParamError) -> ParamError {
    move |error| ParamError { field: name(error.field), ..error }
}

/// Turns marked points into holes on a grid, and drops them otherwise. Returns the number of marked points.
fn remove(points: &mut PointCloud, is_marked: &[bool], is_on_grid: bool) -> usize {
    if is_on_grid {
        let marked = is_marked.iter().enumerate().filter(|(_, marked)| **marked);
        marked.for_each(|(i, _)| points.positions.set(i, [f32::NAN; 3]));
    } else {
        let kept: Vec<usize> = (0..is_marked.len()).filter(|&i| !is_marked[i]).collect();
        *points = points.select(&kept);
    }
    is_marked.iter().filter(|marked| **marked).count()
}
