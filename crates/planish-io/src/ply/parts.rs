//! Reads and writes PLY files in batches of vertices, for clouds that do not fit in memory.

use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use super::super::columns::{axes_of, cloud_from_columns, with_values};
use super::super::records::{RecordEncoder, RecordReader};
use super::super::{Encoding, FormatResult, text};
use super::camera::PlyCamera;
use super::common::{malformed, rename_normals};
use super::encode::{Around, columns_of, element_of};
use super::header::{Header, MAX_BYTES, Storage};
use super::records::Layout;
use super::remarks::Remarks;
use super::{GRID_INFOS, check_size, empty_columns, info, left_out, read_camera, remarks_of};
use planish_core::{Attribute, FormatError, PointCloud, SensorPose};

/// The part of a PLY header that describes the vertices.
pub(crate) struct VertexHeader {
    storage: Storage,
    layout: Layout,
    /// Columns without values.
    columns: Vec<Attribute>,
    /// Indices of the fields x, y and z in a record.
    axes: [usize; 3],
    pose: SensorPose,
    remarks: Remarks,
    left_out: Vec<String>,
}

/// Reads the vertices of an unorganized cloud in batches.
pub(crate) struct PlyReader {
    header: Arc<VertexHeader>,
    body: BufReader<File>,
    points: usize,
    read: usize,
    buffer: Vec<u8>,
}

/// Maximum length of a vertex's line, in bytes.
const MAX_LINE_BYTES: u64 = 64 * 1024;

impl PlyReader {
    fn next_text(&mut self, wanted: usize) -> FormatResult<()> {
        let values = self.header.columns.len();
        let (mut lines, mut words) = (Vec::new(), 0);
        while words < wanted * values {
            let (before, found) = (lines.len(), self.read + words / values);
            let length = (&mut self.body).take(MAX_LINE_BYTES).read_until(b'\n', &mut lines)?;
            if length as u64 == MAX_LINE_BYTES {
                return malformed(format!("the line of vertex {found} has more than {MAX_LINE_BYTES} bytes"));
            }
            if length == 0 {
                return malformed(format!(
                    "the file is truncated: its header states {} vertices, but {found} follow",
                    self.points
                ));
            }
            words += words_of(&lines[before..]);
        }
        let mut columns = self.header.columns.clone();
        let numbered_from_here = |problem| match problem {
            FormatError::Malformed(text) if self.read > 0 => {
                FormatError::Malformed(format!("after the first {} vertices: {text}", self.read))
            }
            problem => problem,
        };
        let read = |columns: &mut [Attribute]| text::Body::new(&lines)?.read(columns, wanted);
        read(&mut columns).map_err(numbered_from_here)?;
        self.buffer = self.header.layout.encode(&columns, 0..wanted);
        Ok(())
    }

    fn next_binary(&mut self, wanted: usize) -> FormatResult<()> {
        self.buffer.resize(wanted * self.header.layout.record, 0);
        self.body.read_exact(&mut self.buffer)?;
        if self.header.storage == Storage::BigEndian {
            self.header.layout.swap(&mut self.buffer);
        }
        Ok(())
    }
}

/// Returns the number of words in a line.
fn words_of(line: &[u8]) -> usize {
    line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).count()
}

impl RecordReader for PlyReader {
    type Header = Arc<VertexHeader>;
    type Encoder = PlyEncoder;

    fn open(path: &Path) -> FormatResult<Self> {
        let unsupported = |what: &str| Err(FormatError::Unsupported(format!("{what} cannot be smoothed in tiles")));
        let mut file = File::open(path)?;
        let bytes = usize::try_from(file.metadata()?.len()).unwrap_or(usize::MAX);
        let mut head = Vec::new();
        (&mut file).take(MAX_BYTES as u64).read_to_end(&mut head)?;
        let (header, at) = Header::read(&head)?;
        let Some(vertex) = header.elements.first() else { return malformed("the PLY has no elements") };
        if vertex.name != "vertex" {
            return unsupported("a PLY whose first element is not vertex");
        }
        check_size(vertex, bytes)?;
        let mut columns = empty_columns(vertex);
        rename_normals(&mut columns);
        let Some(layout) = Layout::of(vertex) else { return unsupported("a PLY with list properties in its vertices") };
        let axes = axes_of(&columns)?;
        let points = vertex.count;
        let pose = match header.elements.iter().position(|element| element.name == "camera") {
            None => SensorPose::default(),
            Some(1) => {
                let camera = camera_behind(path, at, &layout, points, &header)?;
                if camera.grid.is_some_and(|(width, height)| width.checked_mul(height) == Some(points)) {
                    return unsupported("an organized cloud");
                }
                camera.pose.unwrap_or_default()
            }
            Some(_) => return unsupported("a PLY with other elements before its camera"),
        };
        if info(&header, GRID_INFOS[0]).is_some() || header.element("range_grid").is_some() {
            return unsupported("an organized cloud");
        }
        if header.storage != Storage::Ascii && points.saturating_mul(layout.record) > bytes - at {
            return malformed(format!(
                "the file is truncated: its header states {points} vertices, but the file has {bytes} bytes"
            ));
        }
        let (remarks, left_out) = (remarks_of(&header), left_out(&header));
        let header = VertexHeader { storage: header.storage, layout, columns, axes, pose, remarks, left_out };
        let mut body = BufReader::with_capacity(1 << 20, File::open(path)?);
        body.seek(SeekFrom::Start(at as u64))?;
        Ok(Self { header: Arc::new(header), body, points, read: 0, buffer: Vec::new() })
    }

