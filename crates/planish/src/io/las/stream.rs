//! The records of a file some at a time, for clouds that do not fit memory.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;

use las::{Builder, Header, PointData, PointDataBuilder, Reader, Writer};

use super::super::FormatResult;
use super::{Checked, cannot, damaged, format_of, unreadable};
use crate::error::FormatError;

/// Reads records in their order.
pub(crate) struct LasReader {
    reader: Reader,
    header: Arc<Header>,
    points: usize,
    read: usize,
    buffer: PointData,
}

impl LasReader {
    /// Opens a file, and checks its header against it.
    pub(crate) fn open(path: &Path) -> FormatResult<Self> {
        let file = File::open(path)?;
        let head = super::claims::FileBytes::read(&file, 0, 107)
            .ok_or_else(|| FormatError::Malformed("cut off: it is no LAS header".into()))?;
        if !head.starts_with(b"LASF") {
            return Err(FormatError::Malformed("no LAS file: it does not begin with LASF".into()));
        }
        let Checked { points, extended, .. } = Checked::of(&file, format_of(&head))?;
        let opened = catch_unwind(AssertUnwindSafe(|| {
            let reader = Reader::new(BufReader::with_capacity(1 << 20, File::open(path)?))?;
            let mut builder = Builder::from(reader.header().clone());
            builder.evlrs = extended;
            Ok((builder.into_header()?, reader))
        }));
        let (header, reader) = opened.map_err(|_| unreadable())?.map_err(damaged)?;
        let buffer = PointDataBuilder::new().for_header(&header).build();
        Ok(Self { reader, header: Arc::new(header), points, read: 0, buffer })
    }

    pub(crate) fn header(&self) -> &Arc<Header> {
        &self.header
    }

    /// How many points the file has.
    pub(crate) fn points(&self) -> usize {
        self.points
    }

    /// Bytes of a record.
    pub(crate) fn record(&self) -> usize {
        usize::from(self.header.point_format().len())
    }

    /// The next records, at most so many; none after the last.
    pub(crate) fn next_records(&mut self, most: usize) -> FormatResult<&[u8]> {
        let wanted = most.min(self.points - self.read);
        let (reader, buffer) = (&mut self.reader, &mut self.buffer);
        let filled = catch_unwind(AssertUnwindSafe(|| reader.fill_points(wanted as u64, buffer)));
        let found = filled.map_err(|_| unreadable())?.map_err(damaged)? as usize;
        self.read += found;
        if found < wanted {
            return Err(FormatError::Malformed(format!("cut off: {} of {} points", self.read, self.points)));
        }
        Ok(&self.buffer.raw_bytes()[..found * self.record()])
    }
}

/// Writes records in their order.
pub(crate) struct LasWriter {
    writer: Writer<BufWriter<File>>,
    header: Header,
}

impl LasWriter {
    /// Begins a file with this header, whose count and bounds follow from what is written.
    pub(crate) fn new(file: File, header: Header) -> FormatResult<Self> {
        let writer = Writer::new(BufWriter::with_capacity(1 << 20, file), header.clone()).map_err(cannot)?;
        Ok(Self { writer, header })
    }

    pub(crate) fn write(&mut self, records: Vec<u8>) -> FormatResult<()> {
        let points = PointDataBuilder::new().for_header(&self.header).build_from_bytes(records).map_err(cannot)?;
        self.writer.write_points(&points).map_err(cannot)
    }

    /// Writes what stands behind the points, and the header again.
    pub(crate) fn finish(mut self) -> FormatResult<()> {
        self.writer.close().map_err(cannot)?;
        let buffered = self.writer.into_inner().map_err(cannot)?;
        buffered.into_inner().map_err(|error| FormatError::Os(error.into_error()))?;
        Ok(())
    }
}
