//! Any bytes as an LZF stream, and any bytes compressed and decompressed.
//!
//! `cargo fuzz run -s none lzf`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_lzf(bytes));
