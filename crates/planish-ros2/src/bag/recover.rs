//! Completes a recording that was cut off, in place: what is whole stays where it is, and gets an index.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use binrw::BinWrite;
use mcap::McapError;
use mcap::records::{
    Channel, ChunkHeader, ChunkIndex, DataEnd, Footer, MessageIndex, MessageIndexEntry, Record, SchemaHeader,
    Statistics, op,
};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::{MAGIC, decompress, of_mcap};
use planish_core::{FormatError, IoError};
use planish_io::ReadOptions;

/// Bytes before a record: its kind and its length.
const RECORD_HEADER: u64 = 9;

/// What [`recover`] did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recovered {
    /// The complete recording.
    pub path: PathBuf,
    /// Whether it was complete already.
    pub was_whole: bool,
    /// Messages that it has.
    pub messages: u64,
    /// Bytes at its end that were part of a message, and were dropped.
    pub dropped_bytes: u64,
    /// Chunks that cannot be read; they stay in the file, without an index.
    pub damaged_chunks: u64,
}

/// Returns the name that a recording has while it is being written: `NAME.mcap.part`.
pub fn part_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

/// Completes a recording that was cut off, by a killed process or a full disk, in place; `NAME.mcap.part` is then
/// renamed to `NAME.mcap`. Every message that is whole is kept, those of a chunk that was cut too.
///
/// # Errors
/// If the file is no recording, if it cannot be written, or if `NAME.mcap` exists.
pub fn recover(path: &Path, options: &ReadOptions) -> Result<Recovered, IoError> {
    let complete = match path.extension() {
        Some(extension) if extension == "part" => path.with_extension(""),
        _ => path.to_path_buf(),
    };
    if complete != path && complete.exists() {
        let problem = format!("{} exists; rename one of them", complete.display());
        return Err(IoError { path: path.to_path_buf(), problem: FormatError::Unsupported(problem) });
    }
    let recovered = || -> Result<Recovered, FormatError> {
        let recovered = complete_in_place(path, options)?;
        if complete != path {
            std::fs::rename(path, &complete)?;
        }
        Ok(Recovered { path: complete.clone(), ..recovered })
    };
    recovered().map_err(IoError::at(path))
}

/// Completes a recording under the name that it has.
pub(super) fn complete_in_place(path: &Path, options: &ReadOptions) -> Result<Recovered, FormatError> {
    let mut file = OpenOptions::new().read(true).write(true).open(path)?;
    let bytes = file.metadata()?.len();
    let mut scan = Scan::default();
    let end = scan.run(&mut file, bytes, options)?;
    let recovered = |was_whole, dropped_bytes| Recovered {
        path: path.to_path_buf(),
        was_whole,
        messages: scan.counts.values().sum(),
        dropped_bytes,
        damaged_chunks: scan.damaged_chunks,
    };
    if end.is_whole {
        return Ok(recovered(true, 0));
    }
    let tail = scan.tail(end.valid)?;
    // Only from here on the file changes.
    file.set_len(end.valid)?;
    file.seek(SeekFrom::Start(end.valid))?;
    file.write_all(&tail)?;
    file.sync_all()?;
    Ok(recovered(false, end.dropped))
}

/// Where the whole part of a recording ends.
struct End {
    valid: u64,
    dropped: u64,
    is_whole: bool,
}

/// What is known of a recording's records.
#[derive(Default)]
struct Scan {
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
    counts: BTreeMap<u16, u64>,
    times: Option<(u64, u64)>,
    chunks: Vec<ChunkIndex>,
    /// Indices of messages that the last chunk lacks.
    missing: BTreeMap<u16, Vec<MessageIndexEntry>>,
    /// Whole records of a chunk that was cut.
    salvaged: Option<Contents>,
    damaged_chunks: u64,
    attachments: u32,
    metadata: u32,
}

/// The records of a chunk.
#[derive(Default)]
struct Contents {
    bytes: Vec<u8>,
    index: BTreeMap<u16, Vec<MessageIndexEntry>>,
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
    times: Option<(u64, u64)>,
}

