//! Reads and writes ASTM E57. All scans of a file become one cloud in the file's frame, in which each point stores the
//! number of its scan.
//!
//! A scan's metadata (name, pose, sensor, times) are stored with the cloud and written back. Spherical coordinates
//! become Cartesian. Images are dropped, and so is all data of extensions except point fields.

mod scans;

use std::collections::HashMap;
use std::io::Cursor;

use e57::{E57Reader, E57Writer, Extension, Record, RecordDataType, RecordName, RecordValue};
use glam::DVec3;

use self::scans::Scans;
use self::scans::{check_pose, pose_of, set_limits};
use super::columns::{EXACT_INTEGERS, cloud_from_columns};
use super::{FormatResult, ReadOptions, brief};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud, Provenance};

/// Name of the field with the number of each point's scan, in files with several scans.
const SCAN: &str = "scan";
/// Maximum number of different fields across all scans.
const MOST_COLUMNS: usize = 1000;
/// Name of the field that marks points without a colour.
const COLOUR_INVALID: &str = "color_invalid";
/// Our names for the standard E57 fields.
const FIELDS: [(&str, RecordName); 12] = [
    ("intensity", RecordName::Intensity),
    ("intensity_invalid", RecordName::IsIntensityInvalid),
    ("red", RecordName::ColorRed),
    ("green", RecordName::ColorGreen),
    ("blue", RecordName::ColorBlue),
    (COLOUR_INVALID, RecordName::IsColorInvalid),
    ("row", RecordName::RowIndex),
    ("column", RecordName::ColumnIndex),
    ("number_of_returns", RecordName::ReturnCount),
    ("return_index", RecordName::ReturnIndex),
    ("timestamp", RecordName::TimeStamp),
    ("timestamp_invalid", RecordName::IsTimeStampInvalid),
];
/// Our names for the components of normals in the standard's extension.
const NORMALS: [(&str, &str); 3] = [("normal_x", "normalX"), ("normal_y", "normalY"), ("normal_z", "normalZ")];
const OF_NORMALS: (&str, &str) = ("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt");
/// Namespace and URL of our own extension, which stores all fields that are not standard.
const OWN: (&str, &str) = ("planish", "https://github.com/planish/planish");

fn damaged(error: e57::Error) -> FormatError {
    FormatError::Malformed(format!("damaged E57: {}", brief(&error.to_string())))
}

/// The type of a column. It determines the default value for scans that lack the column.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Integer { min: i64, max: i64 },
    Single,
    Double,
}

impl Kind {
    fn of(kind: &RecordDataType) -> Self {
        match *kind {
            RecordDataType::Integer { min, max } => Self::Integer { min, max },
            RecordDataType::Single { .. } => Self::Single,
            RecordDataType::Double { .. } | RecordDataType::ScaledInteger { .. } => Self::Double,
        }
    }

    /// Returns a type that can represent the values of both types.
    fn union(self, other: Self) -> Self {
        match (self, other) {
            (Self::Integer { min: a, max: b }, Self::Integer { min: c, max: d }) => {
                Self::Integer { min: a.min(c), max: b.max(d) }
            }
            (a, b) if a == b => a,
            _ => Self::Double,
        }
    }

    fn missing(self) -> f64 {
        if matches!(self, Self::Integer { .. }) { 0.0 } else { f64::NAN }
    }

    fn values(self, values: Vec<f64>) -> AttributeValues {
        let empty: AttributeValues = match self {
            Self::Single => Vec::<f32>::new().into(),
            Self::Double => return values.into(),
            Self::Integer { min: 0.., max: ..=0xff } => Vec::<u8>::new().into(),
            Self::Integer { min: 0.., max: ..=0xffff } => Vec::<u16>::new().into(),
            Self::Integer { min: 0.., max: ..=0xffff_ffff } => Vec::<u32>::new().into(),
            Self::Integer { min: -0x8000_0000.., max: ..=0x7fff_ffff } => Vec::<i32>::new().into(),
            Self::Integer { .. } => Vec::<i64>::new().into(),
        };
        empty.of_f64(values)
    }
}

/// Indices of a point's coordinates among its values.
enum Position {
    Cartesian([usize; 3]),
    /// Indices of range, azimuth and elevation.
    Spherical([usize; 3]),
}

