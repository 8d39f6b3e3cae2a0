//! Metadata of the scans in an E57 file: scanner poses, and the ranges of measured values.

use std::io::{Read, Seek, Write};

use e57::{
    ColorLimits, DateTime, IntensityLimits, PointCloudWriter, Quaternion, Record, RecordDataType, RecordName,
    RecordValue,
};
use glam::{DQuat, DVec3};
use planish_core::{FormatError, SensorPose};

/// Metadata of an E57 file.
#[derive(Debug, Clone)]
pub(super) struct Scans {
    pub(super) scans: Vec<e57::PointCloud>,
    pub(super) creation: Option<DateTime>,
    /// The coordinate system of the file, as well-known text.
    pub(super) coordinate_metadata: Option<String>,
}

impl Scans {
    /// Returns each scan's scanner position in metres, if there are several scans and at least one has a pose. The
    /// identity does not count as a pose.
    pub(super) fn scanners_m(&self) -> Option<Vec<Option<[f64; 3]>>> {
        let scanner = |scan: &e57::PointCloud| {
            let (rotation, position) = pose_of(scan);
            (rotation != DQuat::IDENTITY || position != DVec3::ZERO).then(|| position.to_array())
        };
        let scanners: Vec<_> = self.scans.iter().map(scanner).collect();
        (scanners.len() > 1 && scanners.iter().any(Option::is_some)).then_some(scanners)
    }
}

impl PartialEq for Scans {
    fn eq(&self, other: &Self) -> bool {
        let key = |scan: &e57::PointCloud| (scan.guid.clone(), scan.name.clone(), scan.records);
        self.scans.iter().map(key).eq(other.scans.iter().map(key))
    }
}

/// Checks the pose of a scan. Returns a note for users if its rotation is unset.
///
/// # Errors
/// If the pose is invalid.
pub(super) fn check_pose(scan: &e57::PointCloud) -> Result<Option<&'static str>, FormatError> {
    let Some(transform) = &scan.transform else { return Ok(None) };
    let (Quaternion { w, x, y, z }, at) = (&transform.rotation, &transform.translation);
    let pose = SensorPose::from_xyzw([at.x, at.y, at.z], [*x, *y, *z, *w]);
    pose.validate().map_err(|error| FormatError::Malformed(format!("a scan has an invalid pose: {error}")))?;
    Ok((pose.orientation == [0.0; 4]).then_some("scans whose rotation is zero are read without rotation"))
}

/// Returns the transform from a scan's frame to the file's frame.
pub(super) fn pose_of(scan: &e57::PointCloud) -> (DQuat, DVec3) {
    scan.transform.as_ref().map_or((DQuat::IDENTITY, DVec3::ZERO), |transform| {
        let Quaternion { w, x, y, z } = transform.rotation;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        let rotation = if rotation.length() > 0.0 { rotation.normalize() } else { DQuat::IDENTITY };
        (rotation, DVec3::new(transform.translation.x, transform.translation.y, transform.translation.z))
    })
}

/// Returns a limit for a field's values, converted to the type in which the field is written.
fn limit(value: Option<&RecordValue>, read: &Record, written: &Record) -> Option<RecordValue> {
    let value = value?.to_f64(&read.data_type).ok()?;
    Some(match written.data_type {
        RecordDataType::Single { .. } => RecordValue::Single(value as f32),
        RecordDataType::Integer { .. } => RecordValue::Integer(value as i64),
        _ => RecordValue::Double(value),
    })
}

/// Sets the sensor's range of intensities and colours, if the scan states it. Otherwise, the writer states the full
/// range of the type.
pub(super) fn set_limits<T: Read + Write + Seek>(
    points: &mut PointCloudWriter<'_, T>,
    scan: &e57::PointCloud,
    prototype: &[Record],
) {
    let of = |name: RecordName, value: &Option<RecordValue>| {
        let named = |records: &[Record]| records.iter().find(|record| record.name == name).cloned();
        limit(value.as_ref(), &named(&scan.prototype)?, &named(prototype)?)
    };
    if let Some(IntensityLimits { intensity_min, intensity_max }) = &scan.intensity_limits {
        let of_intensity = |value| of(RecordName::Intensity, value);
        let limits = [of_intensity(intensity_min), of_intensity(intensity_max)];
        if let [intensity_min @ Some(_), intensity_max @ Some(_)] = limits {
            points.set_intensity_limits(Some(IntensityLimits { intensity_min, intensity_max }));
        }
    }
    if let Some(limits) = &scan.color_limits {
        let [red, green, blue] = [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue];
        let limits = ColorLimits {
            red_min: of(red.clone(), &limits.red_min),
            red_max: of(red, &limits.red_max),
            green_min: of(green.clone(), &limits.green_min),
            green_max: of(green, &limits.green_max),
            blue_min: of(blue.clone(), &limits.blue_min),
            blue_max: of(blue, &limits.blue_max),
        };
        if limits.red_max.is_some() && limits.green_max.is_some() && limits.blue_max.is_some() {
            points.set_color_limits(Some(limits));
        }
    }
}
