//! The records of a chunk, whole or cut.

use std::collections::BTreeMap;

use mcap::McapError;
use mcap::records::{Channel, MessageIndexEntry, Record, SchemaHeader, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::RECORD_HEADER;
use super::tail::record;
use crate::bag::decompress;
use crate::bag::records::{most_records, parse_record};
use planish_io::ReadOptions;
use planish_io::internal::guarded;

/// The records of a chunk.
#[derive(Default)]
pub(super) struct Contents {
    /// The bytes of the records, if they are to be written again.
    pub bytes: Vec<u8>,
    pub index: BTreeMap<u16, Vec<MessageIndexEntry>>,
    pub schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    pub channels: BTreeMap<u16, Channel>,
    pub times: Option<(u64, u64)>,
    /// The offset of the next record in bytes, within the records of the chunk.
    end: u64,
}

impl Contents {
    /// Adds a record, and its bytes if `with_bytes` is set; returns false if it cannot be read.
    pub fn add(&mut self, opcode: u8, data: &[u8], with_bytes: bool) -> bool {
        let offset = self.end;
        let Ok(parsed) = parse_record(opcode, data) else { return false };
        match parsed {
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header, data.into_owned()));
            }
            Record::Channel(channel) => {
                self.channels.insert(channel.id, channel);
            }
            Record::Message { header, .. } => {
                let entry = MessageIndexEntry { log_time: header.log_time, offset };
                self.index.entry(header.channel_id).or_default().push(entry);
                self.times = together(self.times, Some((header.log_time, header.log_time)));
            }
            _ => {}
        }
        self.end += RECORD_HEADER + data.len() as u64;
        if with_bytes {
            record(&mut self.bytes, opcode, data);
        }
        true
    }
}

/// Returns the whole records of a cut, uncompressed chunk; `None` for other chunks. The sizes in its header may be
/// missing, since some programs write them last.
pub(super) fn cut_contents(chunk: &[u8]) -> Option<Contents> {
    let mut rest = chunk.get(header_bytes(chunk)?..)?;
    if !chunk.get(BEFORE_COMPRESSION..)?.starts_with(&[0; 4]) {
        return None;
    }
    let mut contents = Contents::default();
    while let Some((&[opcode, ref length @ ..], after)) = rest.split_first_chunk::<{ RECORD_HEADER as usize }>() {
        let Ok(length) = usize::try_from(u64::from_le_bytes(*length)) else { break };
        let Some((data, next)) = after.split_at_checked(length) else { break };
        if matches!(opcode, 0 | op::CHUNK) || !contents.add(opcode, data, true) {
            break;
        }
        rest = next;
    }
    Some(contents)
}

/// Number of bytes in a chunk record before the name of its compression: two timestamps, the size and the checksum.
const BEFORE_COMPRESSION: usize = 8 + 8 + 8 + 4;

/// Returns the size in bytes of a chunk's header, which ends with the compression's name and the records' size.
pub(super) fn header_bytes(chunk: &[u8]) -> Option<usize> {
    let name = u32::from_le_bytes(*chunk.get(BEFORE_COMPRESSION..)?.first_chunk()?) as usize;
    name.checked_add(BEFORE_COMPRESSION + 4 + 8)
}

/// Returns the whole records of a chunk, and whether the chunk is complete.
pub(super) fn contents_of(chunk: &[u8], with_bytes: bool, options: &ReadOptions) -> (Contents, bool) {
    let mut contents = Contents::default();
    let mut bytes = Vec::with_capacity(chunk.len() + RECORD_HEADER as usize);
    // The chunk record gets the length computed from the sizes in its header, so that a cut chunk is detected.
    let length = length_of(chunk).unwrap_or(chunk.len() as u64);
    bytes.push(op::CHUNK);
    bytes.extend(length.to_le_bytes());
    bytes.extend(chunk);
    let limit = usize::try_from(options.max_memory_bytes / 2).unwrap_or(usize::MAX);
    let reader_options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_record_length_limit(limit);
    let mut reader = LinearReader::new_with_options(reader_options);
    if decompress::register(&mut reader).is_err() {
        return (contents, false);
    }
    let mut rest = &bytes[..];
    let (mut count, mut kept_bytes) = (0, 0);
    loop {
        if count > most_records(chunk.len() as u64) || kept_bytes > limit {
            return (contents, false);
        }
        // In builds with overflow checks, the reader panics on a record that reaches beyond its chunk.
        let next = guarded(|| match reader.next_event() {
            None => Step::End,
            Some(Ok(LinearReadEvent::ReadRequest(wanted))) => Step::Read(wanted),
            Some(Ok(LinearReadEvent::Record { opcode, data })) => Step::Record(opcode, data.to_vec()),
            Some(Err(McapError::UnexpectedEof)) if rest.is_empty() => Step::End,
            Some(Err(_)) => Step::Damaged,
        });
        match next {
            Some(Step::Read(wanted)) => {
                let (now, later) = rest.split_at(wanted.min(rest.len()));
                reader.insert(now.len())[..now.len()].copy_from_slice(now);
                reader.notify_read(now.len());
                rest = later;
            }
            Some(Step::Record(opcode, data))
                if !matches!(opcode, 0 | op::CHUNK) && contents.add(opcode, &data, with_bytes) =>
            {
                count += 1;
                // A message leaves only an entry in the index.
                let is_kept = with_bytes || matches!(opcode, op::SCHEMA | op::CHANNEL);
                kept_bytes +=
                    if is_kept { data.len() + RECORD_HEADER as usize } else { size_of::<MessageIndexEntry>() };
            }
            Some(Step::End) => return (contents, length == chunk.len() as u64),
            _ => return (contents, false),
        }
    }
}

/// One step of the chunk reader.
enum Step {
    Read(usize),
    Record(u8, Vec<u8>),
    End,
    Damaged,
}

/// Returns the length of a chunk record, computed from the sizes in its header; a cut chunk is shorter.
fn length_of(chunk: &[u8]) -> Option<u64> {
    let header = header_bytes(chunk)?;
    let size = u64::from_le_bytes(*chunk.get(header - 8..)?.first_chunk()?);
    size.checked_add(header as u64)
}

pub(super) fn together(a: Option<(u64, u64)>, b: Option<(u64, u64)>) -> Option<(u64, u64)> {
    match (a, b) {
        (Some((first, last)), Some((other_first, other_last))) => Some((first.min(other_first), last.max(other_last))),
        (a, b) => a.or(b),
    }
}
