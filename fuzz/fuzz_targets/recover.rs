//! Any bytes as a truncated recording: rejected and unchanged, or complete afterwards.
//!
//! `cargo fuzz run -s none recover`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(
    // The library catches panics of the crate `mcap`, which occur with overflow checks, as in the target `las`.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_recover(bytes)
);
