//! A frame that owns its data: a depth image or an organized cloud.

use super::{DepthFrame, Frame, IntoFrame};
use crate::cloud::OrganizedCloud;
use crate::error::FrameError;

/// A depth image or an organized cloud that owns its data.
#[derive(Debug, Clone, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a few hundred bytes beside the megabytes of a frame")]
pub enum OwnedFrame {
    /// A depth image with its camera, timestamp and optional colour.
    Depth(DepthFrame),
    /// An organized cloud.
    Cloud {
        /// The points.
        cloud: OrganizedCloud,
        /// Time of capture in seconds, on the clock of the source.
        timestamp_s: Option<f64>,
    },
}

impl OwnedFrame {
    /// Returns the width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(depth) => (depth.camera.width, depth.camera.height),
            Self::Cloud { cloud, .. } => (cloud.width(), cloud.height()),
        }
    }

    /// Returns the time of capture in seconds, on the clock of the source.
    pub fn timestamp_s(&self) -> Option<f64> {
        match self {
            Self::Depth(depth) => depth.timestamp_s,
            Self::Cloud { timestamp_s, .. } => *timestamp_s,
        }
    }
}

impl<'a> IntoFrame<'a> for &'a OwnedFrame {
    fn into_frame(self) -> Result<Frame<'a>, FrameError> {
        match self {
            OwnedFrame::Depth(depth) => depth.into_frame(),
            OwnedFrame::Cloud { cloud, .. } => cloud.into_frame(),
        }
    }
}
