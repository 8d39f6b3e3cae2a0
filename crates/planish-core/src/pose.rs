//! Position and orientation of the sensor in the frame of a cloud's points.

use glam::{DMat3, DQuat, DVec3};

use crate::error::{FrameError, ParamError};

/// Maximum deviation of a quaternion's length from 1: files round the components to a few digits.
const LENGTH_TOLERANCE: f64 = 0.01;

/// Maximum time between two poses of a moving sensor for interpolation between them, in seconds.
pub const LONGEST_POSE_GAP_S: f64 = 0.2;

/// Maximum absolute coordinate of a sensor's position in metres.
const MAX_POSITION_M: f64 = 1e9;

/// Position and orientation of a sensor in the frame of a cloud (cloud_from_sensor), as in PCD's VIEWPOINT.
///
/// The sensor looks along its z axis, with x to the right and y down. [`SensorPose::IDENTITY`] is a sensor at the
/// origin that looks along +z. Files also state this pose if the true one is unknown, so the grids of clouds with this
/// pose are checked (docs/method.md, section 11).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorPose {
    /// Position of the sensor in metres.
    pub position_m: [f64; 3],
    /// Orientation as a unit quaternion (w, x, y, z), which rotates directions from the sensor's frame to the cloud's.
    pub orientation: [f64; 4],
}

impl SensorPose {
    /// A sensor at the origin, without rotation.
    pub const IDENTITY: Self = Self { position_m: [0.0; 3], orientation: [1.0, 0.0, 0.0, 0.0] };

    /// Creates the pose of a PCD VIEWPOINT: x, y, z, then the quaternion w, x, y, z.
    pub fn from_viewpoint([x, y, z, qw, qx, qy, qz]: [f64; 7]) -> Self {
        Self { position_m: [x, y, z], orientation: [qw, qx, qy, qz] }
    }

    /// Creates a pose from a position in metres and a quaternion in the order x, y, z, w, as in ROS and Eigen.
    pub fn from_xyzw(position_m: [f64; 3], [x, y, z, w]: [f64; 4]) -> Self {
        Self { position_m, orientation: [w, x, y, z] }
    }

    /// Creates a pose from a position in metres and a rotation matrix (cloud_from_sensor, row by row). `None` if the
    /// matrix differs from a rotation by more than 1 %, or the position is out of range.
    pub fn from_rotation(position_m: [f64; 3], rows: [[f64; 3]; 3]) -> Option<Self> {
        let rotation = DMat3::from_cols_array_2d(&rows).transpose();
        let off = rotation * rotation.transpose() - DMat3::IDENTITY;
        // False for a NaN.
        let is_rotation =
            off.to_cols_array().iter().all(|value| value.abs() <= LENGTH_TOLERANCE) && rotation.determinant() > 0.0;
        let [x, y, z, w] = DQuat::from_mat3(&rotation).normalize().to_array();
        let pose = Self::from_xyzw(position_m, [x, y, z, w]);
        (is_rotation && pose.validate().is_ok()).then_some(pose)
    }

    /// Returns the rotation from the sensor's frame to the cloud's, row by row.
    pub fn rotation(&self) -> [[f64; 3]; 3] {
        let rotation = self.transform().unwrap_or(RigidTransform::IDENTITY).rotation;
        rotation.transpose().to_cols_array_2d()
    }

    /// Returns the seven numbers of a PCD VIEWPOINT.
    pub fn viewpoint(&self) -> [f64; 7] {
        let ([x, y, z], [qw, qx, qy, qz]) = (self.position_m, self.orientation);
        [x, y, z, qw, qx, qy, qz]
    }

    /// Returns true if the pose carries no information: the identity, or all zeros, as some writers leave it.
    pub fn is_identity(&self) -> bool {
        self.position_m == [0.0; 3] && (self.orientation == [1.0, 0.0, 0.0, 0.0] || self.orientation == [0.0; 4])
    }

    /// Refuses positions with a coordinate that is not finite or above 1e9 m, and quaternions without unit length.
    pub fn validate(&self) -> Result<(), FrameError> {
        self.transform().map(drop)
    }

    /// Returns the pose of a transform from the sensor's frame to the cloud's.
    pub fn from_transform(transform: &RigidTransform) -> Self {
        let quaternion = DQuat::from_mat3(&transform.rotation).normalize();
        Self::from_xyzw(transform.translation.to_array(), quaternion.to_array())
    }

    /// Returns the pose at a share of the way from this valid pose (0) to another one (1).
    pub fn interpolated(&self, to: &Self, share: f64) -> Self {
        let turn = |pose: &Self| {
            let [w, x, y, z] = pose.orientation;
            DQuat::from_xyzw(x, y, z, w).normalize()
        };
        let position = DVec3::from(self.position_m).lerp(to.position_m.into(), share);
        Self::from_xyzw(position.to_array(), turn(self).slerp(turn(to), share).to_array())
    }

