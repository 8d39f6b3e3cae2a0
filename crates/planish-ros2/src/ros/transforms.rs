//! The transforms between coordinate frames over time, from tf and odometry.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::messages::{Header, Time};
use planish_core::SensorPose;
use planish_core::internal::{LONGEST_POSE_GAP_S, RigidTransform};
use planish_io::internal::brief;

/// Maximum number of frames from a frame to the root of its tree. Longer chains count as cycles.
const DEEPEST: usize = 100;
/// The frame in which odometry is continuous, whereas `map` jumps when a robot corrects its position (ROS REP 105).
const CONTINUOUS: &str = "odom";

/// `geometry_msgs/TransformStamped`: the pose of a frame in its parent, which the header names.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TransformStamped {
    /// Stamp and parent frame.
    pub header: Header,
    /// The frame.
    pub child_frame_id: String,
    /// Position of the frame's origin in its parent, in metres.
    pub translation: [f64; 3],
    /// Orientation in the parent as a unit quaternion x, y, z, w.
    pub rotation: [f64; 4],
}

/// `tf2_msgs/TFMessage`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TfMessage {
    /// The transforms.
    pub transforms: Vec<TransformStamped>,
}

/// The beginning of `nav_msgs/Odometry`: the pose of a robot's frame in the header's frame, without covariances and
/// velocities.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Odometry {
    /// Stamp and parent frame.
    pub header: Header,
    /// The robot's frame.
    pub child_frame_id: String,
    /// Position in metres.
    pub position: [f64; 3],
    /// Orientation as a unit quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

impl From<Odometry> for TransformStamped {
    fn from(Odometry { header, child_frame_id, position, orientation }: Odometry) -> Self {
        Self { header, child_frame_id, translation: position, rotation: orientation }
    }
}

/// `geometry_msgs/PoseStamped`, and the beginning of `geometry_msgs/PoseWithCovarianceStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseStamped {
    /// Stamp and parent frame.
    pub header: Header,
    /// Position in metres.
    pub position: [f64; 3],
    /// Orientation as a unit quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

impl PoseStamped {
    /// Returns the transform of the frame whose pose this is.
    pub fn of_frame(self, child_frame_id: &str) -> TransformStamped {
        let Self { header, position, orientation } = self;
        TransformStamped {
            header,
            child_frame_id: child_frame_id.to_owned(),
            translation: position,
            rotation: orientation,
        }
    }
}

/// Reason why a pose is unknown.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TransformError {
    /// The frames are not connected at any time.
    #[error("no transforms connect the frames {frame:?} and {fixed:?}; known are {known}")]
    NotConnected {
        /// The frame whose pose was requested.
        frame: String,
        /// The frame in which it was requested.
        fixed: String,
        /// The known frames.
        known: String,
    },
    /// All transforms of the frame are later, those around this time are more than 0.2 s apart, or the frame's parent
    /// changes between them.
    #[error("the transform of the frame {frame:?} is unknown at this time")]
    Unknown {
        /// The frame.
        frame: String,
    },
    /// The transform of a frame is not known yet at this time.
    #[error("the transform of the frame {frame:?} ends before this time")]
    NotYet {
        /// The frame.
        frame: String,
    },
}

/// A valid pose of a frame in its parent.
#[derive(Debug, Clone)]
struct Sample {
    parent: Arc<str>,
    pose: SensorPose,
}

/// A frame's transforms to its parents.
#[derive(Debug, Clone, Default)]
struct Edge {
    /// The transform that is valid at all times. Transforms over time take precedence over it.
    fixed: Option<Sample>,
    /// By time in nanoseconds.
    samples: BTreeMap<i64, Sample>,
}

impl Edge {
    /// Returns the parent at a time, or the newest one.
    fn parent(&self, at_ns: Option<i64>) -> Option<&Arc<str>> {
        let next = at_ns.and_then(|at_ns| self.samples.range(at_ns..).next());
        let sample = next.or_else(|| self.samples.last_key_value()).map(|(_, sample)| sample);
        sample.or(self.fixed.as_ref()).map(|sample| &sample.parent)
    }

