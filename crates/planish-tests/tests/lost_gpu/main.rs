//! Behaviour when a GPU is lost. A separate process, one test at a time: every device in it is destroyed.

mod fleet;
mod rig;
mod stream;
mod video;

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Keeps the other tests away from the devices for as long as it is held.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}
