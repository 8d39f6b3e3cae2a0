//! Completes a truncated recording in place: whole records stay, and an index is appended.

mod chunk;
mod tail;

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::{Channel, ChunkIndex, MessageIndexEntry, Record, SchemaHeader, op};

use super::MAGIC;
use super::parts::{DEFINITION_COPIES, bytes_of_channel};
use super::records::parse_record;
use chunk::{Contents, contents_of, cut_contents, header_bytes, together};
use planish_core::{FormatError, IoError};
use planish_io::ReadOptions;

/// Size in bytes of the header of a record: its opcode and its length.
const RECORD_HEADER: u64 = 9;

/// Maximum number of bytes lost by a cut, since no recorder writes larger records. A larger loss means damage.
const LARGEST_LOSS: u64 = 256 << 20;

/// Result of [`recover`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Recovered {
    /// The complete recording.
    pub path: PathBuf,
    /// Whether the recording was already complete.
    pub was_whole: bool,
    /// Number of messages.
    pub messages: u64,
    /// Number of bytes of incomplete records removed from the end; 0 if messages of a cut compressed chunk were kept.
    pub dropped_bytes: u64,
    /// Number of chunks that cannot be read; they stay in the file, without an index.
    pub damaged_chunks: u64,
}

/// Returns the name that a recording has while it is being written: `NAME.mcap.part`.
pub fn part_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

/// Completes in place a recording that was cut off by a killed process or a full disk, and renames `NAME.mcap.part`
/// to `NAME.mcap`. Every whole message is kept, even in a chunk that was cut off. Damaged chunks are left unchanged.
///
/// # Errors
/// If the file is not a recording, is being written, is read-only, or is damaged instead of cut off; or if another file
/// is called `NAME.mcap`. The file is then unchanged.
pub fn recover(path: &Path, options: &ReadOptions) -> Result<Recovered, IoError> {
    let complete = match path.extension() {
        Some(extension) if extension == "part" => path.with_extension(""),
        _ => path.to_path_buf(),
    };
    if complete != path && complete.symlink_metadata().is_ok() {
        let problem = format!("{} already exists; rename one of the two files", complete.display());
        return Err(IoError { path: path.to_path_buf(), problem: FormatError::Unsupported(problem) });
    }
    let recovered = || -> Result<Recovered, FormatError> {
        if !path.metadata()?.is_file() {
            return Err(FormatError::Unsupported("not a regular file; give the .mcap or .mcap.part itself".into()));
        }
        if planish_io::is_read_only(path) {
            let problem = "the file is read-only; make it writable, or recover a copy";
            return Err(FormatError::Unsupported(problem.into()));
        }
        let mut file = OpenOptions::new().read(true).write(true).open(path)?;
        if is_being_written(&file) {
            return Err(FormatError::Unsupported("another process is writing this file".into()));
        }
        let recovered = complete_in_place(&mut file, options)?;
        drop(file);
        if complete != path {
            std::fs::rename(path, &complete)?;
        }
        Ok(Recovered { path: complete.clone(), ..recovered })
    };
    recovered().map_err(IoError::at(path))
}

/// Marks a file as being written until it is closed. Does nothing on Windows, where the lock would keep others from
/// reading the file.
pub(super) fn mark_as_being_written(file: &File) {
    #[cfg(unix)]
    let _ = file.try_lock();
    #[cfg(not(unix))]
    let _ = file;
}

/// Returns true if another process, or another part of this process, is writing the file; otherwise marks the file.
pub(super) fn is_being_written(file: &File) -> bool {
    #[cfg(unix)]
    return matches!(file.try_lock(), Err(std::fs::TryLockError::WouldBlock));
    #[cfg(not(unix))]
    {
        let _ = file;
        false
    }
}

