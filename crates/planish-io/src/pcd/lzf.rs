//! LZF, the compression used in binary_compressed PCD files. It is the stream format of M. Lehmann's LibLZF.
//!
//! A stream is a sequence of runs. A control byte c < 32 is followed by c + 1 literal bytes. Any other control byte
//! begins a back-reference. Its upper 3 bits are the length minus 2; if they are 7, the next byte is added to the
//! length. Its lower 5 bits and the byte that follows are the distance minus 1.

/// The error for a stream that is not LZF, or that does not have the stated size when decompressed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the compressed data are damaged: {0}")]
pub struct LzfError(&'static str);

/// Maximum length of a back-reference: 7 + 255 + 2 bytes, encoded in 3 bytes.
pub(super) const MAX_REFERENCE: usize = 264;
const MAX_DISTANCE: usize = 1 << 13;
const MAX_LITERALS: usize = 32;

/// Decompresses a stream that contains exactly `size` bytes of data.
pub fn decompress(stream: &[u8], size: usize) -> Result<Vec<u8>, LzfError> {
    // Check before allocating memory whether a stream this short can expand to the stated size.
    if size / MAX_REFERENCE > stream.len() {
        return Err(LzfError("they are shorter than the stated size"));
    }
    let mut out = Vec::with_capacity(size);
    let mut rest = stream;
    let cut = LzfError("they end within a run");
    while let Some((&control, after)) = rest.split_first() {
        rest = after;
        let control = usize::from(control);
        if control < MAX_LITERALS {
            let (literals, after) = rest.split_at_checked(control + 1).ok_or(cut.clone())?;
            out.extend_from_slice(literals);
            rest = after;
        } else {
            let mut length = (control >> 5) + 2;
            if length == 9 {
                let (&more, after) = rest.split_first().ok_or(cut.clone())?;
                length += usize::from(more);
                rest = after;
            }
            let (&low, after) = rest.split_first().ok_or(cut.clone())?;
            rest = after;
            let distance = ((control & 31) << 8 | usize::from(low)) + 1;
            let start = out.len().checked_sub(distance).ok_or(LzfError("a reference points before their start"))?;
            if distance >= length {
                out.extend_from_within(start..start + length);
            } else {
                // The reference overlaps the bytes being written.
                for i in start..start + length {
                    out.push(out[i]);
                }
            }
        }
        if out.len() > size {
            return Err(LzfError("they decompress to more than the stated size"));
        }
    }
    if out.len() == size { Ok(out) } else { Err(LzfError("they decompress to less than the stated size")) }
}

/// Compresses data greedily, using a table of the last position of each 3-byte sequence.
pub fn compress(data: &[u8]) -> Vec<u8> {
    const TABLE_BITS: u32 = 16;
    let mut last_place = vec![usize::MAX; 1 << TABLE_BITS];
    let hash = |at: usize| {
        let word = u32::from_le_bytes([data[at], data[at + 1], data[at + 2], 0]);
        (word.wrapping_mul(0x9e37_79b1) >> (32 - TABLE_BITS)) as usize
    };
    let mut stream = Vec::with_capacity(data.len() / 2 + 16);
    let (mut at, mut literals_from) = (0, 0);
    while at + 3 <= data.len() {
        let candidate = std::mem::replace(&mut last_place[hash(at)], at);
        let near = candidate != usize::MAX && at - candidate <= MAX_DISTANCE;
        if !near || data[candidate..candidate + 3] != data[at..at + 3] {
            at += 1;
            continue;
        }
        let limit = MAX_REFERENCE.min(data.len() - at);
        let length =
            3 + data[at + 3..at + limit].iter().zip(&data[candidate + 3..]).take_while(|(a, b)| a == b).count();
        put_literals(&data[literals_from..at], &mut stream);
        put_reference(at - candidate, length, &mut stream);
        // Positions inside the reference are indexed too.
        let end = at + length;
        for within in at + 1..end.min(data.len().saturating_sub(2)) {
            last_place[hash(within)] = within;
        }
        (at, literals_from) = (end, end);
    }
    put_literals(&data[literals_from..], &mut stream);
    stream
}

fn put_literals(literals: &[u8], stream: &mut Vec<u8>) {
    for run in literals.chunks(MAX_LITERALS) {
        stream.push((run.len() - 1) as u8);
        stream.extend_from_slice(run);
    }
}

fn put_reference(distance: usize, length: usize, stream: &mut Vec<u8>) {
    let (distance, length) = (distance - 1, length - 2);
    let high = (distance >> 8) as u8;
    if length < 7 {
        stream.push((length as u8) << 5 | high);
    } else {
        stream.push(7 << 5 | high);
        stream.push((length - 7) as u8);
    }
    stream.push(distance as u8);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_streams_decompress() {
        assert_eq!(decompress(&[2, b'a', b'b', b'c'], 3).unwrap(), b"abc");
        // One literal byte, and a back-reference of 5 bytes at distance 1, which overlaps itself.
        assert_eq!(decompress(&[0, b'a', 3 << 5, 0], 6).unwrap(), b"aaaaaa");
        assert_eq!(decompress(&[], 0).unwrap(), b"");
    }

    #[test]
    fn damaged_streams_are_refused_without_allocating() {
        assert!(decompress(&[5, b'a'], 6).is_err());
        assert!(decompress(&[0, b'a', 3 << 5], 6).is_err());
        assert!(decompress(&[0, b'a', 3 << 5, 1], 6).is_err());
        assert!(decompress(&[0, b'a', 7 << 5, 255], 6).is_err());
        assert!(decompress(&[0, b'a'], 2).is_err());
        assert!(decompress(&[1, b'a', b'b'], 1).is_err());
        assert!(decompress(&[0, b'a'], usize::MAX).is_err());
    }

    #[test]
    fn compression_shrinks_what_repeats() {
        let data: Vec<u8> = (0..100_000u32).flat_map(|i| (i / 100).to_le_bytes()).collect();
        let stream = compress(&data);
        assert!(stream.len() < data.len() / 20, "{}", stream.len());
        assert_eq!(decompress(&stream, data.len()).unwrap(), data);
    }
}
