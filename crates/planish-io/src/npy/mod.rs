//! NumPy arrays: depth as [H, W] of integers (raw) or floats (metres), points as [H, W, 3] or [N, 3] of floats
//! (metres), and points with fields as [N, C] of floats or as records.

mod array;
mod half;
mod header;

pub(super) use self::array::{Array, encode};

#[cfg(feature = "more-formats")]
use super::FormatResult;
#[cfg(feature = "more-formats")]
use super::xyz_text::guessed_names;
use super::{CloudRef, Contents, ReadOptions, depth_of_integers, organized_if_grid};
use crate::{Gridded, columns::cloud_from_columns};
#[cfg(feature = "more-formats")]
use planish_core::AttributeValues;
use planish_core::{Attribute, DepthImage, FormatError, PointCloud, validate_shape};

const LAYOUTS: &str =
    "depth must be [H, W] of integers or floats (metres), points [H, W, 3] or [N, 3] of floats or records";

pub(super) fn decode(bytes: &[u8], options: &ReadOptions, notes: &mut Vec<String>) -> Result<Contents, FormatError> {
    let array = Array::parse(bytes)?;
    #[cfg(feature = "more-formats")]
    if let Some(pages) = pages_of_shape(&array.header.shape) {
        let page = array.page(options.image_of(pages, notes)?)?;
        let others = bytes.len() - page.bytes();
        return options.beside(others, |options| contents_of(&page, options, notes));
    }
    #[cfg(feature = "more-formats")]
    if options.image.is_some() {
        options.image_of(1, notes)?;
    }
    contents_of(&array, options, notes)
}

fn contents_of(array: &Array<'_>, options: &ReadOptions, notes: &mut Vec<String>) -> Result<Contents, FormatError> {
    // Memory for the file, the values as stored, integers and columns widened to 8 bytes, and the result.
    let values = array.header.len().unwrap_or(usize::MAX);
    let bytes_each = match (array.header.kind, array.header.size, &array.header.shape[..]) {
        ('u', 2, _) => 2 * array.header.size,
        ('f', 8, [.., 3]) => 32,
        ('f', _, [.., 3]) => 12,
        ('V', size, _) => 3 * size + 36,
        _ => 24,
    };
    options.check(values, bytes_each)?;
    let shape = match array.header.shape[..] {
        // The array has a single channel.
        [height, width, 1] => vec![height, width],
        #[cfg(not(feature = "more-formats"))]
        [1, height, width] if width > 16 => vec![height, width],
        _ => array.header.shape.clone(),
    };
    match (&shape[..], array.header.kind, array.header.size) {
        #[cfg(feature = "more-formats")]
        (&[n], 'V', _) => of_records(array, (n, 1)),
        #[cfg(feature = "more-formats")]
        (&[height, width], 'V', _) => of_records(array, (width, height)),
        (&[height, width], 'u' | 'i', 2 | 4 | 8) if !is_long(height, width) => {
            validate_shape(width, height)?;
            match array.header.kind {
                'u' if array.header.size == 2 => Ok(Contents::Depth(DepthImage { width, height, raw: array.values() })),
                _ => depth_of_integers((width, height), &integers(array), notes),
            }
        }
        (&[n, 3], 'f', 8) => points_f64(n, 1, array.values()),
        (&[n, 3], 'f', 2 | 4) => points(n, 1, floats(array)),
        (&[height, width], 'f', 2 | 4 | 8) if !is_table(height, width) && !is_long(width, height) => {
            validate_shape(width, height)?;
            let depth_m = floats(array);
            // f64 values beyond the range of f32 have become infinite.
            if crate::HAS_ROOM
                && array.header.size == 8
                && array
                    .values::<f64>()
                    .iter()
                    .zip(&depth_m)
                    .any(|(value, depth_m)| value.is_finite() && depth_m.is_infinite())
            {
                return Err(FormatError::Unsupported("a depth exceeds 3.4e38, the largest number in f32".into()));
            }
            Ok(Contents::DepthMetres { width, height, depth_m })
        }
        #[cfg(feature = "more-formats")]
        (&[n, columns @ 4..=16], 'f', 2 | 4 | 8) => of_table(array, (n, 1), columns, notes),
        (&[height, width, 3], 'f', 2 | 4 | 8) => {
            validate_shape(width, height)?;
            match array.header.size {
                8 => points_f64(width, height, array.values()),
                _ => points(width, height, floats(array)),
            }
        }
        #[cfg(feature = "more-formats")]
        (&[height, width, columns @ 4..=16], 'f', 2 | 4 | 8) => {
            validate_shape(width, height)?;
            of_table(array, (width, height), columns, notes)
        }
        (shape, ..) => {
            let descr = &array.header.descr;
            let advice = match shape {
                [_, 3..=16] | [_, _, 3] => {
                    "; convert integer points to metres with array.astype('f4') times their unit"
                }
                [3..=16, _] => "; save array.T if its columns are the points",
                _ => "",
            };
            Err(FormatError::Unsupported(format!(
                "unsupported array of shape {shape:?} and type {descr}; {LAYOUTS}{advice}"
            )))
        }
    }
}

/// Returns the number of depth images in an array.
#[cfg(feature = "more-formats")]
pub(super) fn pages(bytes: &[u8]) -> Result<usize, FormatError> {
    Ok(pages_of_shape(&Array::parse(bytes)?.header.shape).unwrap_or(1))
}

