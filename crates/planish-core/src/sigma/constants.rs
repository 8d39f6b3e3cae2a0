//! The constants of docs/method.md, section 17.

/// Half-width in pixels of the windows over which residuals are averaged.
pub(crate) const HALF_PX: usize = 4;
/// Residuals are clamped to this many standard deviations, so that a floating pixel does not count as noise.
pub(crate) const CLIP: f32 = 6.0;
/// Residuals show at least this share of the sensor's deviation, and that is at least this many metres: where all
/// pixels have the same raw value, or the sensor is exact, points still have an error.
pub(crate) const LEAST_DEVIATION: f32 = 0.1;
pub(crate) const LEAST_DEVIATION_M: f32 = 1e-5;
/// The largest lag of the correlation, in pixels.
pub(crate) const MOST_LAG_PX: usize = 6;
/// Correlations below this are noise of the estimate.
pub(crate) const LEAST_CORRELATION: f64 = 0.02;
/// The correlation is estimated from every third row.
pub(crate) const ROW_STRIDE_PX: usize = 3;
/// The standard error in units of the residual deviation over the root of the number of samples, measured on simulated
/// frames of every sensor; and the exponent of the area of correlation, whose estimate from residuals is low.
pub(crate) const FACTOR: f64 = 1.38;
pub(crate) const EXPONENT: f64 = 0.6;
/// Within this many pixels of a step, the error is larger by this factor.
pub(crate) const NEAR_STEP_PX: usize = 3;
pub(crate) const NEAR_STEP_FACTOR: f32 = 1.45;
/// A step between adjacent pixels, in standard deviations of the sensor and in shares of the range.
pub(crate) const STEP_DEVIATIONS: f32 = 8.0;
pub(crate) const STEP_SHARE: f32 = 0.02;
/// Windows of fewer pixels follow the noise, so residuals do not show all of it: it is at least the sensor's, with at
/// least this area of correlation where it grows with the square of the range, as with stereo and structured light.
pub(crate) const FEW_PIXELS: u32 = 150;
pub(crate) const STEREO_AREA: f64 = 8.0;
/// There, polynomials without kept edges follow the noise by this factor, and at most this share of it is left.
pub(crate) const FOLLOWING_FACTOR: f64 = 2.0;
pub(crate) const MOST_SHARE: f32 = 0.85;
/// A mean residual over a window of this half-width in pixels shows that smoothing flattened the surface, if it exceeds
/// its noise by this many deviations. This share of the rest is added as an error.
pub(crate) const BIAS_HALF_PX: usize = 2;
pub(crate) const BIAS_DEVIATIONS: f32 = 2.0;
pub(crate) const BIAS_WEIGHT: f32 = 0.5;
/// The share of the variance that is the same in every frame of a stationary sensor, and so does not fall over time.
pub(crate) const FIXED_SHARE: f32 = 0.65;
