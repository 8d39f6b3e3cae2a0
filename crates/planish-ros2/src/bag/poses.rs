//! The poses of cameras, from the transforms or the odometry in a recording.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::Record;

use super::records::{Next, Records};
use super::schemas::MESSAGE_ENCODING;
use super::survey::Survey;
use crate::ros::{Header, Odometry, PoseStamped, TfMessage, TransformError, TransformStamped, Transforms, from_cdr};
use planish_core::{Error, FormatError, IoError, SensorPose};
use planish_io::{ReadOptions, Trajectory, printable_line};

/// Memory for one transform, in bytes.
const TRANSFORM_BYTES: usize = 120;

/// A topic with the poses of a moving camera or robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PoseTopic {
    /// The topic: `tf2_msgs/TFMessage` such as `/tf`; `nav_msgs/Odometry`; or `geometry_msgs/PoseStamped` or
    /// `PoseWithCovarianceStamped` with the pose of the camera itself.
    pub topic: String,
    /// The coordinate frame that does not move; `None` for the parent frame of odometry and poses, and for tf the
    /// camera's ancestor `odom` or the root of its tree.
    pub fixed_frame: Option<String>,
}

/// The poses of a moving camera.
#[derive(Debug, Clone, PartialEq)]
pub enum CameraPoses {
    /// Poses that were read from a file, for one camera.
    Trajectory(Trajectory),
    /// A topic of the recording.
    Topic(PoseTopic),
}

/// Message type of a topic with poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Transforms,
    Odometry,
    Pose,
}

impl Kind {
    fn named(type_name: &str) -> Option<Self> {
        Some(match type_name {
            "tf2_msgs/msg/TFMessage" => Self::Transforms,
            "nav_msgs/msg/Odometry" => Self::Odometry,
            "geometry_msgs/msg/PoseStamped" | "geometry_msgs/msg/PoseWithCovarianceStamped" => Self::Pose,
            _ => return None,
        })
    }
}

/// The transforms of a recording.
pub(super) struct Poses {
    transforms: Transforms,
    topic: PoseTopic,
    /// The parent frame of odometry and poses.
    parent: Option<String>,
    /// True if the topic has the poses of the camera itself, whatever its frame.
    of_camera: bool,
}

/// The name under which the camera's own poses are stored.
const CAMERA: &str = "camera itself";

impl Poses {
    /// Reads all poses of a recording, and the static transforms beside them.
    pub(super) fn read(path: &Path, topic: &PoseTopic, options: &ReadOptions) -> Result<Self, FormatError> {
        let mut records = Records::open(path, options).map_err(|error| error.problem)?;
        let mut poses =
            Self { transforms: Transforms::default(), topic: topic.clone(), parent: None, of_camera: false };
        let (mut types, mut channels) = (BTreeMap::new(), BTreeMap::new());
        let (mut messages, mut unreadable, mut invalid) = (0u64, 0u64, 0u64);
        loop {
            let record = match records.next() {
                Ok(Next::Record(record)) => record,
                Ok(Next::DamagedChunk | Next::DamagedFile(_)) => continue,
                // Whatever smooths the frames reports where the recording ends.
                Ok(Next::End | Next::CutOff) | Err(_) => break,
            };
            match record {
                Record::Schema { header, .. } => {
                    types.insert(header.id, header.name);
                }
                Record::Channel(channel) if channel.message_encoding == MESSAGE_ENCODING => {
                    let kind = types.get(&channel.schema_id).and_then(|name| Kind::named(name));
                    channels.insert(channel.id, (channel.topic, kind));
                }
                Record::Message { header, data } => {
                    let Some((name, Some(kind))) = channels.get(&header.channel_id) else { continue };
                    let is_static = *kind == Kind::Transforms && name.ends_with("tf_static");
                    if !is_static && *name != topic.topic {
                        continue;
                    }
                    messages += u64::from(!is_static);
                    match transforms_of(*kind, &data) {
                        Ok(transforms) => {
                            poses.of_camera |= *kind == Kind::Pose;
                            for transform in transforms {
                                if !is_static && *kind != Kind::Transforms {
                                    poses.parent.get_or_insert_with(|| transform.header.frame_id.clone());
                                }
                                invalid += u64::from(!poses.transforms.add(&transform, is_static));
                            }
                        }
                        Err(_) => unreadable += 1,
                    }
                    options.check(poses.transforms.len(), TRANSFORM_BYTES)?;
                }
                _ => {}
            }
        }
        let name = || printable_line(&topic.topic).into_owned();
        let problem = match channels.values().find(|(found, _)| *found == topic.topic) {
            None => format!("the recording has no topic {} in CDR; {}", name(), told(&channels)),
            Some((_, None)) => format!("the topic {} has no poses; {}", name(), told(&channels)),
            Some(_) if messages == 0 => format!("the topic {} has no messages", name()),
            Some(_) if poses.transforms.is_empty() => format!(
                "the topic {} has no valid pose: {unreadable} messages are damaged, {invalid} poses have a quaternion \
                 without unit length or values that are not finite",
                name()
            ),
            Some(_) => return Ok(poses),
        };
        Err(FormatError::Unsupported(problem))
    }

