//! NumPy arrays: depth as [H, W] of u16 (raw) or f32 (metres), points as [H, W, 3] or [N, 3] of f32 or f64 (metres).

mod array;
mod header;

pub(super) use self::array::{Array, encode};

use super::{CloudRef, Contents, ReadOptions, organized_if_grid};
use crate::{Gridded, columns::cloud_from_columns};
use planish_core::{Attribute, DepthImage, FormatError, PointCloud, internal::validate_shape};

const LAYOUTS: &str = "depth is [H, W] of u16 or f32 (metres), points are [H, W, 3] or [N, 3] of f32 or f64";

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<Contents, FormatError> {
    let array = Array::parse(bytes)?;
    // Values as they are, and as positions.
    options.check(array.bytes(), 2)?;
    match (&array.header.shape[..], array.header.kind, array.header.size) {
        (&[height, width], 'u', 2) => {
            validate_shape(width, height)?;
            Ok(Contents::Depth(DepthImage { width, height, raw: array.values() }))
        }
        (&[n, 3], 'f', 8) => points_f64(n, 1, array.values()),
        (&[n, 3], 'f', 4) => points(n, 1, array.values()),
        (&[height, width], 'f', 4 | 8) if !is_table(height, width) => {
            validate_shape(width, height)?;
            let depth_m = match array.header.size {
                4 => array.values(),
                _ => array.values::<f64>().into_iter().map(|value| value as f32).collect(),
            };
            Ok(Contents::DepthMetres { width, height, depth_m })
        }
        (&[height, width, 3], 'f', 4 | 8) => {
            validate_shape(width, height)?;
            match array.header.size {
                4 => points(width, height, array.values()),
                _ => points_f64(width, height, array.values()),
            }
        }
        (shape, ..) => {
            let descr = &array.header.descr;
            let advice = match shape {
                [_, 4..=16] | [_, _, 4..=16] => {
                    "; for points with fields save [..., :3], or .npz with the fields as separate arrays"
                }
                [.., 3] => "; convert integers to metres with array.astype('f4') times their unit",
                _ => "",
            };
            Err(FormatError::Unsupported(format!("an array of shape {shape:?} and type {descr}: {LAYOUTS}{advice}")))
        }
    }
}

/// Returns true if an array is a table with a row per point, not an image.
fn is_table(rows: usize, columns: usize) -> bool {
    columns <= 16 && rows >= 16 * columns
}

fn points(width: usize, height: usize, values: Vec<f32>) -> Result<Contents, FormatError> {
    let positions = values.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    organized_if_grid(Gridded { width, height, points: PointCloud::new(positions) })
}

/// Clouds far from the origin are stored relative to an origin, and written as f64 again.
fn points_f64(width: usize, height: usize, values: Vec<f64>) -> Result<Contents, FormatError> {
    let column = |axis: usize| {
        let values: Vec<f64> = values.iter().skip(axis).step_by(3).copied().collect();
        Attribute { name: ["x", "y", "z"][axis].to_owned(), count: 1, values: values.into() }
    };
    let points = cloud_from_columns(vec![column(0), column(1), column(2)])?;
    organized_if_grid(Gridded { width, height, points })
}

/// Encodes the positions only, [H, W, 3] or [N, 3]; far clouds as f64, so that no digits are lost.
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