impl Scan {
    /// Reads the records up to the end of the data, or to the first that is not whole.
    fn run(&mut self, file: &mut File, bytes: u64, options: &ReadOptions) -> Result<End, FormatError> {
        let mut magic = [0; MAGIC.len()];
        file.seek(SeekFrom::Start(0))?;
        if file.read_exact(&mut magic).is_err() || magic != MAGIC {
            return Err(FormatError::Malformed("not a recording in MCAP: its first bytes are others".into()));
        }
        let mut at = MAGIC.len() as u64;
        loop {
            let cut = |at| Ok(End { valid: at, dropped: bytes - at, is_whole: false });
            let mut header = [0; RECORD_HEADER as usize];
            if bytes - at < RECORD_HEADER {
                return cut(at);
            }
            file.seek(SeekFrom::Start(at))?;
            file.read_exact(&mut header)?;
            let opcode = header[0];
            let length = u64::from_le_bytes(*header[1..].first_chunk().unwrap_or(&[0; 8]));
            let left = bytes - at - RECORD_HEADER;
            // A file that the kernel had only made longer has zeros there.
            if opcode == 0 || length > left && opcode != op::CHUNK {
                return cut(at);
            }
            if opcode == op::DATA_END {
                return Ok(End { valid: at, dropped: 0, is_whole: ends_whole(file, bytes)? });
            }
            let is_needed = matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::MESSAGE_INDEX);
            let mut data = Vec::new();
            if is_needed {
                let read = length.min(left);
                let size = usize::try_from(read).unwrap_or(usize::MAX);
                options.check(size, 3)?;
                data.try_reserve_exact(size).map_err(|_| FormatError::Os(std::io::ErrorKind::OutOfMemory.into()))?;
                Read::by_ref(file).take(read).read_to_end(&mut data)?;
            }
            if opcode == op::CHUNK && length > left {
                let contents = cut_contents(&data).unwrap_or_else(|| contents_of(&data, options).0);
                let cut_end = cut(at);
                if !contents.index.is_empty() {
                    self.take(&contents);
                    self.salvaged = Some(contents);
                }
                return cut_end;
            }
            match opcode {
                op::CHUNK => self.chunk(at, length, &data, options)?,
                op::MESSAGE_INDEX => self.message_index(at, length, &data),
                op::ATTACHMENT => self.attachments += 1,
                op::METADATA => self.metadata += 1,
                // Outside of chunks, as some programs write.
                op::SCHEMA | op::CHANNEL | op::MESSAGE => {
                    let mut contents = Contents::default();
                    if !contents.add(opcode, &data) {
                        return cut(at);
                    }
                    self.take(&contents);
                }
                _ => {}
            }
            at += RECORD_HEADER + length;
        }
    }

    /// A whole chunk. Its indices of messages follow.
    fn chunk(&mut self, at: u64, length: u64, data: &[u8], options: &ReadOptions) -> Result<(), FormatError> {
        self.missing.clear();
        let (contents, is_whole) = contents_of(data, options);
        let Ok(Record::Chunk { header, .. }) = mcap::parse_record(op::CHUNK, data) else {
            self.damaged_chunks += 1;
            return Ok(());
        };
        if !is_whole {
            self.damaged_chunks += 1;
            return Ok(());
        }
        self.take(&contents);
        self.missing = contents.index;
        self.chunks.push(ChunkIndex {
            message_start_time: header.message_start_time,
            message_end_time: header.message_end_time,
            chunk_start_offset: at,
            chunk_length: RECORD_HEADER + length,
            message_index_offsets: BTreeMap::new(),
            message_index_length: 0,
            compression: header.compression,
            compressed_size: header.compressed_size,
            uncompressed_size: header.uncompressed_size,
        });
        Ok(())
    }

    /// An index of messages of the chunk before.
    fn message_index(&mut self, at: u64, length: u64, data: &[u8]) {
        let (Some(chunk), Some(&[low, high])) = (self.chunks.last_mut(), data.first_chunk()) else { return };
        let channel = u16::from_le_bytes([low, high]);
        if self.missing.remove(&channel).is_some() {
            chunk.message_index_offsets.insert(channel, at);
            chunk.message_index_length += RECORD_HEADER + length;
        }
    }

    fn take(&mut self, contents: &Contents) {
        self.schemas.extend(contents.schemas.iter().map(|(id, schema)| (*id, schema.clone())));
        self.channels.extend(contents.channels.iter().map(|(id, channel)| (*id, channel.clone())));
        for (channel, entries) in &contents.index {
            *self.counts.entry(*channel).or_default() += entries.len() as u64;
        }
        self.times = together(self.times, contents.times);
    }

    /// What belongs after the whole part of the file, which ends at `at`: messages of a chunk that was cut, missing
    /// indices, and the summary.
    fn tail(&self, at: u64) -> Result<Vec<u8>, FormatError> {
        let mut tail = Vec::new();
        let mut chunks = self.chunks.clone();
        if let (Some(chunk), false) = (chunks.last_mut(), self.missing.is_empty()) {
            index_messages(&mut tail, at, &self.missing, chunk)?;
        }
        if let Some(contents) = &self.salvaged {
            let start = at + tail.len() as u64;
            let (first, last) = contents.times.unwrap_or_default();
            let size = contents.bytes.len() as u64;
            let header = ChunkHeader {
                message_start_time: first,
                message_end_time: last,
                uncompressed_size: size,
                uncompressed_crc: 0,
                compression: String::new(),
                compressed_size: size,
            };
            let mut data = encoded(&header)?;
            data.extend_from_slice(&contents.bytes);
            record(&mut tail, op::CHUNK, &data);
            let mut index = ChunkIndex {
                message_start_time: first,
                message_end_time: last,
                chunk_start_offset: start,
                chunk_length: RECORD_HEADER + data.len() as u64,
                message_index_offsets: BTreeMap::new(),
                message_index_length: 0,
                compression: String::new(),
                compressed_size: size,
                uncompressed_size: size,
            };
            index_messages(&mut tail, at, &contents.index, &mut index)?;
            chunks.push(index);
        }
        record(&mut tail, op::DATA_END, &encoded(&DataEnd { data_section_crc: 0 })?);

        let summary_start = at + tail.len() as u64;
        for (header, text) in self.schemas.values() {
            let mut data = encoded(header)?;
            data.extend((text.len() as u32).to_le_bytes());
            data.extend(text);
            record(&mut tail, op::SCHEMA, &data);
        }
        for channel in self.channels.values() {
            record(&mut tail, op::CHANNEL, &encoded(channel)?);
        }
        let (first, last) = self.times.unwrap_or_default();
        let statistics = Statistics {
            message_count: self.counts.values().sum(),
            schema_count: self.schemas.len() as u16,
            channel_count: self.channels.len() as u32,
            attachment_count: self.attachments,
            metadata_count: self.metadata,
            chunk_count: chunks.len() as u32,
            message_start_time: first,
            message_end_time: last,
            channel_message_counts: self.counts.clone(),
        };
        record(&mut tail, op::STATISTICS, &encoded(&statistics)?);
        for chunk in &chunks {
            record(&mut tail, op::CHUNK_INDEX, &encoded(chunk)?);
        }
        // 0: no table of the summary's parts, and no checksum.
        record(&mut tail, op::FOOTER, &encoded(&Footer { summary_start, summary_offset_start: 0, summary_crc: 0 })?);
        tail.extend(MAGIC);
        Ok(tail)
    }
}

