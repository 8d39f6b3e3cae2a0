//! Any bytes as a depth TIFF: an error or contents that pass their own validation, never a panic, never more memory
//! than allowed.
//!
//! `cargo fuzz run -s none depth_tiff`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::DepthTiff));
