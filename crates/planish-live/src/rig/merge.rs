//! Puts clouds of any origin together.

use std::borrow::Cow;

use super::fused::{CAMERA_FIELD, Part, fuse_parts};
use planish_core::{AttributeValues, FrameError, PointCloud, SensorPose, Xyz, internal::RigidTransform};

/// The field with the number of each point's scan.
const SCAN_FIELD: &str = "scan";

/// Fields number at most this many clouds.
const MOST_CLOUDS: usize = 256;

/// Puts clouds together in one frame, each with its pose there (`world_from_cloud`; the identity leaves it where it
/// is).
///
/// Holes are left out. Fields with the same name are merged, with zeros for points of clouds without them; types that
/// differ become f64. Normals are rotated. The field `scan` contains the index of each point's cloud, and the positions
/// of the sensors are kept as those of scanners ([`PointCloud::scanners_m`]).
///
/// # Errors
/// If a pose is invalid, or there are more than 256 clouds.
pub fn merge(clouds: &[(PointCloud, SensorPose)]) -> Result<PointCloud, FrameError> {
    if clouds.len() > MOST_CLOUDS {
        let (what, expected) = ("the clouds to merge".into(), MOST_CLOUDS);
        return Err(FrameError::LengthMismatch { what, len: clouds.len(), expected });
    }
    let (mut parts, mut scanners_m) = (Vec::with_capacity(clouds.len()), Vec::new());
    for (i, (cloud, pose)) in clouds.iter().enumerate() {
        let world_from_cloud = pose.transform()?;
        let attributes = cloud.attributes.iter().filter(|field| field.name != SCAN_FIELD).map(|field| {
            let others = clouds.iter().filter_map(|(cloud, _)| cloud.attribute(&field.name));
            let has_type =
                |values: &AttributeValues| std::mem::discriminant(values) == std::mem::discriminant(&field.values);
            let mut field = Cow::Borrowed(field);
            if !others.map(|other| &other.values).all(has_type) {
                let values = (0..field.values.len()).map(|i| field.values.get_f64(i)).collect::<Vec<f64>>();
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
        let sensor = cloud.pose.transform()?.translation;
        let is_known = !cloud.pose.is_identity() || !pose.is_identity();
        scanners_m.push(is_known.then(|| world_from_cloud.to_cloud(sensor).to_array()));
    }
    let mut merged = PointCloud::new(Xyz::default());
    fuse_parts(&parts, &mut merged);
    // The fused cloud's own field has the number of the cloud.
    if let Some(index) = merged.attributes.iter().position(|field| field.name == CAMERA_FIELD) {
        let cloud_of = merged.attributes.remove(index);
        if let AttributeValues::U8(cloud_of) = cloud_of.values {
            merged.set_attribute(SCAN_FIELD, cloud_of.into_iter().map(u16::from).collect::<Vec<_>>());
        }
    }
    for field in merged.attributes.iter_mut().filter(|field| field.name == KEPT_CAMERA) {
        field.name = CAMERA_FIELD.to_owned();
    }
    if scanners_m.iter().any(Option::is_some) {
        merged.set_scanners_m(scanners_m);
    }
    Ok(merged)
}

/// Name of an input's field `camera` while clouds are put together.
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
        let merged = merge(&[(first, SensorPose::IDENTITY), (second, moved)]).unwrap();
        assert_eq!(merged.positions.iter().collect::<Vec<_>>(), [[0.0, 0.0, 2.0], [1.0, 5.0, 0.0]]);
        let field = |name| &merged.attribute(name).unwrap().values;
        assert_eq!(field("label"), &AttributeValues::F64(vec![1.0, 70_000.0]));
        assert_eq!(field("scan"), &AttributeValues::U16(vec![0, 1]));
        assert_eq!(field("camera"), &AttributeValues::U8(vec![7, 0]));
        assert_eq!(merged.scanners_m().unwrap(), [None, Some([0.0, 5.0, 0.0])]);
        merged.validate().unwrap();
        let many = vec![(PointCloud::new(Xyz::default()), SensorPose::IDENTITY); 257];
        assert!(merge(&many).unwrap_err().to_string().contains("257"));
    }
}
