//! Strength of smoothing as one number.

use super::fit::{LIGHT_RIDGE, RIDGE};
use super::window::WindowSize;
use crate::error::ParamError;

/// Strength of smoothing from 0 to 1: windows grow in steps, the ridge continuously.
///
/// ```
/// use planish::{FrameParams, SensorModel, Strength};
///
/// let params = FrameParams::for_sensor(SensorModel::KINECT_V1, Strength::new(0.8)?);
/// let strong = FrameParams::for_sensor(SensorModel::KINECT_V1, Strength::STRONG);
/// assert_eq!(params.window, strong.window);
/// assert!(Strength::new(1.5).is_err());
/// # Ok::<(), planish::ParamError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strength(f32);

impl Strength {
    /// Strength 0: windows of 15x15 pixels for a Kinect v1, for small objects.
    pub const LIGHT: Self = Self(0.0);
    /// Strength 0.5: windows of 25x25 pixels for a Kinect v1.
    pub const DEFAULT: Self = Self(0.5);
    /// Strength 1: windows of 29x29 pixels for a Kinect v1, with 49 samples instead of 25, for walls, floors and far
    /// ranges.
    pub const STRONG: Self = Self(1.0);

    /// Creates a strength from 0 to 1; refuses other values.
    pub fn new(strength: f32) -> Result<Self, ParamError> {
        if (0.0..=1.0).contains(&strength) {
            Ok(Self(strength))
        } else {
            Err(ParamError { field: "strength", value: strength.to_string(), allowed: "0 (light) to 1 (strong)" })
        }
    }

    /// Returns the strength, 0 to 1.
    pub const fn get(self) -> f32 {
        self.0
    }

    /// Returns the window for a sensor whose noise is `noise` times a Kinect v1's, in four steps: light, one stride
    /// between light and default, default, and strong.
    pub(super) fn noisy_window(self, noise: f64) -> WindowSize {
        let (half_width, kinect_stride) = if self.0 < 0.75 { (2, 3.0 + 4.0 * self.0.min(0.5)) } else { (3, 4.0) };
        // Light and default differ by two pixels of stride; the stride between them is another step.
        let stride = f64::from(kinect_stride).round() * noise.cbrt();
        WindowSize { half_width, stride: (stride.round() as u32).clamp(1, 8) }
    }

    /// Returns the window for a sensor without noise: half-widths of 2, 5 and 7 pixels at strengths 0, 0.5 and 1, and
    /// whole numbers in between.
    pub(super) fn exact_window(self) -> WindowSize {
        let half_px = if self.0 < 0.5 { 2.0 + 6.0 * self.0 } else { 3.0 + 4.0 * self.0 };
        WindowSize { half_width: half_px.round() as u32, stride: 1 }
    }

    /// Returns the ridge for a sensor with noise. The ridge grows from `LIGHT_RIDGE` at strength 0 to `RIDGE` at 0.5,
    /// and is constant above 0.5.
    pub(super) fn noisy_ridge(self) -> f32 {
        LIGHT_RIDGE * (RIDGE / LIGHT_RIDGE).powf((2.0 * self.0).min(1.0))
    }
}

impl Default for Strength {
    fn default() -> Self {
        Self::DEFAULT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_strengths_have_their_published_windows_and_ridges() {
        let exact = [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG].map(Strength::exact_window);
        assert_eq!(exact.map(|size| size.half_width), [2, 5, 7]);
        let ridges = [Strength::LIGHT, Strength::DEFAULT, Strength::STRONG].map(Strength::noisy_ridge);
        for (ridge, expected) in ridges.into_iter().zip([LIGHT_RIDGE, RIDGE, RIDGE]) {
            assert!((ridge / expected - 1.0).abs() < 1e-6, "{ridge} {expected}");
        }
        assert!(Strength::new(f32::NAN).is_err() && Strength::new(-0.1).is_err());
    }
}
