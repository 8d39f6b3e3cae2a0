//! NumPy arrays: depth as [H, W] of u16 (raw) or f32 (metres), points as [H, W, 3] or [N, 3] of f32 or f64 (metres).

use npyz::{AutoSerialize, DType, NpyFile, Order, TypeChar, WriterBuilder};

use super::{CloudRef, Contents, ReadOptions, brief, organized_if_grid};
use crate::cloud::{Attribute, PointCloud};
use crate::error::FormatError;
use crate::frame::DepthImage;
use crate::io::Gridded;
use crate::io::columns::cloud_from_columns;
use crate::xyz::validate_shape;

const LAYOUTS: &str = "depth is [H, W] of u16 or f32 (metres), points are [H, W, 3] or [N, 3] of f32";

/// The largest header accepted, in bytes; NumPy's own have some hundred.
const MAX_HEADER_BYTES: usize = 16 * 1024;
/// The deepest nesting accepted: the library's parser takes twice as long with each level, and a flat dict with a shape has two.
const MAX_NESTING: usize = 4;

/// Refuses headers that are cut short, or that no array of numbers has, before the library parses them.
pub(super) fn check_header(bytes: &[u8]) -> Result<(), FormatError> {
    let cut = || FormatError::Malformed("the file is cut short: its NPY header is not whole".into());
    let (start, stated) = match bytes.get(6..).ok_or_else(cut)? {
        [1, _, low, high, ..] => (10, usize::from(u16::from_le_bytes([*low, *high]))),
        [2 | 3, _, a, b, c, d, ..] => (12, u32::from_le_bytes([*a, *b, *c, *d]) as usize),
        [1..=3, ..] => return Err(cut()),
        _ => return Err(FormatError::Unsupported("an NPY of a version that is not known; 1, 2 and 3 are".into())),
    };
    if stated > MAX_HEADER_BYTES {
        return Err(FormatError::Malformed(format!("an NPY header of {stated} bytes is none of an array of numbers")));
    }
    let header = bytes.get(start..start + stated).ok_or_else(cut)?;
    let mut depth = 0usize;
    for byte in header {
        match byte {
            b'(' | b'[' | b'{' => depth += 1,
            b')' | b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_NESTING {
            return Err(FormatError::Malformed("the NPY header is nested: no array of numbers has such a one".into()));
        }
    }
    Ok(())
}

pub(super) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<Contents, FormatError> {
    check_header(bytes)?;
    let file = NpyFile::new(bytes)
        .map_err(|error| FormatError::Malformed(format!("damaged NPY: {}", brief(&error.to_string()))))?;
    let unsupported = |what: String| Err(FormatError::Unsupported(format!("an array of {what}: {LAYOUTS}")));
    let DType::Plain(kind) = file.dtype() else { return unsupported("records".into()) };
    let (kind, size) = (kind.type_char(), kind.size_field());
    let shape: Vec<usize> = file.shape().iter().map(|&n| usize::try_from(n).unwrap_or(usize::MAX)).collect();
    let is_fortran = file.order() != Order::C && shape.len() > 1;
    let available = bytes.len() as u64;
    let needed = shape.iter().try_fold(size, |product, &n| product.checked_mul(n as u64));
    if needed.is_none_or(|needed| needed > available) {
        return Err(FormatError::Malformed(format!("the file is cut short: its header announces the shape {shape:?}")));
    }
    // Values as they are, and as positions.
    options.check(needed.map_or(usize::MAX, |needed| needed as usize), 2)?;
    if is_fortran {
        let c_order = in_c_order(bytes, &shape, size as usize)?;
        return decode(&c_order, options);
    }
    let read = |error: std::io::Error| FormatError::Malformed(format!("damaged NPY: {error}"));
    match (shape[..].to_vec().as_slice(), kind, size) {
        (&[height, width], TypeChar::Uint, 2) => {
            validate_shape(width, height)?;
            Ok(Contents::Depth(DepthImage { width, height, raw: file.into_vec().map_err(read)? }))
        }
        (&[n, 3], TypeChar::Float, 8) => points_f64(n, 1, file.into_vec().map_err(read)?),
        (&[n, 3], TypeChar::Float, _) => points(n, 1, floats(file, size)?),
        (&[height, width], TypeChar::Float, 4 | 8) => {
            validate_shape(width, height)?;
            let depth_m = floats(file, size)?;
            Ok(Contents::DepthMetres { width, height, depth_m })
        }
        (&[height, width, 3], TypeChar::Float, _) => {
            validate_shape(width, height)?;
            match size {
                8 => points_f64(width, height, file.into_vec().map_err(read)?),
                _ => points(width, height, floats(file, size)?),
            }
        }
        _ => unsupported(format!("shape {shape:?} and type {kind:?} of {size} bytes")),
    }
}

/// The same array with its last index running fastest, whose header says so.
pub(super) fn in_c_order(bytes: &[u8], shape: &[usize], size: usize) -> Result<Vec<u8>, FormatError> {
    let cut = || FormatError::Malformed("the file is cut short: its NPY header is not whole".into());
    let start = match bytes.get(6..10).ok_or_else(cut)? {
        [1, _, low, high] => 10 + usize::from(u16::from_le_bytes([*low, *high])),
        _ => 12 + u32::from_le_bytes(bytes.get(8..12).ok_or_else(cut)?.try_into().map_err(|_| cut())?) as usize,
    };
    let (header, data) = bytes.split_at_checked(start).ok_or_else(cut)?;
    // The header keeps its length: a blank before True.
    let stated = b"'fortran_order': True";
    let at = header.windows(stated.len()).position(|window| window == stated).ok_or_else(|| {
        FormatError::Unsupported("an array in Fortran order: save numpy.ascontiguousarray of it".into())
    })?;
    let mut out = header.to_vec();
    out[at..at + stated.len()].copy_from_slice(b"'fortran_order':False");
    let count: usize = shape.iter().product();
    let mut index = vec![0usize; shape.len()];
    for _ in 0..count {
        // Where the element of this index is, with the first running fastest.
        let place = index.iter().zip(shape).rev().fold(0, |place, (&i, &n)| place * n + i);
        out.extend_from_slice(data.get(size * place..size * (place + 1)).ok_or_else(cut)?);
        for (i, &n) in index.iter_mut().zip(shape).rev() {
            *i += 1;
            if *i < n {
                break;
            }
            *i = 0;
        }
    }
    Ok(out)
}

/// Returns the values as f32, whether the file has f32 or f64.
fn floats(file: NpyFile<&[u8]>, size: u64) -> Result<Vec<f32>, FormatError> {
    let read = |error: std::io::Error| FormatError::Malformed(format!("damaged NPY: {error}"));
    match size {
        4 => file.into_vec().map_err(read),
        8 => Ok(file.into_vec::<f64>().map_err(read)?.into_iter().map(|value| value as f32).collect()),
        _ => Err(FormatError::Unsupported(format!("floats of {size} bytes: {LAYOUTS}"))),
    }
}

fn points(width: usize, height: usize, values: Vec<f32>) -> Result<Contents, FormatError> {
    let positions = values.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    organized_if_grid(Gridded { width, height, points: PointCloud::new(positions) })
}

/// Far clouds are kept relative to an origin, and written as f64 again.
fn points_f64(width: usize, height: usize, values: Vec<f64>) -> Result<Contents, FormatError> {
    let column = |axis: usize| {
        let values: Vec<f64> = values.iter().skip(axis).step_by(3).copied().collect();
        Attribute { name: ["x", "y", "z"][axis].to_owned(), count: 1, values: values.into() }
    };
    let points = cloud_from_columns(vec![column(0), column(1), column(2)])?;
    organized_if_grid(Gridded { width, height, points })
}

pub(super) fn encode<T: AutoSerialize + Copy>(
    shape: &[u64],
    values: impl Iterator<Item = T>,
) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Vec::new();
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd()?;
    writer.extend(values)?;
    writer.finish()?;
    Ok(bytes)
}

/// Encodes the positions only, [H, W, 3] or [N, 3]; far clouds as f64, so that no digits are lost.
pub(super) fn encode_points(cloud: CloudRef<'_>) -> Result<Vec<u8>, FormatError> {
    let (width, height) = cloud.grid();
    let shape = match cloud {
        CloudRef::Organized(_) => vec![height as u64, width as u64, 3],
        CloudRef::General(_) => vec![width as u64, 3],
    };
    let (positions, origin) = (&cloud.points().positions, cloud.points().origin_m);
    if origin == [0.0; 3] && !cloud.points().position_columns.double {
        encode(&shape, positions.iter().flatten())
    } else {
        let far = |i: usize| [0, 1, 2].map(|axis| cloud.points().coordinate(axis, i));
        encode(&shape, (0..positions.len()).flat_map(far))
    }
}

pub(super) fn encode_depth(image: &DepthImage) -> Result<Vec<u8>, FormatError> {
    encode(&[image.height as u64, image.width as u64], image.raw.iter().copied())
}

pub(super) fn encode_depth_metres(width: usize, depth_m: &[f32]) -> Result<Vec<u8>, FormatError> {
    let height = depth_m.len() / width.max(1);
    encode(&[height as u64, width as u64], depth_m.iter().copied())
}
