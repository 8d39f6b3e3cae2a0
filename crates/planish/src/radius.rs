//! The radius of a neighbourhood as the f32 engines compute it (docs/method.md, section 3).

use crate::frame::Frame;
use crate::params::{Radius, SmoothParams};

/// A radius beyond this makes no difference to any scene, and its square is far from the end of f32: a coordinate of 1e30 has
/// an infinite radius by the rule, and what is computed from it must stay finite.
pub(crate) const MAX_RADIUS_M: f32 = 1e6;

/// r(z) = constant + max(linear |z|, quadratic z²): both rules in one, for one frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RadiusRule {
    pub(crate) constant: f32,
    pub(crate) linear: f32,
    pub(crate) quadratic: f32,
}

impl RadiusRule {
    /// `pitches` is room for the estimate of the pixel pitch, kept from frame to frame.
    pub(crate) fn new(params: &SmoothParams, frame: Frame<'_>, pitches: &mut Vec<f64>) -> Self {
        match params.radius {
            Radius::Fixed { radius_m } => Self { constant: radius_m, linear: 0.0, quadratic: 0.0 },
            Radius::Sensor { depth_step_at_1m } => Self {
                constant: 0.0,
                linear: (1.5 * f64::from(params.window * params.stride) * frame.pixel_pitch_at_1m(pitches)) as f32,
                quadratic: 4.0 * depth_step_at_1m,
            },
        }
    }
}
