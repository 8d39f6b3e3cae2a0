//! Changes of a file's bytes: single bytes, numbers in text and in binary fields, and whole parts.

use super::numbers::Numbers;

/// Numbers and characters that readers often handle wrongly.
const WORDS: [&[u8]; 22] = [
    b"-1",
    b"0",
    b"1",
    b"255",
    b"65536",
    b"2147483648",
    b"4294967295",
    b"18446744073709551616",
    b"1e-320",
    b"1e39",
    b"1e999",
    b"-1e300",
    b"nan",
    b"inf",
    b"\n",
    b" ",
    b"[",
    b"{",
    b"\"",
    b"\x1b[31m",
    b"\xff",
    b"x",
];

/// Changes a file. In two of three cases, the checksums of PNG and E57 files are corrected, so that readers continue.
pub fn mutate(bytes: &mut Vec<u8>, name: &str, other: &[u8], numbers: &mut Numbers) {
    for _ in 0..1 + numbers.below(3) {
        change(bytes, other, numbers);
    }
    if !numbers.one_in(3) {
        if name.ends_with(".png") {
            mend_png(bytes);
        } else if name.ends_with(".e57") {
            mend_e57(bytes);
        }
    }
}

fn change(bytes: &mut Vec<u8>, other: &[u8], numbers: &mut Numbers) {
    if bytes.is_empty() {
        bytes.extend_from_slice(&other[..other.len().min(1000)]);
        return;
    }
    // Headers are at the beginning of files, and the tables of some formats at the end.
    let (at, len) = (numbers.below(bytes.len()), bytes.len());
    let at = match numbers.below(5) {
        0 | 1 => at % 400.min(len),
        2 => at % 60.min(len),
        3 => len - 1 - at % 400.min(len),
        _ => at,
    };
    match numbers.below(10) {
        0 => bytes.truncate(at),
        1 => bytes[at] = numbers.next() as u8,
        2 => bytes[at] ^= 1 << numbers.below(8),
        3 => {
            let word = numbers.of(&WORDS);
            bytes.splice(at..at, word.iter().copied());
        }
        4 | 5 => number_in_text(bytes, at, numbers),
        6 | 7 => field(bytes, at, numbers),
        8 => {
            let end = (at + numbers.below(200)).min(len);
            let part = bytes[at..end].repeat(1 + numbers.below(3));
            bytes.splice(end..end, part);
        }
        _ => {
            let from = numbers.below(other.len());
            let part = &other[from..(from + numbers.below(300)).min(other.len())];
            let end = (at + part.len()).min(len);
            bytes.splice(at..end, part.iter().copied());
        }
    }
}

/// Replaces the next number in text.
fn number_in_text(bytes: &mut Vec<u8>, at: usize, numbers: &mut Numbers) {
    let is_part = |byte: &u8| byte.is_ascii_digit() || b"+-.eE".contains(byte);
    let Some(start) = bytes[at..].iter().position(u8::is_ascii_digit).map(|offset| at + offset) else { return };
    let end = bytes[start..].iter().position(|byte| !is_part(byte)).map_or(bytes.len(), |offset| start + offset);
    let word = numbers.of(&WORDS);
    bytes.splice(start..end, word.iter().copied());
}

/// Replaces a field of 2, 4 or 8 bytes.
fn field(bytes: &mut [u8], at: usize, numbers: &mut Numbers) {
    const VALUES: [u64; 12] =
        [0, 1, 2, 0x7f, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, 1 << 32, 1 << 48, u64::MAX >> 1, u64::MAX];
    let small = numbers.next() % 300;
    let value = match numbers.below(5) {
        0 => small.to_le_bytes(),
        1 => f64::from_bits(numbers.next()).to_le_bytes(),
        2 => numbers.of(&[f64::NAN, f64::INFINITY, 1e300, -1e-310]).to_le_bytes(),
        _ => numbers.of(&VALUES).to_le_bytes(),
    };
    let width = numbers.of(&[2, 4, 8]);
    let mut value = value[..width].to_vec();
    if numbers.one_in(3) {
        value.reverse();
    }
    let at = if numbers.one_in(2) { at / width * width } else { at };
    for (byte, new) in bytes[at..].iter_mut().zip(value) {
        *byte = new;
    }
}

/// Corrects the checksums of a PNG's chunks.
fn mend_png(bytes: &mut [u8]) {
    let mut at = 8;
    while let Some(stated) = bytes.get(at..at + 4) {
        let len = u32::from_be_bytes(stated.try_into().unwrap()) as usize;
        let Some(contents) = at.checked_add(8 + len).and_then(|end| bytes.get(at + 4..end)) else { return };
        let sum = checksum(contents, 0xedb8_8320).to_be_bytes();
        let Some(place) = bytes.get_mut(at + 8 + len..at + 12 + len) else { return };
        place.copy_from_slice(&sum);
        at += 12 + len;
    }
}

/// Corrects the checksums of an E57's pages of 1024 bytes.
fn mend_e57(bytes: &mut [u8]) {
    for page in bytes.chunks_exact_mut(1024) {
        let sum = checksum(&page[..1020], 0x82f6_3b78).to_be_bytes();
        page[1020..].copy_from_slice(&sum);
    }
}

/// Returns the CRC-32 for a reversed polynomial.
fn checksum(bytes: &[u8], polynomial: u32) -> u32 {
    !bytes.iter().fold(!0, |mut sum, byte| {
        sum ^= u32::from(*byte);
        for _ in 0..8 {
            sum = (sum >> 1) ^ (polynomial & (sum & 1).wrapping_neg());
        }
        sum
    })
}

#[test]
fn checksums_are_those_of_sound_files() {
    for (folder, mend) in [("depth_png/d.png", mend_png as fn(&mut [u8])), ("e57/scan.e57", mend_e57)] {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus").join(folder);
        let sound = std::fs::read(path).unwrap();
        let mut mended = sound.clone();
        mend(&mut mended);
        assert!(mended == sound, "{folder}");
    }
}
