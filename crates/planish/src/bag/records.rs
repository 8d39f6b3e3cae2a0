//! The records of a recording, one after another.

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek};
use std::path::Path;

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use mcap::{McapError, Summary};

use super::of_mcap;
use crate::error::{FormatError, IoError};
use crate::io::ReadOptions;

/// Bytes that are read at once, however many a record is said to have.
const READ_BYTES: usize = 1 << 20;

/// What comes next in a recording.
pub(super) enum Next {
    /// A record of its data section.
    Record(Record<'static>),
    /// The end of the data.
    End,
    /// The file ends in the middle of it.
    CutOff,
}

/// Reads the data section of a recording, chunks decompressed.
pub(super) struct Records {
    file: BufReader<File>,
    reader: LinearReader,
}

impl Records {
    pub(super) fn open(path: &Path, options: &ReadOptions) -> Result<Self, IoError> {
        let file = File::open(path).map_err(|error| IoError { path: path.to_path_buf(), problem: error.into() })?;
        let limit = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
        let options = LinearReaderOptions::default().with_validate_chunk_crcs(true).with_record_length_limit(limit);
        Ok(Self { file: BufReader::new(file), reader: LinearReader::new_with_options(options) })
    }

    /// The next record; those that index others are left out.
    pub(super) fn next(&mut self) -> Result<Next, FormatError> {
        loop {
            let Some(event) = self.reader.next_event() else { return Ok(Next::End) };
            match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let to = self.reader.insert(wanted.min(READ_BYTES));
                    let read = read_some(&mut self.file, to)?;
                    self.reader.notify_read(read);
                }
                Ok(LinearReadEvent::Record { opcode: op::DATA_END | op::FOOTER, .. }) => return Ok(Next::End),
                Ok(LinearReadEvent::Record { opcode: op::MESSAGE_INDEX, .. }) => {}
                Ok(LinearReadEvent::Record { opcode, data }) => {
                    return Ok(Next::Record(mcap::parse_record(opcode, data).map_err(of_mcap)?.into_owned()));
                }
                Err(McapError::UnexpectedEof) => return Ok(Next::CutOff),
                Err(error) => return Err(of_mcap(error)),
            }
        }
    }
}

fn read_some(file: &mut impl Read, to: &mut [u8]) -> std::io::Result<usize> {
    loop {
        match file.read(to) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            read => return read,
        }
    }
}

/// What a recording says about itself at its end; `None` if it has no such part, or a damaged one.
pub(super) fn summary(path: &Path, options: &ReadOptions) -> Option<Summary> {
    let mut file = File::open(path).ok()?;
    let limit = usize::try_from(options.max_memory_bytes).unwrap_or(usize::MAX);
    let options =
        SummaryReaderOptions::default().with_file_size(file.metadata().ok()?.len()).with_record_length_limit(limit);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            SummaryReadEvent::ReadRequest(wanted) => {
                let read = read_some(&mut file, reader.insert(wanted)).ok()?;
                reader.notify_read(read);
            }
            SummaryReadEvent::SeekRequest(to) => {
                let at = file.seek(to).ok()?;
                reader.notify_seeked(at);
            }
        }
    }
    reader.finish()
}
