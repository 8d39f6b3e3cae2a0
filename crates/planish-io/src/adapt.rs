//! Adapts the fields of a cloud that was read from one format to the conventions of another format.

use planish_core::{PointCloud, Precision};

use super::{Format, LengthUnit, convert_to_metres};

/// Converts colours, intensities and the precision of coordinates to the conventions of the format `to`. `read` is the
/// format from which the cloud was read. Returns notes for users, one clause each.
///
/// PCD files get 4-byte coordinates, because PCL silently reads 8-byte coordinates as zeros. There are two exceptions:
/// clouds with coordinates beyond 1000 m, and clouds that were read from PCD files with 8-byte coordinates. `precision`
/// overrides these rules.
pub fn adapt_fields(cloud: &mut PointCloud, read: Format, to: Format, precision: Option<Precision>) -> Vec<String> {
    let mut notes = Vec::new();
    match to {
        Format::Ply if read != Format::Ply => cloud.unpack_colour(),
        Format::Pcd if read == Format::Ply => cloud.pack_colour(),
        Format::Las | Format::Laz if !matches!(read, Format::Las | Format::Laz) && cloud.scale_intensity() => {
            notes.push("intensities are scaled from [0, 1] to [0, 65535], the range of LAS".to_owned());
        }
        _ => {}
    }
    if precision == Some(Precision::F32) || precision.is_none() && to == Format::Pcd && read != Format::Pcd {
        cloud.position_columns.precision = Precision::AsNeeded;
    }
    if precision == Some(Precision::F32) && matches!(to, Format::Pcd | Format::Ply) && cloud.is_written_in_f64() {
        notes.push("coordinates are rounded to 32-bit floats (encoding f64 keeps their digits)".to_owned());
    }
    if let Some(precision) = precision {
        cloud.position_columns.precision = precision;
    }
    if to == Format::Pcd && precision.is_none() && cloud.is_written_in_f64() {
        notes.push(
            "coordinates are written as 64-bit floats, which PCL reads as zeros (encoding f32 writes 32-bit floats)"
                .to_owned(),
        );
    }
    let unit = LengthUnit::of_cloud(cloud);
    match to {
        _ if unit.is_metre() => {}
        Format::Las | Format::Laz => {}
        // The E57 standard requires metres.
        Format::E57 => notes.extend(convert_to_metres(cloud)),
        _ => notes.push(format!("the unit is the {unit} ({}), which {} files do not state", unit.symbol, to.name())),
    }
    notes
}

/// Returns notes on the holes and fields of a cloud that a format cannot store, one clause each.
pub fn losses(cloud: &PointCloud, to: Format) -> Vec<String> {
    let holes = cloud.len() - cloud.valid_points();
    match to {
        Format::Las | Format::Laz if holes > 0 => {
            vec![format!("{holes} holes are dropped, since LAS cannot store them")]
        }
        Format::Npy if !cloud.attributes.is_empty() => {
            let fields = cloud.attributes.len();
            vec![format!("{fields} fields are dropped, since NPY cannot store them (write .npz)")]
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_core::Xyz;

    fn cloud(x: f32, origin_m: f64, precision: Precision) -> PointCloud {
        let mut cloud = PointCloud::new(Xyz::filled(3, x));
        cloud.origin_m = [origin_m; 3];
        cloud.position_columns.precision = precision;
        cloud
    }

    #[test]
    fn pcd_has_four_bytes_unless_they_lose_digits_or_the_file_had_eight() {
        let written = |mut cloud: PointCloud, read, precision| {
            let notes = adapt_fields(&mut cloud, read, Format::Pcd, precision);
            (cloud.is_written_in_f64(), notes.len())
        };
        let near = || cloud(2.0, 3.0, Precision::F64);
        let far = || cloud(2.0, 500_000.0, Precision::F64);
        assert_eq!(written(near(), Format::Las, None), (false, 0));
        assert_eq!(written(near(), Format::Pcd, None), (true, 1));
        assert_eq!(written(near(), Format::Las, Some(Precision::F64)), (true, 0));
        assert_eq!(written(far(), Format::E57, None), (true, 1));
        assert_eq!(written(far(), Format::E57, Some(Precision::F32)), (false, 1));
        assert_eq!(written(near(), Format::E57, Some(Precision::F32)), (false, 0));
        // In other formats, coordinates keep their precision.
        let mut kept = near();
        adapt_fields(&mut kept, Format::Las, Format::Ply, None);
        assert!(kept.is_written_in_f64());
    }
}
