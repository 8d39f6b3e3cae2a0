//! Constants for filling holes (docs/method.md, section 18).

/// Difference in range above which two points are on different surfaces, in standard deviations of the sensor.
pub(crate) const STEP_DEVIATIONS: f64 = 8.0;
/// Difference in range above which two points are on different surfaces, as a share of the range.
pub(crate) const STEP_SHARE: f64 = 0.02;
/// Distance in pixels from a hole pixel within which points determine whether the rim is a single surface.
pub(crate) const RIM_PX: usize = 2;
/// The eight directions, as steps in columns and rows; opposite ones are adjacent.
pub(crate) const DIRECTIONS: [[isize; 2]; 8] = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]];
/// Maximum number of steps to a rim, as a multiple of the maximum hole width.
pub(crate) const REACH: usize = 2;
/// Number of samples in each direction, at the rim and behind it.
pub(crate) const SAMPLES: usize = 4;
/// Distance between the samples of a direction, in pixels.
pub(crate) const SPACING_PX: isize = 2;
/// Number of samples in each direction, for surfaces that are extended into a shadow.
pub(crate) const SHADOW_SAMPLES: usize = 6;
/// Distance between the samples of a direction in pixels, for surfaces that are extended into a shadow.
pub(crate) const SHADOW_SPACING_PX: isize = 3;
/// Ridges of the six terms 1, x, y, x², xy and y² of the fit, as shares of the sum of the weights.
pub(crate) const RIDGES: [f64; 6] = [0.0, 1e-3, 1e-3, 0.3, 0.3, 0.3];
/// Distance from the fit within which a rim point belongs to the surface, in standard deviations of the sensor.
pub(crate) const RIM_DEVIATIONS: f64 = 4.0;
/// Distance from the fit within which a rim point belongs to the surface, as a share of the range.
pub(crate) const RIM_SHARE: f64 = 0.01;
/// Minimum and maximum width of a shadow, as shares of the width that the depth step explains.
pub(crate) const SHADOW_SHARES: [f32; 2] = [0.7, 1.25];
/// Number of pixels added to the minimum and the maximum width of a shadow.
pub(crate) const SHADOW_PX: [f32; 2] = [-2.0, 3.0];
/// Width of the strip next to the near surface that stays a hole, since it could belong to that surface, in pixels.
/// If the hole is wider than the depth step explains, the excess is added to the strip.
pub(crate) const SHADOW_MARGIN_PX: f32 = 2.0;
/// Maximum change of 1/z over a surface that is extended into a shadow, as a share of 1/z at its rim.
pub(crate) const SHADOW_CHANGE: f32 = 0.1;
/// Factor from the residuals and standard errors at the rim to the standard error of a filled pixel: its value at the
/// rim, and its increase per pixel of distance from the nearest rim point. Measured on simulated frames.
pub(crate) const GROWTH: [f64; 2] = [0.95, 0.03];
/// Minimum share of fillable pixels for a hole with one surface at its rim to be filled.
pub(crate) const LEAST_SHARE: f64 = 0.7;
/// Number of rounds in which gaps are closed.
pub(crate) const ROUNDS: usize = 2;
/// Minimum number of neighbours of a gap (of eight) that are not holes, for the gap to be closed.
pub(crate) const LEAST_NEIGHBOURS: usize = 4;
/// Minimum number of neighbours of a gap that were filled, for the gap to be closed.
pub(crate) const LEAST_FILLED: usize = 3;
/// Minimum width in pixels of a filled stripe between holes; narrower stripes are removed.
pub(crate) const LEAST_STRIPE_PX: usize = 4;
