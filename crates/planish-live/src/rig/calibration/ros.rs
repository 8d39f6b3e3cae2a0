//! Static transforms of ROS: `tf2_msgs/TFMessage` as YAML, and the fixed joints of a URDF.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;

use super::{CalibrationOptions, as_name, camera_at, malformed};
use crate::rig::RigCamera;
use planish_core::{FormatError, SensorPose, internal::RigidTransform};
use planish_io::internal::parse_yaml;

/// Maximum depth of a tree of frames; a deeper tree has a cycle.
const DEEPEST: usize = 1000;

/// Suffixes of the frame names of depth cameras, and of cameras in general (REP 103).
const OPTICAL: [&str; 2] = ["depth_optical_frame", "optical_frame"];

/// A tree of coordinate frames: the parent of each frame, and the transform parent_from_child.
#[derive(Default)]
pub(super) struct Tree {
    parents: BTreeMap<String, (String, RigidTransform)>,
    /// Frames that move relative to their parents, with the names of their joints.
    moving: BTreeMap<String, String>,
}

impl Tree {
    fn add(&mut self, parent: &str, child: &str, pose: SensorPose) -> Result<(), FormatError> {
        let problem = |what: String| malformed(format!("the transform from {parent:?} to {child:?}: {what}"));
        if pose.orientation == [0.0; 4] {
            return Err(problem("its rotation is 0, 0, 0, 0, which is invalid".to_owned()));
        }
        let transform = pose.transform().map_err(|error| problem(error.to_string()))?;
        match self.parents.insert(child.to_owned(), (parent.to_owned(), transform)) {
            Some((other, _)) if other != parent => Err(problem(format!("{child:?} has a second parent, {other:?}"))),
            _ => Ok(()),
        }
    }

    /// Returns the only frame that has children and no parent.
    fn root(&self) -> Result<String, FormatError> {
        let mut roots: Vec<&String> = self
            .parents
            .values()
            .map(|(parent, _)| parent)
            .filter(|parent| !self.parents.contains_key(*parent))
            .collect();
        roots.sort();
        roots.dedup();
        match roots[..] {
            [root] => Ok(root.clone()),
            [] => Err(malformed("the file has no transforms, or they form a cycle")),
            _ => Err(malformed(format!("several frames have no parent ({roots:?}); choose the rig's frame (base)"))),
        }
    }

    /// Returns the transform base_from_frame.
    fn base_from(&self, base: &str, frame: &str) -> Result<RigidTransform, FormatError> {
        let to_root = |frame: &str| {
            let (mut chain, mut here) = (vec![(frame.to_owned(), RigidTransform::IDENTITY)], frame);
            while let Some((parent, parent_from_child)) = self.parents.get(here).filter(|_| chain.len() < DEEPEST) {
                let so_far = chain.last().map_or(RigidTransform::IDENTITY, |(_, transform)| *transform);
                chain.push((parent.clone(), parent_from_child.after(so_far)));
                here = parent;
            }
            chain
        };
        let (of_base, of_frame) = (to_root(base), to_root(frame));
        let is_beside = |a: &[(String, RigidTransform)], frame: &str| a.iter().all(|(other, _)| other != frame);
        let on_one_side = |a: &'_ [(String, RigidTransform)], b: &'_ [(String, RigidTransform)]| {
            a.iter()
                .find(|(frame, _)| is_beside(b, frame) && self.moving.contains_key(frame))
                .map(|(frame, _)| frame.clone())
        };
        if let Some(moving) = on_one_side(&of_base, &of_frame).or_else(|| on_one_side(&of_frame, &of_base)) {
            let joint = self.moving.get(&moving).cloned().unwrap_or_default();
            return Err(malformed(format!(
                "the joint {joint:?} moves between {base:?} and {frame:?}, but a rig must be rigid; choose a base \
                 beyond the joint (base), and only cameras attached to that side (frame)"
            )));
        }
        // Via their common ancestor: base_from_common after common_from_frame.
        let met = of_frame.iter().find_map(|(common, from_frame)| {
            of_base
                .iter()
                .find(|(other, _)| other == common)
                .map(|(_, from_base)| from_base.inverse().after(*from_frame))
        });
        met.ok_or_else(|| malformed(format!("no transforms connect {base:?} and {frame:?}")))
    }

