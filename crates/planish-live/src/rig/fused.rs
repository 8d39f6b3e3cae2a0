//! Fuses the clouds of several cameras in the rig's frame.

use std::borrow::Cow;
use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;

use super::{Rig, RigCamera};
use crate::source::OwnedFrame;
use planish_core::{
    Attribute, AttributeValues, Frame, FrameError, IntoFrame, Outputs, PointCloud, SensorPose, Smoothed, Xyz,
    internal::RigidTransform,
};

/// Distance from the rig's origin, in metres, beyond which f32 would lose tenths of a millimetre; positions are then
/// relative to the first camera.
const MOST_WITHOUT_ORIGIN_M: f64 = 1000.0;

/// Names of the fields that together hold a direction, one per component.
pub(super) const DIRECTIONS: [[&str; 3]; 2] = [["normal_x", "normal_y", "normal_z"], ["nx", "ny", "nz"]];

/// Name of the field with the index of each point's camera.
pub(super) const CAMERA_FIELD: &str = "camera";

/// A camera's part of a fused cloud.
pub(super) struct Part<'a> {
    /// Index of the camera in the rig.
    pub(super) camera: usize,
    pub(super) rig_from_points: RigidTransform,
    /// Coordinates x, y and z of the camera's points, including holes.
    pub(super) positions: [&'a [f32]; 3],
    pub(super) attributes: Vec<Cow<'a, Attribute>>,
}

/// Number of points per task.
const POINTS_OF_A_TASK: usize = 1 << 14;

/// Fuses clouds in the rig's frame. Each element of `clouds` consists of a camera's index, its pose (rig_from_camera)
/// and its points in the camera's frame.
///
/// Holes are omitted. Fields with the same name are merged, with zeros for points of cameras without the field.
/// Normals are rotated. The field `camera` contains the index of each point's camera. Positions are relative to
/// [`PointCloud::origin_m`], which is zero unless a camera is more than 1 km from the rig's origin.
///
/// # Errors
/// If a pose is invalid.
pub fn fuse(clouds: &[(usize, SensorPose, &PointCloud)]) -> Result<PointCloud, FrameError> {
    let mut parts = Vec::with_capacity(clouds.len());
    for &(camera, pose, cloud) in clouds {
        parts.push(Part {
            camera,
            rig_from_points: pose.transform()?.after(RigidTransform::shift(cloud.origin_m)),
            positions: cloud.positions.as_slices(),
            attributes: cloud.attributes.iter().map(Cow::Borrowed).collect(),
        });
    }
    let mut fused = PointCloud::new(Xyz::default());
    fuse_parts(&parts, &mut fused);
    Ok(fused)
}

