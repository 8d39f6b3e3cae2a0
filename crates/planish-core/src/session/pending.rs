//! A frame in flight.

use std::sync::Arc;

use super::finish::Finish;
use super::sight::Sight;
use crate::fleet::SharedFrame;
use crate::outputs::Outputs;
use crate::temporal::CameraMotion;

/// A frame that several threads own, without its type.
pub(super) type AnyFrame = Arc<dyn SharedFrame>;

/// A frame in flight.
pub(super) struct Pending {
    /// The frame, to be smoothed again if its device is lost; `None` for one that the session does not share.
    pub(super) frame: Option<AnyFrame>,
    pub(super) is_cloud: bool,
    pub(super) on_receipt: OnReceipt,
    /// How the session finishes its result, if it does.
    pub(super) finish: Option<Finish>,
    /// The outputs that were requested.
    pub(super) outputs: Outputs,
}

/// How to finish a received result.
#[derive(Debug, Clone, Copy, Default)]
pub(super) enum OnReceipt {
    #[default]
    Nothing,
    /// The session smooths it over time, with this geometry.
    Filter(Sight),
    /// The device has smoothed it over time; the motion of the camera.
    Filtered(Sight, Option<CameraMotion>),
}
