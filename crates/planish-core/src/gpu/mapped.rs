//! Tracks the mapping of buffers for the host.

use std::sync::{Arc, Condvar, Mutex, PoisonError};

use super::device::{GpuDevice, TIMEOUT, lock};
use crate::error::EngineError;

/// The buffers whose mapping was requested after a submission.
#[derive(Default)]
pub(super) struct Mapped(Arc<Counts>);

/// Number of buffers that are not mapped yet, and whether a mapping has failed.
///
/// The callbacks that update it run on any thread that calls the device, possibly a little after another thread has
/// seen the submission finish. A thread that needs the buffers therefore waits until the count is 0.
#[derive(Default)]
struct Counts {
    missing: Mutex<(usize, bool)>,
    changed: Condvar,
}

impl Mapped {
    /// Requests the mapping of buffers, which takes place once earlier submissions have finished.
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

    /// Waits until all buffers are mapped for the host. The submission must have finished.
    pub(super) fn wait(&self, gpu: &GpuDevice) -> Result<(), EngineError> {
        let missing = lock(&self.0.missing);
        let waited = self.0.changed.wait_timeout_while(missing, TIMEOUT, |&mut (missing, _)| missing > 0);
        let (missing, has_failed) = *waited.unwrap_or_else(PoisonError::into_inner).0;
        // The lock has been released: `failed` polls the device, which may run callbacks that update the count.
        if missing == 0 && !has_failed { Ok(()) } else { Err(gpu.failed("a buffer could not be mapped")) }
    }
}
