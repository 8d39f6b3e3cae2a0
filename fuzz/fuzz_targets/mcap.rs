//! Any bytes as a recording in MCAP: an error or frames, never a panic.
//!
//! `cargo fuzz run -s none mcap`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_bag(bytes));