/// Completes a recording without renaming it.
pub(super) fn complete_in_place(file: &mut File, options: &ReadOptions) -> Result<Recovered, FormatError> {
    let bytes = file.metadata()?.len();
    let mut scan = Scan::default();
    let end = scan.run(file, bytes, options)?;
    let recovered = |was_whole, dropped_bytes| Recovered {
        path: PathBuf::new(),
        was_whole,
        messages: scan.counts.values().sum(),
        dropped_bytes,
        damaged_chunks: scan.damaged_chunks,
    };
    let summary = summary_start(file, bytes)?;
    let is_ended = summary.is_some();
    // In a complete file, the data are directly followed by the summary, or by a footer without one.
    if end.is_data_end && (summary == Some(end.after) || summary == Some(0) && bytes - end.after == FOOTER_BYTES) {
        return Ok(recovered(true, 0));
    }
    // Recorders append, so a cut costs one record. A larger loss means damage.
    if is_ended || end.dropped > LARGEST_LOSS {
        return Err(FormatError::Malformed(format!(
            "damaged at byte {} rather than truncated, since {} bytes follow; nothing was changed",
            end.valid,
            bytes - end.valid
        )));
    }
    if !scan.has_header {
        return Err(FormatError::Malformed(
            "the recording ends before its first record; nothing can be recovered".into(),
        ));
    }
    let tail = scan.tail(end.valid)?;
    let length = end.valid + tail.len() as u64;
    let lost_at = Some(end.valid).filter(|at| *at < bytes && scan.salvaged.is_none());
    reserve(file, bytes, length, lost_at)?;
    // Whole records are never changed; the bytes after them are changed only from here on.
    file.seek(SeekFrom::Start(end.valid))?;
    file.write_all(&tail)?;
    file.set_len(length)?;
    file.sync_all()?;
    Ok(recovered(false, end.dropped))
}

/// Extends a file of `bytes` bytes with zeros to `length` bytes, if that is more. If the disk is full, the file stays
/// unchanged.
///
/// `lost_at` is the offset of a cut record that cannot be kept. Its opcode is first replaced by 0, because the zeros
/// would make the record look whole if this process were killed before the tail is written.
fn reserve(file: &mut File, bytes: u64, length: u64, lost_at: Option<u64>) -> Result<(), FormatError> {
    let Some(more) = length.checked_sub(bytes).filter(|more| *more > 0) else { return Ok(()) };
    let opcode = lost_at.map(|at| replace_byte(file, at, 0)).transpose()?;
    file.seek(SeekFrom::Start(bytes))?;
    let extended = std::io::copy(&mut std::io::repeat(0).take(more), file).and_then(|_| file.sync_all());
    if let Err(error) = extended {
        file.set_len(bytes)?;
        if let (Some(at), Some(opcode)) = (lost_at, opcode) {
            replace_byte(file, at, opcode)?;
        }
        return Err(error.into());
    }
    Ok(())
}

/// Replaces the byte at an offset on the disk; returns the previous byte.
fn replace_byte(file: &mut File, at: u64, byte: u8) -> std::io::Result<u8> {
    let mut before = [0];
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(&mut before)?;
    file.seek(SeekFrom::Start(at))?;
    file.write_all(&[byte])?;
    file.sync_all()?;
    Ok(before[0])
}

/// The end of the whole records of a recording, as offsets and sizes in bytes.
struct End {
    valid: u64,
    dropped: u64,
    /// Whether the record that ends the data follows.
    is_data_end: bool,
    /// Offset after the record that ends the data; the same as `valid` if that record is missing.
    after: u64,
}

/// Records found so far.
#[derive(Default)]
struct Scan {
    has_header: bool,
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    channels: BTreeMap<u16, Channel>,
    counts: BTreeMap<u16, u64>,
    times: Option<(u64, u64)>,
    chunks: Vec<ChunkIndex>,
    /// Bytes of all schemas and channels.
    definitions: usize,
    /// Message indices that the last chunk lacks.
    missing: BTreeMap<u16, Vec<MessageIndexEntry>>,
    /// Whole records of a chunk that was cut.
    salvaged: Option<Contents>,
    damaged_chunks: u64,
    attachments: u32,
    metadata: u32,
}

