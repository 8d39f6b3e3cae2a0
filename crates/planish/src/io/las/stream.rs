//! The records of a file some at a time, for clouds that do not fit memory.

use std::fmt;
use std::fs::File;
use std::io::{BufReader, Seek, Write};
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
        super::check_transforms(&header)?;
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
pub(crate) struct LasWriter<W: Write + Seek + Send + Sync + fmt::Debug + 'static> {
    /// `None` after an error: the library panics if a writer is dropped that it cannot close.
    writer: Option<Writer<W>>,
    header: Header,
}

impl<W: Write + Seek + Send + Sync + fmt::Debug + 'static> LasWriter<W> {
    /// Begins a file with this header, whose count and bounds follow from what is written.
    pub(crate) fn new(to: W, header: Header) -> FormatResult<Self> {
        let writer = Writer::new(to, header.clone()).map_err(written)?;
        Ok(Self { writer: Some(writer), header })
    }

    fn with_writer(&mut self, work: impl FnOnce(&mut Writer<W>) -> las::Result<()>) -> FormatResult<()> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let result = work(writer).map_err(written);
        if result.is_err() {
            std::mem::forget(self.writer.take());
        }
        result
    }

    pub(crate) fn write(&mut self, records: Vec<u8>) -> FormatResult<()> {
        let points = PointDataBuilder::new().for_header(&self.header).build_from_bytes(records).map_err(cannot)?;
        self.with_writer(|writer| writer.write_points(&points))
    }

    /// Writes what stands behind the points, and the header again.
    pub(crate) fn finish(mut self) -> FormatResult<W> {
        self.with_writer(Writer::close)?;
        let writer = self.writer.take().ok_or_else(|| FormatError::Malformed("nothing was written".into()))?;
        writer.into_inner().map_err(cannot)
    }
}

impl<W: Write + Seek + Send + Sync + fmt::Debug + 'static> Drop for LasWriter<W> {
    fn drop(&mut self) {
        // What was begun and is not finished is of no use.
        std::mem::forget(self.writer.take());
    }
}

/// A full disk is no fault of the cloud's.
fn written(error: las::Error) -> FormatError {
    match error {
        las::Error::Io(error) => FormatError::Os(error),
        las::Error::LasZipError(laz::LasZipError::IoError(error)) => FormatError::Os(error),
        error => cannot(error),
    }
}