impl Contents {
    /// Adds a record; returns false if it cannot be read.
    fn add(&mut self, opcode: u8, data: &[u8]) -> bool {
        let offset = self.bytes.len() as u64;
        let Ok(parsed) = mcap::parse_record(opcode, data) else { return false };
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
        record(&mut self.bytes, opcode, data);
        true
    }
}

/// Returns the whole records of a chunk that was cut and is not compressed; `None` for others. Its header may not be
/// written yet: some programs put the sizes there at the end.
fn cut_contents(chunk: &[u8]) -> Option<Contents> {
    let mut rest = chunk.get(header_bytes(chunk)?..)?;
    if !chunk.get(BEFORE_COMPRESSION..)?.starts_with(&[0; 4]) {
        return None;
    }
    let mut contents = Contents::default();
    while let Some((&[opcode, ref length @ ..], after)) = rest.split_first_chunk::<{ RECORD_HEADER as usize }>() {
        let Ok(length) = usize::try_from(u64::from_le_bytes(*length)) else { break };
        let Some((data, next)) = after.split_at_checked(length) else { break };
        if opcode == op::CHUNK || !contents.add(opcode, data) {
            break;
        }
        rest = next;
    }
    Some(contents)
}

/// Two times, the size and the checksum, at the beginning of a chunk.
const BEFORE_COMPRESSION: usize = 8 + 8 + 8 + 4;

