//! Writing LAS records.

use std::fmt;
use std::io::{Seek, Write};

use las::{Header, PointDataBuilder, Writer};

use super::errors::cannot;
use crate::FormatResult;
use planish_core::FormatError;

/// Writes records in their order.
pub(super) struct LasWriter<W: Write + Seek + Send + Sync + fmt::Debug + 'static> {
    /// `None` after an error: the library panics if a writer is dropped that it cannot close.
    writer: Option<Writer<W>>,
    header: Header,
}

impl<W: Write + Seek + Send + Sync + fmt::Debug + 'static> LasWriter<W> {
    /// Begins a file with this header, whose count and bounds follow from what is written.
    pub(super) fn new(to: W, header: Header) -> FormatResult<Self> {
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

    pub(super) fn write(&mut self, records: Vec<u8>) -> FormatResult<()> {
        let points = PointDataBuilder::new().for_header(&self.header).build_from_bytes(records).map_err(cannot)?;
        self.with_writer(|writer| writer.write_points(&points))
    }

    /// Writes what stands behind the points, and the header again.
    pub(super) fn finish(mut self) -> FormatResult<W> {
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
