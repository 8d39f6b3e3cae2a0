//! Smoothing over time (docs/method.md, section 16): a recursive mean of each pixel's inverse depth, or depth, over
//! the frames of a video. Old frames fade where the scene changes.

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
    /// Inverse depth, for triangulating sensors.
    InverseDepth,
    /// Depth, for time-of-flight sensors.
    Depth,
}

impl Domain {
    /// Returns the domain of a sensor, which depends on the term that dominates its noise at 2 m.
    pub(crate) fn of(sensor: &crate::SensorModel) -> Self {
        let [c0, c1, c2] = sensor.sigma;
        if 4.0 * c2 > c0 + 2.0 * c1 { Self::InverseDepth } else { Self::Depth }
    }

    /// Returns the depth, in metres, that a value represents.
    #[inline(always)]
    fn depth_m(self, value: f32) -> f32 {
        match self {
            Self::InverseDepth => 1.0 / value,
            Self::Depth => value,
        }
    }
}
