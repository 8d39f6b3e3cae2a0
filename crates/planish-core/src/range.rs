//! Quantities that grow with range: radius, the gate of blocks, and noise, as the f32 engines compute them
//! (docs/method.md, sections 2, 3, 10).

use crate::frame::{FrameGeometry, RangeRule, assumed_range_m};
use crate::params::{EngineParams, Radius};

/// The radius of a sensor's window in half widths of it, for surfaces seen obliquely.
const REACHES: f64 = 2.0;

/// Upper bound of a radius, larger than any scene; its square fits f32 easily. A coordinate of 1e30 would give an
/// infinite radius, and values computed from the radius must stay finite.
pub(crate) const MAX_RADIUS_M: f32 = 1e6;

/// Minimum width of a gate, so that a point that is its own sample is its neighbour, and squares fit f32.
pub(crate) const MIN_GATE_M: f32 = 1e-12;

/// The squares of larger ranges and coordinates would leave f32. The radius of a larger range is at its limit or fixed.
pub(crate) const MAX_RANGE_M: f32 = 1e18;

/// The rules of one frame: with the range z, r = max(linear z, step polynomial), sigma = sigma polynomial, and the gate
/// of a block like r.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RangeRules {
    /// Coefficient of z in the radius, from the pixel spacing.
    pub(crate) linear: f32,
    /// Coefficients of 1, z and z² in the radius: four depth steps, or the fixed radius.
    pub(crate) radius: [f32; 3],
    /// Coefficient of z in the gate of blocks, from the pixel spacing.
    pub(crate) block_linear: f32,
    /// Coefficients of 1, z and z² in the gate of the blocks: two and a half depth steps.
    pub(crate) block: [f32; 3],
    /// Coefficients of 1, z and z² in the noise.
    pub(crate) sigma: [f32; 3],
    /// Whether the range is the distance from the sensor rather than the depth along its axis.
    pub(crate) by_distance: bool,
}

impl RangeRules {
    pub(crate) fn new(params: &EngineParams, geometry: &FrameGeometry) -> Self {
        let mut rules = Self {
            linear: 0.0,
            radius: [0.0; 3],
            block_linear: (3.0 * params.block_half_px() as f64 * geometry.rule.pitch_at_1m()) as f32,
            block: params.sensor.step.map(|c| 2.5 * c),
            sigma: params.sensor.sigma,
            by_distance: matches!(geometry.rule, RangeRule::Distance { .. }),
        };
        match params.radius {
            Radius::Fixed { radius_m } => rules.radius[0] = radius_m,
            // For unorganized clouds, which have different rules.
            Radius::Neighbours { .. } => {}
            Radius::Sensor => {
                rules.linear = (REACHES * params.reach_px() as f64 * geometry.rule.pitch_at_1m()) as f32;
                rules.radius = params.sensor.step.map(|c| 4.0 * c);
            }
        }
        if let RangeRule::Constant { spacing_m } = geometry.rule {
            let range_m = assumed_range_m(spacing_m);
            rules.sigma = [params.sensor.sigma_m(range_m) as f32, 0.0, 0.0];
            let block_m = (3.0 * params.block_half_px() as f64 * spacing_m).max(2.5 * params.sensor.step_m(range_m));
            (rules.block_linear, rules.block) = (0.0, [block_m as f32, 0.0, 0.0]);
            if params.radius == Radius::Sensor {
                let by_spacing = REACHES * params.reach_px() as f64 * spacing_m;
                rules.linear = 0.0;
                rules.radius = [by_spacing.max(4.0 * params.sensor.step_m(range_m)) as f32, 0.0, 0.0];
            }
        }
        rules
    }
}
