//! Point files with records of a fixed size, read and written in batches, for clouds that do not fit in memory.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use super::{Encoding, FormatResult};
use planish_core::PointCloud;

/// Reads the records of a file, in file order.
pub(crate) trait RecordReader: Sized {
    /// The part of the file's header that describes the records. Cheap to clone.
    type Header: Clone;
    type Encoder: RecordEncoder<Header = Self::Header>;

    /// Opens a file, and checks its header against its contents.
    fn open(path: &Path) -> FormatResult<Self>;

    fn header(&self) -> &Self::Header;

    /// Returns the number of points in the file.
    fn points(&self) -> usize;

    /// Returns the size of a record in bytes.
    fn record(&self) -> usize;

    /// Returns notes for users on data of the file that the records omit, one clause each.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Reads the next records, at most `most`; returns an empty slice after the last record.
    fn next_records(&mut self, most: usize) -> FormatResult<&[u8]>;

    /// Returns true if only the latest version of the format can store the records read so far.
    fn needs_latest_version(&self) -> bool;

    /// Returns the position of a record in metres; it is not finite for a hole.
    fn position_m(header: &Self::Header, record: &[u8]) -> [f64; 3];

    /// Decodes records of a file with this header into a cloud.
    fn cloud_of(header: &Self::Header, records: &[u8]) -> FormatResult<PointCloud>;
}

/// Converts the points of a cloud to records, and writes records to a file.
pub(crate) trait RecordEncoder: Sized {
    type Header;

    /// True if the format has records for holes.
    const KEEPS_HOLES: bool;

    /// Creates an encoder for the `kept` points of clouds that have the columns of `cloud` and come from a file with
    /// this header.
    fn new(
        header: &Self::Header,
        cloud: &PointCloud,
        kept: &[usize],
        output: &Path,
        encoding: Option<Encoding>,
    ) -> FormatResult<Self>;

    /// Changes the header to the latest version of the format.
    fn in_latest_version(self) -> FormatResult<Self>;

    /// Returns the size of a record in bytes.
    fn record(&self) -> usize;

    /// Returns the records of the kept points, one after another.
    fn encode(&self, cloud: &PointCloud, kept: &[usize]) -> FormatResult<Vec<u8>>;

    /// Writes a file of `points` points. `next` returns their records in batches, then an empty batch.
    fn write(self, to: BufWriter<File>, points: usize, next: impl FnMut() -> FormatResult<Vec<u8>>)
    -> FormatResult<()>;
}
