//! Any bytes as a glTF file: an error or a valid cloud or image, never a panic.
//!
//! `cargo fuzz run -s none gltf`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Gltf));
