//! Merges clouds of any origin.

use std::borrow::Cow;

use glam::DVec3;

use super::fused::{CAMERA_FIELD, DIRECTIONS, Part, fuse_parts};
use planish_core::{
    Attribute, AttributeValues, FrameError, PointCloud, Precision, SensorPose, Xyz, internal::RigidTransform,
};

/// Name of the field with the index of each point's scan.
const SCAN_FIELD: &str = "scan";

/// Maximum number of clouds, which are numbered by a byte.
const MOST_CLOUDS: usize = 256;

/// Merges clouds into one coordinate frame, in which each cloud is placed by its pose (`world_from_cloud`; the
/// identity leaves a cloud in place).
///
/// Coordinates in units other than metres, which LAS files may state, are converted. Holes are omitted. Fields with the
/// same name are merged; points from clouds that lack a field get zeros. Fields of different types become f64, and
/// packed colours become red, green and blue. Normals are rotated. The field `scan` contains the index of each point's
/// cloud, or of its scan if a cloud has several. Sensor positions are kept ([`PointCloud::scanners_m`]). The second
/// value is a list of notes for users, one clause each.
///
/// # Errors
/// If a pose is invalid, there are more than 256 clouds, no cloud has a point, or a coordinate exceeds the range of
/// f32.
pub fn merge(mut clouds: Vec<(PointCloud, SensorPose)>) -> Result<(PointCloud, Vec<String>), FrameError> {
    if clouds.len() > MOST_CLOUDS {
        let (what, expected) = ("the clouds to merge".into(), MOST_CLOUDS);
        return Err(FrameError::LengthMismatch { what, len: clouds.len(), expected });
    }
    clouds.iter_mut().for_each(|(cloud, _)| cloud.unpack_colour());
    // The merged cloud states no unit.
    let in_metres: Vec<String> =
        clouds.iter_mut().filter_map(|(cloud, _)| planish_io::convert_to_metres(cloud)).collect();
    let (mut parts, mut scanners_m, mut first_scans) = (Vec::with_capacity(clouds.len()), Vec::new(), Vec::new());
    for (i, (cloud, pose)) in clouds.iter().enumerate() {
        let world_from_cloud = pose.transform()?;
        let scanners = cloud.scanners_m().map(<[_]>::to_vec);
        let attributes = cloud.attributes.iter().map(|field| {
            let mut field = Cow::Borrowed(field);
            if field.name == SCAN_FIELD {
                let of_scans = (0..field.values.len()).map(|i| match &scanners {
                    Some(_) => field.values.get_f64(i) as u16,
                    None => 0,
                });
                let values = of_scans.collect::<Vec<u16>>().into();
                return Cow::Owned(Attribute { name: KEPT_SCAN.to_owned(), count: 1, values });
            }
            let others = clouds.iter().filter_map(|(cloud, _)| cloud.attribute(&field.name));
            let has_type =
                |values: &AttributeValues| std::mem::discriminant(values) == std::mem::discriminant(&field.values);
            let as_f64 = || (0..field.values.len()).map(|i| field.values.get_f64(i));
            if DIRECTIONS.iter().flatten().any(|name| *name == field.name) {
                // Directions are rotated as f32.
                let values = as_f64().map(|value| value as f32).collect::<Vec<f32>>();
                field.to_mut().values = values.into();
            } else if !others.map(|other| &other.values).all(has_type) {
                let values = as_f64().collect::<Vec<f64>>();
                field.to_mut().values = values.into();
            }
            if field.name == CAMERA_FIELD {
                field.to_mut().name = KEPT_CAMERA.to_owned();
            }
            field
        });
        parts.push(Part {
            camera: i,
            rig_from_points: world_from_cloud.after(RigidTransform::shift(cloud.origin_m)),
            positions: cloud.positions.as_slices(),
            attributes: attributes.collect(),
        });
        first_scans.push(scanners_m.len() as u16);
        let to_world = |position: [f64; 3]| world_from_cloud.to_cloud(DVec3::from_array(position)).to_array();
        match scanners {
            Some(scanners) => scanners_m.extend(scanners.into_iter().map(|scanner| scanner.map(to_world))),
            None => {
                let is_known = !cloud.pose.is_identity() || !pose.is_identity();
                scanners_m.push(is_known.then(|| to_world(cloud.pose.position_m)));
            }
        }
    }
    let mut merged = PointCloud::new(Xyz::default());
    fuse_parts(&parts, &mut merged);
    if merged.is_empty() {
        return Err(FrameError::NoPoints);
    }
    let mut notes = notes(&clouds);
    notes.extend(in_metres.into_iter().next());
    place_exactly(&clouds, &mut merged)?;
    let mut take = |name: &str| {
        let index = merged.attributes.iter().position(|field| field.name == name)?;
        Some(merged.attributes.remove(index).values)
    };
    // The fused cloud's field `camera` contains the index of the cloud.
    let (cloud_of, scan_of) = (take(CAMERA_FIELD), take(KEPT_SCAN));
    if let Some(AttributeValues::U8(cloud_of)) = cloud_of {
        let scan_of = match scan_of {
            Some(AttributeValues::U16(scan_of)) => scan_of,
            _ => vec![0; cloud_of.len()],
        };
        let scan = cloud_of.into_iter().zip(scan_of).map(|(cloud, scan)| first_scans[usize::from(cloud)] + scan);
        merged.set_attribute(SCAN_FIELD, scan.collect::<Vec<u16>>());
    }
    for field in merged.attributes.iter_mut().filter(|field| field.name == KEPT_CAMERA) {
        field.name = CAMERA_FIELD.to_owned();
    }
    if scanners_m.iter().any(Option::is_some) {
        merged.set_scanners_m(scanners_m);
    }
    Ok((merged, notes))
}

