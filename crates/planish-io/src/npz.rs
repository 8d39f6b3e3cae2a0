//! NumPy archives. The positions are the array `points`, `xyz` or `positions`, or otherwise the only array of shape
//! [N, 3]; other arrays with N rows become fields.

use std::io::{Cursor, Read, Write};

use zip::{CompressionMethod, ZipArchive, ZipWriter, write::SimpleFileOptions};

use super::camera_file::{Intrinsics, intrinsics_of as matrix_intrinsics};
use super::columns::with_values;
use super::{CloudRef, Contents, FormatResult, ReadOptions, brief, npy};
use planish_core::{Attribute, AttributeValues, Camera, FormatError};

const POSITIONS: [&str; 4] = ["points", "xyz", "positions", "arr_0"];
const DEPTH: [&str; 2] = ["depth", "arr_0"];
/// Names under which a depth image's intrinsics are stored, as a 3x3 or 4x4 matrix.
const INTRINSICS: [&str; 10] = [
    "K",
    "k",
    "intrinsics",
    "intrinsic",
    "camera_matrix",
    "cam_K",
    "intrinsic_matrix",
    "cam_intrinsics",
    "camera_intrinsics",
    "depth_intrinsics",
];
/// Names of arrays that may have three columns but are not positions.
const NO_POSITIONS: [&str; 9] = ["normals", "normal", "rgb", "colors", "colours", "color", "image", "img", "faces"];
/// Maximum number of files in an archive.
const MOST_ARRAYS: usize = 256;

fn damaged(error: impl std::fmt::Display) -> FormatError {
    FormatError::Malformed(format!("damaged NPZ: {}", brief(&error.to_string())))
}

/// Decodes a cloud, or a depth image with its camera if the archive has one.
pub(super) fn decode(
    bytes: &[u8],
    options: &ReadOptions,
    notes: &mut Vec<String>,
) -> FormatResult<(Contents, Option<Camera>)> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(damaged)?;
    if archive.len() > MOST_ARRAYS {
        return Err(FormatError::Unsupported(format!(
            "the archive has {} files; at most {MOST_ARRAYS} are supported",
            archive.len()
        )));
    }
    let mut arrays: Vec<(String, Vec<u8>)> = Vec::new();
    let mut left = options.max_memory_bytes;
    for i in 0..archive.len() {
        let file = archive.by_index(i).map_err(damaged)?;
        let name = file.name().map_err(damaged)?.into_owned();
        let Some(name) = name.strip_suffix(".npy").map(str::to_owned) else { continue };
        let stated = file.size();
        // The array and its decoded values are in memory at the same time.
        let needed = stated.saturating_mul(2);
        left = left.checked_sub(needed).ok_or(FormatError::TooLarge {
            needed: needed.saturating_add(options.max_memory_bytes - left),
            allowed: options.max_memory_bytes,
        })?;
        let mut array = Vec::new();
        array.try_reserve_exact(stated.saturating_add(1) as usize).map_err(damaged)?;
        // The archive may state a wrong size.
        file.take(stated.saturating_add(1)).read_to_end(&mut array).map_err(damaged)?;
        if array.len() as u64 != stated {
            return Err(damaged("an array is longer or shorter than stated"));
        }
        arrays.push((name, array));
    }
    let named = arrays.iter().position(|(name, _)| INTRINSICS.contains(&name.as_str()));
    let named = named.filter(|&k| is_matrix(&arrays[k].1)).map(|k| arrays.remove(k));
    let intrinsics = named.as_ref().and_then(|(name, array)| Some((name.clone(), intrinsics_of(array)?)));
    if let (Some((name, _)), None) = (&named, &intrinsics) {
        notes.push(format!("the array {} is dropped: it is not [fx 0 cx; 0 fy cy; 0 0 1]", brief(name)));
    }
    let names = || super::quoted(&arrays.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", "));
    // Find an array by its name; otherwise, use the only array that fits.
    let contents_of = |(name, array): &(String, Vec<u8>)| {
        let mut notes = Vec::new();
        let contents = npy::decode(array, options, &mut notes).ok()?;
        Some((name.clone(), contents, notes))
    };
    let of_name = |wanted: &[&str], is_kind: fn(&Contents) -> bool| {
        let named = wanted.iter().find_map(|name| arrays.iter().find(|(found, _)| found == name));
        let named = named.and_then(contents_of).filter(|(_, contents, _)| is_kind(contents));
        named.or_else(|| {
            // Tables such as boxes and labels must not be mistaken for points or depth.
            let may_be = |(name, array): &&(String, Vec<u8>)| {
                !NO_POSITIONS.contains(&name.as_str()) && is_plain(array) && !is_matrix(array)
            };
            let plain = arrays.iter().filter(may_be).filter_map(contents_of);
            let mut all = plain.filter(|(_, contents, notes)| is_kind(contents) && notes.is_empty());
            all.next().filter(|_| all.next().is_none())
        })
    };
    if let Some((name, array)) = arrays.iter().find(|(name, _)| POSITIONS[..3].contains(&name.as_str())) {
        // An array with this name cannot be a depth image, whatever its shape.
        let problem = match npy::decode(array, options, &mut Vec::new()) {
            Ok(contents) if !contents.is_depth() => None,
            Ok(contents) => Some(format!("it is [{1}, {0}]", contents.shape().0, contents.shape().1)),
            Err(error) => Some(error.to_string()),
        };
        if let Some(problem) = problem {
            return Err(FormatError::Unsupported(format!(
                "the array {name} must be [N, 3] or [H, W, 3] of f32 or f64: {}",
                brief(&problem)
            )));
        }
    }
    let points = || of_name(&POSITIONS, |contents| !contents.is_depth());
    let depth = || of_name(&DEPTH, Contents::is_depth);
    // An archive with an array named depth, or with camera intrinsics, is read as a depth image, unless an array has
    // one of the names for positions.
    let has = |names: &[&str]| arrays.iter().any(|(name, _)| names.contains(&name.as_str()));
    let is_depth = (named.is_some() || has(&DEPTH[..1])) && !has(&POSITIONS[..3]);
    let found = if is_depth { depth().or_else(points) } else { points().or_else(depth) };
    let Some((used, mut contents, found_notes)) = found else {
        return Err(FormatError::Unsupported(format!(
            "no points or depth image found among the arrays {}; expected one named points, xyz or \
             positions ([N, 3] or [H, W, 3] of f32 or f64), or depth",
            names()
        )));
    };
    notes.extend(found_notes.into_iter().map(|note| format!("the array {}: {note}", brief(&used))));
    let rows = contents.shape().0 * contents.shape().1;
    let others = arrays.iter().filter(|(name, _)| *name != used);
    let wanted = if contents.is_depth() { &DEPTH[..] } else { &POSITIONS[..] };
    if !wanted.contains(&used.as_str()) {
        let what = if contents.is_depth() { "depth" } else { "positions" };
        notes.push(format!("{what} read from the array {}, the only one whose shape fits", brief(&used)));
    }
    let cloud = match &mut contents {
        Contents::Organized(cloud) => &mut cloud.points,
        Contents::General(cloud) => cloud,
        _ => {
            notes.extend(
                others.map(|(name, _)| format!("the array {} is dropped: depth images have no fields", brief(name))),
            );
            let camera = intrinsics.map(|(name, (focal_length, centre))| {
                notes.push(format!("the array {} is used as the camera's intrinsics", brief(&name)));
                Camera::new(contents.shape(), focal_length, centre)
            });
            return Ok((contents, camera));
        }
    };
    if let Some((name, _)) = &intrinsics {
        notes.push(format!("the array {} is dropped: points need no intrinsics", brief(name)));
    }
    for (name, array) in others {
        match field(name, array, rows)? {
            Ok(attribute) => {
                let is_taken = |name: &str| {
                    cloud.attributes.iter().any(|other| other.name == name)
                        || arrays.iter().any(|(other, _)| other == name)
                };
                let fields = components(attribute, rows, is_taken);
                cloud.attributes.extend(fields);
            }
            Err(reason) => notes.push(format!("the array {} is dropped: {reason}", brief(name))),
        }
    }
    Ok((contents, None))
}

