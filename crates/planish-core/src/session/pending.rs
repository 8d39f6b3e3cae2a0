//! A frame in flight.

use std::sync::Arc;

use super::sight::Sight;
use crate::fleet::SharedFrame;
use crate::temporal::CameraMotion;

/// A frame that several threads own, without its type.
pub(super) type AnyFrame = Arc<dyn SharedFrame>;

/// A frame in flight.
pub(super) struct Pending {
    /// The frame, to be smoothed again if its device is lost; `None` for one that the session does not share.
    pub(super) frame: Option<AnyFrame>,
    pub(super) is_cloud: bool,
    pub(super) on_receipt: OnReceipt,
}

/// What is to be done with a result that is received.
#[derive(Debug, Clone, Copy, Default)]
pub(super) enum OnReceipt {
    #[default]
    Nothing,
    /// It is to be smoothed over time, seen like this.
    Filter(Sight),
    /// Its device has done so; how the camera had moved.
    Filtered(Sight, Option<CameraMotion>),
}
