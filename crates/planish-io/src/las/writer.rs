//! Writes LAS records.

use std::fmt;
use std::io::{Seek, SeekFrom, Write};

use las::{Header, PointDataBuilder, Writer};

use super::Identity;
use super::errors::cannot;
use super::repair::IDENTITY;
use crate::FormatResult;
use planish_core::FormatError;

/// Writes point records in the given order.
pub(super) struct LasWriter<W: Write + Seek + Send + Sync + fmt::Debug + 'static> {
    /// `None` after an error, because the las crate panics if it drops a writer that it cannot close.
    writer: Option<Writer<W>>,
    header: Header,
    identity: Option<Identity>,
}

impl<W: Write + Seek + Send + Sync + fmt::Debug + 'static> LasWriter<W> {
    /// Begins a file with this header. The number of points and the bounds in the header are updated from the written
    /// points.
    pub(super) fn new(to: W, header: Header, identity: Option<Identity>) -> FormatResult<Self> {
        let writer = Writer::new(to, header.clone()).map_err(written)?;
        Ok(Self { writer: Some(writer), header, identity })
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

    /// Writes the data that follow the points, and rewrites the header.
    pub(super) fn finish(mut self) -> FormatResult<W> {
        self.with_writer(Writer::close)?;
        let writer = self.writer.take().ok_or_else(|| FormatError::Malformed("nothing was written".into()))?;
        let mut to = writer.into_inner().map_err(cannot)?;
        if let Some(identity) = self.identity {
            to.seek(SeekFrom::Start(IDENTITY.start as u64))?;
            to.write_all(&identity)?;
            to.seek(SeekFrom::End(0))?;
        }
        Ok(to)
    }
}

impl<W: Write + Seek + Send + Sync + fmt::Debug + 'static> Drop for LasWriter<W> {
    fn drop(&mut self) {
        // Discard an unfinished file.
        std::mem::forget(self.writer.take());
    }
}

/// Converts an error of the las writer. I/O errors, such as a full disk, become [`FormatError::Os`], because the cloud
/// did not cause them.
fn written(error: las::Error) -> FormatError {
    match error {
        las::Error::Io(error) => FormatError::Os(error),
        las::Error::LasZipError(laz::LasZipError::IoError(error)) => FormatError::Os(error),
        error => cannot(error),
    }
}