impl Position {
    fn of(prototype: &[Record]) -> Option<Self> {
        let all = |names: [RecordName; 3]| {
            let found = names.map(|name| prototype.iter().position(|record| record.name == name));
            Some([found[0]?, found[1]?, found[2]?])
        };
        let cartesian = all([RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ]);
        let spherical = || {
            all([RecordName::SphericalRange, RecordName::SphericalAzimuth, RecordName::SphericalElevation])
                .map(Self::Spherical)
        };
        cartesian.map(Self::Cartesian).or_else(spherical)
    }

    fn point(&self, values: &[f64]) -> DVec3 {
        match self {
            Self::Cartesian(places) => DVec3::from_array(places.map(|place| values[place])),
            Self::Spherical(places) => {
                let [range, azimuth, elevation] = places.map(|place| values[place]);
                let (sin_a, cos_a) = azimuth.sin_cos();
                let (sin_e, cos_e) = elevation.sin_cos();
                range * DVec3::new(cos_e * cos_a, cos_e * sin_a, sin_e)
            }
        }
    }
}

/// Returns our name for a field; `None` for coordinates and for flags that mark invalid points.
fn name_of(name: &RecordName) -> Option<String> {
    if let Some((own, _)) = FIELDS.iter().find(|(_, standard)| standard == name) {
        return Some((*own).to_owned());
    }
    let RecordName::Unknown { namespace, name } = name else { return None };
    let normal = NORMALS.iter().find(|(_, standard)| namespace == OF_NORMALS.0 && standard == name);
    Some(match normal {
        Some((own, _)) => (*own).to_owned(),
        None if namespace.is_empty() || namespace == OWN.0 => name.clone(),
        None => format!("{namespace}_{name}"),
    })
}

/// Maximum number of attributes of an XML element.
const MOST_ATTRIBUTES: usize = 1000;

/// Returns the largest number of attributes in any XML tag, counted as quoted values.
fn most_attributes(xml: &[u8]) -> usize {
    let (mut rest, mut most) = (xml, 0);
    while let Some(start) = rest.iter().position(|&byte| byte == b'<') {
        rest = &rest[start..];
        let closed_by: Option<&[u8]> = match rest {
            [b'<', b'!', b'-', b'-', ..] => Some(b"-->"),
            [b'<', b'!', b'[', ..] => Some(b"]]>"),
            [b'<', b'?', ..] => Some(b"?>"),
            _ => None,
        };
        if let Some(end) = closed_by {
            rest = rest.windows(end.len()).position(|bytes| bytes == end).map_or(&[], |at| &rest[at + end.len()..]);
            continue;
        }
        let (mut quote, mut values, mut length) = (None, 0, rest.len());
        for (i, &byte) in rest.iter().enumerate().skip(1) {
            match (quote, byte) {
                (None, b'>') => {
                    length = i;
                    break;
                }
                (None, b'"' | b'\'') => quote = Some(byte),
                (Some(open), _) if open == byte => (quote, values) = (None, values + 1),
                _ => {}
            }
        }
        (rest, most) = (&rest[length..], most.max(values));
    }
    most
}