    /// Returns the pose at a time of `frame`, to which this edge belongs.
    fn at(&self, at_ns: i64, frame: &str) -> Result<SensorPose, TransformError> {
        let unknown = || TransformError::Unknown { frame: frame.to_owned() };
        let Some((newest_ns, _)) = self.samples.last_key_value() else {
            return self.fixed.as_ref().map(|sample| sample.pose).ok_or_else(unknown);
        };
        if at_ns > *newest_ns {
            return Err(TransformError::NotYet { frame: frame.to_owned() });
        }
        let (to_ns, to) = self.samples.range(at_ns..).next().ok_or_else(unknown)?;
        if *to_ns == at_ns {
            return Ok(to.pose);
        }
        let (from_ns, from) = self.samples.range(..at_ns).next_back().ok_or_else(unknown)?;
        if (to_ns - from_ns) as f64 / 1e9 > LONGEST_POSE_GAP_S || from.parent != to.parent {
            return Err(unknown());
        }
        let share = (at_ns - from_ns) as f64 / (to_ns - from_ns) as f64;
        Ok(from.pose.interpolated(&to.pose, share))
    }
}

/// The transforms between coordinate frames over time.
///
/// As in tf, every frame has one parent at a time. Transforms at most 0.2 s apart are interpolated.
#[derive(Debug, Clone, Default)]
pub struct Transforms {
    edges: BTreeMap<Arc<str>, Edge>,
    /// The names of all frames.
    names: BTreeSet<Arc<str>>,
    kept_ns: Option<i64>,
    count: usize,
    name_bytes: usize,
}

impl Transforms {
    /// Keeps only the last `seconds` of each frame's transforms.
    pub fn keeping_s(self, seconds: f64) -> Self {
        Self { kept_ns: Some((1e9 * seconds) as i64), ..self }
    }

    /// Returns the number of transforms.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Returns true if there are no transforms.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns the approximate memory use of all transforms, in bytes.
    pub fn bytes(&self) -> usize {
        /// Memory for a frame besides its name.
        const FRAME: usize = 400;
        /// Memory for a transform.
        const TRANSFORM: usize = 160;
        self.name_bytes + FRAME * self.names.len() + TRANSFORM * self.count
    }

    /// Adds a transform. A static transform is valid at all times, unless the frame has transforms over time. Returns
    /// false, without adding it, if the transform is invalid: a position that is not finite or is beyond 1e9 m, a
    /// quaternion without unit length, a frame without a name, or one that is its own parent.
    pub fn add(&mut self, transform: &TransformStamped, is_static: bool) -> bool {
        let TransformStamped { header, child_frame_id, translation, rotation } = transform;
        let (parent, frame) = (name_of(&header.frame_id), name_of(child_frame_id));
        let pose = SensorPose::from_xyzw(*translation, *rotation);
        let is_pose = pose.validate().is_ok() && *rotation != [0.0; 4];
        if !is_pose || parent == frame || frame.is_empty() || parent.is_empty() {
            return false;
        }
        let (frame, parent) = (self.name(frame), self.name(parent));
        let sample = Sample { parent, pose };
        let edge = self.edges.entry(frame).or_default();
        if is_static {
            self.count += usize::from(edge.fixed.replace(sample).is_none());
            return true;
        }
        let at_ns = time_ns(header.stamp);
        self.count += usize::from(edge.samples.insert(at_ns, sample).is_none());
        let newest_ns = edge.samples.last_key_value().map_or(at_ns, |(newest_ns, _)| *newest_ns);
        while let (Some(kept_ns), Some(oldest)) = (self.kept_ns, edge.samples.first_entry())
            && newest_ns.saturating_sub(*oldest.key()) > kept_ns
        {
            oldest.remove();
            self.count -= 1;
        }
        true
    }

    /// Returns the shared copy of a name.
    fn name(&mut self, name: &str) -> Arc<str> {
        if let Some(known) = self.names.get(name) {
            return Arc::clone(known);
        }
        let name: Arc<str> = name.into();
        self.name_bytes += name.len();
        self.names.insert(Arc::clone(&name));
        name
    }

