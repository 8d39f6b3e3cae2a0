//! What a header claims, checked against the file before the decoder believes it.

use las::Vlr;

use super::super::FormatResult;
use crate::error::FormatError;

/// What a header says that the decoder would believe.
pub(super) struct Claims {
    pub(super) points: u64,
    pub(super) record: usize,
    /// Where extended records begin, and their number.
    pub(super) extended: Option<(usize, u32)>,
}

/// Checks against the file what its header claims; `None` if it ends before that.
pub(super) fn claims(bytes: &[u8]) -> Option<Claims> {
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    let legacy = u64::from(u32::from_le_bytes(read_at(bytes, 107)?));
    if bytes[25] < 4 {
        return Some(Claims { points: legacy, record, extended: None });
    }
    let extended_at = usize::try_from(u64::from_le_bytes(read_at(bytes, 235)?)).ok()?;
    let extended = Some((extended_at, u32::from_le_bytes(read_at(bytes, 243)?)));
    let points = if legacy == 0 { u64::from_le_bytes(read_at(bytes, 247)?) } else { legacy };
    Some(Claims { points, record, extended })
}

/// Refuses chunks of points that the file cannot hold: the decoder allocates what is claimed. `None` if it is cut off.
pub(super) fn check_chunks(bytes: &[u8], points: u64) -> Option<FormatResult<()>> {
    /// More points than that in a chunk are believed only of a file that has them.
    const LARGEST_CHUNK: u64 = 1 << 20;
    let u32_at = |at: usize| read_at(bytes, at).map(u32::from_le_bytes);
    let mut at = usize::from(u16::from_le_bytes(read_at(bytes, 94)?));
    // Every record ahead of the points has 54 bytes plus the length it states.
    for _ in 0..u32_at(100)? {
        let user = bytes.get(at.checked_add(2)?..at.checked_add(18)?)?;
        if user.starts_with(b"laszip encoded") {
            let chunk = u32_at(at + 54 + 12)?;
            if chunk != u32::MAX && u64::from(chunk) > points.max(LARGEST_CHUNK) {
                return Some(Err(FormatError::Malformed(format!("chunks of {chunk} points in a file of {points}"))));
            }
        }
        at += 54 + usize::from(u16::from_le_bytes(read_at(bytes, at + 20)?));
    }
    let table = i64::from_le_bytes(read_at(bytes, u32_at(96)? as usize)?);
    // It stands at the end where a writer could not go back.
    let at_end = || i64::from_le_bytes(read_at(bytes, bytes.len().checked_sub(8)?)?).try_into().ok();
    let table: usize = table.try_into().ok().or_else(at_end)?;
    let chunks = u32_at(table.checked_add(4)?)? as usize;
    let record = usize::from(u16::from_le_bytes(read_at(bytes, 105)?));
    // Each begins with an uncompressed point.
    if chunks.saturating_mul(record.max(1)) > bytes.len() {
        return Some(Err(FormatError::Malformed(format!("{chunks} chunks in {} bytes", bytes.len()))));
    }
    Some(Ok(()))
}

/// The extended records, behind the points. The library reads the first alone.
pub(super) fn extended_records(bytes: &[u8], (at, count): (usize, u32)) -> Option<Vec<Vlr>> {
    if count == 0 {
        // Where they would begin means nothing.
        return Some(Vec::new());
    }
    let mut rest = bytes.get(at..)?;
    let mut records = Vec::new();
    for _ in 0..count {
        // Nothing is allocated for what is not there.
        let length = usize::try_from(u64::from_le_bytes(read_at(rest, 20)?)).ok()?;
        let (record, behind) = rest.split_at_checked(length.checked_add(60)?)?;
        records.push(Vlr::new(las::raw::Vlr::read_from(record, true).ok()?));
        rest = behind;
    }
    Some(records)
}

fn read_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..at.checked_add(N)?)?.try_into().ok()
}
