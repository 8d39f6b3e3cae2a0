//! The range of a point and the position of its sensor (docs/method.md, section 11).

use glam::DVec3;

use crate::params::Project;
use crate::pose::RigidTransform;

/// The rule by which ranges are measured in a frame, with the pitch of its pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RangeRule {
    /// The rule for a camera's grid: the range is the depth along the camera's axis.
    Depth {
        /// Distance between neighbouring pixels at a depth of 1 m, in metres: 1/fx. `None` without a grid, or if no
        /// two neighbours are valid.
        pitch_at_1m: Option<f64>,
    },
    /// The rule for the grid of another sensor: the range is the distance from the sensor.
    Distance {
        /// Distance between neighbouring pixels at a range of 1 m, in metres: along rows or along columns, whichever
        /// is larger.
        pitch_at_1m: f64,
    },
    /// The rule for an unknown sensor position: every point is assigned the range at which the pixels of a Kinect v1
    /// would be as far apart as these points, but at most 5 m.
    Constant {
        /// Distance between neighbouring points in metres.
        spacing_m: f64,
    },
}

/// The focal length of a Kinect v1 in pixels, assumed if none is known.
const KINECT_FOCAL_LENGTH_PX: f64 = 525.0;
/// Maximum range assumed for sensor models if the range is unknown, in metres.
const MAX_ASSUMED_RANGE_M: f64 = 5.0;

impl RangeRule {
    /// Returns the distance between neighbouring pixels at a range of 1 m, in metres; a Kinect v1's if unknown.
    pub fn pitch_at_1m(&self) -> f64 {
        self.known_pitch_at_1m().unwrap_or(1.0 / KINECT_FOCAL_LENGTH_PX)
    }

    /// Returns the pixel pitch at a range of 1 m, in metres; `None` if unknown.
    pub(crate) fn known_pitch_at_1m(&self) -> Option<f64> {
        match *self {
            Self::Depth { pitch_at_1m } => pitch_at_1m,
            Self::Distance { pitch_at_1m } => Some(pitch_at_1m),
            Self::Constant { .. } => None,
        }
    }
}

/// The geometry of a frame that an engine needs in addition to its samples.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameGeometry {
    /// Transform from the sensor's frame to the cloud's; `None` if they are the same frame.
    pub(crate) cloud_from_sensor: Option<RigidTransform>,
    pub(crate) rule: RangeRule,
}

impl FrameGeometry {
    pub(super) fn new(transform: RigidTransform, rule: RangeRule) -> Self {
        Self { cloud_from_sensor: (!transform.is_identity()).then_some(transform), rule }
    }

    /// Returns the sensor's position in the cloud's frame.
    pub(crate) fn sensor_position(&self) -> DVec3 {
        self.cloud_from_sensor.map_or(DVec3::ZERO, |transform| transform.translation)
    }

    /// Returns the unit vector along which the sensor looks, in the cloud's frame.
    pub(crate) fn sensor_axis(&self) -> DVec3 {
        self.cloud_from_sensor.map_or(DVec3::Z, |transform| transform.rotation.z_axis)
    }

    /// Returns true if points move along their rays (docs/method.md, section 7): `project` requests it and the sensor
    /// position is known.
    pub(crate) fn is_on_rays(&self, project: Project) -> bool {
        project == Project::Ray && !matches!(self.rule, RangeRule::Constant { .. })
    }

    /// Returns the range in metres of a point, which is given in the sensor's frame.
    pub(crate) fn range_m(&self, point_in_sensor: DVec3) -> f64 {
        match self.rule {
            RangeRule::Depth { .. } => point_in_sensor.z.abs(),
            RangeRule::Distance { .. } => point_in_sensor.length(),
            RangeRule::Constant { spacing_m } if point_in_sensor.is_finite() => assumed_range_m(spacing_m),
            RangeRule::Constant { .. } => f64::NAN,
        }
    }
}

/// Returns the range in metres that sensor models assume for points with this spacing whose range is unknown.
pub(crate) fn assumed_range_m(spacing_m: f64) -> f64 {
    (KINECT_FOCAL_LENGTH_PX * spacing_m).min(MAX_ASSUMED_RANGE_M)
}
