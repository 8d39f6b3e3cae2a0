//! Any bytes as a PTX file: an error or a valid cloud or image, never a panic.
//!
//! `cargo fuzz run -s none ptx`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Ptx));
