//! Reads and writes pictures as 8-bit PNG.

use std::io::Cursor;
use std::path::Path;

use super::depth_png::encode_png;
use super::{ReadOptions, RgbImage};
use planish_core::{FormatError, IoError};

/// Writes a picture as PNG. A colourless picture is written as grayscale, which needs a third of the bytes.
pub fn write_rgb_png(path: &Path, image: &RgbImage) -> Result<(), IoError> {
    let (width, height, eight) = (image.width, image.height, png::BitDepth::Eight);
    let pixels = image.rgb.chunks_exact(3);
    let encoded = if pixels.clone().all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]) {
        let grey: Vec<u8> = pixels.map(|pixel| pixel[0]).collect();
        encode_png(width, height, png::ColorType::Grayscale, eight, &grey)
    } else {
        encode_png(width, height, png::ColorType::Rgb, eight, &image.rgb)
    };
    encoded.and_then(|bytes| super::write_whole(path, &bytes)).map_err(IoError::at(path))
}

/// Writes pictures of the same size as an animated PNG that repeats endlessly. If all pictures are colourless, it is
/// grayscale.
pub fn write_animated_png(path: &Path, images: &[RgbImage], frames_per_second: u16) -> Result<(), IoError> {
    encode_animated(images, frames_per_second)
        .and_then(|bytes| super::write_whole(path, &bytes))
        .map_err(IoError::at(path))
}

fn encode_animated(images: &[RgbImage], frames_per_second: u16) -> Result<Vec<u8>, FormatError> {
    let failed = |error: png::EncodingError| FormatError::Unsupported(format!("cannot encode an animation: {error}"));
    let too_large = || FormatError::Unsupported("the animation is too large".to_owned());
    let Some(first) = images.first() else {
        return Err(FormatError::Unsupported("an animation needs at least one picture".to_owned()));
    };
    let [width, height, count] = [first.width, first.height, images.len()].map(u32::try_from);
    let (width, height, count) =
        (width.map_err(|_| too_large())?, height.map_err(|_| too_large())?, count.map_err(|_| too_large())?);
    let is_grey = images.iter().all(|image| image.rgb.chunks_exact(3).all(|p| p[0] == p[1] && p[1] == p[2]));
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(if is_grey { png::ColorType::Grayscale } else { png::ColorType::Rgb });
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_animated(count, 0).map_err(failed)?;
    encoder.set_frame_delay(1, frames_per_second).map_err(failed)?;
    let mut writer = encoder.write_header().map_err(failed)?;
    for image in images {
        match is_grey {
            true => writer.write_image_data(&image.rgb.iter().step_by(3).copied().collect::<Vec<_>>()),
            false => writer.write_image_data(&image.rgb),
        }
        .map_err(failed)?;
    }
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// Reads a PNG as 8-bit colour; alpha is dropped, and grey is expanded to colour.
pub fn read_rgb_png(path: &Path) -> Result<RgbImage, IoError> {
    read_rgb_png_with(path, &ReadOptions::default())
}

/// Same as [`read_rgb_png`], with options.
pub fn read_rgb_png_with(path: &Path, options: &ReadOptions) -> Result<RgbImage, IoError> {
    let read = || decode(&super::read_bytes(path, options)?, options);
    read().map_err(IoError::at(path))
}

fn decode(bytes: &[u8], options: &ReadOptions) -> Result<RgbImage, FormatError> {
    let malformed = |error: png::DecodingError| FormatError::Malformed(format!("damaged PNG: {error}"));
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(malformed)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    planish_core::validate_shape(width, height)?;
    let size = reader.output_buffer_size().unwrap_or(usize::MAX);
    // Deflate compresses by a factor of at most 1032, and 1-bit pixels become bytes.
    if size / 8800 > bytes.len() {
        return Err(FormatError::Malformed(format!("the PNG is truncated: its header states {width}x{height} pixels")));
    }
    // Memory for the samples and for the colours.
    options.check(size, 2)?;
    let mut buffer = vec![0; size];
    reader.next_frame(&mut buffer).map_err(malformed)?;
    let channels = size / (width * height);
    let rgb = |pixel: &[u8]| if channels < 3 { [pixel[0]; 3] } else { [pixel[0], pixel[1], pixel[2]] };
    Ok(RgbImage { width, height, rgb: buffer.chunks_exact(channels).flat_map(rgb).collect() })
}
