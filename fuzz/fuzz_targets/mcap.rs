//! Any bytes as an MCAP recording: an error or frames, never a panic that reaches the caller.
//!
//! `cargo fuzz run -s none mcap`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(
    // With overflow checks, the crate `mcap` panics on damaged records. The library catches the panic, but the
    // fuzzer's hook would end the run first.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_bag(bytes)
);
