//! The radius of a neighbourhood (docs/method.md, sections 3 and 11), in metres.

use glam::DVec3;

use crate::frame::{FrameGeometry, RangeRule};
use crate::params::{EngineParams, Radius};

/// Minimum radius in metres. It ensures that a point that is its own sample is always its own neighbour.
const MIN_RADIUS_M: f64 = 1e-12;

/// Returns the radius r of a point in the sensor's frame.
pub(super) fn radius_m(params: &EngineParams, geometry: &FrameGeometry, p: DVec3) -> f64 {
    match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        // `FrameRadius`, for frames on a grid, does not offer these radii.
        Radius::Neighbours { .. } | Radius::SensorAndDensity { .. } => MIN_RADIUS_M,
        Radius::Sensor => {
            let reach_m = f64::from(params.window * params.stride) * spacing_m(geometry, p);
            (2.0 * reach_m).max(4.0 * params.sensor.step_m(geometry.range_m(p))).max(MIN_RADIUS_M)
        }
    }
}

/// Returns the distance between adjacent pixels at a point in the sensor's frame.
pub(super) fn spacing_m(geometry: &FrameGeometry, p: DVec3) -> f64 {
    match geometry.rule {
        RangeRule::Constant { spacing_m } => spacing_m,
        _ => geometry.range_m(p) * geometry.rule.pitch_at_1m(),
    }
}
