//! PLY, ascii and binary: the vertices with all their properties. Faces and other elements are not kept.
//!
//! A grid is stated in one of two ways. Range scanners and PCL write `obj_info num_cols W` and `obj_info num_rows H`,
//! with a vertex for every pixel, or with an element `range_grid` that lists the pixels with a vertex. PCL's element
//! [`camera`] states the grid together with the sensor's pose.

mod camera;
mod common;
mod encode;
#[cfg(feature = "scans")]
mod parts;
mod records;
mod remarks;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{ElementDef, Encoding as PlyEncoding, Header, Property, PropertyDef, PropertyType, ScalarType};

use camera::PlyCamera;
use common::{Record, malformed, rename_normals};
pub(super) use encode::encode;
#[cfg(feature = "scans")]
pub(crate) use parts::PlyReader;
use records::{Layout, take_records};
use remarks::{GRID_INFOS, left_out, remarks_of};

use super::columns::{cloud_from_columns, with_values};
use super::{Encoding, Gridded, ReadOptions, brief, quoted, text};
use planish_core::{Attribute, AttributeValues, FormatError, MAX_PIXELS};

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> Result<Gridded, FormatError> {
    let Some(lines) = header_lines(bytes) else {
        return malformed("the PLY header has no end: a line \"end_header\" is missing in its first 64 KiB");
    };
    let stated = stated_properties(&lines);
    let mut reader = Reader::new(bytes);
    let header = Parser::<Record>::new().read_header(&mut reader).map_err(damaged)?;
    let Some(vertex) = header.elements.get("vertex") else { return malformed("the PLY has no element vertex") };
    if stated.len() != header.elements.len() {
        return malformed("two elements of the PLY have the same name");
    }
    for (element, stated) in header.elements.values().zip(stated) {
        check_size(element, bytes.len())?;
        check_properties(element, stated)?;
        let is_read_by_the_library = header.encoding != PlyEncoding::Ascii && element.name != "vertex";
        // The library stores every value of an element as an enum, in one vector per line.
        let [value_bytes, line_bytes] =
            if is_read_by_the_library { [size_of::<Property>() + 8, size_of::<Record>()] } else { [8, 0] };
        options.check(element.count, line_bytes + element.properties.len() * value_bytes)?;
    }
    let mut columns = empty_columns(vertex)?;
    let Body { cells, camera } = match header.encoding {
        PlyEncoding::Ascii => read_text(&header, reader.into_inner(), &mut columns)?,
        _ => read_binary(&header, reader.into_inner(), &mut columns)?,
    };
    let (width, height) = match (info(&header, GRID_INFOS[0]), info(&header, GRID_INFOS[1]), cells) {
        (Some(width), Some(height), _) if width.checked_mul(height) == Some(vertex.count) => (width, height),
        (Some(width), Some(height), Some(cells)) => {
            if width.checked_mul(height) != Some(cells.len()) {
                return malformed(format!("num_cols x num_rows is {width} x {height}, range_grid has {}", cells.len()));
            }
            columns = columns.into_iter().map(|column| spread(column, &cells)).collect::<Result<_, _>>()?;
            (width, height)
        }
        (Some(width), Some(height), None) => {
            return malformed(format!(
                "num_cols x num_rows is {width} x {height}, but there are {} vertices and no range_grid",
                vertex.count
            ));
        }
        _ => {
            let of_camera = camera.grid.filter(|(width, height)| width.checked_mul(*height) == Some(vertex.count));
            of_camera.unwrap_or((vertex.count, 1))
        }
    };
    rename_normals(&mut columns);
    let mut points = cloud_from_columns(columns)?;
    points.pose = camera.pose.unwrap_or_default();
    points.provenance = remarks_of(&header).into_provenance();
    notes.extend(left_out(&header));
    Ok(Gridded { width, height, points })
}

fn damaged(error: impl Into<std::io::Error>) -> FormatError {
    // After this text the library prints its parser's state.
    const STATE: &str = " Error: ";
    let message = error.into().to_string();
    let message = message.split_once(STATE).map_or(message.as_str(), |(message, _)| message);
    FormatError::Malformed(format!("damaged PLY: {}", brief(message.trim())))
}

/// The vertex of each pixel, if there is an element `range_grid`.
type Cells = Option<Vec<Option<usize>>>;

/// Data after the header, other than vertices.
#[derive(Default)]
struct Body {
    cells: Cells,
    camera: PlyCamera,
}

/// Iterates over the elements up to the last one of interest, each with a flag that it must be complete. Elements after
/// the vertices and their grid may be truncated, since a camera is only a hint.
fn elements_to_read(header: &Header) -> impl Iterator<Item = (&str, &ElementDef, bool)> {
    let last = |names: &[&str]| header.elements.keys().rposition(|name| names.contains(&name.as_str())).unwrap_or(0);
    let (needed, last) = (last(&["vertex", "range_grid"]), last(&["vertex", "range_grid", "camera"]));
    let elements = header.elements.iter().enumerate().take(last + 1);
    elements.map(move |(i, (name, element))| (name.as_str(), element, i <= needed))
}

