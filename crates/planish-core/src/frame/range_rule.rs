//! The range of a point and the position of its sensor (docs/method.md, section 11).

use glam::DVec3;

use crate::params::Project;
use crate::pose::RigidTransform;

/// How ranges are measured in a frame, and how far apart its pixels are.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RangeRule {
    /// The grid is a camera's: the range is the depth along its axis.
    Depth {
        /// 1/fx: metres between neighbouring pixels at a depth of 1 m. `None` if no two neighbours are valid.
        pitch_at_1m: Option<f64>,
    },
    /// The grid is another sensor's: the range is the distance from it.
    Distance {
        /// Metres between neighbouring pixels at a distance of 1 m, of rows or columns, whichever are farther apart.
        pitch_at_1m: f64,
    },
    /// The sensor position is unknown: every point has the range at which pixels of a Kinect v1 are as far apart as
    /// these points.
    Constant {
        /// Metres between neighbouring points.
        spacing_m: f64,
    },
}

/// The focal length of a Kinect v1 in pixels, assumed if none is known.
const KINECT_FOCAL_LENGTH_PX: f64 = 525.0;
/// Maximum range for sensor models if the range is unknown.
const MAX_ASSUMED_RANGE_M: f64 = 5.0;

impl RangeRule {
    /// Metres between neighbouring pixels at a range of 1 m; a Kinect v1's if unknown.
    pub fn pitch_at_1m(&self) -> f64 {
        self.known_pitch_at_1m().unwrap_or(1.0 / KINECT_FOCAL_LENGTH_PX)
    }

    /// Returns the pitch, or `None` if it would be a guess.
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
    /// `None` if the cloud's frame is the sensor's.
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

    /// Returns true if points move along their rays (docs/method.md, section 7): if requested, and if the sensor
    /// position is known.
    pub(crate) fn is_on_rays(&self, project: Project) -> bool {
        project == Project::Ray && !matches!(self.rule, RangeRule::Constant { .. })
    }

    /// Returns the range of a point in the sensor's frame.
    pub(crate) fn range_m(&self, point_in_sensor: DVec3) -> f64 {
        match self.rule {
            RangeRule::Depth { .. } => point_in_sensor.z.abs(),
            RangeRule::Distance { .. } => point_in_sensor.length(),
            RangeRule::Constant { spacing_m } if point_in_sensor.is_finite() => assumed_range_m(spacing_m),
            RangeRule::Constant { .. } => f64::NAN,
        }
    }
}

/// Returns the range for sensor models if it is unknown.
pub(crate) fn assumed_range_m(spacing_m: f64) -> f64 {
    (KINECT_FOCAL_LENGTH_PX * spacing_m).min(MAX_ASSUMED_RANGE_M)
}
