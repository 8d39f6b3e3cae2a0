//! Quality of a rig's surfaces: those seen by several cameras, those seen by one, doubled surfaces, and edges.

use glam::DVec3;
use serde::Serialize;

use super::evaluation::{EDGE_MARGIN_PX, FLAT_MARGIN_PX, Sum, facet};
use super::geometry::{angle_deg, distance_to_surface};
use super::{edge_band, flat_pixels};
use crate::simulate::{DepthNoise, DepthSimulator, NO_OBJECT, Pose, PoseErrors, RigScene, Truth};
use planish_core::{Camera, DepthFrame, FrameError, Xyz};

/// Depth range in which a camera's surfaces are measured, in metres.
const RANGE_M: std::ops::Range<f32> = 0.5..1.5;

/// Maximum difference in depth between a point and the surface that a camera sees at the point's pixel, in metres.
/// Within it, the camera sees the point.
const SEEN_WITHIN_M: f64 = 0.01;

/// Side length, in pixels, of the blocks over which the distance between two cameras' surfaces is averaged.
const BLOCK_PX: usize = 8;
/// Minimum number of pixels in a block that have points from both cameras.
const BLOCK_LEAST: usize = 32;

/// Simulated camera rigs around a table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigSuite {
    /// Number of cameras.
    pub cameras: usize,
    /// Intrinsics of every camera.
    pub camera: Camera,
    /// Noise of every camera, independent between cameras.
    pub noise: DepthNoise,
    /// Errors of the stated poses.
    pub errors: PoseErrors,
}

impl RigSuite {
    /// Creates rigs of full-resolution Kinects whose stated poses are exact.
    pub fn new(cameras: usize) -> Self {
        let (camera, noise) = (Camera::kinect_v1(), DepthNoise::default());
        Self { cameras, camera, noise, errors: PoseErrors::default() }
    }

    /// Returns the case generated from a seed.
    pub fn case(&self, seed: u64) -> Result<RigCase, FrameError> {
        let scene = RigScene::tabletop(seed, self.cameras);
        let stated = scene.poses_with_errors(self.errors, seed);
        let view = |(i, (pose, stated)): (usize, (&Pose, &Pose))| {
            let truth = scene.scene.render(&self.camera, pose);
            let simulator = DepthSimulator::new(self.noise, self.camera, seed * 100 + i as u64);
            let frame = simulator.frame(&truth, 0)?;
            Ok(RigCaseCamera { truth, frame, pose: *pose, stated: *stated })
        };
        let cameras = scene.poses.iter().zip(&stated).enumerate().map(view);
        Ok(RigCase { cameras: cameras.collect::<Result<_, FrameError>>()? })
    }
}

/// One moment of a simulated rig.
#[derive(Debug, Clone)]
pub struct RigCase {
    /// The cameras.
    pub cameras: Vec<RigCaseCamera>,
}

/// A camera of a simulated rig.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct RigCaseCamera {
    /// The noise-free frame.
    pub truth: Truth,
    /// The simulated frame.
    pub frame: DepthFrame,
    /// The true pose.
    pub pose: Pose,
    /// The stated pose, with calibration errors.
    pub stated: Pose,
}

/// The scores of a method on rigs, over surfaces at depths of 0.5 to 1.5 m. Scores that could not be measured are NaN
/// (null in JSON).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct RigReport {
    /// Root mean squared distance to the true surface along its normal, on flat surfaces seen by several cameras, in
    /// millimetres.
    pub overlap_rmse_mm: f64,
    /// Root mean squared distance to the true surface along its normal, on flat surfaces seen by one camera, in
    /// millimetres.
    pub single_rmse_mm: f64,
    /// Mean angle between the facets of adjacent pixels and the true surface, on surfaces seen by several cameras, in
    /// degrees.
    pub overlap_facet_deg: f64,
    /// Mean angle between the facets of adjacent pixels and the true surface, on surfaces seen by one camera, in
    /// degrees.
    pub single_facet_deg: f64,
    /// Distance between two cameras' results for the same surface, in millimetres: the root mean square, over blocks
    /// of 8x8 pixels, of the mean distance in each block.
    pub ghosting_mm: f64,
    /// Mean distance to the nearest true surface within 3 pixels of a step, in millimetres.
    pub edge_mean_mm: f64,
    /// Share of the measured pixels that have no point.
    pub lost_share: f64,
}

