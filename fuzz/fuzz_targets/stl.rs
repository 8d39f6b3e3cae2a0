//! Any bytes as an STL file: an error or a valid cloud, never a panic.
//!
//! `cargo fuzz run -s none stl`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Stl));
