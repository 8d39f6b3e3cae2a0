//! 16-bit grayscale TIFF as a depth image.

use std::io::Cursor;

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Compression, TiffEncoder, colortype};
use tiff::{ColorType, TiffError};

use super::{DepthSummary, ReadOptions};
use planish_core::{DepthImage, FormatError, internal::validate_shape};

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<DepthImage, FormatError> {
    let (mut decoder, (width, height)) = open(bytes, options)?;
    // The image, and a strip or tile that may be all of it.
    options.check(width * height, 4)?;
    match decoder.read_image().map_err(malformed)? {
        DecodingResult::U16(raw) if raw.len() == width * height => Ok(DepthImage { width, height, raw }),
        _ => Err(not_unsigned()),
    }
}

/// Counts the pixels, a strip or tile at a time, without keeping them.
pub(super) fn summarize(bytes: &[u8], options: &ReadOptions) -> Result<DepthSummary, FormatError> {
    let (mut decoder, (width, height)) = open(bytes, options)?;
    let (chunk_width, chunk_height) = decoder.chunk_dimensions();
    options.check(chunk_width as usize * chunk_height as usize, 4)?;
    let mut summary = DepthSummary { width, height, ..DepthSummary::default() };
    let chunks = width.div_ceil(chunk_width.max(1) as usize) * height.div_ceil(chunk_height.max(1) as usize);
    for chunk in 0..u32::try_from(chunks).unwrap_or(u32::MAX) {
        match decoder.read_chunk(chunk).map_err(malformed)? {
            DecodingResult::U16(raw) => summary.add(raw.into_iter()),
            _ => return Err(not_unsigned()),
        }
    }
    Ok(summary)
}

fn malformed(error: TiffError) -> FormatError {
    FormatError::Malformed(format!("damaged TIFF: {error}"))
}

fn not_unsigned() -> FormatError {
    FormatError::Unsupported("the TIFF's samples are not unsigned 16-bit integers".into())
}

/// The decoder of a depth image, and its shape.
type Opened<'a> = (Decoder<Cursor<&'a [u8]>>, (usize, usize));

fn open<'a>(bytes: &'a [u8], options: &ReadOptions) -> Result<Opened<'a>, FormatError> {
    let most = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = most;
    limits.intermediate_buffer_size = most;
    let mut decoder = Decoder::new(Cursor::new(bytes)).map_err(malformed)?.with_limits(limits);
    let (width, height) = decoder.dimensions().map_err(malformed)?;
    let (width, height) = (width as usize, height as usize);
    let kind = decoder.colortype().map_err(malformed)?;
    if kind != ColorType::Gray(16) {
        return Err(FormatError::Unsupported(format!(
            "unsupported TIFF type {kind:?}; a depth image must be 16-bit grayscale"
        )));
    }
    validate_shape(width, height)?;
    Ok((decoder, (width, height)))
}

pub(super) fn encode(image: &DepthImage) -> Result<Vec<u8>, FormatError> {
    let (width, height) = (image.width, image.height);
    let failed =
        |error: TiffError| FormatError::Unsupported(format!("cannot encode a TIFF of {width}x{height}: {error}"));
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes)
        .map_err(failed)?
        .with_compression(Compression::Deflate(tiff::encoder::DeflateLevel::Fast));
    encoder.write_image::<colortype::Gray16>(width as u32, height as u32, &image.raw).map_err(failed)?;
    Ok(bytes.into_inner())
}
