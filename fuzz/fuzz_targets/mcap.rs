//! Any bytes as a recording in MCAP: an error or frames, never a panic that reaches the caller.
//!
//! `cargo fuzz run -s none mcap`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(
    // The library catches the panics of the crate mcap with overflow checks, as in the target las.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_bag(bytes)
);
