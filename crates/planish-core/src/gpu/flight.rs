//! A submission in progress.

use std::sync::{Arc, Mutex};

use super::slot::Slot;
use crate::error::EngineError;

/// Free slots; a view returns its slot from any thread.
pub(super) type FreeSlots = Arc<Mutex<Vec<Slot>>>;

/// A submission that is running, or whose result has not been received.
pub(super) struct Flight {
    pub(super) slot: Slot,
    pub(super) submission: wgpu::SubmissionIndex,
    pub(super) free: FreeSlots,
}

impl Flight {
    /// Waits until the result is ready.
    pub(super) fn wait(&self) -> Result<(), EngineError> {
        self.slot.gpu.wait(self.submission.clone())?;
        self.slot.wait_mapped()
    }
}