/// Fuses parts into a cloud, reusing its memory.
pub(super) fn fuse_parts(parts: &[Part<'_>], cloud: &mut PointCloud) {
    // Parts without points do not affect the origin.
    let mut with_points = parts.iter().filter(|part| part.count(0..part.positions[0].len()) > 0).peekable();
    let first = with_points.peek().copied();
    let farthest = with_points.map(|part| part.rig_from_points.translation.abs().max_element()).fold(0.0, f64::max);
    let first = first.map_or(DVec3::ZERO, |part| part.rig_from_points.translation.round());
    let origin = if farthest > MOST_WITHOUT_ORIGIN_M { first } else { DVec3::ZERO };
    let mut cameras =
        match cloud.attributes.drain(..).find(|field| field.name == CAMERA_FIELD).map(|field| field.values) {
            Some(AttributeValues::U8(cameras)) => cameras,
            _ => Vec::new(),
        };
    *cloud = PointCloud::new(std::mem::take(&mut cloud.positions));
    cloud.origin_m = origin.to_array();
    place(parts, origin, &mut cloud.positions, &mut cameras);

    let mut fields: Vec<&Attribute> = Vec::new();
    for attribute in parts.iter().flat_map(|part| &part.attributes) {
        let is_new = fields.iter().all(|field| (&field.name, field.count) != (&attribute.name, attribute.count));
        if is_new && attribute.name != CAMERA_FIELD && attribute.name != "_" {
            fields.push(attribute);
        }
    }
    if !fields.is_empty() {
        let points: Vec<Vec<usize>> = parts.par_iter().map(Part::points).collect();
        cloud.attributes = fields.par_iter().map(|field| of_all_parts(field, parts, &points)).collect();
        for names in DIRECTIONS {
            turn_directions(cloud, names, parts, &points);
        }
    }
    cloud.set_attribute(CAMERA_FIELD, cameras);
}

/// Writes the points of all parts, without holes, in the rig's frame, and the camera index of each point.
fn place(parts: &[Part<'_>], origin: DVec3, positions: &mut Xyz, cameras: &mut Vec<u8>) {
    let ranges = |part| {
        let of_part: &Part<'_> = part;
        let len = of_part.positions[0].len();
        (0..len).step_by(POINTS_OF_A_TASK).map(move |start| (of_part, start..(start + POINTS_OF_A_TASK).min(len)))
    };
    let ranges: Vec<(&Part<'_>, Range<usize>)> = parts.iter().flat_map(ranges).collect();
    let counts: Vec<usize> = ranges.par_iter().map(|(part, range)| part.count(range.clone())).collect();
    let total = counts.iter().sum();
    // New memory is already zero; the tasks are the first to touch it.
    if positions.capacity() < total {
        *positions = Xyz::filled(total, 0.0);
    }
    positions.resize(total, 0.0);
    let [x, y, z] = positions.as_mut_slices();
    cameras.resize(total, 0);
    let (mut rest, mut rest_of_cameras) = ([x, y, z], &mut cameras[..]);
    let mut tasks = Vec::with_capacity(ranges.len());
    for ((part, range), &count) in ranges.into_iter().zip(&counts) {
        let [x, y, z] = rest.map(|axis| axis.split_at_mut(count));
        let (of_range, after) = rest_of_cameras.split_at_mut(count);
        (rest, rest_of_cameras) = ([x.1, y.1, z.1], after);
        tasks.push((part, range, [x.0, y.0, z.0], of_range));
    }
    tasks.into_par_iter().for_each(|(part, range, out, cameras)| {
        cameras.fill(part.camera as u8);
        part.place(range, origin, out);
    });
}

impl Part<'_> {
    fn is_point(&self, i: usize) -> bool {
        self.positions.iter().all(|axis| axis[i].is_finite())
    }

    /// Returns the indices of the part's points, without holes.
    fn points(&self) -> Vec<usize> {
        (0..self.positions[0].len()).filter(|&i| self.is_point(i)).collect()
    }

    fn count(&self, range: Range<usize>) -> usize {
        let [x, y, z] = self.positions.map(|axis| &axis[range.clone()]);
        x.iter().zip(y).zip(z).filter(|((x, y), z)| x.is_finite() & y.is_finite() & z.is_finite()).count()
    }

    /// Writes the points of a range, without holes, into slices of matching length.
    fn place(&self, range: Range<usize>, origin: DVec3, [out_x, out_y, out_z]: [&mut [f32]; 3]) {
        let [x, y, z] = self.positions.map(|axis| &axis[range.clone()]);
        let RigidTransform { rotation, translation } = self.rig_from_points;
        let shift = translation - origin;
        let points = x.iter().zip(y).zip(z).map(|((&x, &y), &z)| DVec3::new(x.into(), y.into(), z.into()));
        let out = out_x.iter_mut().zip(out_y).zip(out_z);
        for (p, ((x, y), z)) in points.filter(|p| p.is_finite()).zip(out) {
            [*x, *y, *z] = (rotation * p + shift).as_vec3().to_array();
        }
    }
}

/// Concatenates a field over the points of all parts, with zeros for parts without it.
fn of_all_parts(field: &Attribute, parts: &[Part<'_>], points: &[Vec<usize>]) -> Attribute {
    let mut values = field.values.emptied();
    for (part, indices) in parts.iter().zip(points) {
        let is_it = |a: &&Cow<'_, Attribute>| (&a.name, a.count) == (&field.name, field.count);
        match part.attributes.iter().find(is_it) {
            Some(attribute) => values.extend_from(&attribute.values, indices, field.count),
            None => values.push_zeros(indices.len() * field.count),
        }
    }
    Attribute { name: field.name.clone(), count: field.count, values }
}

/// Rotates direction fields, if present, from the cameras' frames to the rig's.
fn turn_directions(cloud: &mut PointCloud, names: [&str; 3], parts: &[Part<'_>], points: &[Vec<usize>]) {
    let index = |name: &str| {
        let is_it = |a: &Attribute| a.name == name && a.count == 1 && matches!(a.values, AttributeValues::F32(_));
        cloud.attributes.iter().position(is_it)
    };
    let [Some(x), Some(y), Some(z)] = names.map(index) else { return };
    let Ok([x, y, z]) = cloud.attributes.get_disjoint_mut([x, y, z]) else { return };
    let (AttributeValues::F32(x), AttributeValues::F32(y), AttributeValues::F32(z)) =
        (&mut x.values, &mut y.values, &mut z.values)
    else {
        return;
    };
    let mut first = 0;
    for (part, indices) in parts.iter().zip(points) {
        for i in first..first + indices.len() {
            let direction = DVec3::new(x[i].into(), y[i].into(), z[i].into());
            [x[i], y[i], z[i]] = (part.rig_from_points.rotation * direction).as_vec3().to_array();
        }
        first += indices.len();
    }
}

/// Returns the transform from a frame's points to the rig. A cloud's points may be in a different frame from its
/// camera's.
pub(super) fn rig_from_points(rig_from_camera: RigidTransform, frame: Frame<'_>) -> Result<RigidTransform, FrameError> {
    match frame {
        Frame::Depth(_) => Ok(rig_from_camera),
        Frame::Points(points) => {
            let camera_from_points =
                points.pose().transform()?.inverse().after(RigidTransform::shift(points.origin_m()));
            Ok(rig_from_camera.after(camera_from_points))
        }
    }
}

impl Rig {
    /// Fuses the results of a moment in the rig's frame: the smoothed points of each camera with all fields of its
    /// frame, the computed outputs among `fields`, and the index of its camera. Holes are omitted.
    pub fn fuse(&self, frames: &[Option<(&OwnedFrame, &Smoothed)>], fields: Outputs) -> Result<PointCloud, FrameError> {
        let placed = self.cameras.iter().zip(frames).enumerate();
        let parts = placed.filter_map(|(i, (camera, frame))| frame.map(|frame| part(i, camera, frame, fields)));
        let mut fused = PointCloud::new(Xyz::default());
        fuse_parts(&parts.collect::<Result<Vec<_>, FrameError>>()?, &mut fused);
        Ok(fused)
    }
}

fn part<'a>(
    index: usize,
    camera: &RigCamera,
    (source, smoothed): (&'a OwnedFrame, &'a Smoothed),
    fields: Outputs,
) -> Result<Part<'a>, FrameError> {
    let (width, height) = source.shape();
    smoothed.points.check_len("the smoothed points", width * height)?;
    let mut attributes = attributes_of(source);
    for (name, values) in smoothed.fields(fields) {
        attributes.retain(|attribute| attribute.name != name);
        attributes.push(Cow::Owned(Attribute { name: name.to_owned(), count: 1, values }));
    }
    let rig_from_points = rig_from_points(camera.pose.transform()?, source.into_frame()?)?;
    Ok(Part { camera: index, rig_from_points, positions: smoothed.points.as_slices(), attributes })
}

/// Returns a cloud's fields or a depth image's colour, without positions.
fn attributes_of(frame: &OwnedFrame) -> Vec<Cow<'_, Attribute>> {
    match frame {
        OwnedFrame::Cloud { cloud, .. } => cloud.points.attributes.iter().map(Cow::Borrowed).collect(),
        OwnedFrame::Depth(depth) => depth.packed_rgb().into_iter().map(Cow::Owned).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the pose of a camera that looks along the rig's x, as at the front of a robot.
    fn ahead(position_m: [f64; 3]) -> SensorPose {
        SensorPose { position_m, orientation: [0.5, -0.5, 0.5, -0.5] }
    }

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        PointCloud::new(points.iter().copied().collect())
    }

    #[test]
    fn points_and_normals_are_in_the_rig_s_frame_and_holes_are_left_out() {
        let mut left = cloud(&[[0.0, 0.0, 2.0], [f32::NAN; 3], [1.0, 0.0, 2.0]]);
        for (name, value) in [("normal_x", 0.0f32), ("normal_y", 0.0), ("normal_z", -1.0)] {
            left.set_attribute(name, vec![value; 3]);
        }
        left.set_attribute("label", vec![1u16, 2, 3]);
        let mut right = cloud(&[[0.0, 0.0, 1.0]]);
        right.set_attribute("label", vec![70_000i32]);
        right.set_attribute("intensity", vec![0.5f32]);
        let poses = [ahead([0.0, 0.5, 0.0]), SensorPose::IDENTITY];
        let fused = fuse(&[(0, poses[0], &left), (3, poses[1], &right)]).unwrap();
        assert_eq!(fused.positions.iter().collect::<Vec<_>>(), [[2.0, 0.5, 0.0], [2.0, -0.5, 0.0], [0.0, 0.0, 1.0]]);
        let field = |name| &fused.attribute(name).unwrap().values;
        assert_eq!(field("camera"), &AttributeValues::U8(vec![0, 0, 3]));
        assert_eq!(field("normal_x"), &AttributeValues::F32(vec![-1.0, -1.0, 0.0]));
        // Values are converted to the first camera's type, clamped to its range.
        assert_eq!(field("label"), &AttributeValues::U16(vec![1, 3, u16::MAX]));
        assert_eq!(field("intensity"), &AttributeValues::F32(vec![0.0, 0.0, 0.5]));
        fused.validate().unwrap();
    }

    #[test]
    fn far_from_the_origin_positions_are_relative() {
        let far = [500_000.0, 4_000_000.0, 300.0];
        let fused = fuse(&[(0, ahead(far), &cloud(&[[0.0, 0.0, 1.25]]))]).unwrap();
        assert_eq!(fused.origin_m, far);
        assert_eq!(fused.positions.get(0), [1.25, 0.0, 0.0]);
        assert_eq!(fuse(&[]).unwrap().len(), 0);
    }
}
