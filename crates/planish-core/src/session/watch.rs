//! The progress of a session, seen from another thread.

use std::sync::{Arc, Mutex, PoisonError};

use crate::progress::Progress;

/// A handle to the progress of the frame that a session is smoothing. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct ProgressWatch(Arc<Mutex<Option<Arc<Progress>>>>);

impl ProgressWatch {
    pub(super) fn set(&self, progress: Option<Arc<Progress>>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = progress;
    }

    /// Returns the progress of the open engine; `None` if no engine is open, or if the engine smooths frames too
    /// quickly to report progress.
    pub fn progress(&self) -> Option<Arc<Progress>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stops the frame that is being smoothed, if the engine reports progress; smoothing then fails with
    /// [`EngineError::Stopped`](crate::EngineError::Stopped).
    pub fn stop(&self) {
        if let Some(progress) = self.progress() {
            progress.stop();
        }
    }
}
