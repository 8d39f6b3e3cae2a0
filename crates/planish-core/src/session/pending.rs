//! A frame in flight.

use std::sync::Arc;

use super::finish::Finish;
use super::sight::Sight;
use crate::fleet::SharedFrame;
use crate::outputs::Outputs;
use crate::temporal::CameraMotion;

/// A shared frame of any type.
pub(super) type AnyFrame = Arc<dyn SharedFrame>;

/// A frame in flight.
pub(super) struct Pending {
    /// The frame, kept in case its device is lost; `None` if the caller did not share it with the session.
    pub(super) frame: Option<AnyFrame>,
    pub(super) is_cloud: bool,
    pub(super) on_receipt: OnReceipt,
    /// The steps that the session applies to the result after the engine, if any.
    pub(super) finish: Option<Finish>,
    /// The requested outputs.
    pub(super) outputs: Outputs,
}

/// The smoothing over time that a result needs when it is received.
#[derive(Debug, Clone, Copy, Default)]
pub(super) enum OnReceipt {
    #[default]
    Nothing,
    /// The session smooths the result over time, using the camera, sensor and geometry of the frame.
    Filter(Sight),
    /// The device has smoothed the result over time. Contains the camera, sensor and geometry of the frame, and the
    /// motion of the camera if known.
    Filtered(Sight, Option<CameraMotion>),
}
