//! Any bytes as the list of a data set in TUM layout: errors or frames, never a panic.
//!
//! `cargo fuzz run -s none tum`

#![no_main]

use std::fs;

use libfuzzer_sys::fuzz_target;
use planish::Camera;
use planish::source::{SourceOptions, open};

fuzz_target!(|bytes: &[u8]| {
    let folder = std::env::temp_dir().join(format!("planish-fuzz-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("a folder for the list");
    let options = SourceOptions::default().with_camera(Some(Camera::kinect_v1()));
    for list in ["depth.txt", "associations.txt"] {
        fs::write(folder.join(list), bytes).expect("a list");
        if let Ok(mut source) = open(folder.to_str().expect("a name in UTF-8"), &options) {
            // The images that it names are not there, or another file is.
            for _ in 0..4 {
                let _ = source.next_frame();
            }
        }
        fs::remove_file(folder.join(list)).expect("the list");
    }
});
