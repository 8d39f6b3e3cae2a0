//! Guards calls to third-party decoders that panic on some damaged files.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Number of guarded calls in progress.
static RUNNING: AtomicUsize = AtomicUsize::new(0);

/// Calls a decoder; returns `None` if it panics.
pub fn guarded<T>(decode: impl FnOnce() -> T) -> Option<T> {
    RUNNING.fetch_add(1, Ordering::Relaxed);
    let decoded = catch_unwind(AssertUnwindSafe(decode)).ok();
    RUNNING.fetch_sub(1, Ordering::Relaxed);
    decoded
}

/// Returns true while a guarded decoder runs on any thread. All threads count because decoders may start threads.
/// During that time, callers should not print panic messages.
pub fn catches_panics() -> bool {
    RUNNING.load(Ordering::Relaxed) > 0
}
