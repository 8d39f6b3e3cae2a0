//! Reads the records of a recording one after another.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::parts::{Numbers, parts_of};
use super::{decompress, of_mcap};
use planish_core::{FormatError, IoError};
use planish_io::ReadOptions;
use planish_io::internal::{guarded, quoted};

/// Maximum number of bytes to read at once, whatever length a record claims.
const READ_BYTES: usize = 1 << 20;

/// Next item of a recording.
pub(super) enum Next {
    /// A record.
    Record(Record<'static>),
    /// The end of a chunk with a wrong checksum. Its records, which were already returned, may be damaged.
    DamagedChunk,
    /// The end of the data section, or of the summary.
    End,
    /// The file ends in the middle of the section.
    CutOff,
    /// The rest of a file cannot be read, for the given reason; another file follows.
    DamagedFile(String),
}

/// A reader of a recording's data section, with chunks decompressed, or of its summary.
pub(super) struct Records {
    file: BufReader<File>,
    reader: LinearReader,
    options: ReadOptions,
    path: PathBuf,
    /// Number of bytes read from all files.
    read_bytes: u64,
    /// Number of records found in all files.
    count: u64,
    /// Files still to be read.
    rest: std::vec::IntoIter<PathBuf>,
    numbers: Numbers,
}

impl Records {
    /// Opens a recording at its beginning. Its files are read one after another.
    pub(super) fn open(path: &Path, options: &ReadOptions) -> Result<Self, IoError> {
        let opened = || -> Result<_, FormatError> {
            let mut rest = parts_of(path)?.into_iter();
            let first = rest.next().unwrap_or_else(|| path.to_path_buf());
            let (file, reader) = open_data(&first, options)?;
            Ok(Self {
                file,
                reader,
                options: *options,
                path: first,
                read_bytes: 0,
                count: 0,
                rest,
                numbers: Numbers::default(),
            })
        };
        opened().map_err(IoError::at(path))
    }

    /// Opens a file at its summary; returns `None` if it has no summary or is damaged.
    fn open_summary(path: &Path, options: &ReadOptions, numbers: Numbers) -> Option<Self> {
        /// Size in bytes of the end of a file: the footer's opcode and length, its two offsets and its checksum, and
        /// the magic bytes.
        const FOOTER_BYTES: i64 = 1 + 8 + 20 + 8;
        let mut file = File::open(path).ok()?;
        file.seek(SeekFrom::End(-FOOTER_BYTES)).ok()?;
        let mut footer = [0; FOOTER_BYTES as usize];
        file.read_exact(&mut footer).ok()?;
        let start = u64::from_le_bytes(*footer[9..].first_chunk()?);
        if footer[0] != op::FOOTER || !footer.ends_with(&super::MAGIC) || start == 0 {
            return None;
        }
        file.seek(SeekFrom::Start(start)).ok()?;
        let reader = LinearReader::new_with_options(reader_options(options).with_skip_start_magic(true));
        let (path, rest) = (path.to_path_buf(), Vec::new().into_iter());
        let file = BufReader::new(file);
        Some(Self { file, reader, options: *options, path, read_bytes: 0, count: 0, rest, numbers })
    }

    /// Returns the next item. Message indices are skipped.
    pub(super) fn next(&mut self) -> Result<Next, FormatError> {
        loop {
            let next = match self.next_of_file() {
                Ok(Next::Record(record)) => match self.numbers.renumbered(record, &self.options) {
                    Ok(Some(record)) => return Ok(Next::Record(record)),
                    Ok(None) => continue,
                    Err(error) => Err(error),
                },
                next => next,
            };
            let damage = match &next {
                Ok(Next::End) => None,
                Ok(Next::CutOff) => Some("the recording ends in the middle of a record".to_owned()),
                Err(error) => Some(error.to_string()),
                _ => return next,
            };
            let Some(path) = self.rest.next() else { return next };
            let before = std::mem::replace(&mut self.path, path);
            (self.file, self.reader) = open_data(&self.path, &self.options)?;
            self.numbers.next_file();
            if let Some(damage) = damage {
                let name = before.file_name().unwrap_or_default().to_string_lossy();
                return Ok(Next::DamagedFile(format!("{}: {damage}; the next file was read", quoted(&name))));
            }
        }
    }

