//! Quantities that grow with range in the f32 engines: the radius, the gate of blocks, and the noise (docs/method.md,
//! sections 2, 3, 10).

use crate::frame::{FrameGeometry, RangeRule, assumed_range_m};
use crate::params::{EngineParams, Radius};

/// Ratio of [`Radius::Sensor`] to the half-width of a window; more than 1 to allow for surfaces that are seen
/// obliquely.
const REACHES: f64 = 2.0;

/// Pixels of a Kinect v1 per metre at 1 m. Windows of every sensor cover a similar part of the scene (docs/method.md,
/// (3.5)).
const PIXELS_AT_1M: f64 = 525.0;
/// Ratio of the radius of a disc to half the side of a square with the same area.
const DISC_IN_SQUARE: f64 = std::f64::consts::FRAC_2_SQRT_PI;
/// Radius in an unorganized cloud of a known sensor, in depth steps.
const STEPS_IN_CLOUD: f64 = 4.0;
/// Maximum ratio of the radius to that by density for 20 neighbours, which bounds the number of neighbours to about
/// 2000 in dense clouds.
pub(crate) const DENSITIES_IN_CLOUD: f32 = 10.0;
/// Maximum ratio of the radius to the radius of a window, which bounds the number of neighbours at long range.
pub(crate) const WINDOWS_IN_CLOUD: f32 = 2.0;

/// Maximum radius in metres, larger than any scene; its square fits f32. Without a limit, a coordinate of 1e30 would
/// give an infinite radius, but values computed from the radius must be finite.
pub(crate) const MAX_RADIUS_M: f32 = 1e6;

/// Minimum width of a gate in metres: every point must be its own neighbour, and squares must fit f32.
pub(crate) const MIN_GATE_M: f32 = 1e-12;

/// Maximum range and coordinate in metres whose squares fit f32. At larger ranges, the radius is fixed or at its limit.
pub(crate) const MAX_RANGE_M: f32 = 1e18;

/// The rules of one frame for quantities at range z. The radius and the gate of a block are each the maximum of a
/// term linear in z and a polynomial in z; the noise is a polynomial in z.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RangeRules {
    /// Coefficient of z in the radius, from the pixel spacing.
    pub(crate) linear: f32,
    /// Coefficients of 1, z and z² in the radius: four depth steps, or the fixed radius.
    pub(crate) radius: [f32; 3],
    /// Coefficient of z in the gate of blocks, from the pixel spacing.
    pub(crate) block_linear: f32,
    /// Coefficients of 1, z and z² in the gate of blocks: two and a half depth steps.
    pub(crate) block: [f32; 3],
    /// Coefficients of 1, z and z² in the noise.
    pub(crate) sigma: [f32; 3],
    /// True if the range is the distance from the sensor instead of the depth along its axis.
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
            // Radii by density do not depend on the range.
            Radius::Neighbours { .. } => {}
            Radius::SensorAndDensity { .. } => {
                rules.linear = of_cloud(params) as f32;
                rules.radius = params.sensor.step.map(|c| STEPS_IN_CLOUD as f32 * c);
                // The sensor's orientation is often unknown.
                rules.by_distance = true;
            }
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

/// Returns the radius of an unorganized cloud's points at a range in metres, if the sensor is known (docs/method.md,
/// section 8). `by_density_m` is the radius by density.
#[cfg(any(test, feature = "reference"))]
pub(crate) fn radius_in_cloud_m(params: &EngineParams, range_m: f64, by_density_m: f64) -> f64 {
    let window_m = of_cloud(params) * range_m;
    let steps_m = STEPS_IN_CLOUD * params.sensor.step_m(range_m);
    let ranged_m = steps_m.clamp(window_m, f64::from(WINDOWS_IN_CLOUD) * window_m);
    by_density_m.max(ranged_m.min(f64::from(DENSITIES_IN_CLOUD) * by_density_m))
}

/// Returns the ratio of the radius to the range in an unorganized cloud: a disc with the area of a frame's window.
fn of_cloud(params: &EngineParams) -> f64 {
    DISC_IN_SQUARE * (params.reach_px() as f64 + params.block_half_px() as f64 + 0.5) / PIXELS_AT_1M
}
