//! Reads depth images of the Netpbm family: PGM with 16 bits, and PFM with floats in metres.

use super::{Contents, FormatResult, ReadOptions, quoted};
use planish_core::{DepthImage, FormatError, validate_shape};

fn malformed<T>(what: String) -> FormatResult<T> {
    Err(FormatError::Malformed(what))
}

/// The remaining bytes of a header, read word by word. Comments may appear between words.
struct Words<'a>(&'a [u8]);

impl<'a> Words<'a> {
    /// Returns the next word, without consuming the white space after it.
    fn next(&mut self) -> Option<&'a str> {
        loop {
            self.0 = self.0.trim_ascii_start();
            match self.0.first()? {
                b'#' => self.0 = &self.0[self.0.iter().position(|byte| *byte == b'\n')?..],
                _ => break,
            }
        }
        let (word, rest) = self.0.split_at(self.0.iter().position(u8::is_ascii_whitespace)?);
        self.0 = rest;
        std::str::from_utf8(word).ok()
    }

    fn number<T: std::str::FromStr>(&mut self, what: &str) -> FormatResult<T> {
        let word = self.next().unwrap_or_default();
        word.parse().or_else(|_| malformed(format!("{} is not {what}", quoted(word))))
    }

    /// Returns the first `needed` bytes after the header.
    fn pixels(&self, needed: usize) -> FormatResult<&'a [u8]> {
        let body = self.0.get(1..).unwrap_or_default();
        match body.get(..needed) {
            Some(pixels) => Ok(pixels),
            None => {
                malformed(format!("the file is truncated: its pixels need {needed} bytes, but {} follow", body.len()))
            }
        }
    }
}

/// Reads a binary PGM (`P5`) with 16-bit big-endian values.
pub(super) fn decode_pgm(bytes: &[u8], options: &ReadOptions) -> FormatResult<Contents> {
    let mut words = Words(bytes);
    let kind = words.next().unwrap_or_default();
    if kind != "P5" {
        return Err(FormatError::Unsupported(format!("unsupported PGM type {}; expected binary (P5)", quoted(kind))));
    }
    let (width, height) = (words.number("a width")?, words.number("a height")?);
    validate_shape(width, height)?;
    let largest: u32 = words.number("a maximum value")?;
    if !(256..=65535).contains(&largest) {
        return Err(FormatError::Unsupported(format!(
            "the PGM's maximum value is {largest}, but depth needs 16 bits (256 to 65535)"
        )));
    }
    options.check(width * height, 2)?;
    let pixels = words.pixels(2 * width * height)?;
    let raw = pixels.as_chunks::<2>().0.iter().map(|bytes| u16::from_be_bytes(*bytes)).collect();
    Ok(Contents::Depth(DepthImage { width, height, raw }))
}

/// Reads a PFM with one channel (`Pf`), whose rows are stored from the bottom up.
pub(super) fn decode_pfm(bytes: &[u8], options: &ReadOptions) -> FormatResult<Contents> {
    let mut words = Words(bytes);
    let kind = words.next().unwrap_or_default();
    if kind != "Pf" {
        return Err(FormatError::Unsupported(format!(
            "unsupported PFM type {}; depth must have one channel (Pf)",
            quoted(kind)
        )));
    }
    let (width, height) = (words.number("a width")?, words.number("a height")?);
    validate_shape(width, height)?;
    // The sign states the byte order. The magnitude is ignored, because its unit is undefined.
    let scale: f64 = words.number("a scale")?;
    options.check(width * height, 4)?;
    let value = if scale < 0.0 { f32::from_le_bytes } else { f32::from_be_bytes };
    let pixels = words.pixels(4 * width * height)?;
    let rows = pixels.chunks_exact(4 * width).rev();
    let depth_m = rows.flat_map(|row| row.as_chunks::<4>().0).map(|bytes| value(*bytes)).collect();
    Ok(Contents::DepthMetres { width, height, depth_m })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_read_in_their_order_of_rows_and_bytes() {
        let options = ReadOptions::default();
        let pgm = [&b"P5\n# by hand\n2 1\n65535\n"[..], &[0x05, 0xdc, 0, 0]].concat();
        let image = DepthImage { width: 2, height: 1, raw: vec![1500, 0] };
        assert_eq!(decode_pgm(&pgm, &options).unwrap(), Contents::Depth(image));
        for (order, bytes) in [("-1.0", f32::to_le_bytes as fn(f32) -> [u8; 4]), ("1.0", f32::to_be_bytes)] {
            let values: Vec<u8> = [3.0, 4.0, 1.0, 2.0].into_iter().flat_map(bytes).collect();
            let pfm = [format!("Pf\n2 2\n{order}\n").as_bytes(), &values].concat();
            let expected = Contents::DepthMetres { width: 2, height: 2, depth_m: vec![1.0, 2.0, 3.0, 4.0] };
            assert_eq!(decode_pfm(&pfm, &options).unwrap(), expected);
        }
        for (pgm, problem) in [
            (&b"P2\n2 1\n65535\n1 2\n"[..], "P5"),
            (b"P5\n2 1\n255\n12", "16 bits"),
            (b"P5\n2 1\n65535\n123", "truncated"),
            (b"P5\n2 x\n65535\n1234", "not a height"),
            (b"P5", "type"),
        ] {
            assert!(decode_pgm(pgm, &options).unwrap_err().to_string().contains(problem), "{problem}");
        }
        assert!(decode_pfm(b"PF\n2 1\n-1\n", &options).unwrap_err().to_string().contains("one channel"));
    }
}
