//! Any bytes as a rig.json or a calibration of several cameras: an error or a rig, never a panic.
//!
//! `cargo fuzz run -s none rig`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| planish_fuzz::check_rig(bytes));
