//! Parameters of the temporal filter.

use crate::error::ParamError;

/// Parameters of smoothing over time: the number of averaged frames, and how long holes keep their last values.
///
/// ```
/// use planish::TemporalParams;
///
/// let params = TemporalParams::STEADY.with_frames(8.0).with_hold_frames(2);
/// assert!(params.validate().is_ok());
/// assert!(TemporalParams::STEADY.with_frames(0.5).validate().is_err());
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct TemporalParams {
    /// Maximum number of frames averaged in a still pixel, 1 to 16.
    pub frames: f32,
    /// Maximum number of frames for which a hole keeps its last value, 0 to 8.
    /// [`TemporalFilter::is_carried`](crate::TemporalFilter::is_carried) identifies such pixels.
    pub hold_frames: u32,
}

impl TemporalParams {
    /// Parameters for a mean of up to 16 frames; holes stay holes.
    pub const STEADY: Self = Self { frames: 16.0, hold_frames: 0 };

    /// Sets the maximum number of frames averaged in a still pixel, 1 to 16.
    pub const fn with_frames(self, frames: f32) -> Self {
        Self { frames, ..self }
    }

    /// Sets the maximum number of frames for which a hole keeps its last value, 0 to 8.
    pub const fn with_hold_frames(self, hold_frames: u32) -> Self {
        Self { hold_frames, ..self }
    }

    /// Checks that all values are within their ranges.
    ///
    /// # Errors
    /// If a value is outside its range. The error names the field and the range.
    pub fn validate(&self) -> Result<(), ParamError> {
        if !(1.0..=16.0).contains(&self.frames) {
            let value = self.frames.to_string();
            return Err(ParamError { field: "temporal.frames", value, allowed: "1 to 16" });
        }
        if self.hold_frames > 8 {
            let value = self.hold_frames.to_string();
            return Err(ParamError { field: "temporal.hold_frames", value, allowed: "0 to 8" });
        }
        Ok(())
    }
}

impl Default for TemporalParams {
    /// Returns [`TemporalParams::STEADY`].
    fn default() -> Self {
        Self::STEADY
    }
}
