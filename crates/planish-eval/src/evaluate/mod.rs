//! Scores of surface quality, with the ground truth of simulated frames or without ground truth.
//!
//! [`Suite`] renders the frames, and [`Evaluation`] computes a method's scores on them. [`tile_planes`] needs no
//! ground truth.

mod calibration;
mod curves;
mod evaluation;
mod filling;
mod geometry;
mod patches;
mod rig;
mod suite;
mod tiles;
mod video;

use crate::simulate::{NO_OBJECT, Truth};
use planish_core::{Camera, Xyz};

pub use calibration::{Calibration, CalibrationReport};
pub use curves::CurveReport;
pub use evaluation::{AngleReport, Evaluation, RangeReport, Report, jitter_mm};
pub use filling::{FillEvaluation, FillReport, HoleReport, cut_holes, hole_mask};
pub use patches::{PatchReport, patch_planes};
pub use rig::{RigCase, RigCaseCamera, RigEvaluation, RigReport, RigSuite};
pub use suite::{Case, Gauges, Suite};
pub use tiles::{LargestPlane, TileReport, largest_plane, tile_planes};
pub use video::{VideoDepth, VideoEvaluation, VideoRange, VideoReport};

/// Errors over a set of pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Errors {
    /// Number of pixels in the set that have a point.
    pub pixels: usize,
    /// Root of the mean squared distance to the true surface, along its normal, in metres.
    pub rms_m: f64,
    /// Mean angle between a point's normal and the true normal, in degrees.
    pub mean_normal_deg: f64,
}

/// Compares points and normals with the truth, over the pixels for which `selected` returns true.
///
/// The distance is measured to the tangent plane of the true surface at the pixel, so a shift along the surface is not
/// an error. Pixels without a point are skipped; pixels without a normal are skipped only in the normal error.
pub fn errors(truth: &Truth, points: &Xyz, normals: &Xyz, selected: impl Fn(usize) -> bool) -> Errors {
    let (mut pixels, mut squares, mut with_normal, mut angles) = (0usize, 0.0, 0usize, 0.0);
    for i in (0..truth.objects.len()).filter(|&i| truth.objects[i] != NO_OBJECT && selected(i)) {
        if !points.is_finite(i) {
            continue;
        }
        let n = truth.normals.get(i);
        let distance = dot(subtract(points.get(i), truth.points.get(i)), n);
        pixels += 1;
        squares += distance * distance;
        if normals.is_finite(i) {
            with_normal += 1;
            angles += dot(normals.get(i).map(f64::from), n).clamp(-1.0, 1.0).acos().to_degrees();
        }
    }
    Errors { pixels, rms_m: (squares / pixels as f64).sqrt(), mean_normal_deg: angles / with_normal as f64 }
}

fn subtract(a: [f32; 3], b: [f32; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| f64::from(a[k]) - f64::from(b[k]))
}

fn dot(a: [f64; 3], b: [f32; 3]) -> f64 {
    (0..3).map(|k| a[k] * f64::from(b[k])).sum()
}

/// Returns a mask of the pixels that have no step, crease or other object within `margin_px` pixels.
pub fn flat_pixels(truth: &Truth, margin_px: usize) -> Vec<bool> {
    let breaks = |i: usize, j: usize| {
        truth.objects[i] != truth.objects[j] || truth.is_step(i, j) || {
            let cosine = dot(truth.normals.get(i).map(f64::from), truth.normals.get(j));
            cosine < CREASE_COSINE
        }
    };
    within(&truth.camera, &broken_pixels(truth, breaks), margin_px).into_iter().map(|near| !near).collect()
}

/// Returns a mask of the pixels with a surface that are within `margin_px` pixels of a step, on either side.
pub fn edge_band(truth: &Truth, margin_px: usize) -> Vec<bool> {
    let steps = broken_pixels(truth, |i, j| truth.is_step(i, j));
    let near = within(&truth.camera, &steps, margin_px);
    (0..near.len()).map(|i| near[i] && truth.objects[i] != NO_OBJECT).collect()
}

/// Returns a mask of the pixels without a surface, or with a discontinuity to one of their four neighbours.
fn broken_pixels(truth: &Truth, breaks: impl Fn(usize, usize) -> bool) -> Vec<bool> {
    let (width, height) = (truth.camera.width, truth.camera.height);
    let at_break = |i: usize| {
        let (u, v) = (i % width, i / width);
        truth.objects[i] == NO_OBJECT
            || (u + 1 < width && breaks(i, i + 1))
            || (u > 0 && breaks(i, i - 1))
            || (v + 1 < height && breaks(i, i + width))
            || (v > 0 && breaks(i, i - width))
    };
    (0..width * height).map(at_break).collect()
}

/// Dilates a mask by a square: marks every pixel within `margin_px` rows and columns of a marked one.
fn within(camera: &Camera, marked: &[bool], margin_px: usize) -> Vec<bool> {
    let (width, height) = (camera.width, camera.height);
    // Along rows first, then along columns.
    let in_row = |i: usize| {
        let (u, row) = (i % width, i / width * width);
        (u.saturating_sub(margin_px)..(u + margin_px + 1).min(width)).any(|u| marked[row + u])
    };
    let marked_in_row: Vec<bool> = (0..width * height).map(in_row).collect();
    let in_box = |i: usize| {
        let (u, v) = (i % width, i / width);
        (v.saturating_sub(margin_px)..(v + margin_px + 1).min(height)).any(|v| marked_in_row[v * width + u])
    };
    (0..width * height).map(in_box).collect()
}

/// Cosine of the angle between two neighbouring pixels' normals, 15°, below which the pixels form a crease.
const CREASE_COSINE: f64 = 0.966;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::{Pose, Scene, Shape};
    use glam::DVec3;

    #[test]
    fn errors_measure_along_the_normal_and_margins_keep_off_the_edges() {
        let camera = Camera::new((64, 48), [60.0; 2], [31.5, 23.5]);
        let scene = Scene {
            objects: vec![
                Shape::Plane { point_m: [0.0, 0.0, 2.0], normal: [0.0, 0.0, 1.0] },
                Shape::Sphere { centre_m: [0.0, 0.0, 1.0], radius_m: 0.1 },
            ],
        };
        let truth = scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0));
        let exact = errors(&truth, &truth.points, &truth.normals, |_| true);
        assert_eq!((exact.pixels, exact.rms_m), (64 * 48, 0.0));
        assert!(exact.mean_normal_deg < 0.05);

        let wall = |i: usize| truth.objects[i] == 0;
        let moved: Xyz = truth.points.iter().map(|[x, y, z]| [x + 0.01, y, z + 0.002]).collect();
        let tilted = DVec3::new(0.0, 0.1, -1.0).normalize().as_vec3().to_array();
        let tilted: Xyz = truth.normals.iter().map(|_| tilted).collect();
        let off = errors(&truth, &moved, &tilted, wall);
        assert!((off.rms_m - 0.002).abs() < 1e-6, "{off:?}");
        assert!((off.mean_normal_deg - 0.1f64.atan().to_degrees()).abs() < 1e-3, "{off:?}");

        let flat = flat_pixels(&truth, 4);
        let centre = 23 * 64 + 31;
        assert!(!flat[centre], "a ball of 12 pixels has none further than 4 from its edge whose normals agree");
        assert!(flat[5 * 64 + 5]);
        let edge = (0..64).find(|&u| truth.objects[23 * 64 + u] == 1).unwrap();
        assert!(!flat[23 * 64 + edge - 4] && flat[23 * 64 + edge - 6]);
    }
}
