//! Reads and writes depth images as 16-bit grayscale PNG.

use std::io::Cursor;

use super::{DepthSummary, ReadOptions};
use planish_core::{DepthImage, FormatError, validate_shape};

/// Decodes a depth image row by row, so that only one copy of it is in memory.
pub fn decode(bytes: &[u8], options: &ReadOptions) -> Result<DepthImage, FormatError> {
    let (mut reader, (width, height)) = open(bytes, options)?;
    options.check(width * height, 2)?;
    let mut raw = Vec::with_capacity(width * height);
    for_each_row(&mut reader, options, |row| raw.extend(row.as_chunks().0.iter().copied().map(u16::from_be_bytes)))?;
    Ok(DepthImage { width, height, raw })
}

/// Summarizes a depth image without storing its pixels.
pub(super) fn summarize(bytes: &[u8], options: &ReadOptions) -> Result<DepthSummary, FormatError> {
    let (mut reader, (width, height)) = open(bytes, options)?;
    let mut summary = DepthSummary { width, height, ..DepthSummary::default() };
    for_each_row(&mut reader, options, |row| summary.add(row.as_chunks().0.iter().copied().map(u16::from_be_bytes)))?;
    Ok(summary)
}

fn malformed(error: png::DecodingError) -> FormatError {
    FormatError::Malformed(format!("damaged PNG: {error}"))
}

/// The PNG reader for a depth image, with the image's width and height.
type Opened<'a> = (png::Reader<Cursor<&'a [u8]>>, (usize, usize));

fn open<'a>(bytes: &'a [u8], options: &ReadOptions) -> Result<Opened<'a>, FormatError> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    // This limits the size of other chunks, such as texts and colour profiles.
    decoder.set_limits(png::Limits { bytes: options.max_memory_bytes.min(64 << 20) as usize });
    decoder.set_ignore_text_chunk(true);
    let reader = decoder.read_info().map_err(malformed)?;
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    let kind = (reader.info().color_type, reader.info().bit_depth);
    if kind != (png::ColorType::Grayscale, png::BitDepth::Sixteen) {
        return Err(FormatError::Unsupported(format!(
            "unsupported PNG type {:?}, {} bits; a depth image must be 16-bit grayscale",
            kind.0, kind.1 as u8
        )));
    }
    validate_shape(width, height)?;
    // Deflate compresses by a factor of at most 1032.
    if 2 * width * height / 1100 > bytes.len() {
        return Err(FormatError::Malformed(format!("the PNG is truncated: its header states {width}x{height} pixels")));
    }
    Ok((reader, (width, height)))
}

/// Visits the rows of an image, as big-endian bytes.
fn for_each_row(
    reader: &mut png::Reader<Cursor<&[u8]>>,
    options: &ReadOptions,
    mut visit: impl FnMut(&[u8]),
) -> Result<(), FormatError> {
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    let mut rows = 0;
    if reader.info().interlaced {
        // Interlaced images are assembled in additional memory.
        options.check(width * height, 4)?;
        let mut buffer = vec![0; 2 * width * height];
        reader.next_frame(&mut buffer).map_err(malformed)?;
        buffer.chunks_exact(2 * width).for_each(&mut visit);
        rows = height;
    } else {
        while let Some(row) = reader.next_row().map_err(malformed)? {
            visit(row.data());
            rows += 1;
        }
    }
    if rows != height {
        return Err(FormatError::Malformed("the PNG is truncated: rows are missing".into()));
    }
    Ok(())
}

/// Encodes a depth image as a 16-bit PNG.
pub fn encode(image: &DepthImage) -> Result<Vec<u8>, FormatError> {
    let bytes: Vec<u8> = image.raw.iter().flat_map(|raw| raw.to_be_bytes()).collect();
    encode_png(image.width, image.height, png::ColorType::Grayscale, png::BitDepth::Sixteen, &bytes)
}

/// Encodes big-endian samples as a PNG.
pub(super) fn encode_png(
    width: usize,
    height: usize,
    colour: png::ColorType,
    depth: png::BitDepth,
    data: &[u8],
) -> Result<Vec<u8>, FormatError> {
    let failed = |error: png::EncodingError| {
        FormatError::Unsupported(format!("cannot encode a PNG of {width}x{height}: {error}"))
    };
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
