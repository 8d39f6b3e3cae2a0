//! Reads and writes the records of LAS and LAZ files in batches, for clouds that do not fit in memory.

use std::fs::File;
use std::io::{BufReader, BufWriter};
use std::path::Path;
use std::sync::Arc;

use las::{Builder, PointData, PointDataBuilder, Reader};

use super::super::format::las_or_laz;
use super::super::records::{RecordEncoder, RecordReader};
use super::super::{Encoding, Format, FormatResult};
use super::errors::{damaged, unreadable};
use super::repair::WithHead;
use super::writer::LasWriter;
use super::{Checked, FileHeader, MOST_RETURNS, Records, identity_of};
use crate::guarded::guarded;
use planish_core::{FormatError, PointCloud};

/// Byte offset, in the point formats before LAS 1.4, of the return number, which is in the lowest three bits.
const RETURNS_AT: usize = 14;

/// Reads point records in file order.
pub(crate) struct LasReader {
    reader: Reader,
    header: Arc<FileHeader>,
    notes: Vec<String>,
    points: usize,
    read: usize,
    has_late_returns: bool,
    buffer: PointData,
}

impl RecordReader for LasReader {
    type Header = Arc<FileHeader>;
    type Encoder = Records;

    fn open(path: &Path) -> FormatResult<Self> {
        let file = File::open(path)?;
        // A file too short for this read is rejected in any case.
        let head = super::validate::FileBytes::read(&file, 0, 107).unwrap_or_default();
        let Checked { points, extended, repaired, .. } = Checked::of(&file, las_or_laz(&head))?;
        let identity = identity_of(&repaired.head);
        let opened = guarded(|| {
            let file = BufReader::with_capacity(1 << 20, File::open(path)?);
            let reader = Reader::new(WithHead::new(repaired.head, file)?)?;
            let mut builder = Builder::from(reader.header().clone());
            builder.evlrs = extended;
            Ok((builder.into_header()?, reader))
        });
        let (header, reader) = opened.ok_or_else(unreadable)?.map_err(damaged)?;
        super::check_transforms(&header)?;
        let buffer = PointDataBuilder::new().for_header(&header).build();
        let header = Arc::new(FileHeader { header, identity });
        let mut notes = repaired.notes;
        notes.extend(super::note_on_heights(&header.header));
        Ok(Self { reader, header, notes, points, read: 0, has_late_returns: false, buffer })
    }

    fn header(&self) -> &Self::Header {
        &self.header
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    fn points(&self) -> usize {
        self.points
    }

    fn record(&self) -> usize {
        usize::from(self.header.header.point_format().len())
    }

    fn next_records(&mut self, most: usize) -> FormatResult<&[u8]> {
        let wanted = most.min(self.points - self.read);
        let (reader, buffer) = (&mut self.reader, &mut self.buffer);
        let filled = guarded(|| reader.fill_points(wanted as u64, buffer));
        let found = filled.ok_or_else(unreadable)?.map_err(damaged)? as usize;
        self.read += found;
        if found < wanted {
            return Err(FormatError::Malformed(format!(
                "the file is truncated: it has {} of {} points",
                self.read, self.points
            )));
        }
        let record = self.record();
        let records = &self.buffer.raw_bytes()[..found * record];
        let is_late = |point: &[u8]| point.get(RETURNS_AT).is_some_and(|returns| returns & 7 > MOST_RETURNS);
        self.has_late_returns |=
            !self.header.header.point_format().is_extended && records.chunks_exact(record).any(is_late);
        Ok(records)
    }

    /// Returns true if points beyond the fifth return were read; headers before LAS 1.4 do not count such points.
    fn needs_latest_version(&self) -> bool {
        self.has_late_returns
    }

    fn position_m(header: &Self::Header, record: &[u8]) -> [f64; 3] {
        let las::Vector { x, y, z } = header.header.transforms();
        [(x, 0), (y, 4), (z, 8)].map(|(transform, at)| {
            transform.direct(i32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]))
        })
    }

    fn cloud_of(header: &Self::Header, records: &[u8]) -> FormatResult<PointCloud> {
        super::cloud_of(Arc::clone(header), records)
    }
}

impl RecordEncoder for Records {
    type Header = Arc<FileHeader>;
    const KEEPS_HOLES: bool = false;

    fn new(
        _header: &Self::Header,
        cloud: &PointCloud,
        kept: &[usize],
        output: &Path,
        _encoding: Option<Encoding>,
    ) -> FormatResult<Self> {
        Self::new(cloud, kept, Format::of_extension(output) == Some(Format::Laz))
    }

    fn in_latest_version(self) -> FormatResult<Self> {
        self.with_all_returns()
    }

    fn record(&self) -> usize {
        self.len()
    }

    fn encode(&self, cloud: &PointCloud, kept: &[usize]) -> FormatResult<Vec<u8>> {
        self.encode(cloud, kept)
    }

    fn write(
        self,
        to: BufWriter<File>,
        _points: usize,
        mut next: impl FnMut() -> FormatResult<Vec<u8>>,
    ) -> FormatResult<()> {
        let mut writer = LasWriter::new(to, self.header, self.identity)?;
        loop {
            let records = next()?;
            if records.is_empty() {
                break;
            }
            writer.write(records)?;
        }
        writer.finish()?.into_inner().map_err(|error| FormatError::Os(error.into_error()))?;
        Ok(())
    }
}
