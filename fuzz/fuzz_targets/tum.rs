//! Any bytes as the file list of a data set in TUM layout: errors or frames, never a panic.
//!
//! `cargo fuzz run -s none tum`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_tum(bytes));
