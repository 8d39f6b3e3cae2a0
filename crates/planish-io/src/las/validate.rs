//! Checks a header's claims against the file, before the decoder relies on them.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};

use las::Vlr;
use laz::laszip::ChunkTable;
use laz::{LazItem, LazItemType, LazVlr};

use super::super::FormatResult;
use crate::guarded::guarded;
use planish_core::FormatError;

/// A file's bytes, in memory or on disk.
pub(super) trait FileBytes {
    /// Returns the size of the file in bytes.
    fn size(&self) -> usize;

    /// Returns the `len` bytes at offset `at`; `None`, without allocating, if the file ends before them.
    fn read(&self, at: usize, len: usize) -> Option<Vec<u8>>;

    /// Returns a reader for the bytes from offset `at` to the end of the file.
    fn reader(&self, at: u64) -> Option<impl Read + Seek>;
}

impl FileBytes for [u8] {
    fn size(&self) -> usize {
        self.len()
    }

    fn read(&self, at: usize, len: usize) -> Option<Vec<u8>> {
        Some(self.get(at..at.checked_add(len)?)?.to_vec())
    }

    fn reader(&self, at: u64) -> Option<impl Read + Seek> {
        let mut reader = Cursor::new(self);
        reader.set_position(at);
        Some(reader)
    }
}

impl FileBytes for File {
    fn size(&self) -> usize {
        self.metadata().map_or(0, |metadata| usize::try_from(metadata.len()).unwrap_or(usize::MAX))
    }

    fn read(&self, at: usize, len: usize) -> Option<Vec<u8>> {
        if at.checked_add(len)? > self.size() {
            return None;
        }
        let (mut file, mut bytes) = (self, vec![0; len]);
        file.seek(SeekFrom::Start(at as u64)).ok()?;
        file.read_exact(&mut bytes).ok()?;
        Some(bytes)
    }

    fn reader(&self, at: u64) -> Option<impl Read + Seek> {
        let mut file = self;
        file.seek(SeekFrom::Start(at)).ok()?;
        Some(file)
    }
}

/// A header's claims that the decoder would rely on.
pub(super) struct Claims {
    pub(super) points: u64,
    pub(super) record: usize,
    /// Byte offset and number of the extended variable-length records.
    pub(super) extended: Option<(usize, u32)>,
}

/// Reads the claims of a header; `None` if the file ends within the header.
pub(super) fn claims(bytes: &(impl FileBytes + ?Sized)) -> Option<Claims> {
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    let legacy = u64::from(u32::from_le_bytes(read_at(bytes, 107)?));
    if read_at::<1>(bytes, 25)? < [4] {
        return Some(Claims { points: legacy, record, extended: None });
    }
    let extended_at = usize::try_from(u64::from_le_bytes(read_at(bytes, 235)?)).ok()?;
    let extended = Some((extended_at, u32::from_le_bytes(read_at(bytes, 243)?)));
    let points = if legacy == 0 { u64::from_le_bytes(read_at(bytes, 247)?) } else { legacy };
    Some(Claims { points, record, extended })
}

/// Returns an error if the header is shorter than its version requires: the decoder would then read the following data
/// at a different offset than [`check_chunks`]. Returns `None` if the file ends within the header.
pub(super) fn check_header(bytes: &(impl FileBytes + ?Sized)) -> Option<FormatResult<()>> {
    let [major, minor] = read_at(bytes, 24)?;
    let (size, needed) = (u16::from_le_bytes(read_at(bytes, 94)?), las::Version::new(major, minor).header_size());
    Some(if size < needed {
        let text = format!("the header has {size} bytes, but LAS {major}.{minor} needs {needed}");
        Err(FormatError::Malformed(text))
    } else {
        Ok(())
    })
}

/// Returns an error if the file cannot hold chunks of the stated sizes, because the decoder allocates these sizes.
/// Returns `None` if the file is truncated.
pub(super) fn check_chunks(bytes: &(impl FileBytes + ?Sized), points: u64) -> Option<FormatResult<()>> {
    /// Number of points per chunk that is accepted even if the file has fewer points.
    const LARGEST_CHUNK: u64 = 1 << 20;
    /// Size in bytes of the header of a variable-length record.
    const RECORD_HEADER: usize = 54;
    /// First LASzip compressor that writes chunks.
    const CHUNKED: u16 = 2;
    let u32_at = |at: usize| read_at(bytes, at).map(u32::from_le_bytes);
    let mut at = usize::from(u16::from_le_bytes(read_at(bytes, 94)?));
    let mut descriptions = Vec::new();
    // Each variable-length record before the points has 54 bytes plus the length it states.
    for _ in 0..u32_at(100)? {
        let user = bytes.read(at.checked_add(2)?, 16)?;
        if user.starts_with(b"laszip encoded") {
            let chunk = u32_at(at + 54 + 12)?;
            if chunk != u32::MAX && u64::from(chunk) > points.max(LARGEST_CHUNK) {
                return Some(Err(FormatError::Malformed(format!(
                    "the LASzip record states chunks of {chunk} points, but the file has only {points}"
                ))));
            }
            // LASzip compressors before version 2 wrote points without chunks.
            if u16::from_le_bytes(read_at(bytes, at + RECORD_HEADER)?) < CHUNKED {
                let text =
                    "LAZ without chunks, from an old LASzip, is not supported; decompress it with laszip or PDAL";
                return Some(Err(FormatError::Unsupported(text.into())));
            }
            let length = usize::from(u16::from_le_bytes(read_at(bytes, at + 20)?));
            descriptions.push(LazVlr::from_buffer(bytes.read(at + 54, length)?).ok()?);
        }
        at += 54 + usize::from(u16::from_le_bytes(read_at(bytes, at + 20)?));
    }
    let table = i64::from_le_bytes(read_at(bytes, u32_at(96)? as usize)?);
    // If the writer could not seek, the offset of the chunk table is at the end of the file.
    let at_end = || i64::from_le_bytes(read_at(bytes, bytes.size().checked_sub(8)?)?).try_into().ok();
    let table: usize = table.try_into().ok().or_else(at_end)?;
    let chunks = u32_at(table.checked_add(4)?)? as usize;
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    // Each chunk begins with an uncompressed point.
    if chunks.saturating_mul(record.max(1)) > bytes.size() {
        return Some(Err(FormatError::Malformed(format!(
            "the chunk table states {chunks} chunks, too many for a file of {} bytes",
            bytes.size()
        ))));
    }
    // If there were several descriptions, the decoder might use a different one.
    let Ok([description]) = <[LazVlr; 1]>::try_from(descriptions) else {
        return Some(Err(FormatError::Malformed("expected exactly one LASzip record".into())));
    };
    let size: usize = description.items().iter().map(item_bytes).sum();
    if size != record {
        return Some(Err(FormatError::Malformed(format!(
            "points have {record} bytes in the header, but {size} bytes in the LASzip record"
        ))));
    }
    check_table(bytes, &description, record, points)
}

