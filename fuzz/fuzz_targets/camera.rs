//! Any text as a camera file: an error or a valid camera, never a panic.
//!
//! `cargo fuzz run -s none camera`

#![no_main]

use libfuzzer_sys::fuzz_target;
use planish::io::parse_camera;

fuzz_target!(|text: &str| {
    for shape in [None, Some((640, 480))] {
        if let Ok(camera) = parse_camera(text, shape) {
            let (width, height) = (camera.width.max(1), camera.height.max(1));
            camera.with_shape((width, height)).validate().expect("a valid camera");
        }
    }
});
