//! PCD v0.7, the Point Cloud Library's format: ascii, binary and binary_compressed.
//!
//! Every field keeps its size, type and count, including padding (`_`); the grid and the viewpoint are also kept.
//! Binary files store little-endian values point by point; compressed files store them field by field, compressed with
//! LZF. As in PCL, ascii files store a packed colour (`rgb`, `rgba`) as an unsigned integer even if it was a float,
//! because the bits of an opaque colour form a NaN and would be lost.

mod binary;
mod header;
pub mod lzf;

use crate::{
    CloudRef, Encoding, Gridded, ReadOptions,
    columns::{bytes_per_point, cloud_from_columns, columns_from_cloud},
    text,
};
use header::{Field, Header};
use planish_core::{Attribute, AttributeValues, FormatError, SensorPose};

/// Decodes a PCD file.
pub(crate) fn decode(bytes: &[u8], options: &ReadOptions) -> Result<Gridded, FormatError> {
    let (header, body) = Header::parse(bytes)?;
    // Memory for the columns and the decompressed bytes. If the file is too short to contain them, the error for a
    // truncated file is reported instead.
    let (decompressed, most_bytes) = match header.encoding {
        Encoding::Ascii => (0, body.len().saturating_mul(8)),
        Encoding::Binary => (0, body.len()),
        Encoding::BinaryCompressed => (header.point_bytes(), body.len().saturating_mul(lzf::MAX_REFERENCE)),
    };
    if header.point_bytes().checked_mul(header.points()).is_some_and(|bytes| bytes <= most_bytes) {
        let bytes_each = match crate::HAS_ROOM {
            true => bytes_per_point(&header.fields.iter().map(Field::empty_column).collect::<Vec<_>>()),
            false => header.point_bytes(),
        };
        options.check(header.points(), decompressed + bytes_each)?;
    }
    let columns = match header.encoding {
        Encoding::Ascii => {
            let mut columns: Vec<_> = header.fields.iter().map(Field::empty_column).collect();
            text::Body::new(body)?.read(&mut columns, header.points())?;
            columns
        }
        Encoding::Binary => binary::decode(&header, body)?,
        Encoding::BinaryCompressed => binary::decode_compressed(&header, body)?,
    };
    let mut points = cloud_from_columns(columns)?;
    points.pose = SensorPose::from_viewpoint(header.viewpoint);
    Ok(Gridded { width: header.width, height: header.height, points })
}

/// Returns the encoding that a file's header states.
pub(crate) fn encoding(bytes: &[u8]) -> Option<Encoding> {
    Header::parse(bytes).ok().map(|(header, _)| header.encoding)
}

/// Encodes a cloud as a PCD file.
pub(crate) fn encode(cloud: CloudRef<'_>, encoding: Encoding) -> Result<Vec<u8>, FormatError> {
    let mut columns = columns_from_cloud(cloud.points());
    if encoding == Encoding::Ascii {
        float_colours_to_integers(&mut columns);
    }
    let (width, height) = cloud.grid();
    let fields = columns.iter().map(Field::of).collect::<Result<Vec<_>, _>>()?;
    let header = Header { fields, width, height, viewpoint: cloud.points().pose.viewpoint(), encoding };
    let mut bytes = header.text().into_bytes();
    match encoding {
        Encoding::Ascii => text::write(&columns, header.points(), &mut bytes),
        Encoding::Binary => binary::encode(&header, &columns, &mut bytes),
        Encoding::BinaryCompressed => binary::encode_compressed(&columns, &mut bytes)?,
    }
    Ok(bytes)
}

/// Converts packed colours to unsigned integers. As floats in text, they could be NaN and lose their bits.
fn float_colours_to_integers(columns: &mut [Attribute]) {
    for column in columns.iter_mut().filter(|column| column.name == "rgb" || column.name == "rgba") {
        if let AttributeValues::F32(values) = &column.values {
            column.values = values.iter().map(|value| value.to_bits()).collect::<Vec<u32>>().into();
        }
    }
}
