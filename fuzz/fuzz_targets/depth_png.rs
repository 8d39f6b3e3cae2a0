//! Any bytes as a depth PNG: an error or contents that pass their own validation, never a panic, never more memory
//! than allowed.
//!
//! `cargo fuzz run -s none depth_png`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::DepthPng));
