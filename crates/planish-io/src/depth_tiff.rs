//! Reads depth images from grayscale TIFF, and writes them as 16-bit integers. Files may contain 16-bit integers,
//! 32-bit integers that fit in 16 bits, or floats in metres.

use std::collections::HashSet;
use std::io::{Cursor, Read, Seek, SeekFrom};

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::encoder::{Compression, TiffEncoder, colortype};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

use super::{Contents, DepthSummary, ReadOptions, depth_of_integers};
use planish_core::{DepthImage, FormatError, validate_shape};

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> Result<Contents, FormatError> {
    let pages = Pages::of(bytes)?;
    let page = options.image_of(pages.offsets.len(), notes)?;
    if pages.is_cut {
        notes.push(format!("the file is truncated after image {}", pages.offsets.len()));
    }
    let mut decoder = decoder(pages.reader(bytes, page), options)?;
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

/// Maximum number of pages; the tag PageNumber has 16 bits.
const MOST_PAGES: usize = u16::MAX as usize;

/// The pages of a file.
pub(super) struct Pages {
    /// The first bytes of the file, up to the offset of the first page.
    header: Vec<u8>,
    /// Number of bytes of an offset: 4, or 8 in a BigTIFF.
    offset_bytes: usize,
    is_big_endian: bool,
    /// Offset of each page's directory.
    pub(super) offsets: Vec<u64>,
    /// Whether the file ends before its last page.
    pub(super) is_cut: bool,
}

impl Pages {
    /// Finds the pages without the decoder, which would read all directories up to a page, whatever their size.
    ///
    /// # Errors
    /// If the directories overlap, there are too many of them, or the file is not a TIFF.
    pub(super) fn of(bytes: &[u8]) -> Result<Self, FormatError> {
        let damaged = |text: &str| FormatError::Malformed(format!("damaged TIFF: {text}"));
        let (is_big_endian, is_big) = match bytes {
            [b'I', b'I', 42, 0, ..] => (false, false),
            [b'M', b'M', 0, 42, ..] => (true, false),
            [b'I', b'I', 43, 0, ..] => (false, true),
            [b'M', b'M', 0, 43, ..] => (true, true),
            _ => return Err(damaged("its signature is missing")),
        };
        let number = |at: usize, size: usize| -> Option<u64> {
            let of = bytes.get(at..at.checked_add(size)?)?;
            let fold = |number: u64, byte: &u8| number << 8 | u64::from(*byte);
            Some(if is_big_endian { of.iter().fold(0, fold) } else { of.iter().rev().fold(0, fold) })
        };
        let (first, offset_bytes, count_bytes, entry) = if is_big { (8, 8, 8, 20) } else { (4, 4, 2, 12) };
        let mut next = number(first, offset_bytes).ok_or_else(|| damaged("it ends within its header"))?;
        let (mut offsets, mut used, mut is_cut) = (Vec::new(), 0u64, false);
        while next != 0 {
            if offsets.len() == MOST_PAGES {
                return Err(FormatError::Unsupported(format!(
                    "the TIFF has more than {MOST_PAGES} pages; split the file"
                )));
            }
            let at = usize::try_from(next).unwrap_or(usize::MAX);
            let size = number(at, count_bytes).and_then(|count| count.checked_mul(entry));
            let end = size.and_then(|size| at.checked_add(count_bytes)?.checked_add(usize::try_from(size).ok()?));
            let Some(after) = end.and_then(|end| number(end, offset_bytes)) else {
                is_cut = true;
                break;
            };
            used += size.unwrap_or_default() + (count_bytes + offset_bytes) as u64;
            offsets.push(next);
            if used > bytes.len() as u64 {
                // Some writers link the last page to the first.
                let mut known = HashSet::new();
                let repeated = offsets.iter().position(|offset| !known.insert(*offset));
                offsets.truncate(repeated.ok_or_else(|| damaged("its pages overlap"))?);
                break;
            }
            next = after;
        }
        // Keep one page, so that the decoder can report what is wrong with it.
        if offsets.is_empty() {
            offsets.push(number(first, offset_bytes).unwrap_or_default());
            is_cut = false;
        }
        Ok(Self { header: bytes[..first].to_vec(), offset_bytes, is_big_endian, offsets, is_cut })
    }

    /// Returns a reader of the file with this page as its first page.
    fn reader<'a>(&self, bytes: &'a [u8], page: usize) -> PageReader<'a> {
        let offset = self.offsets.get(page).copied().unwrap_or_default();
        let of_offset = if self.is_big_endian {
            offset.to_be_bytes()[8 - self.offset_bytes..].to_vec()
        } else {
            offset.to_le_bytes()[..self.offset_bytes].to_vec()
        };
        PageReader { header: [&self.header[..], &of_offset].concat(), file: Cursor::new(bytes) }
    }
}

/// A reader of a file whose header is replaced by `header`.
struct PageReader<'a> {
    header: Vec<u8>,
    file: Cursor<&'a [u8]>,
}

impl Read for PageReader<'_> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        let at = usize::try_from(self.file.position()).unwrap_or(usize::MAX);
        match self.header.get(at..).filter(|rest| !rest.is_empty()) {
            None => self.file.read(to),
            Some(rest) => {
                let count = rest.len().min(to.len());
                to[..count].copy_from_slice(&rest[..count]);
                self.file.set_position((at + count) as u64);
                Ok(count)
            }
        }
    }
}

impl Seek for PageReader<'_> {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.file.seek(to)
    }
}

/// Summarizes a depth image strip by strip or tile by tile, without storing its pixels. Returns `None` for images with
/// several pages, inverted values or samples other than 16-bit integers.
pub(super) fn summarize(bytes: &[u8], options: &ReadOptions) -> Result<Option<DepthSummary>, FormatError> {
    let pages = Pages::of(bytes)?;
    let mut decoder = decoder(pages.reader(bytes, 0), options)?;
    let (width, height) = shape_of_depth(&mut decoder)?;
    if pages.offsets.len() > 1 || pages.is_cut || options.image.is_some() || is_inverted(&mut decoder) {
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

type TiffDecoder<'a> = Decoder<PageReader<'a>>;

fn decoder<'a>(reader: PageReader<'a>, options: &ReadOptions) -> Result<TiffDecoder<'a>, FormatError> {
    let most = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = most;
    limits.intermediate_buffer_size = most;
    Ok(Decoder::new(reader).map_err(malformed)?.with_limits(limits))
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