/// Accumulates the scores of a method over cases.
#[derive(Debug, Clone, Default)]
pub struct RigEvaluation {
    overlap_m: Sum,
    single_m: Sum,
    overlap_facet_deg: Sum,
    single_facet_deg: Sum,
    apart_m: Sum,
    edge_m: Sum,
    measured: usize,
    lost: usize,
}

fn to_world(pose: &Pose, point: DVec3) -> DVec3 {
    pose.world_from_camera * point + pose.position
}

fn to_camera(pose: &Pose, point: DVec3) -> DVec3 {
    pose.world_from_camera.transpose() * (point - pose.position)
}

impl RigEvaluation {
    /// Adds a result: for each camera, one point per pixel in the camera's own frame.
    pub fn add(&mut self, case: &RigCase, results: &[Xyz]) {
        let flat: Vec<Vec<bool>> =
            case.cameras.iter().map(|camera| flat_pixels(&camera.truth, FLAT_MARGIN_PX)).collect();
        for (i, (camera, points)) in case.cameras.iter().zip(results).enumerate() {
            let (truth, is_flat) = (&camera.truth, &flat[i]);
            // Transforms points placed by the stated pose into the true camera's frame.
            let placed = |p: DVec3| to_camera(&camera.pose, to_world(&camera.stated, p));
            let in_range = |p: usize| RANGE_M.contains(&truth.points.z()[p]);
            let seen_by = seen_by(case, i);
            for p in (0..is_flat.len()).filter(|&p| is_flat[p] && in_range(p) && points.is_finite(p)) {
                let n = truth.normals.vector(p);
                let off_m = (placed(points.vector(p)) - truth.points.vector(p)).dot(n);
                let facet = facet(points, is_flat, p, truth.camera.width).map(|facet| angle_deg(n, facet));
                let is_overlap = seen_by[p].iter().any(|seen| seen.is_some());
                let (off, facets) = match is_overlap {
                    true => (&mut self.overlap_m, &mut self.overlap_facet_deg),
                    false => (&mut self.single_m, &mut self.single_facet_deg),
                };
                off.add(off_m);
                facet.into_iter().for_each(|deg| facets.add(deg));
            }
            let band = edge_band(truth, EDGE_MARGIN_PX);
            for p in (0..band.len()).filter(|&p| band[p] && in_range(p) && points.is_finite(p)) {
                self.edge_m.add(distance_to_surface(truth, p, placed(points.vector(p))));
            }
            for (p, &raw) in camera.frame.raw.iter().enumerate() {
                let is_measured = camera.frame.camera.depth_m(raw).is_finite();
                self.measured += usize::from(is_measured);
                self.lost += usize::from(is_measured && !points.is_finite(p));
            }
            for j in i + 1..case.cameras.len() {
                self.add_apart(case, results, (i, j), &flat, &seen_by);
            }
        }
    }

