//! Reads and writes depth images as grayscale TIFF: 16-bit integers, 32-bit integers that fit in 16 bits, or floats in
//! metres.

use std::io::Cursor;

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Compression, TiffEncoder, colortype};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

use super::{Contents, DepthSummary, ReadOptions, depth_of_integers};
use planish_core::{DepthImage, FormatError, validate_shape};

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> Result<Contents, FormatError> {
    let mut decoder = decoder(bytes, options)?;
    let page = options.image_of(count_pages(&mut decoder), notes)?;
    decoder.seek_to_image(page).map_err(malformed)?;
    let (width, height) = shape_of_depth(&mut decoder)?;
    // Memory for the image, and for a strip or tile, which may be as large as the image.
    options.check(width * height, 16)?;
    let is_inverted = is_inverted(&mut decoder);
    let contents = match decoder.read_image().map_err(malformed)? {
        DecodingResult::U16(mut raw) => {
            raw.iter_mut().filter(|_| is_inverted).for_each(|value| *value = u16::MAX - *value);
            Contents::Depth(DepthImage { width, height, raw })
        }
        DecodingResult::U32(mut values) => {
            values.iter_mut().filter(|_| is_inverted).for_each(|value| *value = u32::MAX - *value);
            depth_of_integers((width, height), &values, notes)?
        }
        DecodingResult::I16(values) => depth_of_integers((width, height), &values, notes)?,
        DecodingResult::I32(values) => depth_of_integers((width, height), &values, notes)?,
        DecodingResult::F32(mut depth_m) => {
            depth_m.iter_mut().filter(|_| is_inverted).for_each(|value| *value = 1.0 - *value);
            Contents::DepthMetres { width, height, depth_m }
        }
        DecodingResult::F64(values) => {
            let value = |value: f64| if is_inverted { 1.0 - value } else { value } as f32;
            Contents::DepthMetres { width, height, depth_m: values.into_iter().map(value).collect() }
        }
        _ => return Err(not_depth()),
    };
    Ok(contents)
}

/// Returns the number of pages, up to the first damaged one.
pub(super) fn pages(bytes: &[u8], options: &ReadOptions) -> Result<usize, FormatError> {
    Ok(count_pages(&mut decoder(bytes, options)?))
}

fn count_pages(decoder: &mut TiffDecoder<'_>) -> usize {
    1 + std::iter::from_fn(|| (decoder.more_images() && decoder.next_image().is_ok()).then_some(())).count()
}

/// Summarizes a depth image strip by strip or tile by tile, without storing its pixels. Returns `None` for images with
/// several pages, inverted values or samples other than 16-bit integers.
pub(super) fn summarize(bytes: &[u8], options: &ReadOptions) -> Result<Option<DepthSummary>, FormatError> {
    let mut decoder = decoder(bytes, options)?;
    let (width, height) = shape_of_depth(&mut decoder)?;
    if decoder.more_images() || options.image.is_some() || is_inverted(&mut decoder) {
        return Ok(None);
    }
    let (chunk_width, chunk_height) = decoder.chunk_dimensions();
    options.check(chunk_width as usize * chunk_height as usize, 4)?;
    let mut summary = DepthSummary { width, height, ..DepthSummary::default() };
    let chunks = width.div_ceil(chunk_width.max(1) as usize) * height.div_ceil(chunk_height.max(1) as usize);
    for chunk in 0..u32::try_from(chunks).unwrap_or(u32::MAX) {
        match decoder.read_chunk(chunk).map_err(malformed)? {
            DecodingResult::U16(raw) => summary.add(raw.into_iter()),
            _ => return Ok(None),
        }
    }
    Ok(Some(summary))
}

/// Returns true if the decoder inverts the values because the image states that white is 0.
fn is_inverted(decoder: &mut TiffDecoder<'_>) -> bool {
    decoder.find_tag_unsigned::<u16>(Tag::PhotometricInterpretation).ok().flatten() == Some(0)
}

fn malformed(error: TiffError) -> FormatError {
    FormatError::Malformed(format!("damaged TIFF: {error}"))
}

fn not_depth() -> FormatError {
    FormatError::Unsupported("unsupported TIFF samples; expected 16-bit or 32-bit integers, or floats".into())
}

type TiffDecoder<'a> = Decoder<Cursor<&'a [u8]>>;

fn decoder<'a>(bytes: &'a [u8], options: &ReadOptions) -> Result<TiffDecoder<'a>, FormatError> {
    let most = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = most;
    limits.intermediate_buffer_size = most;
    Ok(Decoder::new(Cursor::new(bytes)).map_err(malformed)?.with_limits(limits))
}

/// Returns the width and height of the current page.
///
/// # Errors
/// If the page is not a depth image.
fn shape_of_depth(decoder: &mut TiffDecoder<'_>) -> Result<(usize, usize), FormatError> {
    let (width, height) = decoder.dimensions().map_err(malformed)?;
    let (width, height) = (width as usize, height as usize);
    let kind = decoder.colortype().map_err(malformed)?;
    if !matches!(kind, ColorType::Gray(16 | 32 | 64)) {
        return Err(FormatError::Unsupported(format!(
            "unsupported TIFF type {kind:?}; a depth image must be grayscale with 16-bit or 32-bit integers, or floats"
        )));
    }
    validate_shape(width, height)?;
    Ok((width, height))
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
