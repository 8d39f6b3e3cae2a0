//! The image in which holes are filled, and its steps.

use super::constants::{STEP_DEVIATIONS, STEP_SHARE};
use crate::sensor::SensorModel;

/// 1/z of each pixel, which is linear over the pixels of a plane.
#[derive(Clone, Copy)]
pub(super) struct Image<'a> {
    /// 1/z of each pixel; 0 for holes.
    pub(super) inverse: &'a [f32],
    pub(super) shape: (usize, usize),
    pub(super) sensor: SensorModel,
}

impl Image<'_> {
    /// Returns `deviations` standard deviations of the sensor or a `share` of the range, whichever is larger, as a
    /// difference of 1/z.
    pub(super) fn limit(&self, inverse: f32, deviations: f64, share: f64) -> f32 {
        let z_m = f64::from(inverse).recip();
        ((deviations * self.sensor.sigma_m(z_m)).max(share * z_m) / (z_m * z_m)) as f32
    }

    /// Returns the maximum difference of 1/z between points of one surface, near the value `inverse`.
    pub(super) fn step_limit(&self, inverse: f32) -> f32 {
        self.limit(inverse, STEP_DEVIATIONS, STEP_SHARE)
    }

    pub(super) fn is_step(&self, a: f32, b: f32) -> bool {
        (a - b).abs() > self.step_limit(a.min(b))
    }

    /// Returns true if points near a pixel belong to two surfaces.
    pub(super) fn has_step_near(&self, (u, v): (usize, usize), reach_px: usize) -> bool {
        let (width, height) = self.shape;
        let (mut least, mut most) = (f32::INFINITY, 0.0f32);
        for y in v.saturating_sub(reach_px)..(v + reach_px + 1).min(height) {
            for x in u.saturating_sub(reach_px)..(u + reach_px + 1).min(width) {
                let inverse = self.inverse[y * width + x];
                if inverse > 0.0 {
                    (least, most) = (least.min(inverse), most.max(inverse));
                }
            }
        }
        least < most && self.is_step(least, most)
    }
}
