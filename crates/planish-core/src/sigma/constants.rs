//! Constants for standard errors (docs/method.md, section 17).

/// Half-width in pixels of the windows over which residuals are averaged.
pub(crate) const HALF_PX: usize = 4;
/// Maximum absolute residual in standard deviations; larger residuals are clamped, so that a floating pixel does not
/// count as noise.
pub(crate) const CLIP: f32 = 6.0;
/// Minimum deviation of residuals, as a share of the sensor's deviation, so that points have an error even where all
/// pixels have the same raw value.
pub(crate) const LEAST_DEVIATION: f32 = 0.1;
/// Minimum standard deviation of the sensor in metres, so that points have an error even if the sensor is exact.
pub(crate) const LEAST_DEVIATION_M: f32 = 1e-5;
/// Maximum lag of the correlation, in pixels.
pub(crate) const MOST_LAG_PX: usize = 6;
/// Minimum correlation; lower values are noise in the estimate.
pub(crate) const LEAST_CORRELATION: f64 = 0.02;
/// Distance in pixels between the rows from which the correlation is estimated.
pub(crate) const ROW_STRIDE_PX: usize = 3;
/// Ratio of the standard error to the residuals' deviation divided by the square root of the number of samples.
/// Measured on simulated frames of every sensor.
pub(crate) const FACTOR: f64 = 1.38;
/// Exponent of the correlation area in the standard error. It exceeds 1/2 because the area estimated from residuals
/// is too small.
pub(crate) const EXPONENT: f64 = 0.6;
/// Distance from a depth step within which the error is larger, in pixels.
pub(crate) const NEAR_STEP_PX: usize = 3;
/// Factor by which the error is larger within [`NEAR_STEP_PX`] of a depth step.
pub(crate) const NEAR_STEP_FACTOR: f32 = 1.45;
/// Difference in range above which adjacent pixels form a step, in standard deviations of the sensor.
pub(crate) const STEP_DEVIATIONS: f32 = 8.0;
/// Difference in range above which adjacent pixels form a step, as a share of the range.
pub(crate) const STEP_SHARE: f32 = 0.02;
/// Number of pixels in a window below which the surface follows the noise, so that residuals do not show all of it.
/// The noise is then at least the sensor's.
pub(crate) const FEW_PIXELS: u32 = 150;
/// Minimum correlation area, in pixels, in windows of fewer than [`FEW_PIXELS`], for sensors whose noise grows with
/// the square of the range, as with stereo and structured light.
pub(crate) const STEREO_AREA: f64 = 8.0;
/// Factor by which the error is larger in windows of fewer than [`FEW_PIXELS`] if edges are not kept, because the
/// polynomials then follow the noise.
pub(crate) const FOLLOWING_FACTOR: f64 = 2.0;
/// Maximum ratio of the standard error to the deviation of the residuals, before the factors for steps and frames.
pub(crate) const MOST_SHARE: f32 = 0.85;
/// Half-width in pixels of the windows whose mean residual shows that smoothing flattened the surface.
pub(crate) const BIAS_HALF_PX: usize = 2;
/// Magnitude of a mean residual, in its own standard deviations, up to which it counts as noise.
pub(crate) const BIAS_DEVIATIONS: f32 = 2.0;
/// Share of a mean residual's excess over its noise that is added as an error.
pub(crate) const BIAS_WEIGHT: f32 = 0.5;
/// Share of the variance that is the same in every frame of a stationary sensor, and so is not reduced over time.
pub(crate) const FIXED_SHARE: f32 = 0.65;
