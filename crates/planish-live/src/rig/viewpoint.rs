//! Viewpoints without a camera that are smoothed as additional views.

use glam::{DQuat, DVec3};

use planish_core::{Camera, FrameError, ParamError, SensorPose};

/// A pose from which the points of all cameras are smoothed as an additional view
/// ([`RigWay::Views`](super::RigWay::Views)); other methods ignore it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Viewpoint {
    /// Pose in the rig's frame, rig_from_camera, as for a [`RigCamera`](super::RigCamera).
    pub pose: SensorPose,
    /// The size and intrinsics of the view. If its pixels are finer than the cameras', the view has gaps between the
    /// samples.
    pub camera: Camera,
}

impl Viewpoint {
    /// Creates a viewpoint with these intrinsics at this pose.
    pub fn new(pose: SensorPose, camera: Camera) -> Self {
        Self { pose, camera }
    }

    /// Returns the viewpoint halfway between two poses, in position and rotation.
    ///
    /// # Errors
    /// If one of the poses is invalid.
    pub fn between(a: &SensorPose, b: &SensorPose, camera: Camera) -> Result<Self, FrameError> {
        let (from, to) = (a.transform()?, b.transform()?);
        let middle: DVec3 = (from.translation + to.translation) / 2.0;
        let turned = DQuat::from_mat3(&from.rotation).slerp(DQuat::from_mat3(&to.rotation), 0.5).normalize();
        Ok(Self::new(SensorPose::from_xyzw(middle.to_array(), turned.to_array()), camera))
    }

    pub(super) fn validate(&self, index: usize) -> Result<(), ParamError> {
        let valid = self.pose.validate().and_then(|()| self.camera.validate());
        valid.map_err(|error| match error {
            FrameError::BadPose(of) | FrameError::BadCamera(of) => {
                ParamError { value: format!("{} (viewpoint {index})", of.value), ..of }
            }
            error => {
                let value = format!("{error} (viewpoint {index})");
                ParamError {
                    field: "viewpoint.camera",
                    value,
                    allowed: "a viewpoint needs a width and a height in pixels, and intrinsics",
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halfway_is_the_middle_and_half_of_the_turn() {
        let camera = Camera::kinect_v1();
        // About y, by 0 and by 90°.
        let quarter = SensorPose::from_xyzw([2.0, 0.0, 4.0], [0.0, 0.5f64.sqrt(), 0.0, 0.5f64.sqrt()]);
        for b in [quarter, SensorPose { orientation: quarter.orientation.map(|value| -value), ..quarter }] {
            let between = Viewpoint::between(&SensorPose::IDENTITY, &b, camera).unwrap();
            assert_eq!(between.pose.position_m, [1.0, 0.0, 2.0]);
            let ahead = between.pose.rotation().map(|row| row[2]);
            let half = 0.5f64.sqrt();
            assert!(ahead.iter().zip([half, 0.0, half]).all(|(a, b)| (a - b).abs() < 1e-12), "{ahead:?}");
        }
    }

    #[test]
    fn what_is_no_view_is_refused_by_its_number() {
        let camera = Camera::kinect_v1();
        let no_pose = SensorPose { orientation: [2.0, 0.0, 0.0, 0.0], ..SensorPose::IDENTITY };
        for (pose, camera, said) in [
            (no_pose, camera, "orientation"),
            (
                SensorPose::IDENTITY,
                Camera::new((camera.width, camera.height), [0.0, camera.fy], [camera.cx, camera.cy]),
                "fx",
            ),
            (SensorPose::IDENTITY, camera.with_shape((0, camera.height)), "width"),
        ] {
            let error = Viewpoint::new(pose, camera).validate(3).unwrap_err().to_string();
            assert!(error.contains(said) && error.contains("viewpoint 3"), "{error}");
        }
        assert!(Viewpoint::new(SensorPose::IDENTITY, camera).validate(0).is_ok());
    }
}