/// Returns N for arrays of shape [N, H, W], which are N depth images; `None` for other arrays.
#[cfg(feature = "more-formats")]
fn pages_of_shape(shape: &[usize]) -> Option<usize> {
    // A last dimension of at most 16 contains the coordinates and fields of points on a grid.
    matches!(*shape, [_, _, width] if width > 16).then(|| shape[0])
}

/// Returns true if an array of integers, or a transposed array of floats, is a table rather than an image.
fn is_long(rows: usize, columns: usize) -> bool {
    (3..=16).contains(&columns) && rows >= 16 * columns
}

/// Returns true if an array is a table with one row per point, not an image.
fn is_table(rows: usize, columns: usize) -> bool {
    /// Maximum number of columns for which any array with more rows than columns counts as a table.
    const NARROW: usize = 8;
    columns <= 16 && rows >= 16 * columns || columns <= NARROW && rows > columns
}

/// Returns the values of an array of 2-, 4- or 8-byte floats as f32.
fn floats(array: &Array<'_>) -> Vec<f32> {
    match array.header.size {
        2 => array.values::<u16>().into_iter().map(half::to_f32).collect(),
        4 => array.values(),
        _ => array.values::<f64>().into_iter().map(|value| value as f32).collect(),
    }
}

/// Returns the values of an array of 2-, 4- or 8-byte integers as i64; larger values become the largest i64.
fn integers(array: &Array<'_>) -> Vec<i64> {
    fn widened<T: Into<i64>>(values: Vec<T>) -> Vec<i64> {
        values.into_iter().map(Into::into).collect()
    }
    match (array.header.kind, array.header.size) {
        ('u', 2) => widened(array.values::<u16>()),
        ('i', 2) => widened(array.values::<i16>()),
        ('u', 4) => widened(array.values::<u32>()),
        ('i', 4) => widened(array.values::<i32>()),
        ('u', _) => array.values::<u64>().into_iter().map(|value| i64::try_from(value).unwrap_or(i64::MAX)).collect(),
        _ => array.values(),
    }
}

/// Returns the points in a table, with fields whose names are guessed from their values.
#[cfg(feature = "more-formats")]
fn of_table(
    array: &Array<'_>,
    (width, height): (usize, usize),
    columns: usize,
    notes: &mut Vec<String>,
) -> FormatResult<Contents> {
    let values: Vec<f64> = match array.header.size {
        8 => array.values(),
        _ => floats(array).into_iter().map(f64::from).collect(),
    };
    let column = |k: usize| values.iter().skip(k).step_by(columns).copied().collect::<Vec<f64>>();
    let all: Vec<Vec<f64>> = (0..columns).map(column).collect();
    let names = guessed_names(&all.iter().map(Vec::as_slice).collect::<Vec<_>>(), false);
    notes.push(format!("its {columns} columns are read as {}", names.join(" ")));
    let typed = |(name, values): (String, Vec<f64>)| {
        let values: AttributeValues = match name.as_str() {
            "red" | "green" | "blue" => values.iter().map(|value| *value as u8).collect::<Vec<u8>>().into(),
            _ if array.header.size == 8 => values.into(),
            _ => values.iter().map(|value| *value as f32).collect::<Vec<f32>>().into(),
        };
        Attribute { name, count: 1, values }
    };
    let points = cloud_from_columns(names.into_iter().zip(all).map(typed).collect())?;
    organized_if_grid(Gridded { width, height, points })
}

/// Returns the points in an array of records.
#[cfg(feature = "more-formats")]
fn of_records(array: &Array<'_>, (width, height): (usize, usize)) -> FormatResult<Contents> {
    let points = cloud_from_columns(array.columns()?)?;
    organized_if_grid(Gridded { width, height, points })
}

fn points(width: usize, height: usize, values: Vec<f32>) -> Result<Contents, FormatError> {
    let positions = values.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    organized_if_grid(Gridded { width, height, points: PointCloud::new(positions) })
}

/// Returns points given as f64. Clouds far from zero get an origin, and are written as f64 again.
fn points_f64(width: usize, height: usize, values: Vec<f64>) -> Result<Contents, FormatError> {
    let column = |axis: usize| {
        let values: Vec<f64> = values.iter().skip(axis).step_by(3).copied().collect();
        Attribute { name: ["x", "y", "z"][axis].to_owned(), count: 1, values: values.into() }
    };
    let points = cloud_from_columns(vec![column(0), column(1), column(2)])?;
    organized_if_grid(Gridded { width, height, points })
}

/// Encodes only the positions, as [H, W, 3] or [N, 3]. Clouds far from zero are encoded as f64, so that no digits are
/// lost.
pub(super) fn encode_points(cloud: CloudRef<'_>) -> Vec<u8> {
    let (width, height) = cloud.grid();
    let shape = match cloud {
        CloudRef::Organized(_) => vec![height, width, 3],
        CloudRef::General(_) => vec![width, 3],
    };
    let points = cloud.points();
    let coordinates = |i: usize| [0, 1, 2].map(|axis| points.coordinate(axis, i));
    if points.is_written_in_f64() {
        encode(&shape, (0..points.len()).flat_map(coordinates))
    } else {
        encode(&shape, (0..points.len()).flat_map(coordinates).map(|value| value as f32))
    }
}

pub(super) fn encode_depth(image: &DepthImage) -> Vec<u8> {
    encode(&[image.height, image.width], image.raw.iter().copied())
}

pub(super) fn encode_depth_metres(width: usize, depth_m: &[f32]) -> Vec<u8> {
    encode(&[depth_m.len() / width.max(1), width], depth_m.iter().copied())
}
