//! Encodes clouds as PLY files.

use super::camera::PlyCamera;
use super::common::{NORMALS, malformed};
use super::header::{Element, Header, Kind, Property, Scalar, Storage};
use super::records::Layout;
use super::remarks::{GRID_INFOS, Remarks};
use crate::columns::{EXACT_INTEGERS, columns_from_cloud, with_values};
use crate::{CloudRef, Encoding, quoted, text};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud, SensorPose};

pub(crate) fn encode(cloud: CloudRef<'_>, encoding: Encoding) -> Result<Vec<u8>, FormatError> {
    let columns = columns_of(cloud.points())?;
    let PointCloud { pose, provenance, .. } = cloud.points();
    let remarks = provenance.get::<Remarks>();
    let points = cloud.points().len();
    let grid = matches!(cloud, CloudRef::Organized(_)).then(|| cloud.grid());
    let [mut bytes, behind] = Around { grid, pose, remarks, encoding }.encode(&columns, points)?;
    bytes.extend(encode_rows(&columns, points, encoding)?);
    bytes.extend(behind);
    Ok(bytes)
}

/// Returns the columns of a cloud under PLY's names, or an error if two names are equal.
pub(super) fn columns_of(cloud: &PointCloud) -> Result<Vec<Attribute>, FormatError> {
    let mut columns = columns_from_cloud(cloud);
    let has = |columns: &[Attribute], name: &str| columns.iter().any(|column| column.name == name);
    if NORMALS.iter().all(|(_, pcl)| has(&columns, pcl)) {
        // Files written by an earlier version of planish have both names; the values under PCL's names are newer.
        columns.retain(|column| NORMALS.iter().all(|(ply, _)| column.name != *ply));
        for (ply, pcl) in NORMALS {
            columns.iter_mut().filter(|column| column.name == pcl).for_each(|column| column.name = ply.to_owned());
        }
    }
    let parts = columns.into_iter().map(ply_columns);
    let mut columns = parts.collect::<Result<Vec<_>, _>>()?.concat();
    for (number, column) in (1..).zip(&mut columns) {
        // White space would end the name.
        let words: Vec<&str> = column.name.split_whitespace().collect();
        column.name = if words.is_empty() { format!("column_{number}") } else { words.join("_") };
    }
    let is_repeated = |(k, column): (usize, &Attribute)| columns[..k].iter().any(|other| other.name == column.name);
    if columns.iter().enumerate().any(is_repeated) {
        return Err(FormatError::Unsupported(
            "two fields have the same name, but names in a PLY must be unique; rename one of them".into(),
        ));
    }
    Ok(columns)
}

/// The contents of a file before and after its vertices.
pub(super) struct Around<'a> {
    pub(super) grid: Option<(usize, usize)>,
    pub(super) pose: &'a SensorPose,
    pub(super) remarks: Option<&'a Remarks>,
    pub(super) encoding: Encoding,
}

impl Around<'_> {
    /// Encodes the header for `points` vertices with these columns, and the camera, which follows the vertices and is
    /// empty without a pose.
    pub(super) fn encode(&self, columns: &[Attribute], points: usize) -> Result<[Vec<u8>; 2], FormatError> {
        let &Self { grid, pose, remarks, encoding } = self;
        let camera =
            if pose.is_identity() { Vec::new() } else { PlyCamera::columns(pose, grid.unwrap_or((points, 1))) };
        let storage = match encoding {
            Encoding::Ascii => Storage::Ascii,
            Encoding::Binary | Encoding::BinaryCompressed => Storage::LittleEndian,
        };
        let Remarks { comments, mut obj_infos } = remarks.cloned().unwrap_or_default();
        if let Some((width, height)) = grid {
            let stated = GRID_INFOS.iter().zip([width, height]).map(|(key, number)| format!("{key} {number}"));
            obj_infos.extend(stated);
        }
        let mut elements = vec![element_of("vertex", points, columns)];
        if !camera.is_empty() {
            elements.push(element_of("camera", 1, &camera));
        }
        let before = Header { storage, elements, comments, obj_infos }.to_text().into_bytes();
        let behind = if camera.is_empty() { Vec::new() } else { encode_rows(&camera, 1, encoding)? };
        Ok([before, behind])
    }
}

/// Encodes the rows of the columns, as lines of text or as binary records.
fn encode_rows(columns: &[Attribute], rows: usize, encoding: Encoding) -> Result<Vec<u8>, FormatError> {
    if encoding == Encoding::Ascii {
        let mut lines = Vec::new();
        text::write(columns, rows, &mut lines);
        return Ok(lines);
    }
    match Layout::of(&element_of("rows", rows, columns)) {
        Some(layout) => Ok(layout.encode(columns, 0..rows)),
        None => malformed("a field is a list"),
    }
}

/// Returns the definition of an element that has these columns as properties.
pub(super) fn element_of(name: &str, count: usize, columns: &[Attribute]) -> Element {
    // White space would end the name.
    let name_of = |column: &Attribute| column.name.split_whitespace().collect::<Vec<_>>().join("_");
    let property =
        |column: &Attribute| Property { name: name_of(column), kind: Kind::Scalar(Scalar::of_values(&column.values)) };
    Element { name: name.into(), count, properties: columns.iter().map(property).collect() }
}

/// Converts a column to columns that PLY can store: one property per value, no padding, and no 64-bit integers.
fn ply_columns(column: Attribute) -> Result<Vec<Attribute>, FormatError> {
    if column.name == "_" {
        return Ok(Vec::new());
    }
    let count = column.count;
    let rounded = || {
        FormatError::Unsupported(format!(
            "the field {} has 64-bit integers, which PLY would round; write .pcd",
            quoted(&column.name)
        ))
    };
    let values = match &column.values {
        AttributeValues::I64(values) => {
            let exact = |&value: &i64| (value.unsigned_abs() <= EXACT_INTEGERS).then_some(value as f64);
            values.iter().map(exact).collect::<Option<Vec<f64>>>().ok_or_else(rounded)?.into()
        }
        AttributeValues::U64(values) => {
            let exact = |&value: &u64| (value <= EXACT_INTEGERS).then_some(value as f64);
            values.iter().map(exact).collect::<Option<Vec<f64>>>().ok_or_else(rounded)?.into()
        }
        values => values.clone(),
    };
    if count == 1 {
        return Ok(vec![Attribute { values, ..column }]);
    }
    let part = |k: usize| {
        let values =
            with_values!(&values, values => values.iter().skip(k).step_by(count).copied().collect::<Vec<_>>().into());
        Attribute { name: format!("{}_{k}", column.name), count: 1, values }
    };
    Ok((0..count).map(part).collect())
}