/// Reads a text body without the library, whose grammar lacks `nan` and `inf`, as holes are written.
fn read_text(header: &Header, body: &[u8], columns: &mut [Attribute]) -> Result<Body, FormatError> {
    let mut body = text::Body::new(body)?;
    let mut found = Body::default();
    for (name, element, is_needed) in elements_to_read(header) {
        match read_text_element(name, element, &mut body, columns, &mut found) {
            Err(error) if is_needed => return Err(error),
            Err(_) => break,
            Ok(()) => {}
        }
    }
    Ok(found)
}

fn read_text_element(
    name: &str,
    element: &ElementDef,
    body: &mut text::Body<'_>,
    columns: &mut [Attribute],
    found: &mut Body,
) -> Result<(), FormatError> {
    if name == "vertex" {
        return body.read(columns, element.count);
    }
    let mut cells = Vec::new();
    for _ in 0..element.count {
        let (_, line) =
            body.line().ok_or_else(|| FormatError::Malformed(format!("the file ends within element {name}")))?;
        let words = line.split_ascii_whitespace();
        if name == "range_grid" {
            let words: Option<Vec<usize>> = words.map(|word| word.parse().ok()).collect();
            cells.push(cell_of(words.as_deref().and_then(<[usize]>::split_first).map(|(_, indices)| indices))?);
        } else if name == "camera" {
            let values: Vec<f64> = words.map(|word| word.parse().unwrap_or(f64::NAN)).collect();
            found.camera = PlyCamera::of(element, &values);
        }
    }
    if name == "range_grid" {
        found.cells = Some(cells);
    }
    Ok(())
}

/// Reads a binary body. The vertices bypass the library, which needs about ten times their memory.
fn read_binary(header: &Header, mut body: &[u8], columns: &mut [Attribute]) -> Result<Body, FormatError> {
    let mut found = Body::default();
    for (name, element, is_needed) in elements_to_read(header) {
        if name == "vertex" {
            // `empty_columns` has refused lists.
            let Some(layout) = Layout::of(element) else { return malformed("a vertex property is a list") };
            let records = take_records(&layout, element.count, header.encoding, &mut body)?;
            layout.append(columns, &records)?;
            continue;
        }
        match read_binary_element(name, element, header, &mut body, &mut found) {
            Err(error) if is_needed => return Err(error),
            Err(_) => break,
            Ok(()) => {}
        }
    }
    Ok(found)
}

fn read_binary_element(
    name: &str,
    element: &ElementDef,
    header: &Header,
    body: &mut &[u8],
    found: &mut Body,
) -> Result<(), FormatError> {
    let mut reader = Reader::new(*body);
    let records = Parser::<Record>::new().read_payload_for_element(&mut reader, element, header).map_err(damaged)?;
    *body = reader.into_inner();
    if name == "range_grid" {
        let cell = |record: &Record| {
            let indices = record.0.first().and_then(Property::to_u32_list);
            let indices: Option<Vec<usize>> = indices.map(|list| list.iter().map(|&i| i as usize).collect());
            cell_of(indices.as_deref())
        };
        found.cells = Some(records.iter().map(cell).collect::<Result<_, _>>()?);
    } else if name == "camera" {
        let values: Vec<f64> =
            records.first().into_iter().flat_map(|record| record.0.iter().map(camera::number)).collect();
        found.camera = PlyCamera::of(element, &values);
    }
    Ok(())
}

/// Decodes the element `camera`, which starts at the first of these bytes.
#[cfg(feature = "scans")]
fn read_camera(header: &Header, mut bytes: &[u8]) -> Result<PlyCamera, FormatError> {
    let mut found = Body::default();
    let Some(element) = header.elements.get("camera") else { return Ok(PlyCamera::default()) };
    if header.encoding == PlyEncoding::Ascii {
        read_text_element("camera", element, &mut text::Body::new(bytes)?, &mut [], &mut found)?;
    } else {
        read_binary_element("camera", element, header, &mut bytes, &mut found)?;
    }
    Ok(found.camera)
}

/// Returns the vertex that a cell of the grid lists, if any.
fn cell_of(indices: Option<&[usize]>) -> Result<Option<usize>, FormatError> {
    match indices {
        Some([]) => Ok(None),
        Some([index]) => Ok(Some(*index)),
        _ => malformed("range_grid must list at most one vertex per pixel"),
    }
}

