//! Progress of smoothing a large cloud. Another thread can display it, or cancel smoothing.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::error::EngineError;

/// The progress of a frame that another thread smooths, and a way to stop that thread.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicU64,
    total: AtomicU64,
    stopped: AtomicBool,
}

impl Progress {
    /// Returns the progress from 0 to 1; 0 before the first frame.
    pub fn share(&self) -> f32 {
        let (done, total) = (self.done.load(Ordering::Relaxed), self.total.load(Ordering::Relaxed));
        if total == 0 { 0.0 } else { (done as f32 / total as f32).min(1.0) }
    }

    /// Cancels smoothing of the current frame, which soon fails with [`EngineError::Stopped`]. The next frame is not
    /// affected.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::Relaxed);
    }

    /// Returns true if the frame was stopped.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// Returns an error if the frame was stopped.
    pub fn check(&self) -> Result<(), EngineError> {
        if self.is_stopped() { Err(EngineError::Stopped) } else { Ok(()) }
    }

    /// Clears the progress and the stop request of the previous frame.
    pub fn reset(&self) {
        self.stopped.store(false, Ordering::Relaxed);
        self.begin(0);
    }

    /// Begins a frame with this many steps.
    pub fn begin(&self, steps: usize) {
        self.done.store(0, Ordering::Relaxed);
        self.total.store(steps as u64, Ordering::Relaxed);
    }

    /// Adds completed steps.
    pub fn add(&self, steps: usize) {
        self.done.fetch_add(steps as u64, Ordering::Relaxed);
    }
}
