//! The radius of a neighbourhood (docs/method.md, section 3), in metres.

use crate::params::{Radius, SmoothParams};

/// r(z) of a point at depth `z_m`; `pitch_at_1m` is 1/fx.
pub(super) fn radius_m(params: &SmoothParams, pitch_at_1m: f64, z_m: f64) -> f64 {
    match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        Radius::Sensor { depth_step_at_1m } => {
            let z = z_m.abs();
            let pitch = z * pitch_at_1m;
            let step = f64::from(depth_step_at_1m) * z * z;
            (1.5 * f64::from(params.window * params.stride) * pitch).max(4.0 * step)
        }
    }
}
