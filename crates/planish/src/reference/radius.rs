//! The radius of a neighbourhood (docs/method.md, sections 3 and 11), in metres.

use glam::DVec3;

use crate::frame::{FrameGeometry, RangeRule};
use crate::params::{Radius, SmoothParams};

/// r of a point in the sensor's frame.
pub(super) fn radius_m(params: &SmoothParams, geometry: &FrameGeometry, p: DVec3) -> f64 {
    match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        Radius::Sensor => {
            let range_m = geometry.range_m(p);
            let spacing_m = match geometry.rule {
                RangeRule::Constant { spacing_m } => spacing_m,
                _ => range_m * geometry.rule.pitch_at_1m(),
            };
            (1.5 * f64::from(params.window * params.stride) * spacing_m).max(4.0 * params.sensor.step_m(range_m))
        }
    }
}
