//! Frames that need too much memory.

use super::Worker;
use anyhow::Result;
use planish::Frame;

/// Maximum memory per point of an engine and its results (default setting with all outputs: 130 to 150 bytes).
const ENGINE_BYTES_A_POINT: u64 = 240;

/// A frame needs more memory than its worker has.
#[derive(Debug)]
pub(super) struct NeedsMemory(pub(super) String);

impl std::fmt::Display for NeedsMemory {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for NeedsMemory {}

impl Worker<'_> {
    /// Refuses a frame for which an engine and its results need more memory than allowed.
    pub(super) fn check_memory(&self, frame: Frame<'_>) -> Result<()> {
        let (width, height) = frame.shape();
        let points = width * height;
        let needed = points as u64 * ENGINE_BYTES_A_POINT;
        let allowed = self.read_options().max_memory_bytes;
        if needed <= allowed {
            return Ok(());
        }
        let text = format!(
            "{points} points need {} MiB of memory, but only {} MiB are allowed; raise --max-memory if the machine \
             has enough",
            needed.div_ceil(1 << 20),
            allowed >> 20
        );
        Err(NeedsMemory(text).into())
    }
}
