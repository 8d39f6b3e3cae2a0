//! A frame in flight.

use std::sync::Arc;

use super::sight::Sight;
use crate::fleet::SharedFrame;

/// A frame that several threads own, without its type.
pub(super) type AnyFrame = Arc<dyn SharedFrame>;

/// A frame in flight.
pub(super) struct Pending {
    /// The frame, to be smoothed again if its device is lost; `None` for one that the session does not share.
    pub(super) frame: Option<AnyFrame>,
    pub(super) is_cloud: bool,
    /// How the frame is seen, if its result is to be smoothed over time once received.
    pub(super) sight: Option<Sight>,
}
