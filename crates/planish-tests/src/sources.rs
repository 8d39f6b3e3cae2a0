//! Sources of frames for streams.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use planish::internal::lose_gpu_devices;
use planish::source::{OwnedFrame, Source};
use planish::{DepthFrame, Error};

/// A source that delivers each frame only after the result of the previous frame, so that GPUs are lost between
/// frames. The timestamps are 0, 1, 2, ... seconds.
pub struct OneByOne {
    frame: DepthFrame,
    next: u64,
    frames: u64,
    results: Arc<AtomicU64>,
    lost_before: Vec<u64>,
}

impl OneByOne {
    /// Creates a source that delivers `frames` frames; `results` counts their results.
    pub fn new(frame: DepthFrame, frames: u64, results: Arc<AtomicU64>) -> Self {
        Self { frame, next: 0, frames, results, lost_before: Vec::new() }
    }

    /// Makes the source lose all GPUs before the frames with these numbers.
    pub fn losing_gpus_before(self, frames: &[u64]) -> Self {
        Self { lost_before: frames.to_vec(), ..self }
    }
}

impl Source for OneByOne {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        while self.results.load(Ordering::Relaxed) < self.next {
            std::thread::yield_now();
        }
        if self.next == self.frames {
            return Ok(None);
        }
        if self.lost_before.contains(&self.next) {
            lose_gpu_devices();
        }
        let frame = self.frame.clone().with_timestamp_s(self.next as f64);
        self.next += 1;
        Ok(Some(OwnedFrame::Depth(frame)))
    }
}