/// Returns true for an array with the shape of a transformation matrix or of intrinsics.
fn is_matrix(array: &[u8]) -> bool {
    npy::Array::parse(array)
        .is_ok_and(|array| matches!(array.header.shape[..], [3, 3] | [3, 4] | [4, 4] | [1, 3, 3] | [1, 4, 4]))
}

/// Returns true for an array that, judging by its shape and type alone, contains points or a depth image.
fn is_plain(array: &[u8]) -> bool {
    npy::Array::parse(array).is_ok_and(|array| {
        matches!(
            (&array.header.shape[..], array.header.kind, array.header.size),
            ([_, 3] | [_, _, 3] | [_, _], 'f', 4 | 8) | ([_, _], 'u', 2)
        )
    })
}

/// Returns the intrinsics in an array; `None` if it is not an intrinsic matrix.
fn intrinsics_of(array: &[u8]) -> Option<Intrinsics> {
    let array = npy::Array::parse(array).ok()?;
    let numbers: Vec<f64> = match (array.header.kind, array.header.size) {
        ('f', 8) => array.values(),
        ('f', 4) => array.values::<f32>().into_iter().map(f64::from).collect(),
        ('i', 4) => array.values::<i32>().into_iter().map(f64::from).collect(),
        ('i', 8) => array.values::<i64>().into_iter().map(|value| value as f64).collect(),
        _ => return None,
    };
    matrix_intrinsics(&numbers)
}

