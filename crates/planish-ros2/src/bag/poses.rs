//! The poses of cameras, from the transforms or the odometry in a recording.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::records::Record;

use super::records::{Next, Records};
use super::schemas::MESSAGE_ENCODING;
use super::survey::Survey;
use crate::ros::{Header, PoseBuffer, PoseKind};
use planish_core::{Error, FormatError, IoError, SensorPose};
use planish_io::{ReadOptions, Trajectory, printable_line};

/// Memory for a decoded message, as a multiple of its size.
const MESSAGE_COPIES: usize = 4;

/// A topic with the poses of a moving camera or robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PoseTopic {
    /// The topic: `tf2_msgs/TFMessage` such as `/tf`; `nav_msgs/Odometry`; or `geometry_msgs/PoseStamped` or
    /// `PoseWithCovarianceStamped` with the pose of the camera itself.
    pub topic: String,
    /// The fixed coordinate frame. `None` selects the parent frame for odometry and poses and, for tf, the camera's
    /// ancestor `odom` or the root of its tree.
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

/// The poses of the cameras of a recording.
pub(super) struct Poses {
    buffer: PoseBuffer,
    topic: String,
}

impl Poses {
    /// Reads all poses and static transforms of a recording.
    pub(super) fn read(path: &Path, topic: &PoseTopic, options: &ReadOptions) -> Result<Self, FormatError> {
        let mut records = Records::open(path, options).map_err(|error| error.problem)?;
        let PoseTopic { topic, fixed_frame } = topic;
        let mut buffer = PoseBuffer::new(fixed_frame.clone());
        let (mut types, mut channels) = (BTreeMap::new(), BTreeMap::new());
        let (mut messages, mut unreadable, mut invalid) = (0usize, 0usize, 0usize);
        loop {
            let record = match records.next() {
                Ok(Next::Record(record)) => record,
                Ok(Next::DamagedChunk | Next::DamagedFile(_)) => continue,
                // The code that smooths the frames reports a premature end.
                Ok(Next::End | Next::CutOff) | Err(_) => break,
            };
            match record {
                Record::Schema { header, .. } => {
                    types.insert(header.id, header.name);
                }
                Record::Channel(channel) if channel.message_encoding == MESSAGE_ENCODING => {
                    let kind = types.get(&channel.schema_id).and_then(|name| PoseKind::of_type(name));
                    channels.insert(channel.id, (channel.topic, kind));
                }
                Record::Message { header, data } => {
                    let Some((name, Some(kind))) = channels.get(&header.channel_id) else { continue };
                    let is_static = *kind == PoseKind::Transforms && is_static_beside(name, topic);
                    if !is_static && name != topic {
                        continue;
                    }
                    options.check(data.len(), MESSAGE_COPIES)?;
                    messages += usize::from(!is_static);
                    match buffer.add_cdr(*kind, &data, is_static) {
                        Ok(number) => invalid += number,
                        Err(_) => unreadable += 1,
                    }
                    options.check(buffer.bytes(), 1)?;
                }
                _ => {}
            }
        }
        let name = || printable_line(topic).into_owned();
        let problem = match channels.values().find(|(found, _)| found == topic) {
            None => format!("the recording has no topic {} in CDR; {}", name(), told(&channels)),
            Some((_, None)) => format!("the topic {} has no poses; {}", name(), told(&channels)),
            Some((_, Some(PoseKind::Transforms))) if is_static(topic) => {
                format!("the topic {} has only static transforms; name the topic with moving ones, such as /tf", name())
            }
            Some(_) if messages == 0 => format!("the topic {} has no messages", name()),
            Some(_) if buffer.is_empty() => format!(
                "the topic {} has no valid pose: {unreadable} messages are damaged, {invalid} poses have no frame, \
                 a quaternion without unit length, or values that are not finite",
                name()
            ),
            Some(_) => return Ok(Self { buffer, topic: topic.clone() }),
        };
        Err(FormatError::Unsupported(problem))
    }

    /// Returns an error if no pose of a camera is known.
    pub(super) fn check(&self, camera_frame: &str) -> Result<(), FormatError> {
        self.trajectory(camera_frame).map(drop)
    }

    /// Returns the pose of the camera of a message; `None` if it is unknown.
    pub(super) fn pose(&self, header: &Header) -> Option<SensorPose> {
        self.buffer.pose(header).ok()
    }

    fn trajectory(&self, camera_frame: &str) -> Result<Trajectory, FormatError> {
        let unsupported = |problem: String| FormatError::Unsupported(printable_line(&problem).into_owned());
        let Self { buffer, topic } = self;
        let poses = buffer.poses(camera_frame).map_err(|error| {
            let of_robot = if buffer.needs_static_transforms() {
                "; the topic has the pose of a robot, to which static transforms must lead from the camera"
            } else {
                ""
            };
            unsupported(format!("the topic {topic} has no poses of the camera: {error}{of_robot}"))
        })?;
        if poses.is_empty() {
            let problem =
                "has no transforms over time between the camera and the fixed frame; name another fixed frame";
            return Err(unsupported(format!("the topic {topic} {problem}")));
        }
        Trajectory::of_times(poses.into_iter().map(|(at, pose)| (at.seconds(), pose)).collect())
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

/// The last part of the name of a topic with static transforms.
const STATIC: &str = "tf_static";

/// Returns true if a topic has static transforms.
fn is_static(name: &str) -> bool {
    name.rsplit('/').next() == Some(STATIC)
}

/// Returns true if a topic has the static transforms that belong to a topic with poses: it is in the same namespace or
/// in an enclosing one. Other namespaces may belong to other robots.
fn is_static_beside(name: &str, topic: &str) -> bool {
    let [name, topic] = [name, topic].map(|name| name.trim_start_matches('/'));
    let namespace = name.strip_suffix(STATIC).filter(|namespace| namespace.is_empty() || namespace.ends_with('/'));
    namespace.is_some_and(|namespace| topic.starts_with(namespace))
}

/// Lists the topics with poses.
fn told(channels: &BTreeMap<u16, (String, Option<PoseKind>)>) -> String {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn static_transforms_belong_to_topics_of_their_namespace() {
        for (name, topic, expected) in [
            ("/tf_static", "/tf", true),
            ("tf_static", "tf", true),
            ("/tf_static", "odom", true),
            ("/tf_static", "/robot/odom", true),
            ("/robot/tf_static", "/robot/tf", true),
            ("/robot/tf_static", "/robot2/tf", false),
            ("/robot/tf_static", "/tf", false),
            ("/my_tf_static", "/tf", false),
        ] {
            assert_eq!(is_static_beside(name, topic), expected, "{name} {topic}");
        }
        assert!(is_static("/tf_static") && is_static("tf_static") && !is_static("/my_tf_static") && !is_static("/tf"));
    }
}
