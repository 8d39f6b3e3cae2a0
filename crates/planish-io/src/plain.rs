//! Removes wrappings that are not part of a format: gzip, and byte-order marks or UTF-16 in text.

use std::borrow::Cow;
#[cfg(feature = "more-formats")]
use std::io::Read;

use super::{FormatResult, ReadOptions};
use planish_core::FormatError;

pub(super) const GZIP: &[u8] = &[0x1f, 0x8b, 8];
const UTF_8: &[u8] = &[0xef, 0xbb, 0xbf];
const UTF_16_LITTLE_ENDIAN: &[u8] = &[0xff, 0xfe];
const UTF_16_BIG_ENDIAN: &[u8] = &[0xfe, 0xff];

/// Returns a file's contents without gzip compression and byte-order marks; UTF-16 text becomes UTF-8.
pub(super) fn plain<'a>(bytes: &'a [u8], options: &ReadOptions) -> FormatResult<Cow<'a, [u8]>> {
    if bytes.starts_with(GZIP) { unpacked(bytes, options) } else { Ok(text_in_utf_8(bytes)) }
}

#[cfg(not(feature = "more-formats"))]
fn unpacked<'a>(_bytes: &'a [u8], _options: &ReadOptions) -> FormatResult<Cow<'a, [u8]>> {
    let text = "the file is gzip-compressed, which needs planish's feature `more-formats`";
    Err(FormatError::Unsupported(text.into()))
}

#[cfg(feature = "more-formats")]
fn unpacked<'a>(bytes: &'a [u8], options: &ReadOptions) -> FormatResult<Cow<'a, [u8]>> {
    let mut contents = Vec::new();
    flate2::read::MultiGzDecoder::new(bytes)
        .take(options.max_memory_bytes.saturating_add(1))
        .read_to_end(&mut contents)
        .map_err(|error| FormatError::Malformed(format!("damaged gzip: {error}")))?;
    options.check(contents.len(), 1)?;
    Ok(match text_in_utf_8(&contents) {
        Cow::Borrowed(text) if text.len() == contents.len() => contents.into(),
        text => text.into_owned().into(),
    })
}

/// Returns text as UTF-8, without its byte-order mark. Other bytes are returned unchanged.
pub(super) fn text_in_utf_8(bytes: &[u8]) -> Cow<'_, [u8]> {
    if let Some(text) = bytes.strip_prefix(UTF_8) {
        return text.into();
    }
    let little_endian = bytes.strip_prefix(UTF_16_LITTLE_ENDIAN).map(|text| decode(text, u16::from_le_bytes));
    let big_endian = || bytes.strip_prefix(UTF_16_BIG_ENDIAN).map(|text| decode(text, u16::from_be_bytes));
    match little_endian.or_else(big_endian) {
        Some(Some(text)) => text.into_bytes().into(),
        _ => bytes.into(),
    }
}

/// Decodes UTF-16; `None` if the bytes are not UTF-16 text.
fn decode(bytes: &[u8], unit: impl Fn([u8; 2]) -> u16) -> Option<String> {
    let (units, rest) = bytes.as_chunks::<2>();
    let text = String::from_utf16(&units.iter().map(|bytes| unit(*bytes)).collect::<Vec<_>>()).ok()?;
    let is_text = |c: char| !c.is_control() || c.is_whitespace();
    (rest.is_empty() && text.chars().all(is_text)).then_some(text)
}

#[cfg(test)]
#[cfg(feature = "more-formats")]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn text_is_read_in_any_wrapping() {
        let text = "x y z\n1 2 3\n";
        let units: Vec<u8> = std::iter::once(0xfeff).chain(text.encode_utf16()).flat_map(u16::to_le_bytes).collect();
        let marked = [UTF_8, text.as_bytes()].concat();
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gzip.write_all(&marked).unwrap();
        for wrapped in [text.as_bytes().to_vec(), units, marked, gzip.finish().unwrap()] {
            assert_eq!(*plain(&wrapped, &ReadOptions::default()).unwrap(), *text.as_bytes());
        }
    }

    #[test]
    fn gzip_larger_than_the_limit_is_refused() {
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        gzip.write_all(&vec![0; 1 << 20]).unwrap();
        let options = ReadOptions::default().with_max_memory_bytes(1 << 16);
        let bytes = gzip.finish().unwrap();
        let refused = plain(&bytes, &options);
        assert!(matches!(refused, Err(FormatError::TooLarge { .. })), "{refused:?}");
        assert!(plain(&[0x1f, 0x8b, 8, 0, 1], &options).is_err());
    }
}
