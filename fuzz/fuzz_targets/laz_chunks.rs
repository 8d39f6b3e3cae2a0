//! A valid LAZ file with any chunk table: an error or a valid cloud, with no more memory than the file's points need.
//!
//! `cargo fuzz run -s none laz_chunks`

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(
    // The library catches the decoder's panics, as in the target `las`.
    init: std::panic::set_hook(Box::new(|_| {})),
    |bytes: &[u8]| planish_fuzz::check_laz_chunks(bytes)
);
