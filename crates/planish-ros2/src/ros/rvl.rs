//! RVL: lossless compression of depth by runs of holes and differences of neighbours (A. D. Wilson, Fast Lossless Depth
//! Image Compression, 2017), as the transport `compressedDepth` stores it: width and height as 32 bits, then the code.
//!
//! Numbers are split into groups of three bits, lowest first. A fourth bit is set if more groups follow. Eight groups
//! make a 32-bit word; the first is in its highest bits.

use planish_core::{DepthImage, FormatError, validate_shape};
use planish_io::ReadOptions;

/// Size in bytes of width and height.
const SIZE_BYTES: usize = 8;
/// Number of groups in a word.
const GROUPS: u32 = 8;
/// Maximum number of groups per 32-bit number.
const MOST_GROUPS: u32 = 11;

fn malformed(what: &str) -> FormatError {
    FormatError::Malformed(format!("damaged RVL: {what}"))
}

/// The groups of a code, in order.
struct Groups<'a> {
    words: std::slice::Iter<'a, [u8; 4]>,
    word: u32,
    left: u32,
}

impl<'a> Groups<'a> {
    fn of(code: &'a [u8]) -> Self {
        Self { words: code.as_chunks::<4>().0.iter(), word: 0, left: 0 }
    }

    fn next(&mut self) -> Option<u32> {
        if self.left == 0 {
            (self.word, self.left) = (u32::from_le_bytes(*self.words.next()?), GROUPS);
        }
        self.left -= 1;
        Some(self.word >> (4 * self.left) & 15)
    }

    fn number(&mut self) -> Result<u32, FormatError> {
        let mut number = 0u32;
        for k in 0..MOST_GROUPS {
            let group = self.next().ok_or_else(|| malformed("the data are truncated"))?;
            number |= (group & 7).checked_shl(3 * k).unwrap_or(0);
            if group & 8 == 0 {
                return Ok(number);
            }
        }
        Err(malformed("a number exceeds 32 bits"))
    }
}

/// Decodes an image.
pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<DepthImage, FormatError> {
    let (size, code) = bytes.split_first_chunk::<SIZE_BYTES>().ok_or_else(|| malformed("the size is missing"))?;
    let [w0, w1, w2, w3, h0, h1, h2, h3] = *size;
    let [width, height] = [[w0, w1, w2, w3], [h0, h1, h2, h3]].map(|bytes| u32::from_le_bytes(bytes) as usize);
    validate_shape(width, height)?;
    let pixels = width * height;
    options.check(pixels, 2)?;
    let mut groups = Groups::of(code);
    let (mut raw, mut last): (Vec<u16>, u16) = (Vec::with_capacity(pixels), 0);
    while raw.len() < pixels {
        let (holes, values) = (groups.number()? as usize, groups.number()? as usize);
        if holes.saturating_add(values) > pixels - raw.len() || holes + values == 0 {
            return Err(malformed("a run extends past the end of the image"));
        }
        raw.resize(raw.len() + holes, 0);
        for _ in 0..values {
            let number = groups.number()?;
            // The lowest bit is the sign.
            let difference = (number >> 1) ^ (number & 1).wrapping_neg();
            last = last.wrapping_add(difference as u16);
            raw.push(last);
        }
    }
    Ok(DepthImage { width, height, raw })
}

/// An RVL encoder's output.
#[derive(Default)]
struct Code {
    bytes: Vec<u8>,
    word: u32,
    groups: u32,
}

impl Code {
    fn push(&mut self, mut number: u32) {
        loop {
            let group = (number & 7) | if number > 7 { 8 } else { 0 };
            (self.word, self.groups) = (self.word << 4 | group, self.groups + 1);
            if self.groups == GROUPS {
                self.bytes.extend(std::mem::take(&mut self.word).to_le_bytes());
                self.groups = 0;
            }
            number >>= 3;
            if number == 0 {
                return;
            }
        }
    }

    fn finish(mut self) -> Vec<u8> {
        if self.groups > 0 {
            self.bytes.extend((self.word << (4 * (GROUPS - self.groups))).to_le_bytes());
        }
        self.bytes
    }
}

/// Encodes an image.
pub(super) fn encode(image: &DepthImage) -> Vec<u8> {
    let (mut code, mut rest, mut last) = (Code::default(), &image.raw[..], 0i32);
    while !rest.is_empty() {
        let (holes, behind) = rest.split_at(rest.iter().take_while(|raw| **raw == 0).count());
        let (values, behind) = behind.split_at(behind.iter().take_while(|raw| **raw != 0).count());
        code.push(holes.len() as u32);
        code.push(values.len() as u32);
        for raw in values.iter().map(|raw| i32::from(*raw)) {
            let difference = raw - last;
            code.push(((difference << 1) ^ (difference >> 31)) as u32);
            last = raw;
        }
        rest = behind;
    }
    let size = [image.width, image.height].map(|pixels| (pixels as u32).to_le_bytes());
    [size.concat(), code.finish()].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_come_back_and_a_known_code_is_read() {
        let options = ReadOptions::default();
        for raw in [vec![0; 12], vec![1500; 12], vec![0, 65535, 1, 0, 0, 7, 700, 698, 65535, 65534, 0, 3]] {
            let image = DepthImage { width: 4, height: 3, raw };
            let bytes = encode(&image);
            assert_eq!(decode(&bytes, &options).unwrap(), image);
            assert!(decode(&bytes[..bytes.len() - 4], &options).is_err());
        }
        // By hand: 1 hole, 2 values, +5 (10 = 0b001_010), -1 (1), then zeros.
        let code = 0x12a1_1000_u32.to_le_bytes();
        let bytes = [&3u32.to_le_bytes()[..], &1u32.to_le_bytes(), &code].concat();
        assert_eq!(decode(&bytes, &options).unwrap().raw, [0, 5, 4]);
    }

    #[test]
    fn damaged_codes_are_refused() {
        let options = ReadOptions::default().with_max_memory_bytes(1 << 20);
        let size = |width: u32, height: u32| [width.to_le_bytes(), height.to_le_bytes()].concat();
        assert!(decode(&size(60_000, 60_000), &options).is_err());
        assert!(decode(&size(2, 2), &options).unwrap_err().to_string().contains("truncated"));
        assert!(decode(&[size(2, 2), vec![0; 8]].concat(), &options).unwrap_err().to_string().contains("run"));
        assert!(decode(&[size(2, 2), vec![0xff; 64]].concat(), &options).unwrap_err().to_string().contains("32 bits"));
        assert!(decode(&[1, 2, 3], &options).is_err());
    }
}
