//! 16-bit grayscale TIFF as a depth image.

use std::io::Cursor;

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Compression, TiffEncoder, colortype};
use tiff::{ColorType, TiffError};

use super::ReadOptions;
use crate::error::FormatError;
use crate::frame::DepthImage;
use crate::xyz::validate_shape;

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<DepthImage, FormatError> {
    let malformed = |error: TiffError| FormatError::Malformed(format!("damaged TIFF: {error}"));
    let most = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = most;
    limits.intermediate_buffer_size = most;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(malformed)?.with_limits(limits);
    let (width, height) = decoder.dimensions().map_err(malformed)?;
    let (width, height) = (width as usize, height as usize);
    let kind = decoder.colortype().map_err(malformed)?;
    if kind != ColorType::Gray(16) {
        return Err(FormatError::Unsupported(format!("a TIFF of {kind:?}: a depth image is 16-bit grayscale")));
    }
    validate_shape(width, height)?;
    // The image, and a strip or tile that may be all of it.
    options.check(width * height, 4)?;
    match decoder.read_image().map_err(malformed)? {
        DecodingResult::U16(raw) if raw.len() == width * height => Ok(DepthImage { width, height, raw }),
        _ => Err(FormatError::Unsupported("the TIFF's samples are not unsigned 16-bit integers".into())),
    }
}

pub(super) fn encode(image: &DepthImage) -> Result<Vec<u8>, FormatError> {
    let (width, height) = (image.width, image.height);
    let failed = |error: TiffError| FormatError::Unsupported(format!("no TIFF of {width}x{height}: {error}"));
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes)
        .map_err(failed)?
        .with_compression(Compression::Deflate(tiff::encoder::DeflateLevel::Fast));
    encoder.write_image::<colortype::Gray16>(width as u32, height as u32, &image.raw).map_err(failed)?;
    Ok(bytes.into_inner())
}
