//! Corrects invalid headers that other programs wrote, before the files are decoded, and reports the corrections.

use std::io::{self, Read, Seek, SeekFrom};

use super::validate::{FileBytes, extended_records, read_at};
use crate::FormatResult;
use planish_core::FormatError;

/// Byte offset of the global encoding in the header.
const ENCODING: usize = 6;
/// Byte offset of the major and minor version in the header.
const VERSION: usize = 24;
/// Byte offset of the header's size in the header.
const SIZE: usize = 94;
/// Byte offset, in the header, of the field that states where the points begin.
pub(super) const POINTS_AT: usize = 96;
/// Byte offset, in the header, of the number of variable-length records.
const RECORDS: usize = 100;
/// Byte offset of the point format in the header.
const FORMAT: usize = 104;
/// Byte offset, in the header, of the point record's size.
const RECORD: usize = 105;
/// Byte offset, in the header, of the 32-bit number of points.
const LEGACY_POINTS: usize = 107;
/// Byte offset, in the header, of the field that states where the waveforms begin.
const WAVEFORMS_AT: usize = 227;
/// Byte offset, in the header, of the field that states where the extended records begin.
const EXTENDED_AT: usize = 235;
/// Byte offset, in the header, of the number of extended records.
const EXTENDED: usize = 243;
/// Byte offset, in the header, of the 64-bit number of points.
const POINTS: usize = 247;
/// Byte range, in the header, of the system and program that wrote the file, and of the day and year.
pub(super) const IDENTITY: std::ops::Range<usize> = 26..94;

/// Size in bytes of the header of a variable-length record, which precedes its data.
const RECORD_HEADER: usize = 54;
/// Bits of the global encoding that mark waveforms in the file or in a separate file.
const WAVEFORMS: u16 = 1 << 1 | 1 << 2;
/// Bit of the point format that marks compressed points.
const COMPRESSED: u8 = 0x80;
/// First version with extended variable-length records, LAS 1.4.
const EXTENDED_SINCE: [u8; 2] = [1, 4];
/// Latest supported version, LAS 1.5, which only adds fields to the header.
const LATEST: [u8; 2] = [1, 5];
/// Bit of the global encoding that marks GPS times with an explicit offset.
const TIME_OFFSET: u16 = 1 << 6;
/// Byte offset, in the header, of the GPS time offset, which is in millions of seconds.
const TIME_OFFSET_AT: usize = 391;

/// A corrected header, and notes on the corrections.
pub(super) struct Repaired {
    pub(super) head: Vec<u8>,
    pub(super) notes: Vec<String>,
}

impl Repaired {
    /// Reads and corrects the header of a file; `None` if the file ends within the header.
    pub(super) fn read(file: &(impl FileBytes + ?Sized)) -> Option<FormatResult<Self>> {
        let size = usize::from(u16::from_le_bytes(read_at(file, SIZE)?));
        let version: [u8; 2] = read_at(file, VERSION)?;
        let [major, minor] = version;
        if major != LATEST[0] {
            let text = format!("LAS version {major}.{minor} is not supported; expected 1.0 to 1.5");
            return Some(Err(FormatError::Malformed(text)));
        }
        if version > LATEST {
            let text = format!("LAS {major}.{minor} is not supported; expected 1.0 to 1.5. Save the file as LAS 1.4");
            return Some(Err(FormatError::Unsupported(text)));
        }
        let mut repaired = Self { head: file.read(0, size)?, notes: Vec::new() };
        repaired.count_records(file)?;
        if version >= EXTENDED_SINCE {
            repaired.count_points(file)?;
            repaired.count_extended_records(file)?;
        }
        repaired.compare_points(file)?;
        if version == LATEST {
            repaired.set(VERSION, &EXTENDED_SINCE);
            repaired.notes.push("the file is read as LAS 1.4, which has the same point fields".into());
            let has_offset = size >= TIME_OFFSET_AT + 2;
            let offset = if has_offset { i16::from_le_bytes(read_at(file, TIME_OFFSET_AT)?) } else { 0 };
            if u16::from_le_bytes(read_at(file, ENCODING)?) & TIME_OFFSET != 0 && offset != 0 {
                repaired.notes.push(format!("the offset of its GPS times, {offset} million seconds, is dropped"));
            }
        }
        if u16::from_le_bytes(read_at(file, ENCODING)?) & WAVEFORMS != 0 {
            repaired.notes.push("its waveforms are dropped; the points keep only their references to them".into());
        }
        Some(Ok(repaired))
    }

    fn set(&mut self, at: usize, bytes: &[u8]) {
        if let Some(place) = self.head.get_mut(at..at + bytes.len()) {
            place.copy_from_slice(bytes);
        }
    }

    /// Corrects the number of variable-length records before the points; some scanners state one too many.
    fn count_records(&mut self, file: &(impl FileBytes + ?Sized)) -> Option<()> {
        let stated = u32::from_le_bytes(read_at(file, RECORDS)?);
        let points_at = u32::from_le_bytes(read_at(file, POINTS_AT)?) as usize;
        let (mut at, mut found) = (self.head.len(), 0);
        while found < stated && at + RECORD_HEADER <= points_at {
            at += RECORD_HEADER + usize::from(u16::from_le_bytes(read_at(file, at + 20)?));
            if at > points_at {
                break;
            }
            found += 1;
        }
        if found < stated {
            self.set(RECORDS, &found.to_le_bytes());
            self.notes
                .push(format!("the number of records before the points is {found}, but the header states {stated}"));
        }
        Some(())
    }

