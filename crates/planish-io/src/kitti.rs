//! Lidar scans as plain f32: KITTI's `.bin` with x, y, z, intensity, and nuScenes' `.pcd.bin` with an additional ring.
//!
//! The files have no header: the file name's extension decides.

use super::{CloudRef, FormatResult, ReadOptions};
use planish_core::{Attribute, AttributeValues, FormatError, PointCloud};

const FIELDS: [&str; 2] = ["intensity", "ring"];

pub(super) fn decode(bytes: &[u8], has_ring: bool, options: &ReadOptions) -> FormatResult<PointCloud> {
    let columns = if has_ring { 5 } else { 4 };
    let record = 4 * columns;
    if !bytes.len().is_multiple_of(record) {
        return Err(FormatError::Malformed(format!(
            "{} bytes are not a multiple of {columns} floats of 4 bytes, the points of a lidar's .bin: truncated, or \
             in another layout",
            bytes.len()
        )));
    }
    options.check(bytes.len(), 2)?;
    let value = |point: &[u8], k: usize| f32::from_le_bytes(std::array::from_fn(|i| point[4 * k + i]));
    let column = |k: usize| -> Vec<f32> { bytes.chunks_exact(record).map(|point| value(point, k)).collect() };
    let positions = bytes.chunks_exact(record).map(|point| [0, 1, 2].map(|k| value(point, k))).collect();
    let mut cloud = PointCloud::new(positions);
    let largest = cloud.extent_m().into_iter().fold(0.0, f32::max);
    // No lidar sees that far: bytes that are no floats.
    if cloud.valid_points() * 2 < cloud.len() || largest > 1e9 {
        return Err(FormatError::Malformed(
            "its values are not positions in metres: not a lidar's .bin of floats".into(),
        ));
    }
    for (k, name) in FIELDS.into_iter().enumerate().take(columns - 3) {
        cloud.set_attribute(name, column(3 + k));
    }
    Ok(cloud)
}

/// Encodes x, y, z, intensity, and optionally the ring; missing fields become 0.
pub(super) fn encode(cloud: CloudRef<'_>, has_ring: bool) -> FormatResult<Vec<u8>> {
    let points = cloud.points();
    let fields = &FIELDS[..if has_ring { 2 } else { 1 }];
    let other = points.attributes.iter().find(|attribute| !fields.contains(&attribute.name.as_str()));
    if let Some(Attribute { name, .. }) = other {
        return Err(FormatError::Unsupported(format!(
            "a lidar's .bin stores x, y, z and {}, but the cloud has the field {name}; write .pcd, .ply or .las",
            fields.join(", ")
        )));
    }
    let values: Vec<Option<&AttributeValues>> =
        fields.iter().map(|name| points.attribute(name).map(|attribute| &attribute.values)).collect();
    let mut bytes = Vec::with_capacity(points.len() * 4 * (3 + fields.len()));
    for (i, p) in points.positions.iter().enumerate() {
        let position = (0..3).map(|axis| (points.origin_m[axis] + f64::from(p[axis])) as f32);
        let rest = values.iter().map(|values| values.map_or(0.0, |values| values.get_f64(i) as f32));
        position.chain(rest).for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    }
    Ok(bytes)
}