/// Returns true if a cloud was read from E57.
pub(super) fn has_scans(cloud: &PointCloud) -> bool {
    cloud.provenance.get::<Scans>().is_some()
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> FormatResult<PointCloud> {
    // The parser's time grows with the square of the number of attributes.
    if most_attributes(&E57Reader::raw_xml(Cursor::new(bytes)).map_err(damaged)?) > MOST_ATTRIBUTES {
        return Err(FormatError::Malformed(format!("an XML element has more than {MOST_ATTRIBUTES} attributes")));
    }
    let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(damaged)?;
    let scans = reader.pointclouds();
    match reader.images().len() {
        0 => {}
        1 => notes.push("an image is dropped".into()),
        images => notes.push(format!("{images} images are dropped")),
    }
    let count = scans.iter().try_fold(0u64, |sum, scan| sum.checked_add(scan.records));
    // A point takes at least one bit; without this check, a small header could claim any number of points.
    let count = count.filter(|count| *count <= 8 * bytes.len() as u64).ok_or_else(|| {
        FormatError::Malformed("the file is truncated: its header states more points than the file holds".into())
    })?;
    let mut columns: Vec<(String, Kind, Vec<f64>)> = Vec::new();
    let mut column_of: HashMap<String, usize> = HashMap::new();
    for record in scans.iter().flat_map(|scan| &scan.prototype) {
        let (Some(name), kind) = (name_of(&record.name), Kind::of(&record.data_type)) else { continue };
        match column_of.get(&name) {
            Some(&column) => columns[column].1 = columns[column].1.union(kind),
            None if columns.len() == MOST_COLUMNS => {
                return Err(FormatError::Unsupported(format!(
                    "the scans have more than {MOST_COLUMNS} different fields; remove some of them"
                )));
            }
            None => {
                column_of.insert(name.clone(), columns.len());
                columns.push((name, kind, Vec::new()));
            }
        }
    }
    let has_colour = |scan: &e57::PointCloud| scan.prototype.iter().any(|record| record.name == RecordName::ColorRed);
    let colourless = scans.iter().filter(|scan| !has_colour(scan)).count();
    let marks_colourless = (1..scans.len()).contains(&colourless);
    if marks_colourless {
        notes.push(format!(
            "{colourless} of {} scans have no colour; their points are black, and marked in {COLOUR_INVALID}",
            scans.len()
        ));
        if !columns.iter().any(|(name, ..)| name == COLOUR_INVALID) {
            columns.push((COLOUR_INVALID.to_owned(), Kind::Integer { min: 0, max: 1 }, Vec::new()));
        }
    }
    options.check(usize::try_from(count).unwrap_or(usize::MAX), 16 * (columns.len() + 4))?;
    let normals = NORMALS.map(|(name, _)| columns.iter().position(|column| column.0 == name));
    let mut positions: [Vec<f64>; 3] = Default::default();
    let mut scan_of: Vec<u16> = Vec::new();
    let mut has_rounded = false;
    for (number, scan) in scans.iter().enumerate() {
        let position = Position::of(&scan.prototype)
            .ok_or_else(|| FormatError::Unsupported("a scan has neither Cartesian nor spherical positions".into()))?;
        let is_invalid = |record: &Record| {
            matches!(record.name, RecordName::CartesianInvalidState | RecordName::SphericalInvalidState)
        };
        let invalid: Vec<usize> = (0..scan.prototype.len()).filter(|&i| is_invalid(&scan.prototype[i])).collect();
        let note = check_pose(scan)?.map(str::to_owned).filter(|note| !notes.contains(note));
        notes.extend(note);
        let (rotation, translation) = pose_of(scan);
        let lacks_colour = marks_colourless && !has_colour(scan);
        let mut sources: Vec<Option<usize>> = vec![None; columns.len()];
        for (i, record) in scan.prototype.iter().enumerate() {
            if let Some(&column) = name_of(&record.name).and_then(|name| column_of.get(&name)) {
                sources[column].get_or_insert(i);
            }
        }
        let mut values = Vec::with_capacity(scan.prototype.len());
        for point in reader.pointcloud_raw(scan).map_err(damaged)? {
            values.clear();
            for (value, record) in point.map_err(damaged)?.iter().zip(&scan.prototype) {
                if let RecordValue::Integer(value) = value {
                    has_rounded |= value.unsigned_abs() > EXACT_INTEGERS;
                }
                values.push(value.to_f64(&record.data_type).map_err(damaged)?);
            }
            let p = rotation * position.point(&values) + translation;
            let is_hole = invalid.iter().any(|&i| values[i] != 0.0);
            for (axis, positions) in positions.iter_mut().enumerate() {
                positions.push(if is_hole { f64::NAN } else { p[axis] });
            }
            for ((name, kind, column), source) in columns.iter_mut().zip(&sources) {
                let missing = if lacks_colour && name == COLOUR_INVALID { 1.0 } else { kind.missing() };
                column.push(source.map_or(missing, |source| values[source]));
            }
            // Normals are in the scan's frame, like positions.
            if let [Some(x), Some(y), Some(z)] = normals {
                let last = |column: usize| columns[column].2.last().copied().unwrap_or(f64::NAN);
                let turned = rotation * DVec3::new(last(x), last(y), last(z));
                for (column, value) in [x, y, z].into_iter().zip(turned.to_array()) {
                    columns[column].2.last_mut().into_iter().for_each(|last| *last = value);
                }
            }
            scan_of.push(u16::try_from(number).unwrap_or(u16::MAX));
        }
    }
    if has_rounded {
        notes.push("integers beyond 2^53 are rounded".into());
    }
    let [x, y, z] = positions;
    let axis = |name: &str, values: Vec<f64>| Attribute { name: name.into(), count: 1, values: values.into() };
    let mut all = vec![axis("x", x), axis("y", y), axis("z", z)];
    all.extend(columns.into_iter().map(|(name, kind, values)| Attribute {
        name,
        count: 1,
        values: kind.values(values),
    }));
    if scans.len() > 1 {
        all.push(Attribute { name: SCAN.into(), count: 1, values: scan_of.into() });
    }
    let mut cloud = cloud_from_columns(all)?;
    if let [scan] = &scans[..] {
        let (rotation, translation) = pose_of(scan);
        cloud.pose.position_m = translation.to_array();
        cloud.pose.orientation = [rotation.w, rotation.x, rotation.y, rotation.z];
    }
    let (creation, coordinate_metadata) = (reader.creation(), reader.coordinate_metadata().map(str::to_owned));
    let of_file = Scans { scans, creation, coordinate_metadata };
    if let Some(scanners_m) = of_file.scanners_m() {
        cloud.set_scanners_m(scanners_m);
    }
    cloud.provenance = Provenance::new(of_file);
    Ok(cloud)
}

/// Returns the fields that the standard requires together with the field `name`.
fn needed_beside(name: &RecordName) -> &'static [&'static str] {
    match name {
        RecordName::ColorRed | RecordName::ColorGreen | RecordName::ColorBlue | RecordName::IsColorInvalid => {
            &["red", "green", "blue"]
        }
        RecordName::ReturnCount | RecordName::ReturnIndex => &["number_of_returns", "return_index"],
        RecordName::IsIntensityInvalid => &["intensity"],
        RecordName::IsTimeStampInvalid => &["timestamp"],
        _ => &[],
    }
}