    /// Corrects the 32-bit number of points of LAS 1.4. Only older programs read this field, and it may be left over
    /// from an earlier version of the file.
    fn count_points(&mut self, file: &(impl FileBytes + ?Sized)) -> Option<()> {
        let legacy = u32::from_le_bytes(read_at(file, LEGACY_POINTS)?);
        let points = u64::from_le_bytes(read_at(file, POINTS)?);
        if legacy != 0 && points != 0 && u64::from(legacy) != points {
            self.set(LEGACY_POINTS, &0u32.to_le_bytes());
            self.notes
                .push(format!("the header states {points} points, but {legacy} in the legacy field, which is ignored"));
        }
        Some(())
    }

    /// Compares the number of points stated by an uncompressed file with the file's size, and corrects a stated number
    /// of 0.
    fn compare_points(&mut self, file: &(impl FileBytes + ?Sized)) -> Option<()> {
        let [format] = read_at(file, FORMAT)?;
        let record = u64::from(u16::from_le_bytes(read_at(file, RECORD)?));
        if format & COMPRESSED != 0 || record == 0 {
            return Some(());
        }
        let head =
            |at: usize| self.head.get(at..at + 8).and_then(|bytes| bytes.try_into().ok()).map(u64::from_le_bytes);
        let minor = self.head.get(VERSION + 1).copied()?;
        let start = u64::from(u32::from_le_bytes(read_at(file, POINTS_AT)?));
        let waveforms = head(WAVEFORMS_AT).filter(|at| minor >= 3 && *at > start);
        let extended = head(EXTENDED_AT).filter(|at| minor >= 4 && *at > start);
        let end = [waveforms, extended].into_iter().flatten().fold(file.size() as u64, u64::min);
        let there = end.saturating_sub(start) / record;
        let legacy = u64::from(u32::from_le_bytes(self.head.get(LEGACY_POINTS..LEGACY_POINTS + 4)?.try_into().ok()?));
        let stated = if legacy == 0 && minor >= 4 { head(POINTS)? } else { legacy };
        if stated == 0 && there > 0 {
            match u32::try_from(there) {
                Ok(there) => self.set(LEGACY_POINTS, &there.to_le_bytes()),
                Err(_) => self.set(POINTS, &there.to_le_bytes()),
            }
            self.notes.push(format!("the header states no points; all {there} points of the file are read"));
        } else if stated < there {
            self.notes
                .push(format!("only the {stated} points stated in the header are read, but the file has {there}"));
        }
        Some(())
    }

    /// Reduces the stated number of extended records to the number that can be read.
    fn count_extended_records(&mut self, file: &(impl FileBytes + ?Sized)) -> Option<()> {
        let stated = u32::from_le_bytes(read_at(file, EXTENDED)?);
        let at = u64::from_le_bytes(read_at(file, EXTENDED_AT)?);
        // Each record has at least 60 bytes.
        let most = stated.min(u32::try_from(file.size() / 60).unwrap_or(u32::MAX));
        let found = usize::try_from(at).map_or(0, |at| extended_records(file, (at, most)).len() as u32);
        if found < stated {
            self.set(EXTENDED, &found.to_le_bytes());
            if found == 0 {
                self.set(EXTENDED_AT, &0u64.to_le_bytes());
            }
            self.notes.push(format!(
                "the header states {stated} extended records at offset {at}, but only {found} can be read"
            ));
        }
        Some(())
    }
}

/// A reader of a file, with the header replaced by `head`.
#[derive(Debug)]
pub(super) struct WithHead<R> {
    pub(super) head: Vec<u8>,
    pub(super) rest: R,
    at: u64,
}

impl<R: Read + Seek> WithHead<R> {
    pub(super) fn new(head: Vec<u8>, mut rest: R) -> io::Result<Self> {
        rest.rewind()?;
        Ok(Self { head, rest, at: 0 })
    }
}

impl<R: Read + Seek> Read for WithHead<R> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let read = match usize::try_from(self.at).ok().and_then(|at| self.head.get(at..)) {
            Some(head) if !head.is_empty() => {
                let count = head.len().min(bytes.len());
                bytes[..count].copy_from_slice(&head[..count]);
                self.rest.seek_relative(count as i64)?;
                count
            }
            _ => self.rest.read(bytes)?,
        };
        self.at += read as u64;
        Ok(read)
    }
}

impl<R: Read + Seek> Seek for WithHead<R> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.at = self.rest.seek(to)?;
        Ok(self.at)
    }
}

/// The bytes of a file, with the header replaced by `head`.
pub(super) struct Overlaid<'a, B: ?Sized> {
    pub(super) head: &'a [u8],
    pub(super) file: &'a B,
}

impl<B: FileBytes + ?Sized> FileBytes for Overlaid<'_, B> {
    fn size(&self) -> usize {
        self.file.size()
    }

    fn read(&self, at: usize, len: usize) -> Option<Vec<u8>> {
        let mut bytes = self.file.read(at, len)?;
        if let Some(head) = self.head.get(at..) {
            bytes.iter_mut().zip(head).for_each(|(byte, of_head)| *byte = *of_head);
        }
        Some(bytes)
    }

    fn reader(&self, at: u64) -> Option<impl Read + Seek> {
        self.file.reader(at)
    }
}