    fn header(&self) -> &Self::Header {
        &self.header
    }

    fn notes(&self) -> Vec<String> {
        self.header.left_out.clone()
    }

    fn points(&self) -> usize {
        self.points
    }

    fn record(&self) -> usize {
        self.header.layout.record
    }

    fn next_records(&mut self, most: usize) -> FormatResult<&[u8]> {
        let wanted = most.min(self.points - self.read);
        match self.header.storage {
            Storage::Ascii => self.next_text(wanted)?,
            _ => self.next_binary(wanted)?,
        }
        self.read += wanted;
        Ok(&self.buffer)
    }

    fn needs_latest_version(&self) -> bool {
        false
    }

    fn position_m(header: &Self::Header, record: &[u8]) -> [f64; 3] {
        header.axes.map(|axis| header.layout.number(record, axis))
    }

    fn cloud_of(header: &Self::Header, records: &[u8]) -> FormatResult<PointCloud> {
        let mut columns = header.columns.clone();
        header.layout.append(&mut columns, records)?;
        let mut cloud = cloud_from_columns(columns)?;
        cloud.pose = header.pose;
        Ok(cloud)
    }
}

/// Reads the element `camera` that follows the vertices. `vertices_at` is the byte offset of the vertices in the file.
fn camera_behind(
    path: &Path,
    vertices_at: usize,
    layout: &Layout,
    points: usize,
    header: &Header,
) -> FormatResult<PlyCamera> {
    let mut body = BufReader::with_capacity(1 << 20, File::open(path)?);
    if header.storage == Storage::Ascii {
        body.seek(SeekFrom::Start(vertices_at as u64))?;
        let (mut line, mut words) = (Vec::new(), 0);
        while words < points.saturating_mul(layout.values()) {
            line.clear();
            if body.read_until(b'\n', &mut line)? == 0 {
                break;
            }
            words += words_of(&line);
        }
    } else {
        let at = vertices_at as u64 + points as u64 * layout.record as u64;
        body.seek(SeekFrom::Start(at))?;
    }
    let mut behind = Vec::new();
    body.take(MAX_BYTES as u64).read_to_end(&mut behind)?;
    // The camera is optional, as in files that are read at once, so errors in it are ignored.
    Ok(read_camera(header, &behind).unwrap_or_default())
}

/// Converts the points of a cloud to vertices.
pub(crate) struct PlyEncoder {
    encoding: Encoding,
    layout: Layout,
    /// Columns without values.
    columns: Vec<Attribute>,
    pose: SensorPose,
    remarks: Remarks,
}

impl RecordEncoder for PlyEncoder {
    type Header = Arc<VertexHeader>;
    const KEEPS_HOLES: bool = true;

    fn new(
        header: &Self::Header,
        cloud: &PointCloud,
        _kept: &[usize],
        _output: &Path,
        encoding: Option<Encoding>,
    ) -> FormatResult<Self> {
        let own = if header.storage == Storage::Ascii { Encoding::Ascii } else { Encoding::Binary };
        let mut columns = columns_of(cloud)?;
        for column in &mut columns {
            with_values!(&mut column.values, values => values.clear());
        }
        let element = element_of("vertex", 0, &columns);
        let Some(layout) = Layout::of(&element) else { return malformed("vertices have no lists") };
        let (pose, remarks) = (cloud.pose, header.remarks.clone());
        Ok(Self { encoding: encoding.unwrap_or(own), layout, columns, pose, remarks })
    }

    fn in_latest_version(self) -> FormatResult<Self> {
        Ok(self)
    }

    fn record(&self) -> usize {
        self.layout.record
    }

    fn encode(&self, cloud: &PointCloud, kept: &[usize]) -> FormatResult<Vec<u8>> {
        Ok(self.layout.encode(&columns_of(cloud)?, kept.iter().copied()))
    }

    fn write(
        self,
        mut to: BufWriter<File>,
        points: usize,
        mut next: impl FnMut() -> FormatResult<Vec<u8>>,
    ) -> FormatResult<()> {
        let Self { pose, remarks, encoding, .. } = &self;
        let around = Around { grid: None, pose, remarks: Some(remarks), encoding: *encoding };
        let [head, behind] = around.encode(&self.columns, points)?;
        to.write_all(&head)?;
        loop {
            let records = next()?;
            if records.is_empty() {
                break;
            }
            if self.encoding == Encoding::Ascii {
                let mut columns = self.columns.clone();
                self.layout.append(&mut columns, &records)?;
                let mut lines = Vec::new();
                text::write(&columns, records.len() / self.layout.record, &mut lines);
                to.write_all(&lines)?;
            } else {
                to.write_all(&records)?;
            }
        }
        to.write_all(&behind)?;
        to.flush()?;
        Ok(())
    }
}
