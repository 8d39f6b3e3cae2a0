//! The poses of cameras over time, from tf, odometry or pose messages.

use std::str::FromStr;

use super::from_cdr;
use super::messages::{Header, Time};
use super::transforms::{Odometry, PoseStamped, TfMessage, TransformError, TransformStamped, Transforms};
use planish_core::{FormatError, ParamError, SensorPose};

/// The name under which the camera's own poses are stored.
const CAMERA: &str = "camera itself";

/// Type of the messages that state the motion of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PoseKind {
    /// `tf2_msgs/TFMessage`, as on `/tf` and `/tf_static`.
    Transforms,
    /// `nav_msgs/Odometry`: the pose of a robot, to which static transforms lead from the camera.
    Odometry,
    /// `geometry_msgs/PoseStamped`: the pose of the camera itself.
    Pose,
    /// `geometry_msgs/PoseWithCovarianceStamped`: the pose of the camera itself.
    PoseWithCovariance,
}

impl PoseKind {
    const ALL: [Self; 4] = [Self::Transforms, Self::Odometry, Self::Pose, Self::PoseWithCovariance];

    /// Returns the name used in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Transforms => "tf",
            Self::Odometry => "odometry",
            Self::Pose => "pose",
            Self::PoseWithCovariance => "pose_with_covariance",
        }
    }

    /// Returns the package and the name of the message type.
    pub fn message_type(self) -> (&'static str, &'static str) {
        match self {
            Self::Transforms => ("tf2_msgs", "TFMessage"),
            Self::Odometry => ("nav_msgs", "Odometry"),
            Self::Pose => ("geometry_msgs", "PoseStamped"),
            Self::PoseWithCovariance => ("geometry_msgs", "PoseWithCovarianceStamped"),
        }
    }

    /// Returns the kind of a message type, such as `nav_msgs/msg/Odometry`; `None` for other types.
    pub fn of_type(type_name: &str) -> Option<Self> {
        let (package, name) = type_name.split_once("/msg/")?;
        Self::ALL.into_iter().find(|kind| kind.message_type() == (package, name))
    }
}

impl FromStr for PoseKind {
    type Err = ParamError;

    /// Reads a [`name`](Self::name).
    fn from_str(text: &str) -> Result<Self, ParamError> {
        let allowed = "tf, odometry, pose or pose_with_covariance";
        let found = Self::ALL.into_iter().find(|kind| kind.name() == text);
        found.ok_or_else(|| ParamError { field: "poses", value: text.to_owned(), allowed })
    }
}

/// The poses of cameras over time.
#[derive(Debug, Clone, Default)]
pub struct PoseBuffer {
    transforms: Transforms,
    fixed_frame: Option<String>,
    /// The parent frame of odometry and poses.
    parent: Option<String>,
    /// True if the messages have the poses of the camera itself, whatever its frame.
    is_of_camera: bool,
}

impl PoseBuffer {
    /// Creates an empty buffer. `fixed_frame` is the frame that does not move. `None` selects the parent frame for
    /// odometry and poses and, for tf, the camera's ancestor `odom` or the root of its tree.
    pub fn new(fixed_frame: Option<String>) -> Self {
        Self { fixed_frame, ..Self::default() }
    }

    /// Keeps only the last `seconds` of each frame's transforms.
    pub fn keeping_s(self, seconds: f64) -> Self {
        Self { transforms: self.transforms.keeping_s(seconds), ..self }
    }

    /// Returns the approximate memory use of all transforms, in bytes.
    pub fn bytes(&self) -> usize {
        self.transforms.bytes()
    }

    /// Returns true if there are no transforms.
    pub fn is_empty(&self) -> bool {
        self.transforms.is_empty()
    }

    /// Adds the transforms of a message in CDR; static ones are valid at all times. Returns the number of invalid
    /// transforms, which are not added.
    ///
    /// # Errors
    /// If the message is damaged.
    pub fn add_cdr(&mut self, kind: PoseKind, message: &[u8], are_static: bool) -> Result<usize, FormatError> {
        Ok(match kind {
            PoseKind::Transforms => self.add_transforms(&from_cdr::<TfMessage>(message)?, are_static),
            PoseKind::Odometry => self.add_odometry(from_cdr::<Odometry>(message)?),
            PoseKind::Pose | PoseKind::PoseWithCovariance => self.add_pose(from_cdr::<PoseStamped>(message)?),
        })
    }

    /// Adds transforms; static ones are valid at all times. Returns the number of invalid ones, which are not added.
    pub fn add_transforms(&mut self, message: &TfMessage, are_static: bool) -> usize {
        message.transforms.iter().filter(|transform| !self.transforms.add(transform, are_static)).count()
    }

    /// Adds the pose of a robot. Returns 1 if it is invalid, 0 otherwise.
    pub fn add_odometry(&mut self, odometry: Odometry) -> usize {
        self.add_moving(odometry.into())
    }

    /// Adds the pose of the camera itself. Returns 1 if it is invalid, 0 otherwise.
    pub fn add_pose(&mut self, pose: PoseStamped) -> usize {
        self.is_of_camera = true;
        self.add_moving(pose.of_frame(CAMERA))
    }

    fn add_moving(&mut self, transform: TransformStamped) -> usize {
        self.parent.get_or_insert_with(|| transform.header.frame_id.clone());
        usize::from(!self.transforms.add(&transform, false))
    }

    /// Returns the name of a camera's frame in the buffer, and the frame in which its pose is measured.
    fn frames<'a>(&'a self, camera_frame: &'a str) -> (&'a str, String) {
        let frame = if self.is_of_camera { CAMERA } else { camera_frame };
        let fixed = self.fixed_frame.clone().or_else(|| self.parent.clone());
        (frame, fixed.or_else(|| self.transforms.fixed_frame(frame)).unwrap_or_else(|| "odom".to_owned()))
    }

    /// Returns the pose of the camera of a message at the message's time.
    ///
    /// # Errors
    /// If no transforms connect the camera and the fixed frame, or one of them is unknown at that time.
    pub fn pose(&self, header: &Header) -> Result<SensorPose, TransformError> {
        let (frame, fixed) = self.frames(&header.frame_id);
        self.transforms.pose(frame, &fixed, header.stamp)
    }

    /// Returns all known poses of a camera with their times; empty if only static transforms lead to the fixed frame.
    ///
    /// # Errors
    /// If no transforms connect the camera and the fixed frame.
    pub fn poses(&self, camera_frame: &str) -> Result<Vec<(Time, SensorPose)>, TransformError> {
        let (frame, fixed) = self.frames(camera_frame);
        let times = self.transforms.times(frame, &fixed)?;
        let known = |at: Time| Some((at, self.transforms.pose(frame, &fixed, at).ok()?));
        Ok(times.into_iter().filter_map(known).collect())
    }

    /// Returns true if static transforms must lead from the camera to a robot's frame.
    pub fn needs_static_transforms(&self) -> bool {
        self.parent.is_some() && !self.is_of_camera
    }
}
