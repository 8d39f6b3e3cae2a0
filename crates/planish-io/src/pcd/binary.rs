//! Reads and writes the binary bodies of PCD files: point by point, or field by field and compressed.

use super::header::{Header, Scalar};
use super::lzf;
use crate::{columns::with_values, little_endian::LittleEndian};
use planish_core::{Attribute, AttributeValues, FormatError};

/// Reads one field: the `count` values at `offset` in each point of `stride` bytes.
fn read_field(
    scalar: Scalar,
    count: usize,
    points: usize,
    bytes: &[u8],
    offset: usize,
    stride: usize,
) -> AttributeValues {
    fn values<T: LittleEndian>(count: usize, points: usize, bytes: &[u8], offset: usize, stride: usize) -> Vec<T> {
        let size = size_of::<T>();
        if count == 1 {
            let of_point = |point: &[u8]| T::read(&point[offset..offset + size]);
            return bytes.chunks_exact(stride).take(points).map(of_point).collect();
        }
        let mut values = Vec::with_capacity(points * count);
        for point in bytes.chunks_exact(stride).take(points) {
            let field = &point[offset..offset + count * size];
            values.extend(field.chunks_exact(size).map(T::read));
        }
        values
    }
    match scalar {
        Scalar::I8 => values::<i8>(count, points, bytes, offset, stride).into(),
        Scalar::I16 => values::<i16>(count, points, bytes, offset, stride).into(),
        Scalar::I32 => values::<i32>(count, points, bytes, offset, stride).into(),
        Scalar::I64 => values::<i64>(count, points, bytes, offset, stride).into(),
        Scalar::U8 => values::<u8>(count, points, bytes, offset, stride).into(),
        Scalar::U16 => values::<u16>(count, points, bytes, offset, stride).into(),
        Scalar::U32 => values::<u32>(count, points, bytes, offset, stride).into(),
        Scalar::U64 => values::<u64>(count, points, bytes, offset, stride).into(),
        Scalar::F32 => values::<f32>(count, points, bytes, offset, stride).into(),
        Scalar::F64 => values::<f64>(count, points, bytes, offset, stride).into(),
    }
}

/// Decodes the body after `DATA binary`.
pub(super) fn decode(header: &Header, body: &[u8]) -> Result<Vec<Attribute>, FormatError> {
    let stride = header.point_bytes();
    let needed = stride.checked_mul(header.points());
    if needed.is_none_or(|needed| body.len() < needed) {
        return Err(FormatError::Malformed(format!(
            "the file is truncated: its header states {} points of {stride} bytes, but {} bytes follow",
            header.points(),
            body.len()
        )));
    }
    let mut offset = 0;
    let read = |field: &super::Field| {
        let values = read_field(field.scalar, field.count, header.points(), body, offset, stride);
        offset += field.bytes();
        Attribute { name: field.name.clone(), count: field.count, values }
    };
    Ok(header.fields.iter().map(read).collect())
}

/// Decodes the body after `DATA binary_compressed`: the compressed and the decompressed size as u32, then the
/// compressed fields.
pub(super) fn decode_compressed(header: &Header, body: &[u8]) -> Result<Vec<Attribute>, FormatError> {
    let malformed = |text: String| Err(FormatError::Malformed(text));
    let Some((sizes, compressed)) = body.split_at_checked(8) else {
        return malformed("the file is truncated: the sizes of the compressed data are missing".into());
    };
    let (compressed_size, size) = (u32::read(&sizes[..4]) as usize, u32::read(&sizes[4..]) as usize);
    let expected = header.point_bytes().checked_mul(header.points());
    if expected != Some(size) {
        return malformed(format!(
            "the compressed data hold {size} bytes, but the header states {} points of {} bytes",
            header.points(),
            header.point_bytes()
        ));
    }
    let Some(compressed) = compressed.get(..compressed_size) else {
        return malformed(format!(
            "the file is truncated: its header states {compressed_size} compressed bytes, but {} follow",
            compressed.len()
        ));
    };
    let data = lzf::decompress(compressed, size).map_err(|error| FormatError::Malformed(error.to_string()))?;
    let mut rest = &data[..];
    let read = |field: &super::Field| {
        let (bytes, after) = rest.split_at(field.bytes() * header.points());
        rest = after;
        let values = read_field(field.scalar, field.count, header.points(), bytes, 0, field.bytes());
        Attribute { name: field.name.clone(), count: field.count, values }
    };
    Ok(header.fields.iter().map(read).collect())
}

/// Appends the body after `DATA binary` to `bytes`.
pub(super) fn encode(header: &Header, columns: &[Attribute], bytes: &mut Vec<u8>) {
    let stride = header.point_bytes();
    let start = bytes.len();
    bytes.resize(start + stride * header.points(), 0);
    let body = &mut bytes[start..];
    let mut offset = 0;
    for (column, field) in columns.iter().zip(&header.fields) {
        let size = field.scalar.size();
        with_values!(&column.values, values => {
            for (point, values) in body.chunks_exact_mut(stride).zip(values.chunks_exact(column.count)) {
                let bytes = &mut point[offset..offset + field.bytes()];
                for (bytes, value) in bytes.chunks_exact_mut(size).zip(values) {
                    value.write(bytes);
                }
            }
        });
        offset += field.bytes();
    }
}

/// Appends the body after `DATA binary_compressed` to `bytes`.
pub(super) fn encode_compressed(columns: &[Attribute], bytes: &mut Vec<u8>) -> Result<(), FormatError> {
    let size: usize = columns.iter().map(|column| column.values.len() * column.values.scalar_size()).sum();
    let mut data = Vec::with_capacity(size);
    for column in columns {
        with_values!(&column.values, values => {
            for value in values {
                data.extend_from_slice(&value.to_le_bytes());
            }
        });
    }
    let compressed = lzf::compress(&data);
    let (Ok(compressed_size), Ok(size)) = (u32::try_from(compressed.len()), u32::try_from(size)) else {
        return Err(FormatError::Unsupported("a compressed PCD file cannot exceed 4 GiB; write it as binary".into()));
    };
    bytes.extend_from_slice(&compressed_size.to_le_bytes());
    bytes.extend_from_slice(&size.to_le_bytes());
    bytes.extend_from_slice(&compressed);
    Ok(())
}