    /// Returns the frame of the rig, and its cameras.
    pub(super) fn cameras(&self, options: &CalibrationOptions) -> Result<(String, Vec<RigCamera>), FormatError> {
        let is_known = |frame: &String| {
            self.parents.contains_key(frame) || self.parents.values().any(|(parent, _)| parent == frame)
        };
        let all: Vec<&String> = self.parents.keys().collect();
        if let Some(missing) = options.frames.iter().chain(&options.base).find(|frame| !is_known(frame)) {
            return Err(malformed(format!("no frame {missing:?}; available are {all:?}")));
        }
        let base = options.base.clone().map_or_else(|| self.root(), Ok)?;
        let ending =
            |ending: &str| all.iter().filter(|frame| frame.ends_with(ending)).map(|frame| (*frame).clone()).collect();
        let mut frames = options.frames.clone();
        for optical in OPTICAL {
            frames = if frames.is_empty() { ending(optical) } else { frames };
        }
        if frames.is_empty() {
            return Err(malformed(format!(
                "no frame name ends in optical_frame; choose camera frames (frame), which look along z; \
                 available are {all:?}"
            )));
        }
        let camera = |frame: &String| {
            let stem = OPTICAL.iter().find_map(|optical| frame.strip_suffix(optical)).unwrap_or(frame);
            Ok(camera_at(&as_name(stem.trim_end_matches('_')), &self.base_from(&base, frame)?))
        };
        Ok((base.clone(), frames.iter().map(camera).collect::<Result<_, FormatError>>()?))
    }
}

/// Reads the transforms of messages printed by `ros2 topic echo`.
pub(super) fn transforms(text: &str) -> Result<Tree, FormatError> {
    #[derive(Deserialize)]
    struct Message {
        transforms: Vec<Stamped>,
    }
    #[derive(Deserialize)]
    struct Stamped {
        header: Header,
        child_frame_id: String,
        transform: Transform,
    }
    #[derive(Deserialize)]
    struct Header {
        frame_id: String,
    }
    #[derive(Deserialize)]
    struct Transform {
        translation: Vector,
        rotation: Quaternion,
    }
    #[derive(Deserialize)]
    struct Vector {
        x: f64,
        y: f64,
        z: f64,
    }
    #[derive(Deserialize)]
    struct Quaternion {
        x: f64,
        y: f64,
        z: f64,
        w: f64,
    }
    let mut tree = Tree::default();
    // Each message ends with `---`, the separator of YAML documents.
    for document in text.split("\n---").filter(|document| document.contains("transforms:")) {
        let message: Message = parse_yaml(document.trim_start().trim_start_matches("---"))
            .map_err(|error| malformed(format!("not a list of transforms: {error}")))?;
        for Stamped { header, child_frame_id, transform } in message.transforms {
            let Transform { translation: Vector { x, y, z }, rotation: q } = transform;
            let pose = SensorPose::from_xyzw([x, y, z], [q.x, q.y, q.z, q.w]);
            tree.add(header.frame_id.trim_start_matches('/'), child_frame_id.trim_start_matches('/'), pose)?;
        }
    }
    Ok(tree)
}

