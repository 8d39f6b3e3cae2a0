//! Any bytes as a LAS or LAZ file: an error or a valid cloud, never a panic that reaches the caller.
//!
//! `cargo fuzz run -s none las`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(
    // The decoder of LAZ panics on damaged points, which the library catches. The fuzzer's hook would end the run
    // before that; without it, a panic that is not caught ends the run still.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Las)
);