    /// Returns the pose of a frame in another one at a time.
    ///
    /// # Errors
    /// If the frames are not connected, or one of the transforms between them is unknown at that time.
    pub fn pose(&self, frame: &str, fixed: &str, at: Time) -> Result<SensorPose, TransformError> {
        let at_ns = time_ns(at);
        let (up, down) = self.paths(frame, fixed, Some(at_ns))?;
        let along = |path: &[&str]| {
            path.iter().try_fold(RigidTransform::IDENTITY, |inner, frame| {
                let pose = self.edges[*frame].at(at_ns, frame)?;
                Ok(pose.transform().unwrap_or(RigidTransform::IDENTITY).after(inner))
            })
        };
        Ok(SensorPose::from_transform(&along(&down)?.inverse().after(along(&up)?)))
    }

    /// Returns the times at which transforms between two frames are known; empty if all are static.
    ///
    /// # Errors
    /// If the frames are not connected.
    pub fn times(&self, frame: &str, fixed: &str) -> Result<Vec<Time>, TransformError> {
        let mut between = self.frames_above(name_of(frame), name_of(fixed));
        if !between.remove(name_of(fixed)) {
            let mut others = self.frames_above(name_of(fixed), name_of(frame));
            if others.remove(name_of(frame)) {
                between = others;
            } else if between.is_disjoint(&others) {
                return Err(self.not_connected(frame, fixed));
            } else {
                // Transforms above both frames do not move the frames relative to each other.
                between = &between ^ &others;
            }
        }
        let edges = between.into_iter().filter_map(|frame| self.edges.get(frame));
        let times: BTreeSet<i64> = edges.flat_map(|edge| edge.samples.keys().copied()).collect();
        Ok(times.into_iter().map(of_ns).collect())
    }

    /// Returns a frame and all frames that were its ancestors at any time, up to `last`.
    fn frames_above<'a>(&'a self, frame: &'a str, last: &str) -> BTreeSet<&'a str> {
        let (mut found, mut open) = (BTreeSet::new(), vec![frame]);
        while let Some(frame) = open.pop() {
            if found.insert(frame) && frame != last {
                let edge = self.edges.get(frame);
                let samples = edge.into_iter().flat_map(|edge| edge.samples.values().chain(&edge.fixed));
                let parents: BTreeSet<&str> = samples.map(|sample| &*sample.parent).collect();
                open.extend(parents);
            }
        }
        found
    }

    /// Returns the frame that a frame's motion is best measured in: its ancestor `odom`, or otherwise the root of its
    /// tree; `None` if the frame is unknown or its tree has no root.
    pub fn fixed_frame(&self, frame: &str) -> Option<String> {
        let ancestors = self.ancestors(name_of(frame), None);
        let continuous = ancestors.iter().find(|ancestor| **ancestor == CONTINUOUS);
        let root = ancestors.last().filter(|_| ancestors.len() <= DEEPEST && self.names.contains(name_of(frame)));
        continuous.or(root).map(|frame| (*frame).to_owned())
    }

    fn not_connected(&self, frame: &str, fixed: &str) -> TransformError {
        TransformError::NotConnected { frame: brief(frame), fixed: brief(fixed), known: self.some_names() }
    }

    /// Lists some of the known frames.
    fn some_names(&self) -> String {
        const MOST: usize = 12;
        let first: Vec<&str> = self.names.iter().take(MOST).map(|name| &**name).collect();
        let more = if self.names.len() > MOST { ", ..." } else { "" };
        let names = if first.is_empty() { "no frames".to_owned() } else { first.join(", ") };
        brief(&names) + more
    }

    /// Returns a frame and its ancestors at a time, or the newest ones, up to the root. The list ends after
    /// [`DEEPEST`] + 1 frames, so cycles end, too.
    fn ancestors<'a>(&'a self, frame: &'a str, at_ns: Option<i64>) -> Vec<&'a str> {
        let parent = |frame: &&'a str| Some(&**self.edges.get(*frame)?.parent(at_ns)?);
        std::iter::successors(Some(frame), parent).take(DEEPEST + 1).collect()
    }