    fn next_of_file(&mut self) -> Result<Next, FormatError> {
        loop {
            if self.count > most_records(self.read_bytes) {
                return Err(FormatError::Malformed("damaged: more records than a file of this size can hold".into()));
            }
            // In builds with overflow checks, the reader panics on a record that reaches beyond its chunk.
            let reader = &mut self.reader;
            let next = move || std::convert::identity(reader).next_event();
            let Some(event) = guarded(next) else {
                return Err(beyond_its_chunk());
            };
            let Some(event) = event else { return Ok(Next::End) };
            match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let to = self.reader.insert(wanted.min(READ_BYTES));
                    let read = read_some(&mut self.file, to)?;
                    self.reader.notify_read(read);
                    self.read_bytes += read as u64;
                }
                // No record has type 0: after a power failure, a file may end in zeros.
                Ok(LinearReadEvent::Record { opcode: 0, .. }) => return Ok(Next::CutOff),
                Ok(LinearReadEvent::Record { opcode: op::DATA_END | op::FOOTER, .. }) => return Ok(Next::End),
                Ok(LinearReadEvent::Record { opcode: op::MESSAGE_INDEX, .. }) => self.count += 1,
                // In builds without overflow checks, the reader continues as if the chunk did not end. Only in this
                // case does it return a chunk record.
                Ok(LinearReadEvent::Record { opcode: op::CHUNK, .. }) => return Err(beyond_its_chunk()),
                Ok(LinearReadEvent::Record { opcode, data }) => {
                    self.count += 1;
                    return Ok(Next::Record(parse_record(opcode, data)?.into_owned()));
                }
                Err(McapError::UnexpectedEof) => return Ok(Next::CutOff),
                Err(McapError::BadChunkCrc { .. }) => return Ok(Next::DamagedChunk),
                Err(error) => return Err(of_mcap(error)),
            }
        }
    }
}

/// Returns the maximum plausible number of records in this many bytes of a recording, whose chunks may be compressed.
/// Real messages take more than a byte each; a chunk of zeros could hold billions of empty records.
pub(super) fn most_records(bytes: u64) -> u64 {
    1_000_000 + 16 * bytes
}

/// Opens the data section of a file.
fn open_data(path: &Path, options: &ReadOptions) -> Result<(BufReader<File>, LinearReader), FormatError> {
    let file = File::open(path)?;
    let mut reader = LinearReader::new_with_options(reader_options(options).with_validate_chunk_crcs(true));
    decompress::register(&mut reader).map_err(of_mcap)?;
    Ok((BufReader::new(file), reader))
}

fn beyond_its_chunk() -> FormatError {
    FormatError::Malformed("damaged: a record extends past the end of its chunk".into())
}

/// Returns the options of a reader. They limit a record to half of the allowed memory, since each record is in memory
/// twice: in the reader's buffer and decoded.
fn reader_options(options: &ReadOptions) -> LinearReaderOptions {
    let limit = usize::try_from(options.max_memory_bytes / 2).unwrap_or(usize::MAX);
    LinearReaderOptions::default().with_record_length_limit(limit)
}

fn read_some(file: &mut impl Read, to: &mut [u8]) -> std::io::Result<usize> {
    loop {
        match file.read(to) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            read => return read,
        }
    }
}

/// Parses a record after checking that its parts fit into it.
pub(super) fn parse_record(opcode: u8, data: &[u8]) -> Result<Record<'_>, FormatError> {
    if !lengths_fit(opcode, data) {
        return Err(FormatError::Malformed("damaged: a part is longer than its record".into()));
    }
    mcap::parse_record(opcode, data).map_err(of_mcap)
}

