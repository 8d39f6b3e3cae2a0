//! Any bytes as an E57 file: an error or a valid cloud, never a panic.
//!
//! `cargo fuzz run -s none e57`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::E57));
