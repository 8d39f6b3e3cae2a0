//! Any bytes as a Wavefront OBJ file: an error or a valid cloud, never a panic.
//!
//! `cargo fuzz run -s none obj`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Obj));
