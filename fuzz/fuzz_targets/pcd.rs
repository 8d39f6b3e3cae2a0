//! Any bytes as a PCD file: an error or a cloud that passes its own validation, never a panic.
//!
//! `cargo fuzz run -s none pcd`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::{Contents, Format, decode};

fuzz_target!(|bytes: &[u8]| {
    match decode(bytes, Some(Format::Pcd)) {
        Ok((Format::Pcd, Contents::Organized(cloud))) => cloud.points.validate().expect("fields of one length"),
        Ok((Format::Pcd, Contents::General(cloud))) => cloud.validate().expect("fields of one length"),
        _ => {}
    }
});