    /// Adds the distances between two cameras' surfaces, averaged over blocks of the first camera's pixels.
    fn add_apart(
        &mut self,
        case: &RigCase,
        results: &[Xyz],
        (i, j): (usize, usize),
        flat: &[Vec<bool>],
        seen_by: &[Vec<Option<usize>>],
    ) {
        let (camera, other) = (&case.cameras[i], &case.cameras[j]);
        let (width, height) = (camera.truth.camera.width, camera.truth.camera.height);
        let apart_m = |p: usize| -> Option<f64> {
            let q = seen_by[p][j].filter(|&q| flat[j][q] && results[j].is_finite(q))?;
            let usable = flat[i][p] && results[i].is_finite(p) && RANGE_M.contains(&camera.truth.points.z()[p]);
            let n = camera.pose.world_from_camera * camera.truth.normals.vector(p);
            let mine = to_world(&camera.stated, results[i].vector(p));
            let others = to_world(&other.stated, results[j].vector(q));
            usable.then(|| (others - mine).dot(n))
        };
        for block_v in (0..height).step_by(BLOCK_PX) {
            for block_u in (0..width).step_by(BLOCK_PX) {
                let mut block = Sum::default();
                for v in block_v..(block_v + BLOCK_PX).min(height) {
                    (block_u..(block_u + BLOCK_PX).min(width))
                        .filter_map(|u| apart_m(v * width + u))
                        .for_each(|apart_m| block.add(apart_m));
                }
                if block.count >= BLOCK_LEAST {
                    self.apart_m.add(block.mean());
                }
            }
        }
    }

    /// Returns the scores so far.
    pub fn report(&self) -> RigReport {
        RigReport {
            overlap_rmse_mm: 1e3 * self.overlap_m.rms(),
            single_rmse_mm: 1e3 * self.single_m.rms(),
            overlap_facet_deg: self.overlap_facet_deg.mean(),
            single_facet_deg: self.single_facet_deg.mean(),
            ghosting_mm: 1e3 * self.apart_m.rms(),
            edge_mean_mm: 1e3 * self.edge_m.mean(),
            lost_share: self.lost as f64 / self.measured as f64,
        }
    }
}

/// For each pixel of camera `i`, returns the pixel at which each other camera sees the same surface and has measured
/// it.
fn seen_by(case: &RigCase, i: usize) -> Vec<Vec<Option<usize>>> {
    let camera = &case.cameras[i];
    let at = |p: usize, j: usize| -> Option<usize> {
        if i == j || camera.truth.objects[p] == NO_OBJECT {
            return None;
        }
        let other = &case.cameras[j];
        let there = to_camera(&other.pose, to_world(&camera.pose, camera.truth.points.vector(p)));
        let q = other.truth.camera.pixel_of(there.to_array())?;
        let is_seen = (f64::from(other.truth.points.z()[q]) - there.z).abs() < SEEN_WITHIN_M;
        let is_measured = other.frame.camera.depth_m(other.frame.raw[q]).is_finite();
        (is_seen && is_measured).then_some(q)
    };
    (0..camera.truth.objects.len()).map(|p| (0..case.cameras.len()).map(|j| at(p, j)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn suite(errors: PoseErrors) -> RigSuite {
        let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
        RigSuite { camera, noise: DepthNoise::NONE, errors, ..RigSuite::new(3) }
    }

    fn truth(case: &RigCase) -> Vec<Xyz> {
        case.cameras.iter().map(|camera| camera.truth.points.clone()).collect()
    }

    #[test]
    fn what_is_on_the_surface_has_no_errors_and_no_ghosts() {
        let case = suite(PoseErrors::default()).case(1).unwrap();
        let mut evaluation = RigEvaluation::default();
        evaluation.add(&case, &truth(&case));
        let report = evaluation.report();
        assert!(
            report.overlap_rmse_mm < 1e-3 && report.single_rmse_mm < 1e-3 && report.edge_mean_mm < 1e-3,
            "{report:?}"
        );
        // The remaining error is pixel quantization: on curved surfaces, the two points are up to one pixel of this
        // coarse camera apart.
        assert!(report.ghosting_mm < 0.1, "{report:?}");
    }

    #[test]
    fn errors_of_poses_are_seen_as_ghosts() {
        let case = suite(PoseErrors::new(0.0, 0.005)).case(1).unwrap();
        let mut evaluation = RigEvaluation::default();
        evaluation.add(&case, &truth(&case));
        let report = evaluation.report();
        // An error of 5 mm in a random direction is about 3 mm along a normal, for two cameras out of three.
        assert!((1.0..8.0).contains(&report.ghosting_mm) && report.overlap_rmse_mm > 1.0, "{report:?}");
        assert_eq!(report.lost_share, 0.0);
    }
}