impl Scan {
    /// Reads the records up to the end of the data, or to the first incomplete record.
    fn run(&mut self, file: &mut File, bytes: u64, options: &ReadOptions) -> Result<End, FormatError> {
        let mut magic = [0; MAGIC.len()];
        file.seek(SeekFrom::Start(0))?;
        if file.read_exact(&mut magic).is_err() || magic != MAGIC {
            return Err(FormatError::Malformed("not an MCAP recording: its signature is missing".into()));
        }
        let mut at = MAGIC.len() as u64;
        loop {
            let cut = |dropped| Ok(End { valid: at, dropped, is_data_end: false, after: at });
            let mut header = [0; RECORD_HEADER as usize];
            if bytes - at < RECORD_HEADER {
                return cut(bytes - at);
            }
            file.seek(SeekFrom::Start(at))?;
            file.read_exact(&mut header)?;
            let opcode = header[0];
            let length = u64::from_le_bytes(*header[1..].first_chunk().unwrap_or(&[0; 8]));
            let left = bytes - at - RECORD_HEADER;
            // After a power failure, the end of the file may consist of zeros.
            if opcode == 0 && is_zero(file)? {
                return cut(0);
            }
            if opcode == 0 || length > left && opcode != op::CHUNK {
                return cut(bytes - at);
            }
            if opcode == op::DATA_END {
                return Ok(End { valid: at, dropped: 0, is_data_end: true, after: at + RECORD_HEADER + length });
            }
            let is_needed =
                matches!(opcode, op::HEADER | op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::MESSAGE_INDEX);
            let mut data = Vec::new();
            if is_needed {
                let read = length.min(left);
                let size = usize::try_from(read).unwrap_or(usize::MAX);
                options.check(size, 3)?;
                data.try_reserve_exact(size).map_err(|_| FormatError::Os(std::io::ErrorKind::OutOfMemory.into()))?;
                Read::by_ref(file).take(read).read_to_end(&mut data)?;
            }
            match opcode {
                op::HEADER if parse_record(op::HEADER, &data).is_ok() => self.has_header = true,
                op::HEADER => return cut(bytes - at),
                op::CHUNK => {
                    let (contents, is_whole) = contents_of(&data, false, options);
                    if length > left || !is_whole && is_zero(file)? {
                        let dropped = self.salvage(&data, options)?;
                        return cut(dropped);
                    }
                    self.chunk((at, length), &data, contents, is_whole, options)?;
                }
                op::MESSAGE_INDEX => self.message_index(at, length, &data),
                op::ATTACHMENT => self.attachments += 1,
                op::METADATA => self.metadata += 1,
                // Some programs write messages outside of chunks.
                op::SCHEMA | op::CHANNEL | op::MESSAGE => {
                    let mut contents = Contents::default();
                    let is_read = contents.add(opcode, &data, false);
                    // A record whose end became zeros may refer to unknown channels.
                    if !self.knows_channels(&contents) {
                        return cut(bytes - at);
                    }
                    match is_read {
                        true => self.take(&contents, options)?,
                        false => self.damaged_chunks += 1,
                    }
                }
                _ => {}
            }
            at += RECORD_HEADER + length;
        }
    }

    /// Keeps the whole records of a chunk that was cut; returns the number of lost bytes.
    fn salvage(&mut self, data: &[u8], options: &ReadOptions) -> Result<u64, FormatError> {
        // After a power failure, a message may end in zeros.
        let zeros = data.iter().rev().take_while(|&&byte| byte == 0).count();
        let (contents, kept) = match cut_contents(&data[..data.len() - zeros]) {
            Some(contents) => {
                let kept = header_bytes(data).unwrap_or(0) + contents.bytes.len();
                (contents, kept)
            }
            None => {
                let contents = contents_of(data, true, options).0;
                let kept = if contents.index.is_empty() { 0 } else { data.len() };
                (contents, kept)
            }
        };
        if contents.index.is_empty() || !self.knows_channels(&contents) {
            return Ok(data.len() as u64);
        }
        self.take(&contents, options)?;
        self.salvaged = Some(contents);
        Ok(data.len().saturating_sub(kept) as u64)
    }

