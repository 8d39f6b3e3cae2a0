//! What the fuzz targets check.

use planish::Camera;
use planish::bag::BagSource;
use planish::io::{Contents, Format, ReadOptions, decode_with};
use planish::source::Source;

/// Decodes any bytes as a file with the extension of a format.
///
/// # Panics
/// If contents are not valid.
pub fn check_decoder(bytes: &[u8], announced: Format) {
    let options = ReadOptions::default().with_max_memory_bytes(256 << 20);
    match decode_with(bytes, Some(announced), &options).map(|(_, contents)| contents) {
        Ok(Contents::Organized(cloud)) => cloud.points.validate().expect("fields of one length"),
        Ok(Contents::General(cloud)) => cloud.validate().expect("fields of one length"),
        Ok(Contents::Depth(image)) => assert_eq!(image.raw.len(), image.width * image.height),
        Ok(Contents::DepthMetres { width, height, depth_m }) => assert_eq!(depth_m.len(), width * height),
        _ => {}
    }
}

/// Reads any bytes as a recording.
///
/// # Panics
/// If there is nowhere to write them.
pub fn check_bag(bytes: &[u8]) {
    let path = std::env::temp_dir().join(format!("planish-fuzz-{}.mcap", std::process::id()));
    std::fs::write(&path, bytes).expect("a folder for temporary files");
    let camera = Camera::kinect_v1().with_shape((0, 0));
    if let Ok(mut source) = BagSource::open(&path, None, None, Some(camera)) {
        // Frames that cannot be read are errors, and the next may be fine.
        while !matches!(source.next_frame(), Ok(None)) {}
    }
}
