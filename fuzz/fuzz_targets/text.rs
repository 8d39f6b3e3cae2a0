//! Any bytes as lines of numbers: an error or a valid cloud or image, never a panic.
//!
//! `cargo fuzz run -s none text`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Text));
