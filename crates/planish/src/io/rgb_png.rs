//! 8-bit colour PNG: pictures for people.

use std::path::Path;

use crate::error::{FormatError, IoError};

/// A picture, 3 bytes (red, green, blue) a pixel, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// 3 * width * height bytes.
    pub rgb: Vec<u8>,
}

/// Writes a picture.
pub fn write_rgb_png(path: &Path, image: &RgbImage) -> Result<(), IoError> {
    encode(image.width, image.height, png::ColorType::Rgb, png::BitDepth::Eight, &image.rgb)
        .and_then(|bytes| super::write_whole(path, &bytes))
        .map_err(IoError::at(path))
}

pub(super) fn encode(
    width: usize,
    height: usize,
    colour: png::ColorType,
    depth: png::BitDepth,
    data: &[u8],
) -> Result<Vec<u8>, FormatError> {
    let failed = |error: png::EncodingError| FormatError::Unsupported(format!("no PNG of {width}x{height}: {error}"));
    let (Ok(columns), Ok(rows)) = (u32::try_from(width), u32::try_from(height)) else {
        return Err(FormatError::Unsupported(format!("{width}x{height} pixels are too many for a PNG")));
    };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, columns, rows);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(data).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}
