//! Frames that need too much memory.

use super::Worker;
use anyhow::Result;
use planish::Frame;
use planish::io::Work;

/// The error of a frame that needs more memory than its worker may use.
#[derive(Debug)]
pub(super) struct NeedsMemory(pub(super) String);

impl std::fmt::Display for NeedsMemory {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for NeedsMemory {}

impl Worker<'_> {
    /// Returns an error if smoothing a frame needs more memory than allowed for the engine and its results.
    pub(super) fn check_memory(&self, frame: Frame<'_>, field_bytes: usize) -> Result<()> {
        let (width, height) = frame.shape();
        match self.read_options().check_work_on_frame(Work::Smooth, frame, field_bytes) {
            Ok(()) => Ok(()),
            Err(error) => Err(NeedsMemory(format!("{width} x {height}: {error} (--max-memory)")).into()),
        }
    }
}
