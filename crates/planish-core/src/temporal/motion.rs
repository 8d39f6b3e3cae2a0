//! Moves the state into the view of a camera that has moved (docs/method.md, equations 16.8 to 16.10).
//!
//! Each pixel of the current frame looks up where its point was in the frame before, and takes the mean of the four
//! pixels there that are on the same surface. That mean is a point on a ray of the previous camera; its depth as the
//! current one sees it is the new state. Holes look up by their remembered depth.

use rayon::prelude::*;

use super::rows::Rule;
use super::state::{Pixel, State};
use crate::camera::{Camera, Rays};
use crate::error::FrameError;
use crate::pose::{RigidTransform, SensorPose};

/// Sigmas by which pixels of one surface differ at most.
const SAME_SURFACE: f32 = 5.0;
/// What the slope of a surface adds, relative to the value.
const SLOPE: f32 = 0.004;
/// Weight of the pixels of the same surface above which they count; otherwise the nearest pixel does.
const LEAST_WEIGHT: f32 = 0.2;
/// Nearest depth in metres at which points are looked up.
const NEAREST_M: f32 = 0.05;

/// How a camera has moved between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct CameraMotion {
    /// The camera.
    pub camera: Camera,
    /// Transform from the camera's frame now (x right, y down, z forward) to that at the frame before.
    pub previous_from_current: SensorPose,
}

impl CameraMotion {
    /// Creates the motion between two poses of a camera in the world.
    ///
    /// # Errors
    /// If a pose is invalid.
    pub fn between(camera: Camera, previous: &SensorPose, current: &SensorPose) -> Result<Self, FrameError> {
        let previous_from_current = match previous == current {
            true => RigidTransform::IDENTITY,
            false => previous.transform()?.inverse().after(current.transform()?),
        };
        Ok(Self { camera, previous_from_current: SensorPose::from_transform(&previous_from_current) })
    }
}

/// A motion in the numbers of the filter.
pub(super) struct Lookup<'a> {
    pub(super) rule: Rule,
    pub(super) camera: &'a Camera,
    pub(super) rays: &'a Rays,
    /// previous_from_current.
    pub(super) motion: RigidTransform,
    /// Pixels of a row of the state.
    pub(super) pitch: usize,
}

impl Lookup<'_> {
    /// Computes the state as the current camera sees it; `depth_m` is the current frame, row by row of `pitch`.
    pub(super) fn move_state(&self, depth_m: &[f32], before: &State, after: &mut State) {
        let rows = after.mean.par_chunks_mut(self.pitch).zip(after.frames_variance.par_chunks_mut(self.pitch));
        let rows = rows.zip(after.bias_idle.par_chunks_mut(self.pitch));
        rows.enumerate().for_each(|(v, ((mean, frames_variance), bias_idle))| {
            for u in 0..self.camera.width {
                let pixel = self.look_up([u, v], depth_m[v * self.pitch + u], before);
                (mean[u], frames_variance[u], bias_idle[u]) = pixel.packed();
            }
        });
    }

    fn look_up(&self, [u, v]: [usize; 2], depth_m: f32, before: &State) -> Pixel {
        let here = before.pixel(v * self.pitch + u);
        let depth_m = match depth_m {
            _ if self.rule.is_valid(depth_m) => depth_m,
            _ if here.frames > 0.0 => self.rule.domain.depth_m(here.mean),
            _ => return Pixel::UNKNOWN,
        };
        // The point as the camera saw it before.
        let [x, y] = self.rays.at(u, v);
        let rotation = self.motion.rotation.as_mat3();
        let translation = self.motion.translation.as_vec3();
        let seen = rotation * (glam::Vec3::new(x, y, 1.0) * depth_m) + translation;
        if seen.z.is_nan() || seen.z < NEAREST_M {
            return Pixel::UNKNOWN;
        }
        let ray = seen / seen.z;
        let Camera { width, height, .. } = *self.camera;
        let [column, row] = self.camera.project_ray([ray.x, ray.y]);
        let is_inside = column > -0.5 && row > -0.5 && column < width as f32 - 0.5 && row < height as f32 - 0.5;
        if !is_inside {
            return Pixel::UNKNOWN;
        }
        let (value, sigma) = self.rule.value(seen.z);
        let mut sums = [0.0; 4];
        let (left, above) = (column.floor(), row.floor());
        for (corner_u, corner_v) in [(left, above), (left + 1.0, above), (left, above + 1.0), (left + 1.0, above + 1.0)] {
            let weight = (1.0 - (column - corner_u).abs()) * (1.0 - (row - corner_v).abs());
            let place = |at: f32, size: usize| at.clamp(0.0, size as f32 - 1.0) as usize;
            let pixel = before.pixel(place(corner_v, height) * self.pitch + place(corner_u, width));
            let band = SAME_SURFACE * sigma * (1.0 + 1.0 / pixel.frames.max(1.0)).sqrt() + SLOPE * value;
            if pixel.frames > 0.0 && (pixel.mean - value).abs() < band {
                let values = [1.0, pixel.mean, pixel.frames, pixel.bias];
                sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value);
            }
        }
        let nearest = [column, row].map(|at| (at + 0.5).floor());
        let place = |at: f32, size: usize| at.clamp(0.0, size as f32 - 1.0) as usize;
        let nearest = before.pixel(place(nearest[1], height) * self.pitch + place(nearest[0], width));
        let [weight, ..] = sums;
        let found = if weight > LEAST_WEIGHT {
            Pixel { mean: sums[1] / weight, frames: sums[2] / weight, bias: sums[3] / weight, ..nearest }
        } else {
            Pixel { bias: 0.0, ..nearest }
        };
        if found.frames <= 0.0 {
            return Pixel::UNKNOWN;
        }
        // Its point as the camera sees it now.
        let forward = rotation.z_axis;
        let depth_m = self.rule.domain.depth_m(found.mean) * forward.dot(ray) - forward.dot(translation);
        if depth_m.is_nan() || depth_m < NEAREST_M {
            return Pixel::UNKNOWN;
        }
        Pixel { mean: self.rule.value(depth_m).0, ..found }
    }
}
