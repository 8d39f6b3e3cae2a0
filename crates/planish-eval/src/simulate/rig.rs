//! Simulated camera rigs around a table, and the poses that an inexact calibration would state.

use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use super::random::Random;
use super::scene::{Pose, Scene};

/// Point at which the cameras look, in metres. The cameras are above it, at y = 0.
const CENTRE: DVec3 = DVec3::new(0.0, 0.40, 1.05);
/// Horizontal distance between each camera and the point at which it looks, in metres.
const DISTANCE_M: f64 = 1.0;
/// Maximum angle between adjacent cameras as seen from the table, in degrees.
const MOST_APART_DEG: f64 = 50.0;
/// Index of the wall in [`Scene::tabletop`], which is removed from the rig's scene.
const WALL: usize = 1;
const STREAM_POSES: u64 = 1 << 40;

/// A scene with cameras around it.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct RigScene {
    /// The scene.
    pub scene: Scene,
    /// Pose of each camera in the world (world_from_camera).
    pub poses: Vec<Pose>,
}

/// The size of calibration errors in camera poses.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct PoseErrors {
    /// Angle of the rotation about a random axis, in degrees.
    pub angle_deg: f64,
    /// Length of the shift in a random direction, in metres.
    pub shift_m: f64,
}

impl PoseErrors {
    /// Creates errors with a rotation angle in degrees and a shift in metres.
    pub const fn new(angle_deg: f64, shift_m: f64) -> Self {
        Self { angle_deg, shift_m }
    }
}

impl RigScene {
    /// Creates the table of [`Scene::tabletop`] without its wall, seen by `cameras` cameras on an arc, at most 50°
    /// apart.
    pub fn tabletop(seed: u64, cameras: usize) -> Self {
        let (mut scene, _) = Scene::tabletop(seed);
        scene.objects.remove(WALL);
        let apart = MOST_APART_DEG.to_radians().min(TAU / cameras.max(1) as f64);
        let pose = |i: usize| {
            let angle = apart * (i as f64 - (cameras.max(1) - 1) as f64 / 2.0);
            let position =
                DVec3::new(angle.sin(), 0.0, -angle.cos()) * DISTANCE_M + DVec3::new(CENTRE.x, 0.0, CENTRE.z);
            let down = (CENTRE.y - position.y).atan2(DISTANCE_M);
            Pose::looking(position.to_array(), -angle, down)
        };
        Self { scene, poses: (0..cameras).map(pose).collect() }
    }

    /// Returns the poses that a calibration with `errors` would produce. The first camera's pose is exact; all others
    /// are rotated about a random axis and shifted in a random direction.
    pub fn poses_with_errors(&self, errors: PoseErrors, seed: u64) -> Vec<Pose> {
        let mut random = Random::new(seed, STREAM_POSES);
        let mut direction = || {
            let vector = DVec3::new(random.normal(), random.normal(), random.normal());
            vector.try_normalize().unwrap_or(DVec3::X)
        };
        let with_errors = |(i, pose): (usize, &Pose)| {
            let (axis, towards) = (direction(), direction());
            if i == 0 {
                return *pose;
            }
            let turn = DMat3::from_axis_angle(axis, errors.angle_deg.to_radians());
            Pose {
                position: pose.position + errors.shift_m * towards,
                world_from_camera: turn * pose.world_from_camera,
            }
        };
        self.poses.iter().enumerate().map(with_errors).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_core::Camera;

    #[test]
    fn every_camera_looks_at_the_table() {
        let camera = Camera::new((80, 60), [66.0; 2], [39.5, 29.5]);
        for cameras in [2, 4, 8] {
            let rig = RigScene::tabletop(1, cameras);
            assert_eq!(rig.poses.len(), cameras);
            for pose in &rig.poses {
                let truth = rig.scene.render(&camera, pose);
                // Without the wall, the table is the second object; the objects on it follow.
                let on_table = truth.objects.iter().filter(|&&object| object != super::super::NO_OBJECT && object >= 1);
                assert!(on_table.count() > truth.objects.len() / 3);
                let z = truth.points.z()[30 * 80 + 40];
                assert!((0.7..1.3).contains(&z), "{z}");
            }
        }
    }

    #[test]
    fn errors_of_poses_are_as_large_as_asked_for() {
        let rig = RigScene::tabletop(1, 4);
        let stated = rig.poses_with_errors(PoseErrors::new(0.2, 0.002), 7);
        assert_eq!(stated[0], rig.poses[0]);
        for (stated, pose) in stated.iter().zip(&rig.poses).skip(1) {
            assert!(((stated.position - pose.position).length() - 0.002).abs() < 1e-12);
            let turn = stated.world_from_camera * pose.world_from_camera.transpose();
            let trace = turn.x_axis.x + turn.y_axis.y + turn.z_axis.z;
            let angle_deg = ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees();
            assert!((angle_deg - 0.2).abs() < 1e-6, "{angle_deg}");
        }
    }
}