/// Returns true if the texts, tables and data of a record fit into it. The parser does not check this: it would
/// allocate the claimed sizes, or panic.
fn lengths_fit(opcode: u8, data: &[u8]) -> bool {
    /// Skips a text or block that follows its length in four bytes.
    fn skip(data: &[u8]) -> Option<&[u8]> {
        let (length, rest) = data.split_first_chunk::<4>()?;
        rest.get(u32::from_le_bytes(*length) as usize..)
    }
    /// Skips a table whose entries are two texts each.
    fn skip_texts(data: &[u8]) -> Option<&[u8]> {
        let after = skip(data)?;
        let mut table = &data[4..data.len() - after.len()];
        while !table.is_empty() {
            table = skip(skip(table)?)?;
        }
        Some(after)
    }
    /// Skips a table with entries of `bytes` bytes. Returns `None` if the last entry is incomplete: the parser would
    /// read beyond the end of the table.
    fn skip_entries(data: &[u8], bytes: usize) -> Option<&[u8]> {
        let after = skip(data)?;
        (data.len() - after.len() - 4).is_multiple_of(bytes).then_some(after)
    }
    /// Skips the data of an attachment, between its length in eight bytes and its checksum in four bytes.
    fn skip_attached(data: &[u8]) -> Option<&[u8]> {
        let (length, rest) = data.split_first_chunk::<8>()?;
        rest.get(usize::try_from(u64::from_le_bytes(*length)).ok()?.checked_add(4)?..)
    }
    let fits = || match opcode {
        op::HEADER => skip(skip(data)?),
        op::SCHEMA => skip(skip(skip(data.get(2..)?)?)?),
        op::CHANNEL => skip_texts(skip(skip(data.get(4..)?)?)?),
        op::ATTACHMENT => skip_attached(skip(skip(data.get(16..)?)?)?),
        op::METADATA => skip_texts(skip(data)?),
        op::STATISTICS => skip_entries(data.get(42..)?, 10),
        op::CHUNK => skip(data.get(28..)?),
        op::MESSAGE_INDEX => skip_entries(data.get(2..)?, 16),
        op::CHUNK_INDEX => skip(skip_entries(data.get(32..)?, 10)?.get(8..)?),
        op::ATTACHMENT_INDEX => skip(skip(data.get(40..)?)?),
        op::METADATA_INDEX => skip(data.get(16..)?),
        _ => Some(data),
    };
    fits().is_some()
}

/// Summary at the end of a recording.
#[derive(Default)]
pub(super) struct Summary {
    /// Topic and type of each channel.
    pub(super) channels: BTreeMap<u16, (String, String)>,
    /// Name of each schema by ID.
    pub(super) schemas: BTreeMap<u16, String>,
    /// Number of messages per channel, and in total.
    pub(super) messages: Option<(BTreeMap<u16, u64>, u64)>,
    /// Compression of the first chunk.
    pub(super) compression: Option<String>,
    /// Whether the summary lacks a schema or channel of the data.
    pub(super) is_partial: bool,
}

impl Summary {
    /// Reads the summaries of all files; `None` if one is missing or damaged.
    pub(super) fn of(path: &Path, options: &ReadOptions) -> Option<Self> {
        let (mut summary, mut numbers) = (Self::default(), Numbers::default());
        let mut with_counts = 0;
        let files = parts_of(path).ok()?;
        for file in &files {
            let before = summary.messages.take();
            numbers = summary.add(Records::open_summary(file, options, numbers)?)?;
            numbers.next_file();
            with_counts += usize::from(summary.messages.is_some());
            if let (Some((of_channels, all)), Some((before, all_before))) = (&mut summary.messages, before) {
                before.into_iter().for_each(|(id, count)| *of_channels.entry(id).or_default() += count);
                *all += all_before;
            }
        }
        summary.messages = summary.messages.filter(|_| with_counts == files.len());
        Some(summary)
    }