/// Returns notes on the fields that merging changes.
fn notes(clouds: &[(PointCloud, SensorPose)]) -> Vec<String> {
    let mut notes = Vec::new();
    let mut partial: Vec<&str> = Vec::new();
    for field in clouds.iter().flat_map(|(cloud, _)| &cloud.attributes).filter(|field| field.name != SCAN_FIELD) {
        let is_in_all = clouds.iter().all(|(cloud, _)| cloud.attribute(&field.name).is_some());
        if !is_in_all && field.name != "_" && !partial.contains(&field.name.as_str()) {
            partial.push(&field.name);
        }
    }
    if !partial.is_empty() {
        notes.push(format!("fields missing from some clouds are set to 0 there: {}", partial.join(", ")));
    }
    if clouds.iter().any(|(cloud, _)| cloud.attribute(SCAN_FIELD).is_some()) {
        notes.push("the field scan is renumbered".to_owned());
    }
    notes
}

/// Sets the positions of the merged cloud with the full precision of the inputs. Far from the origin, they are
/// relative to the approximate median of all points.
fn place_exactly(clouds: &[(PointCloud, SensorPose)], merged: &mut PointCloud) -> Result<(), FrameError> {
    let mut exact: [Vec<f64>; 3] = std::array::from_fn(|_| Vec::with_capacity(merged.len()));
    for (cloud, pose) in clouds {
        let world_from_cloud = pose.transform()?;
        for i in (0..cloud.len()).filter(|&i| cloud.positions.is_finite(i)) {
            let point = DVec3::from_array([0, 1, 2].map(|axis| cloud.coordinate(axis, i)));
            let point = if pose.is_identity() { point } else { world_from_cloud.to_cloud(point) };
            exact.iter_mut().zip(point.to_array()).for_each(|(exact, value)| exact.push(value));
        }
    }
    let largest_m = exact.iter().flatten().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    if largest_m > f64::from(f32::MAX) {
        return Err(FrameError::TooFar);
    }
    let is_far = largest_m > FAR_M;
    let middle = |values: &Vec<f64>| {
        let mut sample: Vec<f64> = values.iter().step_by(values.len().div_ceil(1000)).copied().collect();
        sample.sort_by(f64::total_cmp);
        sample[sample.len() / 2].round()
    };
    // Differences of larger coordinates could exceed f32's range.
    let has_origin = is_far && largest_m <= f64::from(f32::MAX / 2.0);
    merged.origin_m = if has_origin { [0, 1, 2].map(|axis| middle(&exact[axis])) } else { [0.0; 3] };
    let origin_m = merged.origin_m;
    let relative = |i: usize| [0, 1, 2].map(|axis| (exact[axis][i] - origin_m[axis]) as f32);
    merged.positions = (0..exact[0].len()).map(relative).collect();
    if is_far || clouds.iter().any(|(cloud, _)| cloud.is_written_in_f64()) {
        merged.position_columns.precision = Precision::F64;
        merged.keep_exact(exact);
    }
    Ok(())
}

/// Coordinate in metres beyond which f32 has too few digits.
const FAR_M: f64 = 1000.0;

/// Temporary name of an input's field `scan` during merging.
const KEPT_SCAN: &str = "scan of the input";

/// Temporary name of an input's field `camera` during merging.
const KEPT_CAMERA: &str = "camera of the input";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_are_placed_fields_keep_their_values_and_points_know_their_cloud() {
        let mut first = PointCloud::new([[0.0, 0.0, 2.0], [f32::NAN; 3]].into_iter().collect());
        first.set_attribute("label", vec![1u16, 2]);
        first.set_attribute("camera", vec![7u8, 8]);
        let mut second = PointCloud::new([[1.0, 0.0, 0.0]].into_iter().collect());
        second.set_attribute("label", vec![70_000i32]);
        second.set_attribute("scan", vec![9u16]);
        let moved = SensorPose { position_m: [0.0, 5.0, 0.0], ..SensorPose::IDENTITY };
        let (merged, notes) = merge(vec![(first, SensorPose::IDENTITY), (second, moved)]).unwrap();
        assert!(notes.len() == 2 && notes[0].ends_with("camera"), "{notes:?}");
        assert_eq!(merged.positions.iter().collect::<Vec<_>>(), [[0.0, 0.0, 2.0], [1.0, 5.0, 0.0]]);
        let field = |name| &merged.attribute(name).unwrap().values;
        assert_eq!(field("label"), &AttributeValues::F64(vec![1.0, 70_000.0]));
        assert_eq!(field("scan"), &AttributeValues::U16(vec![0, 1]));
        assert_eq!(field("camera"), &AttributeValues::U8(vec![7, 0]));
        assert_eq!(merged.scanners_m().unwrap(), [None, Some([0.0, 5.0, 0.0])]);
        merged.validate().unwrap();
        // Clouds that are far apart keep all their digits.
        let mut far = PointCloud::new([[0.25, 0.0, 0.0]].into_iter().collect());
        far.origin_m = [500_000.0, 4_000_000.0, 0.0];
        let near = PointCloud::new([[0.1, 0.2, 0.3]].into_iter().collect());
        let (merged, _) = merge(vec![(near.clone(), SensorPose::IDENTITY), (far, SensorPose::IDENTITY)]).unwrap();
        assert_eq!([merged.coordinate(0, 0), merged.coordinate(0, 1)], [f64::from(0.1f32), 500_000.25]);
        assert!(merged.is_written_in_f64());
        assert!(merge(vec![(PointCloud::new(Xyz::default()), SensorPose::IDENTITY)]).is_err());
        let many = vec![(PointCloud::new(Xyz::default()), SensorPose::IDENTITY); 257];
        assert!(merge(many).unwrap_err().to_string().contains("257"));
    }
}
