//! Point files with records of one size, read and written in batches, for clouds that do not fit in memory.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use super::{Encoding, FormatResult};
use planish_core::PointCloud;

/// Reads the records of a file in their order.
pub(crate) trait RecordReader: Sized {
    /// Description of the records in the file's header. Cheap to clone.
    type Header: Clone;
    type Encoder: RecordEncoder<Header = Self::Header>;

    /// Opens a file, and checks its header against it.
    fn open(path: &Path) -> FormatResult<Self>;

    fn header(&self) -> &Self::Header;

    /// Returns the number of points in the file.
    fn points(&self) -> usize;

    /// Returns the size of a record in bytes.
    fn record(&self) -> usize;

    /// Lists data of the file that its records omit: one clause each, for users.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Reads the next records, at most `most`; returns an empty slice after the last.
    fn next_records(&mut self, most: usize) -> FormatResult<&[u8]>;

    /// Returns true if only the latest version of the format can store the number of records read so far.
    fn needs_latest_version(&self) -> bool;

    /// Returns the coordinates of a record in metres, which are not finite for a hole.
    fn position_m(header: &Self::Header, record: &[u8]) -> [f64; 3];

    /// Returns the cloud of records from a file with this header.
    fn cloud_of(header: &Self::Header, records: &[u8]) -> FormatResult<PointCloud>;
}

/// Converts the points of a cloud to records, and writes records to a file.
pub(crate) trait RecordEncoder: Sized {
    type Header;

    /// True if holes have records.
    const KEEPS_HOLES: bool;

    /// Prepares to encode the `kept` points of clouds with the columns of `cloud`, from a file with this header.
    fn new(
        header: &Self::Header,
        cloud: &PointCloud,
        kept: &[usize],
        output: &Path,
        encoding: Option<Encoding>,
    ) -> FormatResult<Self>;

    /// Converts the header to the latest version of the format.
    fn in_latest_version(self) -> FormatResult<Self>;

    /// Returns the size of a record in bytes.
    fn record(&self) -> usize;

    /// Returns the records of the kept points, one after another.
    fn encode(&self, cloud: &PointCloud, kept: &[usize]) -> FormatResult<Vec<u8>>;

    /// Writes a file of `points` points; `next` returns their records in batches, the last of them empty.
    fn write(self, to: BufWriter<File>, points: usize, next: impl FnMut() -> FormatResult<Vec<u8>>)
    -> FormatResult<()>;
}
