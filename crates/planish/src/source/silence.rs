//! How long a device may deliver nothing before it counts as gone.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

static SECONDS: AtomicU64 = AtomicU64::new(5);

/// After so long a silence, which is whole seconds, a device counts as gone.
pub(super) fn longest_silence() -> Duration {
    Duration::from_secs(SECONDS.load(Ordering::Relaxed))
}

/// Has the sources of this process wait less, or longer: tests wait for nothing else.
#[cfg(feature = "internal")]
pub fn set_longest_silence_s(seconds: u64) {
    SECONDS.store(seconds, Ordering::Relaxed);
}