/// Returns the E57 record for one of a cloud's fields: a standard record if possible, otherwise an extension's.
fn record_of(attribute: &Attribute, all: &[Attribute]) -> FormatResult<Record> {
    let is_float = matches!(attribute.values, AttributeValues::F32(_) | AttributeValues::F64(_));
    let is_allowed = |name: &RecordName| {
        let counts = matches!(
            name,
            RecordName::RowIndex | RecordName::ColumnIndex | RecordName::ReturnCount | RecordName::ReturnIndex
        );
        !(counts && is_float) && needed_beside(name).iter().all(|needed| all.iter().any(|other| other.name == *needed))
    };
    let standard = FIELDS.iter().find(|(own, name)| *own == attribute.name && is_allowed(name));
    let name = match standard {
        Some((_, name)) => name.clone(),
        None => {
            let normal = NORMALS.iter().find(|(own, _)| *own == attribute.name);
            let (namespace, name) = normal.map_or((OWN.0, attribute.name.as_str()), |(_, name)| (OF_NORMALS.0, *name));
            let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
            let mut name: String = name.chars().map(|c| if is_allowed(c) { c } else { '_' }).collect();
            // XML names cannot begin with a digit or a hyphen.
            if !name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') {
                name.insert(0, '_');
            }
            RecordName::Unknown { namespace: namespace.into(), name }
        }
    };
    if attribute.count != 1 {
        return Err(FormatError::Unsupported(format!(
            "the field {} has {} values per point, but E57 stores one; write .pcd",
            attribute.name, attribute.count
        )));
    }
    let is_flag =
        matches!(name, RecordName::IsColorInvalid | RecordName::IsIntensityInvalid | RecordName::IsTimeStampInvalid);
    let data_type = match &attribute.values {
        AttributeValues::F32(_) => RecordDataType::Single { min: None, max: None },
        AttributeValues::F64(_) => RecordDataType::Double { min: None, max: None },
        _ if is_flag => RecordDataType::Integer { min: 0, max: 1 },
        AttributeValues::U8(_) => RecordDataType::Integer { min: 0, max: 0xff },
        AttributeValues::U16(_) => RecordDataType::Integer { min: 0, max: 0xffff },
        AttributeValues::U32(_) => RecordDataType::Integer { min: 0, max: 0xffff_ffff },
        AttributeValues::I8(_) | AttributeValues::I16(_) | AttributeValues::I32(_) => {
            RecordDataType::Integer { min: i64::from(i32::MIN), max: i64::from(i32::MAX) }
        }
        AttributeValues::I64(values) => integers_of(attribute, values.iter().map(|value| i128::from(*value)))?,
        AttributeValues::U64(values) => integers_of(attribute, values.iter().map(|value| i128::from(*value)))?,
    };
    Ok(Record { name, data_type })
}

