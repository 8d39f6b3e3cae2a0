//! The time without frames after which a device counts as gone.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

static SECONDS: AtomicU64 = AtomicU64::new(5);

/// Returns the time without frames after which a device counts as gone, in whole seconds.
pub(super) fn longest_silence() -> Duration {
    Duration::from_secs(SECONDS.load(Ordering::Relaxed))
}

/// Sets the timeout for all sources of this process, to shorten tests.
#[cfg(feature = "internal")]
pub fn set_longest_silence_s(seconds: u64) {
    SECONDS.store(seconds, Ordering::Relaxed);
}
