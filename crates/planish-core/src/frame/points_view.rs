//! Borrowed points: planes or interleaved, f32 or f64, on a grid or not.

use std::ops::Range;

use glam::DVec3;

use super::{Colours, check_rows};
use crate::camera::Camera;
use crate::cloud::{OrganizedCloud, PointCloud};
use crate::error::{FrameError, ParamError};
use crate::pose::{RigidTransform, SensorPose};
use crate::threads::ONE_THREAD;
use crate::xyz::{MAX_PIXELS, Xyz, validate_shape};

/// The type of a coordinate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scalar {
    /// IEEE 754, 32 bits.
    F32,
    /// IEEE 754, 64 bits.
    F64,
}

/// The layout of interleaved points, as in ROS's PointCloud2 and PCL's structs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PointLayout {
    /// The type of x, y and z, in the byte order of this machine.
    pub scalar: Scalar,
    /// Offsets in bytes of x, y and z from the beginning of a point.
    pub offsets: [usize; 3],
    /// Distance in bytes from one point to the next in a row.
    pub point_stride: usize,
    /// Distance in bytes from one row to the next.
    pub row_stride: usize,
}

/// Borrowed points in the memory layout of their owner: three planes or interleaved rows, f32 or f64, organized or
/// unorganized.
///
/// ```
/// use planish::{PointsView, SensorPose};
///
/// let points = vec![[0.0f32, 0.0, 1.0]; 64 * 48];
/// let pose = SensorPose::from_viewpoint([0.1, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5]);
/// let view = PointsView::from_rows(&points)?.with_grid(64, 48)?.with_pose(pose)?;
/// assert_eq!(view.len(), 64 * 48);
/// # Ok::<(), planish::FrameError>(())
/// ```
///
/// Results are in the frame of the points. f32 is too coarse for georeferenced coordinates:
/// [`PointsView::with_origin`] makes results relative to an origin near the data.
#[derive(Debug, Clone, Copy)]
pub struct PointsView<'a> {
    positions: Positions<'a>,
    len: usize,
    grid: Option<(usize, usize)>,
    /// The sensor's pose in the frame of the file, not relative to `origin_m`.
    pose: SensorPose,
    /// The offset to add to a result to convert it back to the frame of the file.
    origin_m: DVec3,
    /// The offset that is subtracted from the positions. The origin of a [`PointCloud`] is not subtracted, because
    /// its positions are already relative to it.
    subtracted_m: DVec3,
    camera: Option<&'a Camera>,
    /// Extent in metres and number of points of the whole cloud, if these points are a part of one.
    whole: Option<(f64, usize)>,
    /// The cloud that the positions belong to; `None` for other buffers.
    cloud: Option<&'a PointCloud>,
}

