//! What the fuzz targets check.

use planish::io::{Contents, Format, ReadOptions, decode_with};

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
