//! Windows of pixels, and their adaptation to a frame's resolution.

use std::ops::RangeInclusive;

use super::fit::check;
use crate::error::ParamError;

/// Focal length in pixels for which strides are chosen: a Kinect v1's.
const TUNED_FOCAL_LENGTH_PX: f64 = 525.0;
/// Offset added to a stride before truncation. Fractions from 0.4 are rounded up, so that halves, which occur at half
/// the resolution, do not depend on an estimate's last digits.
const ROUNDING: f64 = 0.6;
/// Minimum reach of a window on coarse pixels as a share of its nominal reach, both in pixels; limited by [`WIDEST`].
const LEAST_REACH: f64 = 0.5;
/// Maximum half-width of a window in samples.
const WIDEST: u32 = 7;
/// Allowed strides in pixels.
const STRIDES: RangeInclusive<u32> = 1..=8;

/// The size of a window: a square of (2k+1)² samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WindowSize {
    /// Half-width k in samples, 1 to 7.
    pub half_width: u32,
    /// Distance s between samples in pixels, 1 to 8.
    pub stride: u32,
}

impl WindowSize {
    /// Returns the reach of the window from its centre in pixels: k s.
    pub const fn reach_px(self) -> usize {
        (self.half_width * self.stride) as usize
    }

    /// Returns the number of samples: (2k+1)².
    pub const fn samples(self) -> usize {
        let side = 2 * self.half_width as usize + 1;
        side * side
    }

    /// Refuses sizes outside their ranges.
    pub fn validate(self) -> Result<(), ParamError> {
        check("window", self.half_width, 1..=WIDEST, "1 to 7")?;
        check("stride", self.stride, STRIDES, "1 to 8")
    }

    /// Returns the size for a pixel pitch in metres at 1 m. Strides are tuned for a Kinect v1, whose pixels span
    /// 1/525 of the range. Coarser pixels shorten the stride in proportion, down to 1, so that a window covers a
    /// similar area of the scene. (Otherwise the default windows would reach over whole objects at 160x120, and mix
    /// them.) If the window then keeps less than half of its reach in pixels, it gets wider, since noise is averaged
    /// over pixels. Finer pixels do not change the size.
    fn at_pitch(self, pitch_at_1m: f64) -> Self {
        if !STRIDES.contains(&self.stride) {
            return self;
        }
        let coarseness = pitch_at_1m * TUNED_FOCAL_LENGTH_PX;
        let stride = (f64::from(self.stride) / coarseness + ROUNDING).floor();
        let stride = (stride as u32).clamp(1, self.stride);
        let least_reach_px = self.reach_px() as f64 * LEAST_REACH;
        let half_width = (least_reach_px / f64::from(stride)).ceil() as u32;
        Self { stride, half_width: half_width.min(WIDEST).max(self.half_width) }
    }
}

/// The window of a frame's pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Window {
    /// A size that follows the resolution of the frames: this size for pixels at least as fine as a Kinect v1's,
    /// shorter strides for coarser pixels. A smoother decides by its first frame with a known resolution.
    Auto(WindowSize),
    /// The same size for every frame.
    Fixed(WindowSize),
}

impl Window {
    /// Returns the size for frames of unknown resolution.
    pub const fn nominal(self) -> WindowSize {
        match self {
            Self::Auto(size) | Self::Fixed(size) => size,
        }
    }

    /// Returns true if the size follows the resolution.
    pub const fn is_auto(self) -> bool {
        matches!(self, Self::Auto(_))
    }

    /// Returns the size for pixels with this pitch, in metres at 1 m.
    pub(crate) fn at_pitch(self, pitch_at_1m: f64) -> WindowSize {
        match self {
            Self::Auto(size) => size.at_pitch(pitch_at_1m),
            Self::Fixed(size) => size,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strides_follow_coarse_pixels_and_nothing_else() {
        let at = |focal_length_px: f64, stride| {
            let size = WindowSize { half_width: 2, stride }.at_pitch(1.0 / focal_length_px);
            (size.half_width, size.stride)
        };
        let of_default: Vec<_> = [1000.0, 525.0, 425.0, 366.0, 262.5, 210.0, 131.25, 10.0]
            .map(|focal_length_px| at(focal_length_px, 5))
            .into();
        assert_eq!(of_default, [(2, 5), (2, 5), (2, 4), (2, 4), (2, 3), (3, 2), (5, 1), (5, 1)]);
        assert_eq!((at(525.0, 1), at(262.5, 2), at(262.5, 8)), ((2, 1), (2, 1), (2, 4)));
        // Values out of range stay as they are and are refused later.
        assert_eq!((at(100.0, 0), at(100.0, 12)), ((2, 0), (2, 12)));
    }
}