/// The coordinates in their memory layout.
#[derive(Debug, Clone, Copy)]
enum Positions<'a> {
    Planes([&'a [f32]; 3]),
    PlanesF64([&'a [f64]; 3]),
    /// Interleaved points, `row_points` in each row of the layout.
    Interleaved {
        bytes: &'a [u8],
        layout: PointLayout,
        row_points: usize,
    },
}

impl<'a> PointsView<'a> {
    /// Borrows x, y and z in metres from three slices of the same length.
    pub fn from_planes(x: &'a [f32], y: &'a [f32], z: &'a [f32]) -> Result<Self, FrameError> {
        check_planes([x.len(), y.len(), z.len()])?;
        Ok(Self::of(Positions::Planes([x, y, z]), x.len()))
    }

    /// Same as [`from_planes`](Self::from_planes), for f64.
    pub fn from_planes_f64(x: &'a [f64], y: &'a [f64], z: &'a [f64]) -> Result<Self, FrameError> {
        check_planes([x.len(), y.len(), z.len()])?;
        Ok(Self::of(Positions::PlanesF64([x, y, z]), x.len()))
    }

    /// Borrows interleaved points: x, y and z of each point in metres.
    pub fn from_rows(points: &'a [[f32; 3]]) -> Result<Self, FrameError> {
        let layout =
            PointLayout { scalar: Scalar::F32, offsets: [0, 4, 8], point_stride: 12, row_stride: 12 * points.len() };
        Self::from_bytes(bytemuck::cast_slice(points), layout, (points.len(), 1))
    }

    /// Borrows interleaved points of four values each, as in PCL's PointXYZ and GPU buffers; the fourth value is
    /// ignored.
    pub fn from_rows4(points: &'a [[f32; 4]]) -> Result<Self, FrameError> {
        let layout =
            PointLayout { scalar: Scalar::F32, offsets: [0, 4, 8], point_stride: 16, row_stride: 16 * points.len() };
        Self::from_bytes(bytemuck::cast_slice(points), layout, (points.len(), 1))
    }

    /// Borrows interleaved points in f64, as in Open3D and NumPy.
    pub fn from_rows_f64(points: &'a [[f64; 3]]) -> Result<Self, FrameError> {
        let layout =
            PointLayout { scalar: Scalar::F64, offsets: [0, 8, 16], point_stride: 24, row_stride: 24 * points.len() };
        Self::from_bytes(bytemuck::cast_slice(points), layout, (points.len(), 1))
    }

    /// Borrows points from bytes in any layout; the bytes may be unaligned. (width, height) is the grid; a height of 1
    /// means that there is no grid, as in ROS and PCL.
    pub fn from_bytes(
        bytes: &'a [u8],
        layout: PointLayout,
        (width, height): (usize, usize),
    ) -> Result<Self, FrameError> {
        let size = match layout.scalar {
            Scalar::F32 => 4,
            Scalar::F64 => 8,
        };
        let positions = Positions::Interleaved { bytes, layout, row_points: width };
        if (width, height) == (0, 0) || (width, height) == (0, 1) {
            return Ok(Self::of(positions, 0));
        }
        let point_end = layout.offsets.iter().map(|offset| offset.saturating_add(size)).max().unwrap_or(0);
        if layout.point_stride < point_end {
            let (what, stride) = ("point stride", layout.point_stride);
            return Err(FrameError::BadStride { what, stride, least: point_end });
        }
        validate_shape(width, height)?;
        let row_bytes = (width - 1).checked_mul(layout.point_stride).and_then(|row| row.checked_add(point_end));
        let row_stride = if height == 1 { row_bytes.unwrap_or(usize::MAX) } else { layout.row_stride };
        check_rows("the byte buffer of points", bytes.len(), (row_bytes.unwrap_or(usize::MAX), height), row_stride)?;
        let view = Self::of(positions, width * height);
        if height > 1 { view.with_grid(width, height) } else { Ok(view) }
    }

    fn of(positions: Positions<'a>, len: usize) -> Self {
        Self {
            positions,
            len,
            grid: None,
            pose: SensorPose::IDENTITY,
            origin_m: DVec3::ZERO,
            subtracted_m: DVec3::ZERO,
            camera: None,
            whole: None,
            cloud: None,
        }
    }

    /// Borrows an unorganized cloud.
    pub fn from_cloud(cloud: &'a PointCloud) -> Result<Self, FrameError> {
        cloud.positions.check_len("positions", cloud.len())?;
        check_origin(cloud.origin_m)?;
        let positions = &cloud.positions;
        let view = Self::from_planes(positions.x(), positions.y(), positions.z())?;
        Self { origin_m: DVec3::from_array(cloud.origin_m), cloud: Some(cloud), ..view }.with_pose(cloud.pose)
    }

    /// Borrows an organized cloud.
    pub fn from_organized(cloud: &'a OrganizedCloud) -> Result<Self, FrameError> {
        cloud.positions().check_len("positions", cloud.width() * cloud.height())?;
        let view = Self::from_cloud(&cloud.points)?.with_grid(cloud.width(), cloud.height())?;
        match &cloud.camera {
            Some(camera) => view.with_camera(camera),
            None => Ok(view),
        }
    }

    /// Arranges the points row by row on a grid of pixels; refuses a grid that they do not fill exactly.
    pub fn with_grid(self, width: usize, height: usize) -> Result<Self, FrameError> {
        validate_shape(width, height)?;
        if width * height != self.len {
            let what = format!("an organized cloud of {width}x{height}");
            return Err(FrameError::LengthMismatch { what, len: self.len, expected: width * height });
        }
        Ok(Self { grid: Some((width, height)), ..self })
    }

    /// Sets the position and orientation of the sensor in the frame of the points. Without this call, they are
    /// estimated (docs/method.md, section 11).
    pub fn with_pose(self, pose: SensorPose) -> Result<Self, FrameError> {
        pose.validate()?;
        Ok(Self { pose, ..self })
    }

    /// Sets the camera that took the points: its pixels form the grid, and depth becomes available as an output.
    pub fn with_camera(self, camera: &'a Camera) -> Result<Self, FrameError> {
        camera.validate()?;
        camera.check_shape(self.grid.unwrap_or((self.len, 1)))?;
        Ok(Self { camera: Some(camera), ..self })
    }

    /// Subtracts an origin near the data from the points and the pose. Results are then relative to this origin, and
    /// lose less precision when they are rounded to f32.
    pub fn with_origin(self, origin_m: [f64; 3]) -> Result<Self, FrameError> {
        check_origin(origin_m)?;
        let origin_m = DVec3::from_array(origin_m);
        // The positions may already be relative to another origin.
        Ok(Self { origin_m, subtracted_m: self.subtracted_m + (origin_m - self.origin_m), ..self })
    }

    /// Marks the view as part of a cloud that has `points` points and an extent of `extent_m` metres.
    pub fn as_part_of(self, points: usize, extent_m: f64) -> Self {
        Self { whole: Some((extent_m, points)), ..self }
    }

    /// Returns the extent of the whole cloud in metres; `None` if these points are not a part of one.
    pub fn extent_m(&self) -> Option<f64> {
        self.whole.map(|(extent_m, _)| extent_m)
    }

    /// Returns the number of points in the whole cloud, excluding holes.
    pub fn points_of_whole(&self) -> usize {
        self.whole.map_or_else(|| self.valid_points(), |(_, points)| points)
    }

    /// Returns a view of other positions on a grid, relative to the same origin.
    pub(super) fn regridded<'b>(&self, positions: &'b Xyz, grid: (usize, usize), pose: SensorPose) -> PointsView<'b> {
        let planes = Positions::Planes([positions.x(), positions.y(), positions.z()]);
        PointsView { grid: Some(grid), pose, origin_m: self.origin_m, ..PointsView::of(planes, positions.len()) }
    }

    /// Returns a view of the same points at other positions, relative to the same origin.
    pub(crate) fn moved_to<'b>(&self, positions: &'b Xyz) -> PointsView<'b>
    where
        'a: 'b,
    {
        let planes = Positions::Planes([positions.x(), positions.y(), positions.z()]);
        PointsView { positions: planes, subtracted_m: DVec3::ZERO, cloud: None, ..*self }
    }

    pub(super) fn colours(&self) -> Option<Colours<'a>> {
        // WebAssembly builds do not fill holes, so they need no colours.
        if ONE_THREAD { None } else { self.cloud.and_then(Colours::of_cloud) }
    }

    /// Returns the number of points, including holes.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns true if there are no points.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns the width and height in pixels; `None` for an unorganized cloud.
    pub fn grid(&self) -> Option<(usize, usize)> {
        self.grid
    }

    /// Returns the sensor's pose; the identity if unknown.
    pub fn pose(&self) -> SensorPose {
        self.pose
    }

    /// Returns the origin that positions and results are relative to, in metres.
    pub fn origin_m(&self) -> [f64; 3] {
        self.origin_m.to_array()
    }

    /// Returns the camera, if known.
    pub fn camera(&self) -> Option<&'a Camera> {
        self.camera
    }

    /// Returns point `i` in metres, relative to the origin. A hole is not finite.
    pub fn get(&self, i: usize) -> [f64; 3] {
        self.point(i).to_array()
    }

    /// Returns point `i` in metres, relative to the origin; with the f64 digits of its file if it has not moved.
    pub(crate) fn get_exact(&self, i: usize) -> [f64; 3] {
        let rounded = self.get(i);
        std::array::from_fn(|axis| match self.cloud.filter(|cloud| cloud.is_unmoved(axis, i)) {
            Some(cloud) => cloud.coordinate(axis, i) - self.origin_m[axis],
            None => rounded[axis],
        })
    }

    /// Returns the number of finite points.
    pub fn valid_points(&self) -> usize {
        if let Positions::Planes([x, y, z]) = self.positions {
            // This form vectorizes: x * 0 is 0 only for finite x.
            let is_finite = |((x, y), z): ((&f32, &f32), &f32)| x * 0.0 + y * 0.0 + z * 0.0 == 0.0;
            return x.iter().zip(y).zip(z).filter(|point| is_finite(*point)).count();
        }
        (0..self.len).filter(|&i| self.point(i).is_finite()).count()
    }

    /// Returns the transform from the sensor's frame to the cloud's, relative to the origin.
    pub fn transform(&self) -> RigidTransform {
        // A view's pose is always valid.
        let transform = self.pose.transform().unwrap_or(RigidTransform::IDENTITY);
        RigidTransform { translation: transform.translation - self.origin_m, ..transform }
    }

    /// Returns the transform of an unrotated sensor at the origin of the file's coordinates.
    pub fn origin_transform(&self) -> RigidTransform {
        RigidTransform { translation: -self.origin_m, ..RigidTransform::IDENTITY }
    }

    /// Returns point `i` in metres, relative to the origin.
    #[inline]
    pub fn point(&self, i: usize) -> DVec3 {
        let point = match self.positions {
            Positions::Planes([x, y, z]) => DVec3::new(f64::from(x[i]), f64::from(y[i]), f64::from(z[i])),
            Positions::PlanesF64([x, y, z]) => DVec3::new(x[i], y[i], z[i]),
            Positions::Interleaved { bytes, layout, row_points } => {
                let at = i / row_points * layout.row_stride + i % row_points * layout.point_stride;
                DVec3::from_array(layout.offsets.map(|offset| match layout.scalar {
                    Scalar::F32 => f64::from(read_f32(bytes, at + offset)),
                    Scalar::F64 => read_f64(bytes, at + offset),
                }))
            }
        };
        point - self.subtracted_m
    }

    /// Returns the borrowed f32 planes; `None` if points need a conversion from another layout, or the subtraction of
    /// an origin.
    pub fn plain_planes(&self) -> Option<[&'a [f32]; 3]> {
        match self.positions {
            Positions::Planes(planes) if self.subtracted_m == DVec3::ZERO => Some(planes),
            _ => None,
        }
    }

    /// Copies a range of points, relative to the origin and rounded to f32.
    pub fn copy_to(&self, points: Range<usize>, x: &mut [f32], y: &mut [f32], z: &mut [f32]) {
        if let Some([from_x, from_y, from_z]) = self.plain_planes() {
            x.copy_from_slice(&from_x[points.clone()]);
            y.copy_from_slice(&from_y[points.clone()]);
            z.copy_from_slice(&from_z[points]);
            return;
        }
        for (((i, x), y), z) in points.zip(x).zip(y).zip(z) {
            [*x, *y, *z] = self.point(i).to_array().map(|value| value as f32);
        }
    }
}

