//! SIGINT and SIGTERM, in every command: no half-written file stays behind.

use std::process::exit;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::{Context, Result};

/// The exit code of a process that was asked to end, as shells have it for SIGINT.
pub const INTERRUPTED: u8 = 130;

/// Set by the first signal, where a command looks at it.
static STOP: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Handles the signals from here on.
pub fn install() -> Result<()> {
    let handler = || match STOP.get() {
        // The command ends by itself; asked twice, something does not.
        Some(stop) if !stop.swap(true, Ordering::Relaxed) => {}
        _ => {
            planish::io::remove_temporaries();
            exit(i32::from(INTERRUPTED));
        }
    };
    ctrlc::set_handler(handler).context("signals cannot be handled")
}

/// Returns the flag that the first signal sets. A command that asks for it looks at it often; any other is ended at once.
pub fn stop_flag() -> Arc<AtomicBool> {
    Arc::clone(STOP.get_or_init(Default::default))
}
