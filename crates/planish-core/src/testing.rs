//! Simulated frames for the unit tests of this crate.
//!
//! The simulator depends on a build of this crate without tests, whose types are different, so its cameras and frames
//! are converted.

use planish_eval::simulate;
pub(crate) use planish_eval::simulate::{DepthNoise, Pose, Random, Scene};

use crate::camera::Camera;
use crate::frame::DepthFrame;

/// Returns the first frame of a scene as a sensor with this noise sees it.
pub(crate) fn simulated(scene: (Scene, Pose), noise: DepthNoise, camera: Camera, seed: u64) -> DepthFrame {
    simulated_frame(scene, noise, camera, seed, 0)
}

/// Returns frame `index` of a still scene as a sensor with this noise sees it.
pub(crate) fn simulated_frame(
    (scene, pose): (Scene, Pose),
    noise: DepthNoise,
    camera: Camera,
    seed: u64,
    index: u64,
) -> DepthFrame {
    let Camera { width, height, fx, fy, cx, cy, .. } = camera;
    let seen_by = simulate::Camera::new((width, height), [fx, fy], [cx, cy]);
    let truth = scene.render(&seen_by, &pose);
    let frame = simulate::DepthSimulator::new(noise, seen_by, seed).frame(&truth, index).unwrap();
    DepthFrame::new(camera, frame.raw).unwrap()
}
