//! Frames and devices of a fleet.

use crate::engines::Engine;
use crate::error::{EngineError, FrameError};
use crate::frame::{Frame, IntoFrame};

/// A frame that several threads own, passed to a [`Fleet`](crate::Fleet) in an [`Arc`](std::sync::Arc). Implemented
/// for every type whose reference converts to a [`Frame`].
pub trait SharedFrame: Send + Sync + 'static {
    /// Returns the frame.
    ///
    /// # Errors
    /// If buffers contradict the shape, or the camera or the pose is invalid.
    fn frame(&self) -> Result<Frame<'_>, FrameError>;
}

impl<T: Send + Sync + 'static> SharedFrame for T
where
    for<'a> &'a T: IntoFrame<'a>,
{
    fn frame(&self) -> Result<Frame<'_>, FrameError> {
        self.into_frame()
    }
}

/// A device of a fleet and its statistics.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct FleetMember {
    /// Name of the GPU, or of the engine.
    pub name: String,
    /// The engine of the device.
    pub engine: Engine,
    /// Number of frames that the device has computed.
    pub frames: u64,
    /// The error that removed the device from the fleet; `None` while the device works.
    pub lost: Option<EngineError>,
}