    /// Returns the frames whose transforms lead from `frame` and from `fixed` to their closest common ancestor.
    fn paths<'a>(&'a self, frame: &'a str, fixed: &'a str, at_ns: Option<i64>) -> Result<Paths<'a>, TransformError> {
        let [mut up, mut down] = [frame, fixed].map(|frame| self.ancestors(name_of(frame), at_ns));
        let common =
            up.iter().find_map(|ancestor| down.iter().position(|other| other == ancestor).zip(Some(*ancestor)));
        let Some((length, common)) = common else {
            return Err(self.not_connected(frame, fixed));
        };
        down.truncate(length);
        up.truncate(up.iter().position(|ancestor| *ancestor == common).unwrap_or_default());
        Ok((up, down))
    }
}

/// The frames below the closest common ancestor of two frames.
type Paths<'a> = (Vec<&'a str>, Vec<&'a str>);

/// Returns the name of a frame without the leading slash of ROS 1.
fn name_of(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

fn time_ns(time: Time) -> i64 {
    1_000_000_000 * i64::from(time.sec) + i64::from(time.nanosec)
}

fn of_ns(time_ns: i64) -> Time {
    let (sec, nanosec) = (time_ns.div_euclid(1_000_000_000), time_ns.rem_euclid(1_000_000_000));
    Time { sec: sec as i32, nanosec: nanosec as u32 }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    fn at(seconds: f64) -> Time {
        of_ns((1e9 * seconds).round() as i64)
    }

    fn transform(frame: &str, parent: &str, seconds: f64, translation: [f64; 3], degrees: f64) -> TransformStamped {
        let rotation = DQuat::from_rotation_z(degrees.to_radians()).to_array();
        let header = Header { stamp: at(seconds), frame_id: parent.to_owned() };
        TransformStamped { header, child_frame_id: frame.to_owned(), translation, rotation }
    }

    /// A robot that turns from 0 to 90° between 10.0 and 10.1 s, with a camera 1 m ahead of its centre.
    fn robot() -> Transforms {
        let mut transforms = Transforms::default();
        assert!(transforms.add(&transform("camera", "base", 0.0, [1.0, 0.0, 0.0], 0.0), true));
        assert!(transforms.add(&transform("base", "odom", 10.0, [0.0; 3], 0.0), false));
        assert!(transforms.add(&transform("base", "odom", 10.1, [0.0, 2.0, 0.0], 90.0), false));
        assert!(transforms.add(&transform("odom", "map", 0.0, [100.0, 0.0, 0.0], 0.0), false));
        transforms
    }

    #[test]
    fn poses_follow_the_chain_and_are_interpolated() {
        let transforms = robot();
        let pose = transforms.pose("camera", "odom", at(10.05)).unwrap();
        let expected = [45.0f64.to_radians().cos(), 1.0 + 45.0f64.to_radians().sin(), 0.0];
        assert!((DVec3::from(pose.position_m) - DVec3::from(expected)).length() < 1e-9, "{pose:?}");
        assert!((pose.orientation[3] - 22.5f64.to_radians().sin()).abs() < 1e-9, "{pose:?}");
        // Poses are also found from parent to child, and between frames on different branches.
        let back = transforms.pose("odom", "camera", at(10.0)).unwrap();
        assert_eq!(back.position_m, [-1.0, 0.0, 0.0]);
        let mut beside = robot();
        beside.add(&transform("lidar", "base", 0.0, [0.0, 3.0, 0.0], 0.0), true);
        assert_eq!(beside.pose("lidar", "/camera", at(99.0)).unwrap().position_m, [-1.0, 3.0, 0.0]);
        assert_eq!(transforms.times("camera", "odom").unwrap(), [at(10.0), at(10.1)]);
        assert_eq!(beside.times("lidar", "camera").unwrap(), []);
        assert_eq!(transforms.fixed_frame("/camera"), Some("odom".into()));
        assert_eq!(transforms.fixed_frame("map"), Some("map".into()));
        assert_eq!(transforms.fixed_frame("arm"), None);
    }

    #[test]
    fn unknown_times_frames_and_transforms_are_told_apart() {
        let mut transforms = robot();
        let error =
            |transforms: &Transforms, fixed: &str, seconds| transforms.pose("camera", fixed, at(seconds)).unwrap_err();
        assert_eq!(error(&transforms, "odom", 10.2), TransformError::NotYet { frame: "base".into() });
        assert_eq!(error(&transforms, "odom", 9.9), TransformError::Unknown { frame: "base".into() });
        let unconnected = error(&transforms, "world", 10.0);
        assert!(unconnected.to_string().contains("known are base, camera, map, odom"), "{unconnected}");
        // A gap of more than 0.2 s.
        transforms.add(&transform("base", "odom", 10.5, [0.0; 3], 0.0), false);
        assert_eq!(error(&transforms, "odom", 10.3), TransformError::Unknown { frame: "base".into() });
        let mut bad = transform("base", "odom", 10.6, [f64::NAN, 0.0, 0.0], 0.0);
        assert!(!transforms.add(&bad, false));
        bad = TransformStamped { translation: [0.0; 3], rotation: [0.0; 4], ..bad };
        assert!(!transforms.add(&bad, false));
        assert!(!transforms.add(&transform("odom", "/odom", 1.0, [0.0; 3], 0.0), false));
        // A cycle ends.
        transforms.add(&transform("map", "camera", 1.0, [0.0; 3], 0.0), true);
        assert!(transforms.pose("camera", "world", at(10.0)).is_err() && transforms.fixed_frame("base").is_some());
        // Nothing moves between a camera and what is fixed to it, in either direction.
        let mut transforms = robot();
        transforms.add(&transform("tag", "camera", 0.0, [0.1, 0.0, 0.0], 0.0), true);
        for (frame, fixed) in [("camera", "tag"), ("tag", "camera"), ("tag", "base"), ("base", "tag")] {
            assert!(transforms.times(frame, fixed).unwrap().is_empty(), "{frame} in {fixed}");
        }
        assert_eq!(transforms.times("tag", "odom").unwrap(), transforms.times("odom", "tag").unwrap());
        assert!(!transforms.times("odom", "tag").unwrap().is_empty());
    }

    #[test]
    fn only_recent_transforms_are_kept() {
        let mut transforms = Transforms::default().keeping_s(1.0);
        for k in 0..100 {
            transforms.add(&transform("base", "odom", 0.1 * f64::from(k), [f64::from(k), 0.0, 0.0], 0.0), false);
        }
        assert_eq!(transforms.len(), 11);
        // Out of order, and twice the same time.
        transforms.add(&transform("base", "odom", 9.75, [97.5, 1.0, 0.0], 0.0), false);
        transforms.add(&transform("base", "odom", 9.75, [97.5, 2.0, 0.0], 0.0), false);
        assert_eq!(transforms.len(), 12);
        assert_eq!(transforms.pose("base", "odom", at(9.75)).unwrap().position_m, [97.5, 2.0, 0.0]);
    }

    #[test]
    fn a_parent_may_change_and_static_transforms_do_not_replace_those_over_time() {
        let mut transforms = Transforms::default();
        for k in 0..10 {
            let parent = if k < 5 { "odom" } else { "map" };
            transforms.add(&transform("base", parent, 0.1 * f64::from(k), [f64::from(k), 0.0, 0.0], 0.0), false);
        }
        transforms.add(&transform("odom", "map", 0.0, [100.0, 0.0, 0.0], 0.0), true);
        transforms.add(&transform("base", "odom", 0.0, [7.0, 0.0, 0.0], 0.0), true);
        assert_eq!(transforms.pose("base", "map", at(0.35)).unwrap().position_m, [103.5, 0.0, 0.0]);
        assert_eq!(transforms.pose("base", "map", at(0.75)).unwrap().position_m, [7.5, 0.0, 0.0]);
        // Between the two parents.
        let error = transforms.pose("base", "map", at(0.45)).unwrap_err();
        assert_eq!(error, TransformError::Unknown { frame: "base".into() });
        assert_eq!(transforms.times("base", "map").unwrap().len(), 10);
        // Only earlier transforms lead to this frame.
        let mut earlier = transforms.clone();
        earlier.edges.remove("odom");
        assert_eq!(earlier.times("base", "odom").unwrap().len(), 10);
        assert!(earlier.pose("base", "odom", at(0.3)).is_ok() && earlier.pose("base", "odom", at(0.7)).is_err());
        assert_eq!((transforms.len(), transforms.fixed_frame("base")), (12, Some("map".into())));
        // A chain without a root has no fixed frame.
        transforms.add(&transform("map", "base", 0.0, [0.0; 3], 0.0), true);
        assert_eq!(transforms.fixed_frame("base"), None);
    }
}
