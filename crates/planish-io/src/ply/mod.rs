//! PLY, ascii and binary: the vertices with all their numeric properties. Faces and other elements are dropped.
//!
//! A file states a grid in one of two ways. Range scanners and PCL write `obj_info num_cols W` and `obj_info num_rows
//! H`, either with a vertex for every pixel, or with an element `range_grid` that lists the vertex of each pixel that
//! has one. PCL also writes an element [`camera`] with the grid and the sensor's pose.

mod camera;
mod common;
mod encode;
mod header;
#[cfg(feature = "scans")]
mod parts;
mod records;
mod remarks;

use camera::PlyCamera;
use common::{malformed, rename_normals};
pub(super) use encode::encode;
use header::{Element, Header, Kind, Storage};
#[cfg(feature = "scans")]
pub(crate) use parts::PlyReader;
use records::{Layout, pass_over, take_records, take_values};
use remarks::{GRID_INFOS, left_out, remarks_of};

use super::columns::{bytes_per_point, cloud_from_columns, with_values};
use super::{Encoding, Gridded, ReadOptions, quoted, text};
use planish_core::{Attribute, AttributeValues, FormatError, MAX_PIXELS};

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> Result<Gridded, FormatError> {
    let (header, at) = Header::read(bytes)?;
    let Some(vertex) = header.element("vertex") else { return malformed("the PLY has no vertex element") };
    for element in &header.elements {
        check_size(element, bytes.len())?;
        options.check(element.count, 8 * element.properties.len())?;
    }
    let mut columns = empty_columns(vertex);
    if crate::HAS_ROOM {
        options.check(vertex.count, bytes_per_point(&columns))?;
    }
    let Body { cells, camera } = match header.storage {
        Storage::Ascii => read_text(&header, &bytes[at..], &mut columns)?,
        _ => read_binary(&header, &bytes[at..], &mut columns)?,
    };
    let (width, height) = match (info(&header, GRID_INFOS[0]), info(&header, GRID_INFOS[1]), cells) {
        (Some(width), Some(height), _) if width.checked_mul(height) == Some(vertex.count) => (width, height),
        (Some(width), Some(height), Some(cells)) => {
            if width.checked_mul(height) != Some(cells.len()) {
                return malformed(format!(
                    "num_cols x num_rows is {width} x {height}, but range_grid has {} pixels",
                    cells.len()
                ));
            }
            columns = columns.into_iter().map(|column| spread(column, &cells)).collect::<Result<_, _>>()?;
            (width, height)
        }
        (Some(width), Some(height), None) => {
            return malformed(format!(
                "num_cols x num_rows is {width} x {height}, but the file has {} vertices and no range_grid",
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

/// Index of the vertex of each pixel, if the file has an element `range_grid`.
type Cells = Option<Vec<Option<usize>>>;

/// Data after the header, other than vertices.
#[derive(Default)]
struct Body {
    cells: Cells,
    camera: PlyCamera,
}

/// Iterates over the elements up to the last one of interest, each with a flag that is true if the element must be
/// complete. Elements after the vertices and their grid may be truncated, since a camera is optional.
fn elements_to_read(header: &Header) -> impl Iterator<Item = (&Element, bool)> {
    let last = |names: &[&str]| {
        header.elements.iter().rposition(|element| names.contains(&element.name.as_str())).unwrap_or(0)
    };
    let (needed, last) = (last(&["vertex", "range_grid"]), last(&["vertex", "range_grid", "camera"]));
    header.elements.iter().enumerate().take(last + 1).map(move |(i, element)| (element, i <= needed))
}

/// Reads a text body.
fn read_text(header: &Header, body: &[u8], columns: &mut [Attribute]) -> Result<Body, FormatError> {
    let mut body = text::Body::new(body)?;
    let mut found = Body::default();
    for (element, is_needed) in elements_to_read(header) {
        match read_text_element(element, &mut body, columns, &mut found) {
            Err(error) if is_needed => return Err(error),
            Err(_) => break,
            Ok(()) => {}
        }
    }
    Ok(found)
}

fn read_text_element(
    element: &Element,
    body: &mut text::Body<'_>,
    columns: &mut [Attribute],
    found: &mut Body,
) -> Result<(), FormatError> {
    let name = element.name.as_str();
    if name == "vertex" {
        if !element.has_lists() {
            return body.read(columns, element.count);
        }
        let scalars = records::text_without_lists(element, body)?;
        return text::Body::new(scalars.as_bytes())?.read(columns, element.count);
    }
    let mut cells = Vec::new();
    for _ in 0..element.count {
        let (_, line) = body
            .line()
            .ok_or_else(|| FormatError::Malformed(format!("the file is truncated: it ends within element {name}")))?;
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

/// Reads a binary body.
fn read_binary(header: &Header, mut body: &[u8], columns: &mut [Attribute]) -> Result<Body, FormatError> {
    let mut found = Body::default();
    for (element, is_needed) in elements_to_read(header) {
        if element.name == "vertex" {
            if let Some(layout) = Layout::of(element) {
                let records = take_records(&layout, element.count, header.storage, &mut body)?;
                layout.append(columns, &records)?;
                continue;
            }
            let scalars = records::without_lists(element, header.storage, &mut body)?;
            let layout = Layout::of_scalars(element);
            layout.append(columns, &take_records(&layout, element.count, header.storage, &mut &scalars[..])?)?;
            continue;
        }
        match read_binary_element(element, header.storage, &mut body, &mut found) {
            Err(error) if is_needed => return Err(error),
            Err(_) => break,
            Ok(()) => {}
        }
    }
    Ok(found)
}

fn read_binary_element(
    element: &Element,
    storage: Storage,
    body: &mut &[u8],
    found: &mut Body,
) -> Result<(), FormatError> {
    if !["range_grid", "camera"].contains(&element.name.as_str()) {
        return (0..element.count).try_for_each(|_| pass_over(element, storage, body));
    }
    let (mut cells, mut numbers) = (Vec::new(), Vec::new());
    for _ in 0..element.count {
        let mut cell = None;
        take_values(element, storage, body, |property, values| match element.name.as_str() {
            "range_grid" if property == 0 => {
                cell = Some(values.iter().map(|index| *index as usize).collect::<Vec<_>>())
            }
            "camera" => numbers.push(if let [value] = values { *value } else { f64::NAN }),
            _ => {}
        })?;
        if let Some(indices) = cell {
            cells.push(cell_of(Some(&indices))?);
        }
    }
    match element.name.as_str() {
        "range_grid" => found.cells = Some(cells),
        "camera" => found.camera = PlyCamera::of(element, &numbers),
        _ => {}
    }
    Ok(())
}

/// Decodes the element `camera`, which starts at the beginning of `bytes`.
#[cfg(feature = "scans")]
fn read_camera(header: &Header, mut bytes: &[u8]) -> Result<PlyCamera, FormatError> {
    let mut found = Body::default();
    let Some(element) = header.element("camera") else { return Ok(PlyCamera::default()) };
    match header.storage {
        Storage::Ascii => read_text_element(element, &mut text::Body::new(bytes)?, &mut [], &mut found)?,
        storage => read_binary_element(element, storage, &mut bytes, &mut found)?,
    }
    Ok(found.camera)
}

/// Returns the vertex listed for a cell of the grid, if any.
fn cell_of(indices: Option<&[usize]>) -> Result<Option<usize>, FormatError> {
    match indices {
        Some([]) => Ok(None),
        Some([index]) => Ok(Some(*index)),
        _ => malformed("range_grid must list at most one vertex per pixel"),
    }
}

/// Returns the number in the first line `obj_info key number`.
fn info(header: &Header, key: &str) -> Option<usize> {
    let number = |line: &String| line.trim().strip_prefix(key)?.trim().parse().ok();
    header.obj_infos.iter().find_map(number)
}

/// Returns the encoding that a file's header states. Big-endian files count as binary, and are written as
/// little-endian.
pub(super) fn encoding(bytes: &[u8]) -> Option<Encoding> {
    match header::stated_storage(bytes)? {
        Storage::Ascii => Some(Encoding::Ascii),
        _ => Some(Encoding::Binary),
    }
}

/// Returns an error if the file is too small for the stated number of items. Call it before allocating memory for them.
fn check_size(element: &Element, file_bytes: usize) -> Result<(), FormatError> {
    if element.count > MAX_PIXELS || element.count > file_bytes {
        return malformed(format!(
            "the file is truncated: its header states {} items of element {}, but the file has {file_bytes} bytes",
            element.count,
            quoted(&element.name)
        ));
    }
    Ok(())
}

/// Returns an empty column for each property that is a number, not a list.
fn empty_columns(vertex: &Element) -> Vec<Attribute> {
    let column = |property: &header::Property| match property.kind {
        Kind::Scalar(scalar) => Some(Attribute { name: property.name.clone(), count: 1, values: scalar.empty() }),
        Kind::List { .. } => None,
    };
    vertex.properties.iter().filter_map(column).collect()
}

/// Spreads the vertices' values over the pixels of the grid; pixels without a vertex become holes.
fn spread(column: Attribute, cells: &[Option<usize>]) -> Result<Attribute, FormatError> {
    fn on_grid<T: Copy>(values: &[T], hole: T, cells: &[Option<usize>]) -> Result<Vec<T>, FormatError> {
        let value = |cell: &Option<usize>| cell.map_or(Some(hole), |index| values.get(index).copied());
        let found: Option<Vec<T>> = cells.iter().map(value).collect();
        found.ok_or_else(|| FormatError::Malformed("range_grid refers to a vertex that does not exist".into()))
    }
    let values = match &column.values {
        AttributeValues::F32(values) => on_grid(values, f32::NAN, cells)?.into(),
        AttributeValues::F64(values) => on_grid(values, f64::NAN, cells)?.into(),
        values => with_values!(values, values => on_grid(values, Default::default(), cells)?.into()),
    };
    Ok(Attribute { values, ..column })
}