/// Returns the bytes of a chunk's header: those, the name of its compression and its size.
fn header_bytes(chunk: &[u8]) -> Option<usize> {
    let name = u32::from_le_bytes(*chunk.get(BEFORE_COMPRESSION..)?.first_chunk()?) as usize;
    name.checked_add(BEFORE_COMPRESSION + 4 + 8)
}

/// Returns the whole records of a chunk, and whether it has no others. A chunk that was cut gives those before the cut.
fn contents_of(chunk: &[u8], options: &ReadOptions) -> (Contents, bool) {
    let mut contents = Contents::default();
    let mut bytes = Vec::with_capacity(chunk.len() + RECORD_HEADER as usize);
    // Of the length that the chunk was to have: it is only known to be that of its data where it is whole.
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
    loop {
        // With overflow checks the reader panics on a record that reaches beyond its chunk.
        let next = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| match reader.next_event() {
            None => Step::End,
            Some(Ok(LinearReadEvent::ReadRequest(wanted))) => Step::Read(wanted),
            Some(Ok(LinearReadEvent::Record { opcode, data })) => Step::Record(opcode, data.to_vec()),
            Some(Err(McapError::UnexpectedEof)) if rest.is_empty() => Step::End,
            Some(Err(_)) => Step::Damaged,
        }));
        match next {
            Ok(Step::Read(wanted)) => {
                let (now, later) = rest.split_at(wanted.min(rest.len()));
                reader.insert(now.len())[..now.len()].copy_from_slice(now);
                reader.notify_read(now.len());
                rest = later;
            }
            Ok(Step::Record(opcode, data)) if opcode != op::CHUNK && contents.add(opcode, &data) => {}
            Ok(Step::End) => return (contents, length == chunk.len() as u64),
            _ => return (contents, false),
        }
    }
}

/// What the reader of a chunk says.
enum Step {
    Read(usize),
    Record(u8, Vec<u8>),
    End,
    Damaged,
}

/// Returns the length of a chunk's record by its header, which may be more than there is of it.
fn length_of(chunk: &[u8]) -> Option<u64> {
    let header = header_bytes(chunk)?;
    let size = u64::from_le_bytes(*chunk.get(header - 8..)?.first_chunk()?);
    size.checked_add(header as u64)
}

/// Adds the indices of a chunk's messages to what follows it; `at` is where `to` begins in the file.
fn index_messages(
    to: &mut Vec<u8>,
    at: u64,
    messages: &BTreeMap<u16, Vec<MessageIndexEntry>>,
    chunk: &mut ChunkIndex,
) -> Result<(), FormatError> {
    for (&channel_id, records) in messages {
        let before = to.len();
        chunk.message_index_offsets.insert(channel_id, at + before as u64);
        record(to, op::MESSAGE_INDEX, &encoded(&MessageIndex { channel_id, records: records.clone() })?);
        chunk.message_index_length += (to.len() - before) as u64;
    }
    Ok(())
}

fn record(to: &mut Vec<u8>, opcode: u8, data: &[u8]) {
    to.push(opcode);
    to.extend((data.len() as u64).to_le_bytes());
    to.extend(data);
}

fn encoded<T: for<'a> BinWrite<Args<'a> = ()>>(value: &T) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Cursor::new(Vec::new());
    value.write_le(&mut bytes).map_err(|error| of_mcap(McapError::Parse(error)))?;
    Ok(bytes.into_inner())
}

fn together(a: Option<(u64, u64)>, b: Option<(u64, u64)>) -> Option<(u64, u64)> {
    match (a, b) {
        (Some((first, last)), Some((other_first, other_last))) => Some((first.min(other_first), last.max(other_last))),
        (a, b) => a.or(b),
    }
}

/// Returns true if a file ends with a footer.
fn ends_whole(file: &mut File, bytes: u64) -> Result<bool, FormatError> {
    /// The record of a footer, and the magic bytes.
    const FOOTER_BYTES: u64 = RECORD_HEADER + 20 + 8;
    if bytes < FOOTER_BYTES {
        return Ok(false);
    }
    let mut footer = [0; FOOTER_BYTES as usize];
    file.seek(SeekFrom::Start(bytes - FOOTER_BYTES))?;
    file.read_exact(&mut footer)?;
    Ok(footer[0] == op::FOOTER && footer.ends_with(&MAGIC))
}
