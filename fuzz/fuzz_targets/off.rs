//! Any bytes as an OFF file: an error or a valid cloud or image, never a panic.
//!
//! `cargo fuzz run -s none off`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Off));