/// Returns the E57 type of a field of 64-bit integers. The type includes the range of the values.
///
/// # Errors
/// If a value, or the range of the values, exceeds 63 bits.
fn integers_of(attribute: &Attribute, values: impl Iterator<Item = i128> + Clone) -> FormatResult<RecordDataType> {
    let (min, max) = (values.clone().min().unwrap_or(0), values.max().unwrap_or(0));
    match (i64::try_from(min), i64::try_from(max), i64::try_from(max - min)) {
        (Ok(min), Ok(max), Ok(_)) => Ok(RecordDataType::Integer { min, max }),
        _ => Err(FormatError::Unsupported(format!(
            "the field {} has values from {min} to {max}, but E57 stores integers of 63 bits; write .pcd",
            attribute.name
        ))),
    }
}

fn value_of(attribute: &Attribute, i: usize) -> RecordValue {
    match &attribute.values {
        AttributeValues::F32(values) => RecordValue::Single(values[i]),
        AttributeValues::F64(values) => RecordValue::Double(values[i]),
        AttributeValues::I64(values) => RecordValue::Integer(values[i]),
        AttributeValues::U64(values) => RecordValue::Integer(i64::try_from(values[i]).unwrap_or(i64::MAX)),
        values => RecordValue::Integer(values.get_f64(i) as i64),
    }
}

