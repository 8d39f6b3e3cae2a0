//! Behaviour when a GPU is lost. These tests have their own process and run one at a time, because the loss destroys
//! every device of the process.

mod fleet;
mod rig;
mod stream;
mod video;

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Returns a lock that keeps the other tests away from the devices while it is held.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}