/// Reads the joints of a URDF; movable joints are assumed to be at their zero position.
pub(super) fn urdf(text: &str) -> Result<Tree, FormatError> {
    let document = roxmltree::Document::parse(text).map_err(|error| malformed(format!("not a URDF: {error}")))?;
    let robot = document.root_element();
    if robot.tag_name().name() != "robot" {
        return Err(malformed(format!(
            "not a URDF: the root element is <{}>; expected <robot>",
            robot.tag_name().name()
        )));
    }
    let mut tree = Tree::default();
    for joint in robot.children().filter(|node| node.has_tag_name("joint")) {
        let name = joint.attribute("name").unwrap_or_default();
        let problem = |what: &str| malformed(format!("the joint {name:?} {what}"));
        let child = |tag: &str| joint.children().find(|node| node.has_tag_name(tag));
        let link = |tag: &str| child(tag).and_then(|node| node.attribute("link"));
        let (Some(parent), Some(link)) = (link("parent"), link("child")) else {
            return Err(problem("lacks its parent or its child"));
        };
        let numbers = |attribute: &str| match child("origin").and_then(|origin| origin.attribute(attribute)) {
            None => Some(DVec3::ZERO),
            Some(text) => {
                let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
                numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok()).map(DVec3::from_array)
            }
        };
        let (Some(xyz), Some(rpy)) = (numbers("xyz"), numbers("rpy")) else {
            return Err(problem(
                "has an invalid origin; expected three numbers, such as xyz=\"0 0 0.1\" (expand xacro first)",
            ));
        };
        // About fixed axes: first roll about x, then pitch about y, then yaw about z.
        let rotation = DMat3::from_rotation_z(rpy.z) * DMat3::from_rotation_y(rpy.y) * DMat3::from_rotation_x(rpy.x);
        if joint.attribute("type").is_some_and(|kind| kind != "fixed") {
            tree.moving.insert(link.to_owned(), name.to_owned());
        }
        tree.add(parent, link, SensorPose::from_xyzw(xyz.to_array(), DQuat::from_mat3(&rotation).to_array()))?;
    }
    Ok(tree)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two cameras on a robot, one of them through a separate link, as RealSense's driver publishes it.
    const TRANSFORMS: &str = "transforms:
- header:
    stamp: {sec: 1, nanosec: 0}
    frame_id: base_link
  child_frame_id: left_link
  transform:
    translation: {x: 1.0, y: 0.5, z: 0.25}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
- header:
    frame_id: left_link
  child_frame_id: left_depth_optical_frame
  transform:
    translation: {x: 0.0, y: 0.0, z: 0.0}
    rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}
- header:
    frame_id: left_link
  child_frame_id: left_color_optical_frame
  transform:
    translation: {x: 0.0, y: 0.015, z: 0.0}
    rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}
---
transforms:
- header:
    frame_id: base_link
  child_frame_id: right_depth_optical_frame
  transform:
    translation: {x: 1.0, y: -0.5, z: 0.25}
    rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}
---
";

    const URDF: &str = r#"<?xml version="1.0"?>
<robot name="r">
  <link name="base_link"/>
  <joint name="a" type="fixed"><parent link="base_link"/><child link="left_link"/><origin xyz="1 0.5 0.25" rpy="0 0 0"/></joint>
  <joint name="b" type="fixed"><parent link="left_link"/><child link="left_depth_optical_frame"/>
    <origin xyz="0 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
  <joint name="c" type="fixed"><parent link="base_link"/><child link="right_depth_optical_frame"/>
    <origin xyz="1 -0.5 0.25" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