/// Encodes each scan of the cloud in its own frame, or all points as one scan.
pub(super) fn encode(cloud: &PointCloud) -> FormatResult<Vec<u8>> {
    let cannot = |error: e57::Error| {
        FormatError::Unsupported(format!("cannot encode this cloud as E57: {}", brief(&error.to_string())))
    };
    let mut cloud = cloud.clone();
    cloud.unpack_colour();
    cloud.attributes.retain(|attribute| attribute.name != "_");
    let provenance = cloud.provenance.clone();
    let of_file = provenance.get::<Scans>();
    let scans = of_file.map(|file| file.scans.clone());
    let number = cloud.attributes.iter().position(|attribute| attribute.name == SCAN && attribute.count == 1);
    let several = scans.filter(|scans| scans.len() == 1 || number.is_some());
    let scans = several.unwrap_or_else(|| vec![e57::PointCloud::default()]);
    let number = number.filter(|_| scans.len() > 1).map(|place| cloud.attributes.remove(place));
    let records = cloud
        .attributes
        .iter()
        .map(|field| record_of(field, &cloud.attributes))
        .collect::<FormatResult<Vec<Record>>>()?;
    let has_holes = cloud.valid_points() < cloud.len();
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, &guid(&cloud, usize::MAX)).map_err(cannot)?;
    if let Some(file) = of_file {
        writer.set_creation(file.creation.clone());
        writer.set_coordinate_metadata(file.coordinate_metadata.clone());
    }
    for (namespace, url) in [OF_NORMALS, OWN] {
        let is_used =
            |record: &Record| matches!(&record.name, RecordName::Unknown { namespace: of, .. } if of == namespace);
        if records.iter().any(is_used) {
            writer.register_extension(Extension::new(namespace, url)).map_err(cannot)?;
        }
    }
    let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
    let mut prototype: Vec<Record> =
        axes.map(|name| Record { name, data_type: RecordDataType::Double { min: None, max: None } }).into();
    if has_holes {
        let data_type = RecordDataType::Integer { min: 0, max: 2 };
        prototype.push(Record { name: RecordName::CartesianInvalidState, data_type });
    }
    prototype.extend(records);
    let normals = NORMALS.map(|(name, _)| cloud.attributes.iter().position(|attribute| attribute.name == name));
    for (scan_number, scan) in scans.iter().enumerate() {
        let is_of_scan = |i: &usize| number.as_ref().is_none_or(|of| of.values.get_f64(*i) as usize == scan_number);
        // Skip empty scans, because other readers fail on them.
        if scans.len() > 1 && !(0..cloud.len()).any(|i| is_of_scan(&i)) {
            continue;
        }
        let own_guid = scan.guid.clone().unwrap_or_else(|| guid(&cloud, scan_number));
        let mut points = writer.add_pointcloud(&own_guid, prototype.clone()).map_err(cannot)?;
        points.set_name(scan.name.clone());
        points.set_description(scan.description.clone());
        points.set_original_guids(scan.original_guids.clone());
        set_limits(&mut points, scan, &prototype);
        points.set_transform(scan.transform.clone());
        points.set_acquisition_start(scan.acquisition_start.clone());
        points.set_acquisition_end(scan.acquisition_end.clone());
        points.set_sensor_vendor(scan.sensor_vendor.clone());
        points.set_sensor_model(scan.sensor_model.clone());
        points.set_sensor_serial(scan.sensor_serial.clone());
        points.set_sensor_hw_version(scan.sensor_hw_version.clone());
        points.set_sensor_sw_version(scan.sensor_sw_version.clone());
        points.set_sensor_fw_version(scan.sensor_fw_version.clone());
        points.set_temperature(scan.temperature);
        points.set_humidity(scan.humidity);
        points.set_atmospheric_pressure(scan.atmospheric_pressure);
        let (rotation, translation) = pose_of(scan);
        for i in (0..cloud.len()).filter(is_of_scan) {
            let p = DVec3::from_array([0, 1, 2].map(|axis| cloud.coordinate(axis, i)));
            let is_hole = !p.is_finite();
            let p = if is_hole { DVec3::ZERO } else { rotation.conjugate() * (p - translation) };
            let mut values: Vec<RecordValue> = p.to_array().map(RecordValue::Double).into();
            if has_holes {
                values.push(RecordValue::Integer(if is_hole { 2 } else { 0 }));
            }
            let first_field = values.len();
            values.extend(cloud.attributes.iter().map(|attribute| value_of(attribute, i)));
            if let [Some(x), Some(y), Some(z)] = normals {
                let of = |field: usize| cloud.attributes[field].values.get_f64(i);
                let turned = rotation.conjugate() * DVec3::new(of(x), of(y), of(z));
                for (field, component) in [x, y, z].into_iter().zip(turned.to_array()) {
                    match &mut values[first_field + field] {
                        RecordValue::Single(value) => *value = component as f32,
                        RecordValue::Double(value) => *value = component,
                        _ => {}
                    }
                }
            }
            points.add_point(values).map_err(cannot)?;
        }
        points.finalize().map_err(cannot)?;
    }
    writer.finalize().map_err(cannot)?;
    drop(writer);
    Ok(bytes.into_inner())
}

/// Returns an identifier computed from the points, so that encoding the same cloud twice gives the same file.
fn guid(cloud: &PointCloud, number: usize) -> String {
    let values = cloud.positions.iter().flatten().map(|value| u64::from(value.to_bits()));
    // FNV-1a, over 64 bits.
    let hash = values
        .chain([number as u64])
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, value| (hash ^ value).wrapping_mul(0x0100_0000_01b3));
    let [a, b, c, d] = [hash >> 32, (hash >> 16) & 0xffff, hash & 0xffff, hash.rotate_left(13)];
    format!("{{{a:08X}-{b:04X}-{c:04X}-8000-{:012X}}}", d & 0xffff_ffff_ffff)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_are_counted_per_element() {
        let many = (0..1500).map(|i| format!(" a{i}='{i}'")).collect::<String>();
        for (xml, count) in [
            ("<a b=\"1\" c='>\"<'><d/></a>".to_owned(), 2),
            (format!("<!-- <a{many}> --><![CDATA[<a{many}>]]><b c=\"1\"/>"), 1),
            (format!("<?xml version=\"1.0\"?><a{many}>"), 1500),
            (format!("<a{many}"), 1500),
            (format!("<?x '?><a{many} z='>'/>"), 1501),
            ("<!--".to_owned(), 0),
        ] {
            assert_eq!(most_attributes(xml.as_bytes()), count, "{xml}");
        }
    }
}