fn check_origin(origin_m: [f64; 3]) -> Result<(), FrameError> {
    if origin_m.into_iter().all(f64::is_finite) {
        return Ok(());
    }
    let (field, value) = ("origin_m", format!("{origin_m:?}"));
    Err(FrameError::BadPose(ParamError { field, value, allowed: "three finite numbers in metres" }))
}

fn check_planes([len, y, z]: [usize; 3]) -> Result<(), FrameError> {
    for (what, found) in [("y", y), ("z", z)] {
        if found != len {
            return Err(FrameError::LengthMismatch { what: what.into(), len: found, expected: len });
        }
    }
    if len > MAX_PIXELS {
        return Err(FrameError::BadShape { width: len, height: 1, allowed: "at most 2^28 points" });
    }
    Ok(())
}

/// Reads a value; NaN beyond the end of the buffer, which no valid view reaches.
fn read_f32(bytes: &[u8], at: usize) -> f32 {
    bytes.get(at..at + 4).and_then(|value| value.try_into().ok()).map_or(f32::NAN, f32::from_ne_bytes)
}

fn read_f64(bytes: &[u8], at: usize) -> f64 {
    bytes.get(at..at + 8).and_then(|value| value.try_into().ok()).map_or(f64::NAN, f64::from_ne_bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_layout_gives_the_same_points() {
        let rows: Vec<[f32; 3]> = (0..12).map(|i| [i as f32, 10.0 + i as f32, -1.5 * i as f32]).collect();
        let rows4: Vec<[f32; 4]> = rows.iter().map(|&[x, y, z]| [x, y, z, 9.0]).collect();
        let rows_f64: Vec<[f64; 3]> = rows.iter().map(|row| row.map(f64::from)).collect();
        let plane = |axis: usize| rows.iter().map(|row| row[axis]).collect::<Vec<f32>>();
        let plane_f64 = |axis: usize| rows.iter().map(|row| f64::from(row[axis])).collect::<Vec<f64>>();
        let (planes, planes_f64) = ([0, 1, 2].map(plane), [0, 1, 2].map(plane_f64));
        // Unaligned: one leading byte, a gap between z and x, and padding after every fourth point.
        let mut bytes = vec![0u8; 1];
        for (i, [x, y, z]) in rows.iter().enumerate() {
            bytes.extend(z.to_ne_bytes());
            bytes.extend([7; 3]);
            bytes.extend(x.to_ne_bytes().into_iter().chain(y.to_ne_bytes()));
            if i % 4 == 3 {
                bytes.extend([0; 5]);
            }
        }
        let layout = PointLayout { scalar: Scalar::F32, offsets: [7, 11, 0], point_stride: 15, row_stride: 65 };
        let views = [
            PointsView::from_planes(&planes[0], &planes[1], &planes[2]).unwrap(),
            PointsView::from_planes_f64(&planes_f64[0], &planes_f64[1], &planes_f64[2]).unwrap(),
            PointsView::from_rows(&rows).unwrap(),
            PointsView::from_rows4(&rows4).unwrap(),
            PointsView::from_rows_f64(&rows_f64).unwrap(),
            PointsView::from_bytes(&bytes[1..], layout, (4, 3)).unwrap(),
        ];
        for view in views {
            assert_eq!(view.len(), 12);
            let mut out = [[0f32; 12]; 3];
            let [x, y, z] = &mut out;
            view.copy_to(0..12, x, y, z);
            for (i, row) in rows.iter().enumerate() {
                assert_eq!(view.get(i), row.map(f64::from), "{view:?}");
                assert_eq!([x[i], y[i], z[i]], *row);
            }
        }
        assert_eq!(views[5].grid(), Some((4, 3)));
        assert!(PointsView::from_bytes(&bytes[..bytes.len() - 10], layout, (4, 3)).is_err());
        let overlapping = PointLayout { point_stride: 10, ..layout };
        assert!(PointsView::from_bytes(&bytes, overlapping, (4, 3)).unwrap_err().to_string().contains("stride"));
    }

    #[test]
    fn nothing_is_read_beyond_a_buffer_and_no_points_are_a_cloud_too() {
        assert!(PointsView::from_planes(&[0.0; 4], &[0.0; 4], &[0.0; 3]).is_err());
        assert!(PointsView::from_rows(&[[0.0; 3]; 4]).unwrap().with_grid(2, 3).is_err());
        assert!(PointsView::from_rows(&[]).unwrap().is_empty());
        let huge = PointLayout { scalar: Scalar::F64, offsets: [0, 8, usize::MAX], point_stride: 24, row_stride: 24 };
        assert!(PointsView::from_bytes(&[0; 24], huge, (1, 1)).is_err());
        let layout = PointLayout { offsets: [0, 8, 16], ..huge };
        assert!(PointsView::from_bytes(&[0; 24], layout, (usize::MAX, 2)).is_err());
        assert!(PointsView::from_bytes(&[0; 24], layout, (1, 0)).is_err());
    }
}
