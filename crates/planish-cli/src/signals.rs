//! Handles SIGINT, SIGTERM and SIGHUP in every command, so that no half-written file remains and no recording is lost.

use std::process::exit;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::{Context, Result};

/// Exit code of an interrupted process, as shells report it for SIGINT.
pub const INTERRUPTED: u8 = 130;

/// Flag set by the first signal, for commands that check it.
static STOP: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// True once a signal is ending the process.
static IS_ENDING: AtomicBool = AtomicBool::new(false);

/// Number of SIGXFSZ on Linux and macOS.
#[cfg(unix)]
const FILE_TOO_LARGE: i32 = 25;

/// Installs the signal handlers.
pub fn install() -> Result<()> {
    let handler = || match STOP.get() {
        // After the first signal, the command stops at its next check. A second signal means that something hangs.
        Some(stop) if !stop.swap(true, Ordering::Relaxed) => {}
        _ => {
            IS_ENDING.store(true, Ordering::Relaxed);
            #[cfg(feature = "mcap")]
            planish::bag::finish_recordings();
            planish::io::remove_temporaries();
            exit(i32::from(INTERRUPTED));
        }
    };
    let ignored = ignored_signals();
    ctrlc::set_handler(handler).context("cannot install the signal handlers")?;
    ignored.into_iter().for_each(ignore);
    // A write beyond the file size limit then fails instead of killing the process.
    #[cfg(unix)]
    ignore(FILE_TOO_LARGE);
    Ok(())
}

/// Waits forever if a signal is ending the process, so that errors caused by the shutdown are not printed.
pub fn wait_if_ending() {
    while IS_ENDING.load(Ordering::Relaxed) {
        std::thread::park();
    }
}

/// Returns the signals that the parent process wants ignored: SIGHUP under `nohup`, SIGINT for a shell's background
/// jobs.
fn ignored_signals() -> Vec<i32> {
    const HANGUP_AND_INTERRUPT: [i32; 2] = [1, 2];
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    HANGUP_AND_INTERRUPT.into_iter().filter(|signal| mask >> (signal - 1) & 1 == 1).collect()
}

/// Makes the process ignore a signal.
fn ignore(number: i32) {
    #[cfg(unix)]
    {
        const SIG_IGN: usize = 1;
        unsafe extern "C" {
            fn signal(signal: i32, handler: usize) -> usize;
        }
        // SAFETY: the C library's own function, with a signal and a handler that it defines.
        unsafe { signal(number, SIG_IGN) };
    }
    #[cfg(not(unix))]
    let _ = number;
}

/// Returns the flag that the first signal sets. A command that calls this function must check the flag often; the
/// first signal ends any other command at once.
pub fn stop_flag() -> Arc<AtomicBool> {
    Arc::clone(STOP.get_or_init(Default::default))
}

/// Makes the first signal from now on set `stop`. Before this call, a signal ends the command at once.
pub fn stop_by(stop: &Arc<AtomicBool>) {
    // Each command calls this once.
    let _ = STOP.set(Arc::clone(stop));
}