    /// Returns true if the channels of all messages are known.
    fn knows_channels(&self, contents: &Contents) -> bool {
        contents.index.keys().all(|id| self.channels.contains_key(id) || contents.channels.contains_key(id))
    }

    /// Indexes a chunk, whose message indices follow, or counts it as damaged.
    fn chunk(
        &mut self,
        (at, length): (u64, u64),
        data: &[u8],
        contents: Contents,
        is_whole: bool,
        options: &ReadOptions,
    ) -> Result<(), FormatError> {
        self.missing.clear();
        let header = match parse_record(op::CHUNK, data) {
            Ok(Record::Chunk { header, .. }) if is_whole => header,
            _ => {
                self.damaged_chunks += 1;
                // Later chunks may refer to this chunk's schemas and channels.
                return self.define(&contents, options);
            }
        };
        self.take(&contents, options)?;
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

    /// Registers a message index of the last chunk.
    fn message_index(&mut self, at: u64, length: u64, data: &[u8]) {
        let (Some(chunk), Some(&[low, high])) = (self.chunks.last_mut(), data.first_chunk()) else { return };
        let channel = u16::from_le_bytes([low, high]);
        chunk.message_index_length += RECORD_HEADER + length;
        if self.missing.remove(&channel).is_some() {
            chunk.message_index_offsets.insert(channel, at);
        }
    }

    /// Keeps schemas and channels.
    ///
    /// # Errors
    /// If all schemas and channels kept so far exceed the memory limit.
    fn define(&mut self, contents: &Contents, options: &ReadOptions) -> Result<(), FormatError> {
        let bytes_of =
            |(header, text): &(SchemaHeader, Vec<u8>)| text.len() + header.name.len() + header.encoding.len();
        for (id, schema) in &contents.schemas {
            let replaced = self.schemas.insert(*id, schema.clone());
            self.definitions = self.definitions + bytes_of(schema) - replaced.as_ref().map_or(0, bytes_of);
        }
        for (id, channel) in &contents.channels {
            let replaced = self.channels.insert(*id, channel.clone());
            self.definitions =
                self.definitions + bytes_of_channel(channel) - replaced.as_ref().map_or(0, bytes_of_channel);
        }
        options.check(self.definitions, DEFINITION_COPIES)
    }

    fn take(&mut self, contents: &Contents, options: &ReadOptions) -> Result<(), FormatError> {
        self.define(contents, options)?;
        for (channel, entries) in &contents.index {
            *self.counts.entry(*channel).or_default() += entries.len() as u64;
        }
        self.times = together(self.times, contents.times);
        Ok(())
    }
}

/// Size in bytes of a footer record and the magic bytes after it.
const FOOTER_BYTES: u64 = RECORD_HEADER + 20 + 8;

/// Returns the offset of the summary that the footer states, 0 if there is no summary; `None` without a footer.
fn summary_start(file: &mut File, bytes: u64) -> Result<Option<u64>, FormatError> {
    if bytes < FOOTER_BYTES {
        return Ok(None);
    }
    let mut footer = [0; FOOTER_BYTES as usize];
    file.seek(SeekFrom::Start(bytes - FOOTER_BYTES))?;
    file.read_exact(&mut footer)?;
    let start = footer[RECORD_HEADER as usize..].first_chunk().map(|start| u64::from_le_bytes(*start));
    Ok(start.filter(|_| footer[0] == op::FOOTER && footer.ends_with(&MAGIC)))
}

/// Returns true if the rest of the file consists of zeros.
fn is_zero(file: &mut File) -> Result<bool, FormatError> {
    let mut buffer = vec![0; 1 << 16];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(true),
            read if buffer[..read].iter().all(|&byte| byte == 0) => {}
            _ => return Ok(false),
        }
    }
}

#[cfg(test)]
mod tests;