/// Returns the size in bytes that the decoder reads for an item of a compressed point. The file may state a different
/// size.
fn item_bytes(item: &LazItem) -> usize {
    match item.item_type() {
        LazItemType::Byte(count) | LazItemType::Byte14(count) => count.into(),
        LazItemType::GpsTime | LazItemType::RGBNIR14 => 8,
        LazItemType::Point10 => 20,
        LazItemType::Point14 => 30,
        LazItemType::RGB12 | LazItemType::RGB14 => 6,
        LazItemType::WavePacket13 | LazItemType::WavePacket14 => 29,
    }
}

/// Returns an error if a chunk states more bytes or points than the file has, or a size that differs from the sum of
/// its layers. Without this check, the decoder would allocate whatever sizes the file states. From version 3 on, each
/// chunk begins with a point, the number of points, and the sizes of the layers that contain the other points.
fn check_table(
    bytes: &(impl FileBytes + ?Sized),
    description: &LazVlr,
    record: usize,
    points: u64,
) -> Option<FormatResult<()>> {
    let has_layers = description.items().iter().any(|item| item.version() >= 3);
    let layers = |item: &LazItem| match item.item_type() {
        LazItemType::Point14 => 9,
        LazItemType::RGBNIR14 => 2,
        LazItemType::Byte14(count) => usize::from(count),
        _ => 1,
    };
    let layers: usize = description.items().iter().map(layers).sum();
    let points_at = u64::from(u32::from_le_bytes(read_at(bytes, 96)?));
    // The chunk table decoder trusts its input, like the point decoder.
    let table = guarded(|| ChunkTable::read_from(bytes.reader(points_at)?, description).ok());
    let table = table??;
    let (mut at, mut stated) = (points_at + ChunkTable::OFFSET_SIZE as u64, 0u64);
    for chunk in &table {
        if has_layers && chunk.byte_count > 0 {
            let sizes_at = usize::try_from(at).ok()?.checked_add(record + 4)?;
            let sizes = bytes.read(sizes_at, 4 * layers)?;
            let size = |size: &[u8]| size.iter().rev().fold(0, |sum, byte| sum << 8 | u64::from(*byte));
            let needed = (record + 4 + 4 * layers) as u64 + sizes.chunks_exact(4).map(size).sum::<u64>();
            if needed != chunk.byte_count {
                let text = format!("a chunk has {} bytes, but its layers need {needed}", chunk.byte_count);
                return Some(Err(FormatError::Malformed(text)));
            }
        }
        let Some(end) = at.checked_add(chunk.byte_count).filter(|&end| end <= bytes.size() as u64) else {
            let (count, size) = (chunk.byte_count, bytes.size());
            let text =
                format!("a chunk of {count} bytes at offset {at} extends past the end of the file ({size} bytes)");
            return Some(Err(FormatError::Malformed(text)));
        };
        at = end;
        stated = stated.saturating_add(chunk.point_count);
    }
    // The table of fixed-size chunks may state more points than the chunks have.
    if description.uses_variable_size_chunks() && stated != points {
        let text = format!("the header states {points} points, but its chunk table states {stated}");
        return Some(Err(FormatError::Malformed(text)));
    }
    Some(Ok(()))
}

/// Returns the extended records from offset `at` on, up to the first one that cannot be read. The las crate reads only
/// one.
pub(super) fn extended_records(bytes: &(impl FileBytes + ?Sized), (at, count): (usize, u32)) -> Vec<Vlr> {
    let record = |at: &mut usize| {
        let length = usize::try_from(u64::from_le_bytes(read_at(bytes, at.checked_add(20)?)?)).ok()?.checked_add(60)?;
        let record = Vlr::new(las::raw::Vlr::read_from(&bytes.read(*at, length)?[..], true).ok()?);
        *at = at.checked_add(length)?;
        Some(record)
    };
    (0..count).scan(at, |at, _| record(at)).collect()
}

pub(super) fn read_at<const N: usize>(bytes: &(impl FileBytes + ?Sized), at: usize) -> Option<[u8; N]> {
    bytes.read(at, N)?.try_into().ok()
}