    /// Returns the frame of a camera, and the frame in which its pose is measured.
    fn frames(&self, camera_frame: &str) -> (String, String) {
        let frame = if self.of_camera { CAMERA } else { camera_frame };
        let fixed = self.topic.fixed_frame.clone().or_else(|| self.parent.clone());
        let fixed = fixed.or_else(|| self.transforms.fixed_frame(frame)).unwrap_or_else(|| "odom".to_owned());
        (frame.to_owned(), fixed)
    }

    /// Checks that the poses of a camera are known at some times.
    pub(super) fn check(&self, camera_frame: &str) -> Result<(), FormatError> {
        self.trajectory(camera_frame).map(drop)
    }

    /// Returns the pose of the camera of a message; `None` if it is unknown.
    pub(super) fn pose(&self, header: &Header) -> Option<SensorPose> {
        let (frame, fixed) = self.frames(&header.frame_id);
        self.transforms.pose(&frame, &fixed, header.stamp).ok()
    }

    fn trajectory(&self, camera_frame: &str) -> Result<Trajectory, FormatError> {
        let topic = || printable_line(&self.topic.topic).into_owned();
        let unsupported = |problem: String| FormatError::Unsupported(printable_line(&problem).into_owned());
        let (frame, fixed) = self.frames(camera_frame);
        let times = self.transforms.times(&frame, &fixed).map_err(|error: TransformError| {
            let of_odometry =
                if self.parent.is_some() { " (static transforms must lead to the robot's frame)" } else { "" };
            unsupported(format!("the topic {} has no poses of the camera: {error}{of_odometry}", topic()))
        })?;
        let known =
            times.into_iter().filter_map(|at| Some((at.seconds(), self.transforms.pose(&frame, &fixed, at).ok()?)));
        let known: Vec<(f64, SensorPose)> = known.collect();
        if known.is_empty() {
            return Err(unsupported(format!(
                "the topic {} has no transforms over time between {frame} and {fixed}; name another fixed frame",
                topic()
            )));
        }
        Trajectory::of_times(known)
    }
}

/// Returns the poses of a camera in a recording. `depth_topic` names the camera's depth images or clouds, as for
/// [`BagSource`](super::BagSource).
///
/// # Errors
/// If the recording lacks the topics, or no transforms connect the camera with the fixed frame.
pub fn camera_trajectory(
    path: &Path,
    depth_topic: Option<&str>,
    poses: &PoseTopic,
    options: &ReadOptions,
) -> Result<Trajectory, Error> {
    let survey = Survey::of(path, options)?;
    let topics: Vec<String> = depth_topic.map(str::to_owned).into_iter().collect();
    let frame_id = survey.frame_of(path, &topics)?;
    let trajectory = Poses::read(path, poses, options).and_then(|poses| poses.trajectory(&frame_id));
    trajectory.map_err(|problem| IoError { path: path.to_path_buf(), problem }.into())
}

/// Returns the transforms in a message.
fn transforms_of(kind: Kind, data: &[u8]) -> Result<Vec<TransformStamped>, FormatError> {
    Ok(match kind {
        Kind::Transforms => from_cdr::<TfMessage>(data)?.transforms,
        Kind::Odometry => vec![from_cdr::<Odometry>(data)?.into()],
        Kind::Pose => vec![from_cdr::<PoseStamped>(data)?.of_frame(CAMERA)],
    })
}

/// Lists the topics with poses.
fn told(channels: &BTreeMap<u16, (String, Option<Kind>)>) -> String {
    const MOST: usize = 12;
    let mut names: Vec<&str> =
        channels.values().filter(|(_, kind)| kind.is_some()).map(|(name, _)| name.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    names.truncate(MOST);
    match &names[..] {
        [] => "it has no topic with TFMessage, Odometry, PoseStamped or PoseWithCovarianceStamped".to_owned(),
        names => format!("poses are on {}", printable_line(&names.join(", "))),
    }
}