</robot>"#;

    fn close(pose: &SensorPose, position_m: [f64; 3], rotation: [[f64; 3]; 3]) -> bool {
        let rows = pose.rotation();
        let off = |i: usize, k: usize| (rows[i][k] - rotation[i][k]).abs();
        (0..3).all(|i| (pose.position_m[i] - position_m[i]).abs() < 1e-9 && (0..3).all(|k| off(i, k) < 1e-9))
    }

    /// The camera's z is the robot's x, its x the robot's -y.
    const AHEAD: [[f64; 3]; 3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];

    #[test]
    fn cameras_on_both_sides_of_a_joint_that_moves_are_no_rig() {
        let urdf = |kind: &str| {
            super::urdf(&URDF.replacen("name=\"a\" type=\"fixed\"", &format!("name=\"a\" type=\"{kind}\""), 1)).unwrap()
        };
        assert!(urdf("fixed").cameras(&CalibrationOptions::default()).is_ok());
        let error = urdf("revolute").cameras(&CalibrationOptions::default()).unwrap_err().to_string();
        assert!(error.contains("\"a\" moves"), "{error}");
        // Beyond the joint, all frames are fixed to each other.
        let beyond = CalibrationOptions::default()
            .with_base(Some("left_link".to_owned()))
            .with_frames(vec!["left_depth_optical_frame".to_owned()]);
        assert_eq!(urdf("revolute").cameras(&beyond).unwrap().1.len(), 1);
    }

    #[test]
    fn depth_cameras_of_transforms_and_of_a_urdf_stand_where_the_robot_has_them() {
        for tree in [transforms(TRANSFORMS).unwrap(), urdf(URDF).unwrap()] {
            let (base, cameras) = tree.cameras(&CalibrationOptions::default()).unwrap();
            let names: Vec<&str> = cameras.iter().map(|camera| camera.name.as_str()).collect();
            assert_eq!((base.as_str(), &names[..]), ("base_link", &["left", "right"][..]));
            assert!(close(&cameras[0].pose, [1.0, 0.5, 0.25], AHEAD), "{:?}", cameras[0].pose);
            assert!(close(&cameras[1].pose, [1.0, -0.5, 0.25], AHEAD), "{:?}", cameras[1].pose);
        }
    }

    #[test]
    fn frames_and_base_are_those_asked_for() {
        let tree = transforms(TRANSFORMS).unwrap();
        let options = CalibrationOptions::default().with_base(Some("left_depth_optical_frame".into()));
        let frames = ["left_color_optical_frame", "right_depth_optical_frame"].map(str::to_owned).to_vec();
        let (_, cameras) = tree.cameras(&options.with_frames(frames)).unwrap();
        let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        assert_eq!(cameras[0].name, "left_color");
        assert!(close(&cameras[0].pose, [-0.015, 0.0, 0.0], identity), "{:?}", cameras[0].pose);
        assert!(close(&cameras[1].pose, [1.0, 0.0, 0.0], identity), "{:?}", cameras[1].pose);
    }

    #[test]
    fn trees_that_lead_nowhere_are_refused() {
        let refused =
            |tree: &Tree, options: CalibrationOptions| tree.cameras(&options).map(drop).unwrap_err().to_string();
        let tree = transforms(TRANSFORMS).unwrap();
        let said = refused(&tree, CalibrationOptions::default().with_frames(vec!["middle".into()]));
        assert!(said.contains("middle") && said.contains("left_link"), "{said}");
        let two = format!(
            "{TRANSFORMS}\n{}",
            TRANSFORMS.replace("base_link", "other").replace("left_", "l_").replace("right_", "r_")
        );
        let said = refused(&transforms(&two).unwrap(), CalibrationOptions::default());
        assert!(said.contains("(base)"), "{said}");
        let circle = TRANSFORMS.replace("child_frame_id: right_depth_optical_frame", "child_frame_id: base_link");
        assert!(transforms(&circle).is_ok_and(|tree| refused(&tree, CalibrationOptions::default()).contains("cycle")));
        let twice =
            TRANSFORMS.replace("child_frame_id: right_depth_optical_frame", "child_frame_id: left_depth_optical_frame");
        assert!(transforms(&twice).map(drop).unwrap_err().to_string().contains("second parent"));
        let turned = TRANSFORMS.replace("w: 1.0", "w: 2.0");
        assert!(transforms(&turned).map(drop).unwrap_err().to_string().contains("left_link"));
        for bad in ["<robot><joint/></robot>", "<robot", "<html/>", &URDF.replace("1 0.5 0.25", "${x} 0 0")] {
            assert!(urdf(bad).is_err(), "{bad}");
        }
    }
}
