//! Measurement of the time per stage of smoothing.

use std::ops::AddAssign;
use std::time::Duration;
#[cfg(not(target_family = "wasm"))]
use std::time::Instant;

/// Time per stage of one frame or batch, on a GPU or in the CPU engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct FrameTimings {
    /// Time to copy the input to the device's memory, close to zero if the kernel reads host memory; on the CPU, time
    /// to copy or deproject the input into the kernel's padded frame.
    pub upload: Duration,
    /// Time of the kernel, including the preceding pass if edges are kept.
    pub kernel: Duration,
    /// Time to copy the result to host memory; close to zero if the kernel writes it there, as in the CPU engine.
    pub readback: Duration,
}

impl AddAssign for FrameTimings {
    fn add_assign(&mut self, more: Self) {
        self.upload += more.upload;
        self.kernel += more.kernel;
        self.readback += more.readback;
    }
}

/// A point in time for measuring durations. WebAssembly has no clock in the standard library; there, all durations are
/// zero.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stopwatch(#[cfg(not(target_family = "wasm"))] Instant);

impl Stopwatch {
    pub(crate) fn start() -> Self {
        Self(
            #[cfg(not(target_family = "wasm"))]
            Instant::now(),
        )
    }

    /// Returns the time since the start.
    pub(crate) fn elapsed(&self) -> Duration {
        #[cfg(not(target_family = "wasm"))]
        return self.0.elapsed();
        #[cfg(target_family = "wasm")]
        return Duration::ZERO;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_add_up_stage_by_stage() {
        let times = |ms: [u64; 3]| {
            let [upload, kernel, readback] = ms.map(Duration::from_millis);
            FrameTimings { upload, kernel, readback }
        };
        let mut sum = times([1, 20, 300]);
        sum += times([4, 50, 600]);
        assert_eq!(sum, times([5, 70, 900]));
    }
}
