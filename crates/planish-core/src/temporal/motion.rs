//! Moves the state into the view of a camera that has moved (docs/method.md, equations 16.9 to 16.11).
//!
//! Each pixel of the current frame looks up where its point was in the previous frame, and averages those of the four
//! surrounding pixels that are on the same surface. The mean is a point on a ray of the previous camera; its depth in
//! the current view is the new state. For a hole, the remembered depth determines the point.

use fearless_simd::{Level, Simd, dispatch};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

use super::constants::{LEAST_WEIGHT, NEAREST_M, SAME_SURFACE, SLOPE};
use super::rows::Rule;
use super::state::{Pixel, State};
use crate::camera::{Camera, Rays, RowRays, RowRaysY};
use crate::error::FrameError;
use crate::pose::{RigidTransform, SensorPose};

/// The motion of a camera between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct CameraMotion {
    /// The camera.
    pub camera: Camera,
    /// Transform from the camera's coordinates at the current frame (x right, y down, z forward) to those at the
    /// previous frame.
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
        let previous_from_current = SensorPose::from_transform(&previous_from_current);
        previous_from_current.validate()?;
        Ok(Self { camera, previous_from_current })
    }
}

/// A camera's motion and the other inputs for looking up pixels.
#[derive(Clone, Copy)]
pub(super) struct Lookup<'a> {
    rule: Rule,
    level: Level,
    camera: &'a Camera,
    rays: &'a Rays,
    /// Rotation of previous_from_current.
    rotation: Mat3,
    /// Translation of previous_from_current in metres.
    translation: Vec3,
    /// fx, fy, cx and cy in pixels.
    intrinsics: [f32; 4],
    is_distorted: bool,
    width: usize,
    height: usize,
    /// Number of pixels per row of the state.
    pitch: usize,
}

impl<'a> Lookup<'a> {
    pub(super) fn new(rule: Rule, level: Level, camera: &'a Camera, rays: &'a Rays, pitch: usize) -> Self {
        let (rotation, translation) = (Mat3::IDENTITY, Vec3::ZERO);
        let Camera { width, height, fx, fy, cx, cy, distortion, .. } = *camera;
        let (intrinsics, is_distorted) = ([fx, fy, cx, cy].map(|value| value as f32), !distortion.is_none());
        Self { rule, level, camera, rays, rotation, translation, intrinsics, is_distorted, width, height, pitch }
    }

    /// Computes the state in the view of the current camera. `depth_m` is the current frame, with rows of `pitch`
    /// pixels.
    pub(super) fn move_state(&self, motion: &RigidTransform, depth_m: &[f32], before: &State, after: &mut State) {
        let (rotation, translation) = (motion.rotation.as_mat3(), motion.translation.as_vec3());
        let lookup = Self { rotation, translation, ..*self };
        let rows = after.mean.par_chunks_mut(self.pitch).zip(after.frames_variance.par_chunks_mut(self.pitch));
        let rows = rows.zip(after.bias_idle.par_chunks_mut(self.pitch));
        rows.enumerate().for_each(|(v, ((mean, frames_variance), bias_idle))| {
            // This loop is compiled for each instruction set, because rounding is a function call without SSE4.1.
            dispatch!(self.level, simd => lookup.move_row(simd, v, depth_m, before, (mean, frames_variance, bias_idle)));
        });
    }

    #[inline(always)]
    fn move_row<S: Simd>(
        &self,
        _: S,
        v: usize,
        depth_m: &[f32],
        before: &State,
        (mean, frames_variance, bias_idle): (&mut [f32], &mut [u32], &mut [u32]),
    ) {
        let RowRays { x, y } = self.rays.row(v);
        for u in 0..self.width {
            let y = match y {
                RowRaysY::Same(y) => y,
                RowRaysY::Each(y) => y[u],
            };
            let pixel = self.look_up(v * self.pitch + u, [x[u], y], depth_m[v * self.pitch + u], before);
            (mean[u], frames_variance[u], bias_idle[u]) = pixel.packed();
        }
    }

    /// Returns the column and row at which a ray is seen.
    #[inline(always)]
    fn project(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let [fx, fy, cx, cy] = self.intrinsics;
        if self.is_distorted { self.camera.project_ray([x, y]) } else { [fx * x + cx, fy * y + cy] }
    }

    #[inline(always)]
    fn look_up(&self, at: usize, [x, y]: [f32; 2], depth_m: f32, before: &State) -> Pixel {
        let depth_m = if self.rule.is_valid(depth_m) {
            depth_m
        } else {
            let here = before.pixel(at);
            if here.frames <= 0.0 {
                return Pixel::UNKNOWN;
            }
            self.rule.domain.depth_m(here.mean)
        };
        // The point in the previous camera's coordinates.
        let seen = self.rotation * (Vec3::new(x, y, 1.0) * depth_m) + self.translation;
        if seen.z.is_nan() || seen.z < NEAREST_M {
            return Pixel::UNKNOWN;
        }
        let ray = seen / seen.z;
        let [column, row] = self.project([ray.x, ray.y]);
        let (last_u, last_v) = (self.width as f32 - 1.0, self.height as f32 - 1.0);
        let is_inside = column > -0.5 && row > -0.5 && column < last_u + 0.5 && row < last_v + 0.5;
        if !is_inside {
            return Pixel::UNKNOWN;
        }
        let (value, sigma) = self.rule.value(seen.z);
        let (left, above) = (column.floor(), row.floor());
        let (share_u, share_v) = (column - left, row - above);
        let place = |at: f32, last: f32| at.max(0.0).min(last) as usize;
        let columns = [place(left, last_u), place(left + 1.0, last_u)];
        let rows = [place(above, last_v), place(above + 1.0, last_v)].map(|row| row * self.pitch);
        let corners = [
            ((1.0 - share_u) * (1.0 - share_v), rows[0] + columns[0]),
            (share_u * (1.0 - share_v), rows[0] + columns[1]),
            ((1.0 - share_u) * share_v, rows[1] + columns[0]),
            (share_u * share_v, rows[1] + columns[1]),
        ];
        let (mut weights, mut mean, mut frames, mut bias) = (0.0, 0.0, 0.0, 0.0);
        for (weight, at) in corners {
            let pixel = before.pixel(at);
            // Tests off < 5 sigma sqrt(1 + 1/n) without a root or a division.
            let off = ((pixel.mean - value).abs() - SLOPE * value).max(0.0);
            let known = pixel.frames.max(1.0);
            let is_same =
                pixel.frames > 0.0 && off * off * known < SAME_SURFACE * SAME_SURFACE * sigma * sigma * (known + 1.0);
            let weight = if is_same { weight } else { 0.0 };
            weights += weight;
            mean += weight * pixel.mean;
            frames += weight * pixel.frames;
            bias += weight * pixel.bias;
        }
        if weights <= LEAST_WEIGHT {
            return Pixel::UNKNOWN;
        }
        let nearest = corners[2 * usize::from(share_v >= 0.5) + usize::from(share_u >= 0.5)].1;
        let nearest = before.pixel(nearest);
        let found = Pixel { mean: mean / weights, frames: frames / weights, bias: bias / weights, ..nearest };
        // The depth of the found point in the current camera's coordinates.
        let forward = self.rotation.z_axis;
        let depth_m = self.rule.domain.depth_m(found.mean) * forward.dot(ray) - forward.dot(self.translation);
        if depth_m.is_nan() || depth_m < NEAREST_M {
            return Pixel::UNKNOWN;
        }
        Pixel { mean: self.rule.value(depth_m).0, ..found }
    }
}
