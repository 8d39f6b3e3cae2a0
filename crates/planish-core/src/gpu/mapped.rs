//! Buffers mapped for the host.

use std::sync::{Arc, Condvar, Mutex, PoisonError};

use super::device::{GpuDevice, TIMEOUT, lock};
use crate::error::EngineError;

/// The buffers requested after a submission.
#[derive(Default)]
pub(super) struct Mapped(Arc<Counts>);

/// Number of buffers that are not mapped yet, and whether mapping one of the others has failed.
///
/// Any thread that calls the device may run the callbacks that count, also a little after another has seen the
/// submission done: a thread that needs the buffers waits for the counts.
#[derive(Default)]
struct Counts {
    missing: Mutex<(usize, bool)>,
    changed: Condvar,
}

impl Mapped {
    /// Requests buffers; they are mapped as soon as earlier submissions have finished.
    pub(super) fn ask_for<'a>(&self, buffers: impl Iterator<Item = (&'a wgpu::Buffer, wgpu::MapMode)>) {
        let buffers: Vec<_> = buffers.collect();
        *lock(&self.0.missing) = (buffers.len(), false);
        for (buffer, mode) in buffers {
            let counts = Arc::clone(&self.0);
            buffer.map_async(mode, .., move |result| {
                let mut missing = lock(&counts.missing);
                missing.0 -= 1;
                missing.1 |= result.is_err();
                counts.changed.notify_all();
            });
        }
    }

    /// Waits until every buffer is the host's again, after a submission that has run.
    pub(super) fn wait(&self, gpu: &GpuDevice) -> Result<(), EngineError> {
        let missing = lock(&self.0.missing);
        let waited = self.0.changed.wait_timeout_while(missing, TIMEOUT, |&mut (missing, _)| missing > 0);
        let (missing, has_failed) = *waited.unwrap_or_else(PoisonError::into_inner).0;
        // Nothing is locked here, since callbacks, which update the count, may run next.
        if missing == 0 && !has_failed { Ok(()) } else { Err(gpu.failed("a buffer could not be mapped")) }
    }
}