/// Returns the number in a line `obj_info key number`.
fn info(header: &Header, key: &str) -> Option<usize> {
    let number = |line: &String| line.trim().strip_prefix(key)?.trim().parse().ok();
    header.obj_infos.iter().find_map(number)
}

/// The largest header accepted, in bytes; real ones have a few hundred.
const MAX_HEADER_BYTES: usize = 64 * 1024;

/// Returns the lines of the header, up to `end_header`; `None` if that is missing.
fn header_lines(bytes: &[u8]) -> Option<Vec<&str>> {
    let bytes = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
    let mut lines = Vec::new();
    for line in bytes.split(|&byte| byte == b'\n') {
        match std::str::from_utf8(line).unwrap_or_default().trim() {
            "end_header" => return Some(lines),
            line => lines.push(line),
        }
    }
    None
}

/// Returns the encoding that a header states; big-endian files are binary, and written as little-endian.
pub(super) fn encoding(bytes: &[u8]) -> Option<Encoding> {
    let stated = header_lines(bytes)?.into_iter().find_map(|line| line.strip_prefix("format "))?;
    Some(if stated.trim_start().starts_with("ascii") { Encoding::Ascii } else { Encoding::Binary })
}

/// Returns the number of properties of each element, in order.
fn stated_properties(header_lines: &[&str]) -> Vec<usize> {
    let mut counts = Vec::new();
    for line in header_lines {
        match line.split_ascii_whitespace().next() {
            Some("element") => counts.push(0),
            Some("property") => counts.iter_mut().last().into_iter().for_each(|count| *count += 1),
            _ => {}
        }
    }
    counts
}

/// Refuses elements that the library would read wrongly. Of several properties with the same name it keeps one and
/// misreads the bytes of the others; an element without properties has no bytes, whatever its count.
fn check_properties(element: &ElementDef, stated: usize) -> Result<(), FormatError> {
    if stated != element.properties.len() {
        return malformed(format!("two properties of element {} have the same name", quoted(&element.name)));
    }
    if stated == 0 && (element.count > 0 || element.name == "vertex") {
        return malformed(format!("element {} has no properties", quoted(&element.name)));
    }
    Ok(())
}

/// Refuses counts that the file cannot hold, before anything is allocated for them.
fn check_size(element: &ElementDef, file_bytes: usize) -> Result<(), FormatError> {
    if element.count > MAX_PIXELS || element.count > file_bytes {
        return malformed(format!(
            "the file is truncated: its header states {} of element {} in {file_bytes} bytes",
            element.count,
            quoted(&element.name)
        ));
    }
    Ok(())
}

fn empty_columns(vertex: &ElementDef) -> Result<Vec<Attribute>, FormatError> {
    let column = |(name, property): (&String, &PropertyDef)| {
        let values = match property.data_type {
            PropertyType::Scalar(ScalarType::Char) => AttributeValues::I8(Vec::new()),
            PropertyType::Scalar(ScalarType::UChar) => AttributeValues::U8(Vec::new()),
            PropertyType::Scalar(ScalarType::Short) => AttributeValues::I16(Vec::new()),
            PropertyType::Scalar(ScalarType::UShort) => AttributeValues::U16(Vec::new()),
            PropertyType::Scalar(ScalarType::Int) => AttributeValues::I32(Vec::new()),
            PropertyType::Scalar(ScalarType::UInt) => AttributeValues::U32(Vec::new()),
            PropertyType::Scalar(ScalarType::Float) => AttributeValues::F32(Vec::new()),
            PropertyType::Scalar(ScalarType::Double) => AttributeValues::F64(Vec::new()),
            PropertyType::List(..) => {
                return Err(FormatError::Unsupported(format!(
                    "the vertex property {} is a list; only scalars are supported",
                    quoted(name)
                )));
            }
        };
        Ok(Attribute { name: name.clone(), count: 1, values })
    };
    vertex.properties.iter().map(column).collect()
}

/// Puts the values of the vertices on the grid.
fn spread(column: Attribute, cells: &[Option<usize>]) -> Result<Attribute, FormatError> {
    fn on_grid<T: Copy>(values: &[T], hole: T, cells: &[Option<usize>]) -> Result<Vec<T>, FormatError> {
        let value = |cell: &Option<usize>| cell.map_or(Some(hole), |index| values.get(index).copied());
        let found: Option<Vec<T>> = cells.iter().map(value).collect();
        found.ok_or_else(|| FormatError::Malformed("range_grid names a missing vertex".into()))
    }
    let values = match &column.values {
        AttributeValues::F32(values) => on_grid(values, f32::NAN, cells)?.into(),
        AttributeValues::F64(values) => on_grid(values, f64::NAN, cells)?.into(),
        values => with_values!(values, values => on_grid(values, Default::default(), cells)?.into()),
    };
    Ok(Attribute { values, ..column })
}
