//! Smoothing over time (docs/method.md, section 16): a recursive mean of each pixel's inverse depth over the frames of
//! a video, which gives way where the scene changes.

pub(crate) mod constants;
mod filter;
mod motion;
mod params;
mod rows;
mod state;
mod tiles;
mod track;

pub use filter::TemporalFilter;
pub use motion::CameraMotion;
pub use params::TemporalParams;
pub(crate) use track::{Surface, SurfaceRef, Tracker};

/// The averaged quantity: inverse depth or depth, whichever has the more constant noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Domain {
    /// Triangulating sensors.
    InverseDepth,
    /// Sensors of time of flight.
    Depth,
}

impl Domain {
    /// By what dominates the noise at 2 m.
    pub(crate) fn of(sensor: &crate::SensorModel) -> Self {
        let [c0, c1, c2] = sensor.sigma;
        if 4.0 * c2 > c0 + 2.0 * c1 { Self::InverseDepth } else { Self::Depth }
    }

    /// Returns the depth of a value.
    #[inline(always)]
    fn depth_m(self, value: f32) -> f32 {
        match self {
            Self::InverseDepth => 1.0 / value,
            Self::Depth => value,
        }
    }
}
