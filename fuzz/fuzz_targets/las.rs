//! Any bytes as a LAS or LAZ file: an error or a valid cloud, never a panic that reaches the caller.
//!
//! `cargo fuzz run -s none las`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::Format;

fuzz_target!(
    // The LAZ decoder panics on damaged points, and the library catches the panic. The fuzzer's hook would end the
    // run first; without it, an uncaught panic still ends the run.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_decoder(bytes, Format::Las)
);