/// Converts an array to a field of `rows` points. If the array is not a field but, for example, an unrelated matrix,
/// the inner error states the reason.
fn field(name: &str, array: &[u8], rows: usize) -> FormatResult<Result<Attribute, String>> {
    let array = match npy::Array::parse(array) {
        Ok(array) => array,
        Err(FormatError::Unsupported(reason)) => return Ok(Err(reason)),
        Err(error) => return Err(FormatError::Malformed(format!("the array {name}: {error}"))),
    };
    // The leading dimensions are those of the points, on a grid or not.
    let mut leading = array.header.shape.iter().scan(1usize, |points, &n| {
        *points = points.saturating_mul(n);
        Some(*points)
    });
    if rows == 0 || !leading.any(|points| points == rows) || array.header.len() == Some(0) {
        return Ok(Err(format!("its shape {:?} does not match the {rows} points", array.header.shape)));
    }
    let values: AttributeValues = match (array.header.kind, array.header.size) {
        ('i', 1) => array.values::<i8>().into(),
        ('i', 2) => array.values::<i16>().into(),
        ('i', 4) => array.values::<i32>().into(),
        ('i', 8) => array.values::<i64>().into(),
        ('u' | 'b', 1) => array.values::<u8>().into(),
        ('u', 2) => array.values::<u16>().into(),
        ('u', 4) => array.values::<u32>().into(),
        ('u', 8) => array.values::<u64>().into(),
        ('f', 4) => array.values::<f32>().into(),
        ('f', 8) => array.values::<f64>().into(),
        _ => return Ok(Err(format!("its type is {}; save it as integers, f32 or f64", array.header.descr))),
    };
    let count = values.len() / rows;
    Ok(Ok(Attribute { name: name.to_owned(), count, values }))
}

/// Names of vector arrays, with the names of the three fields for their components.
const VECTORS: [(&[&str], [&str; 3]); 2] = [
    (&["normals", "normal"], ["normal_x", "normal_y", "normal_z"]),
    (&["rgb", "colors", "colours", "color"], ["red", "green", "blue"]),
];

/// Splits an array of normals or colours into the component fields that all other formats have, unless other arrays
/// have the names of these fields. Returns any other array unchanged.
fn components(attribute: Attribute, rows: usize, is_taken: impl Fn(&str) -> bool) -> Vec<Attribute> {
    let is_colour = |names: &[&str; 3]| names[0] == "red";
    let is_bytes = matches!(attribute.values, AttributeValues::U8(_));
    let vector = VECTORS.iter().find(|(names, components)| {
        names.contains(&attribute.name.as_str())
            && attribute.count == 3
            && (is_bytes || !is_colour(components))
            && !components.iter().any(|name| is_taken(name))
            // If several of the vector's names are present, only the first is split.
            && !names.iter().take_while(|name| **name != attribute.name).any(|name| is_taken(name))
    });
    let Some((_, names)) = vector else { return vec![attribute] };
    let component = |k: usize| {
        let values: Vec<f64> = (0..rows).map(|i| attribute.values.get_f64(3 * i + k)).collect();
        Attribute { name: names[k].into(), count: 1, values: attribute.values.of_f64(values) }
    };
    (0..3).map(component).collect()
}

/// Joins the component fields of normals and of colours into one array each.
fn vectors(attributes: &[Attribute]) -> Vec<Attribute> {
    let mut all = attributes.to_vec();
    for (names, components) in VECTORS {
        let place = |name: &str| all.iter().position(|attribute| attribute.name == name && attribute.count == 1);
        let [Some(x), Some(y), Some(z)] = components.map(place) else { continue };
        let kinds = [x, y, z].map(|k| std::mem::discriminant(&all[k].values));
        // If another array has the vector's name, both this array and the components are kept.
        if all.iter().any(|attribute| attribute.name == names[0]) {
            continue;
        }
        if kinds[0] != kinds[1] || kinds[0] != kinds[2] || (names[0] == "rgb" && all[x].values.scalar_size() > 1) {
            continue;
        }
        let rows = all[x].values.len();
        let values = (0..rows).flat_map(|i| [x, y, z].map(|k| all[k].values.get_f64(i))).collect();
        all[x] = Attribute { name: names[0].into(), count: 3, values: all[x].values.of_f64(values) };
        all.retain(|attribute| !components.contains(&attribute.name.as_str()));
    }
    all
}

/// Encodes the positions as the array `points`, and every field as an array with the field's name.
pub(super) fn encode(cloud: CloudRef<'_>) -> FormatResult<Vec<u8>> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    let mut add = |name: &str, array: &[u8]| -> FormatResult<()> {
        writer.start_file(format!("{name}.npy"), options).map_err(|error| FormatError::Os(error.into()))?;
        Ok(writer.write_all(array)?)
    };
    add(POSITIONS[0], &npy::encode_points(cloud))?;
    let (width, height) = cloud.grid();
    let mut named = cloud.points().clone();
    named.unpack_colour();
    for attribute in vectors(&named.attributes).iter().filter(|attribute| attribute.name != "_") {
        let grid = match cloud {
            CloudRef::Organized(_) => vec![height, width],
            CloudRef::General(_) => vec![width],
        };
        let shape = if attribute.count == 1 { grid } else { [grid, vec![attribute.count]].concat() };
        let array = with_values!(&attribute.values, values => npy::encode(&shape, values.iter().copied()));
        add(&attribute.name, &array)?;
    }
    Ok(writer.finish().map_err(|error| FormatError::Os(error.into()))?.into_inner())
}
