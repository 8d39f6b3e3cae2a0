//! Any bytes as a LAS or LAZ file: an error or a valid cloud, never a panic.
//!
//! `cargo fuzz run -s none las`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Las));