    /// Adds the summary of a file; returns the numbering for the next file, or `None` if the summary is damaged.
    fn add(&mut self, mut records: Records) -> Option<Numbers> {
        let summary = self;
        loop {
            match records.next().ok()? {
                Next::Record(Record::Schema { header, .. }) => {
                    summary.schemas.insert(header.id, header.name);
                }
                Next::Record(Record::Channel(channel)) => {
                    let schema = summary.schemas.get(&channel.schema_id);
                    summary.is_partial |= schema.is_none() && channel.schema_id != 0;
                    let kind = schema.cloned().unwrap_or_default();
                    summary.channels.insert(channel.id, (channel.topic, kind));
                }
                Next::Record(Record::Statistics(statistics)) => {
                    summary.messages = Some((statistics.channel_message_counts, statistics.message_count));
                }
                Next::Record(Record::ChunkIndex(index)) => {
                    summary.compression.get_or_insert(index.compression);
                }
                Next::Record(_) | Next::DamagedChunk => {}
                Next::End => {
                    let of_channels = summary.messages.iter().flat_map(|(of_channels, _)| of_channels.keys());
                    summary.is_partial |= of_channels.into_iter().any(|id| !summary.channels.contains_key(id));
                    return Some(records.numbers);
                }
                Next::CutOff | Next::DamagedFile(_) => return None,
            }
        }
    }
}

/// Returns the compression of the first chunk of a recording: an empty string if a message comes before any chunk,
/// `None` if the recording has neither.
pub(super) fn first_compression(path: &Path) -> Option<String> {
    /// Number of bytes in a chunk record before the name of its compression: two timestamps, the uncompressed size
    /// and the checksum.
    const BEFORE_COMPRESSION: i64 = 8 + 8 + 8 + 4;
    let first = parts_of(path).ok()?.into_iter().next()?;
    let mut file = BufReader::new(File::open(first).ok()?);
    file.seek(SeekFrom::Start(super::MAGIC.len() as u64)).ok()?;
    loop {
        let mut start = [0; 9];
        file.read_exact(&mut start).ok()?;
        let [opcode, length @ ..] = start;
        match opcode {
            op::MESSAGE => return Some(String::new()),
            op::CHUNK => {
                file.seek_relative(BEFORE_COMPRESSION).ok()?;
                let mut length = [0; 4];
                file.read_exact(&mut length).ok()?;
                // Compression names are short.
                let mut name =
                    vec![0; usize::try_from(u32::from_le_bytes(length)).ok().filter(|length| *length < 100)?];
                file.read_exact(&mut name).ok()?;
                return String::from_utf8(name).ok();
            }
            op::DATA_END | op::FOOTER => return None,
            _ => file.seek_relative(i64::try_from(u64::from_le_bytes(length)).ok()?).ok()?,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_whose_entries_reach_beyond_them_are_refused_before_they_are_parsed() {
        let text = |text: &[u8]| [&(text.len() as u32).to_le_bytes(), text].concat();
        let channel =
            |table: &[u8]| [&[1, 0, 0, 0][..], &text(b"/a"), &text(b"cdr"), &text(table), &[0xff; 4]].concat();
        // A name without a value: the parser would read the value's length from beyond the table.
        let name = text(b"");
        let refused = |opcode, data: &[u8]| parse_record(opcode, data).is_err_and(|e| e.to_string().contains("longer"));
        assert!(refused(op::CHANNEL, &channel(&name)));
        assert!(parse_record(op::CHANNEL, &channel(&[&name[..], &name].concat())).is_ok());
        let chunk_index = |table: &[u8]| [&[0; 32][..], &text(table), &[0; 8], &text(b"lz4"), &[0; 16]].concat();
        assert!(refused(op::CHUNK_INDEX, &chunk_index(&[0])));
        assert!(parse_record(op::CHUNK_INDEX, &chunk_index(&[0; 10])).is_ok());
        // The record ends within the attachment's data.
        assert!(refused(op::ATTACHMENT, &[0; 28]));
    }
}