    /// Returns the transform from the sensor's frame to the cloud's.
    pub fn transform(&self) -> Result<RigidTransform, FrameError> {
        let bad = |field, value: String, allowed| Err(FrameError::BadPose(ParamError { field, value, allowed }));
        if self.is_identity() {
            return Ok(RigidTransform::IDENTITY);
        }
        let [w, x, y, z] = self.orientation;
        // Some writers leave the orientation zero if they know only the position.
        let is_unknown = self.orientation == [0.0; 4];
        let quaternion = if is_unknown { DQuat::IDENTITY } else { DQuat::from_xyzw(x, y, z, w) };
        // False for a NaN.
        let is_unit = (quaternion.length() - 1.0).abs() <= LENGTH_TOLERANCE;
        if !is_unit {
            let allowed = "a quaternion w, x, y, z of length 1";
            return bad("orientation", format!("{:?}", self.orientation), allowed);
        }
        let translation = DVec3::from_array(self.position_m);
        let is_within = self.position_m.iter().all(|coordinate| coordinate.abs() <= MAX_POSITION_M);
        if !is_within {
            return bad("position_m", format!("{:?}", self.position_m), "three numbers in metres, at most 1e9 each");
        }
        Ok(RigidTransform { rotation: DMat3::from_quat(quaternion.normalize()), translation })
    }
}

impl Default for SensorPose {
    fn default() -> Self {
        Self::IDENTITY
    }
}

/// A rigid transform from the sensor's frame to the cloud's (cloud_from_sensor): p_cloud = rotation p_sensor +
/// translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidTransform {
    /// The rotation.
    pub rotation: DMat3,
    /// The translation in metres.
    pub translation: DVec3,
}

impl RigidTransform {
    /// The identity.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns true for the identity.
    pub fn is_identity(&self) -> bool {
        *self == Self::IDENTITY
    }

    /// Transforms a point from the sensor's frame to the cloud's.
    pub fn to_cloud(self, point_in_sensor: DVec3) -> DVec3 {
        self.rotation * point_in_sensor + self.translation
    }

    /// Returns the transform that adds `origin_m` (in metres) to points, without a rotation.
    pub fn shift(origin_m: [f64; 3]) -> Self {
        Self { rotation: DMat3::IDENTITY, translation: DVec3::from_array(origin_m) }
    }

    /// Returns the transform that applies `other` first, then `self`.
    pub fn after(self, other: Self) -> Self {
        let translation = self.rotation * other.translation + self.translation;
        Self { rotation: self.rotation * other.rotation, translation }
    }

    /// Returns the inverse transform.
    pub fn inverse(self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Transforms a point from the cloud's frame to the sensor's.
    pub fn to_sensor(self, point_in_cloud: DVec3) -> DVec3 {
        self.rotation.transpose() * (point_in_cloud - self.translation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_looks_forward() {
        // The usual optical frame of a camera that looks along the robot's +x.
        let pose = SensorPose::from_viewpoint([0.1, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5]);
        let ahead = pose.transform().unwrap().to_sensor(DVec3::new(2.1, 0.0, 0.6));
        assert!((ahead - DVec3::new(0.0, 0.0, 2.0)).length() < 1e-12, "{ahead}");
        assert_eq!(SensorPose::from_viewpoint(pose.viewpoint()), pose);
    }

    #[test]
    fn a_rotation_matrix_is_a_pose_and_back() {
        let pose = SensorPose::from_viewpoint([1.0, 2.0, 3.0, 0.5, -0.5, 0.5, -0.5]);
        let again = SensorPose::from_rotation(pose.position_m, pose.rotation()).unwrap();
        let off = |k: usize| (again.viewpoint()[k].abs() - pose.viewpoint()[k].abs()).abs();
        assert!((0..7).all(|k| off(k) < 1e-12), "{again:?}");
        assert_eq!(pose.rotation()[0], [0.0, 0.0, 1.0], "the robot's x is the camera's z");
        for none in [[[0.0; 3]; 3], [[f64::NAN; 3]; 3], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]] {
            assert_eq!(SensorPose::from_rotation([0.0; 3], none), None);
        }
    }

    #[test]
    fn poses_that_are_none_are_refused_and_zeros_are_the_identity() {
        let pose = |viewpoint| SensorPose::from_viewpoint(viewpoint);
        assert!(pose([0.0; 7]).transform().unwrap().is_identity());
        let unturned = pose([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0]).transform().unwrap();
        assert_eq!(unturned.rotation, DMat3::IDENTITY);
        for bad in [[0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]] {
            assert!(pose(bad).validate().unwrap_err().to_string().contains("length 1"));
        }
        assert!(pose([f64::NAN, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]).validate().is_err());
        assert!(pose([0.0, 1e39, 0.0, 1.0, 0.0, 0.0, 0.0]).validate().is_err());
    }
}
