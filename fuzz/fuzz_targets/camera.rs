//! Any text as a camera file: an error or a valid camera, never a panic.
//!
//! `cargo fuzz run -s none camera`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| planish_fuzz::check_camera(text));
