//! The poses of a moving camera in a recording: tf, odometry and poses.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use mcap::records::MessageHeader;
use planish::bag::{CameraPoses, PoseTopic, SmoothBagOptions, SmoothBagReport, camera_trajectory, smooth_bag};
use planish::internal::RigidTransform;
use planish::io::ReadOptions;
use planish::ros::{
    CameraInfo, DepthPixels, Header, Image, MessageSmoother, Odometry, PoseStamped, TfMessage, Time, TransformStamped,
    to_cdr,
};
use planish::simulate::{DepthNoise, Event, Sequence};
use planish::{Error, SensorPose};
use planish_tests::scenes::small_camera;
use tempfile::TempDir;

const FRAMES: u64 = 12;
/// The pose of the camera in the robot's frame: 0.3 m ahead, 0.5 m up, looking along the robot's +x.
const MOUNT: [f64; 7] = [0.3, 0.0, 0.5, 0.5, -0.5, 0.5, -0.5];

/// A recording that is being written.
struct Bag {
    writer: mcap::Writer<BufWriter<File>>,
    channels: BTreeMap<String, u16>,
}

impl Bag {
    fn add(&mut self, topic: &str, type_name: &str, time: Time, data: &[u8]) {
        let Self { writer, channels } = self;
        let channel = *channels.entry(topic.to_owned()).or_insert_with(|| {
            let schema = writer.add_schema(type_name, "ros2msg", b"").unwrap();
            writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap()
        });
        let log_time = time.nanoseconds();
        let header = MessageHeader { channel_id: channel, sequence: 0, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, data).unwrap();
    }
}

fn time(number: f64) -> Time {
    Time::from_nanoseconds(100_000_000_000 + (number * 33e6) as u64)
}

fn stamped(parent: &str, child: &str, at: Time, transform: &RigidTransform) -> TransformStamped {
    let SensorPose { position_m, orientation: [w, x, y, z], .. } = SensorPose::from_transform(transform);
    TransformStamped {
        header: Header { stamp: at, frame_id: parent.into() },
        child_frame_id: child.into(),
        translation: position_m,
        rotation: [x, y, z, w],
    }
}

/// Writes a recording of a hand-held camera: depth, the robot's transforms and odometry, and the camera's own poses.
/// Returns its path and the true poses.
fn recording(folder: &TempDir) -> (PathBuf, Vec<SensorPose>) {
    let path = folder.path().join("moving.mcap");
    let options = mcap::WriteOptions::new().compression(None).profile("ros2");
    let writer = options.create(BufWriter::new(File::create(&path).unwrap())).unwrap();
    let mut bag = Bag { writer, channels: BTreeMap::new() };
    let camera = small_camera();
    let mount = SensorPose::from_viewpoint(MOUNT).transform().unwrap();
    let fixed = TfMessage { transforms: vec![stamped("base_link", "optical", time(0.0), &mount)] };
    bag.add("/tf_static", "tf2_msgs/msg/TFMessage", time(0.0), &to_cdr(&fixed).unwrap());
    // Another robot has a camera of the same name.
    let other = TfMessage { transforms: vec![stamped("base_link", "optical", time(0.0), &RigidTransform::IDENTITY)] };
    bag.add("/other/tf_static", "tf2_msgs/msg/TFMessage", time(1.0), &to_cdr(&other).unwrap());
    let mut sequence = Sequence::new(Event::MovingCamera, camera, DepthNoise::default(), 2);
    let mut poses = Vec::new();
    for number in 0..FRAMES {
        let seen = sequence.frame(number).unwrap();
        let at = time(number as f64);
        let pose = seen.pose.sensor_pose().unwrap();
        let world_from_base = pose.transform().unwrap().after(mount.inverse());
        let of_base = stamped("odom", "base_link", at, &world_from_base);
        let corrected =
            stamped("map", "odom", time(3.0 * number as f64), &RigidTransform::shift([number as f64, 0.0, 0.0]));
        let transforms = TfMessage { transforms: vec![of_base.clone(), corrected] };
        bag.add("/tf", "tf2_msgs/msg/TFMessage", at, &to_cdr(&transforms).unwrap());
        let TransformStamped { header, child_frame_id, translation: position, rotation: orientation } = of_base;
        let odometry = Odometry { header, child_frame_id, position, orientation };
        // The covariances and the velocity follow.
        let bytes = [to_cdr(&odometry).unwrap(), vec![0; 8 * (36 + 6 + 36)]].concat();
        bag.add("/odom", "nav_msgs/msg/Odometry", at, &bytes);
        let [w, x, y, z] = pose.orientation;
        let header = Header { stamp: at, frame_id: "world".into() };
        let own = PoseStamped { header, position: pose.position_m, orientation: [x, y, z, w] };
        bag.add("/slam/pose", "geometry_msgs/msg/PoseStamped", at, &to_cdr(&own).unwrap());
        let header = Header { stamp: at, frame_id: "optical".into() };
        let info = CameraInfo::of_camera(header.clone(), &camera);
        bag.add("/depth/camera_info", "sensor_msgs/msg/CameraInfo", at, &to_cdr(&info).unwrap());
        let depth = planish::DepthImage { width: camera.width, height: camera.height, raw: seen.frame.raw.clone() };
        let image = Image::of_depth(header, &DepthPixels::Millimetres(depth));
        bag.add("/depth/image", "sensor_msgs/msg/Image", at, &to_cdr(&image).unwrap());
        poses.push(pose);
    }
    bag.writer.finish().unwrap();
    (path, poses)
}

fn topic(topic: &str, fixed_frame: Option<&str>) -> PoseTopic {
    PoseTopic { topic: topic.into(), fixed_frame: fixed_frame.map(str::to_owned) }
}

fn smooth(input: &Path, poses: Option<CameraPoses>, settings: &str) -> Result<(SmoothBagReport, Vec<u8>), Error> {
    let folder = TempDir::new().unwrap();
    let output = folder.path().join("smooth.mcap");
    let mut smoother = MessageSmoother::new(format!("engine=cpu {settings}").parse().unwrap()).unwrap();
    let options = SmoothBagOptions::default().with_poses(poses);
    let report = smooth_bag(input, &output, &mut smoother, &options, &AtomicBool::new(false), &mut |_, _| ())?;
    Ok((report, std::fs::read(output).unwrap()))
}

#[test]
fn transforms_odometry_and_poses_are_the_camera_s_trajectory() {
    let folder = TempDir::new().unwrap();
    let (path, poses) = recording(&folder);
    let first = poses[0].transform().unwrap();
    for (topic, name) in [
        (topic("/tf", None), "odom by default"),
        (topic("/tf", Some("odom")), "a named frame"),
        (topic("/odom", None), "odometry and static transforms"),
        (topic("/slam/pose", None), "the camera's own poses"),
    ] {
        let trajectory = camera_trajectory(&path, None, &topic, &ReadOptions::default()).unwrap();
        assert_eq!((trajectory.len(), trajectory.has_times()), (FRAMES as usize, true), "{name}");
        for (number, pose) in poses.iter().enumerate() {
            let found = trajectory.pose(0, Some(time(number as f64).seconds()), None).unwrap();
            let off = found.transform().unwrap().after(pose.transform().unwrap().inverse());
            assert!(off.translation.length() < 1e-9, "{name}, frame {number}: {found:?} {pose:?}");
            assert!(found.transform().unwrap().after(first.inverse()).translation.length() < 1.0);
        }
    }
    // The transforms of `map` are 0.1 s apart. Their interpolated corrections move the camera.
    let trajectory = camera_trajectory(&path, None, &topic("/tf", Some("map")), &ReadOptions::default()).unwrap();
    let [a, b] = [0, 11].map(|number| trajectory.pose(0, Some(time(f64::from(number)).seconds()), None).unwrap());
    let [true_a, true_b] = [&poses[0], &poses[11]].map(|pose| pose.position_m[0]);
    assert!((b.position_m[0] - a.position_m[0] - (true_b - true_a) - 11.0 / 3.0).abs() < 1e-6, "{a:?} {b:?}");
}

#[test]
fn a_recording_is_smoothed_with_its_poses_as_with_those_of_a_file() {
    let folder = TempDir::new().unwrap();
    let (path, poses) = recording(&folder);
    let of_file = poses.iter().enumerate().map(|(number, pose)| (time(number as f64).seconds(), *pose)).collect();
    let of_file = CameraPoses::Trajectory(planish::io::Trajectory::of_times(of_file).unwrap());
    let (report, expected) = smooth(&path, Some(of_file), "temporal=steady").unwrap();
    assert_eq!((report.topics[0].smoothed, report.without_pose), (FRAMES, 0));
    let (report, by_pose) =
        smooth(&path, Some(CameraPoses::Topic(topic("/slam/pose", None))), "temporal=steady").unwrap();
    assert_eq!(report.without_pose, 0);
    assert!(by_pose == expected);
    let (_, by_tf) = smooth(&path, Some(CameraPoses::Topic(topic("/tf", None))), "temporal=steady").unwrap();
    let differing = by_tf.iter().zip(&expected).filter(|(a, b)| a != b).count();
    assert!(differing * 1000 < expected.len(), "rounding may move {differing} of {} bytes", expected.len());
    let (_, still) = smooth(&path, None, "temporal=steady").unwrap();
    assert!(still.iter().zip(&expected).filter(|(a, b)| a != b).count() * 50 > expected.len());
}

#[test]
fn poses_that_do_not_apply_are_refused_with_the_reason() {
    let folder = TempDir::new().unwrap();
    let (path, _) = recording(&folder);
    for (poses, settings, problem) in [
        (topic("/tf", None), "", "smoothing over time"),
        (topic("/tf", None), "track=true", "omit one of the two"),
        (topic("/none", None), "temporal=steady", "poses are on /odom, /other/tf_static, /slam/pose, /tf, /tf_static"),
        (topic("/depth/image", None), "temporal=steady", "has no poses"),
        (topic("/tf", Some("world")), "temporal=steady", "known are base_link, map, odom, optical"),
        (topic("/tf", Some("base_link")), "temporal=steady", "no transforms over time"),
        (topic("/tf_static", None), "temporal=steady", "only static transforms"),
    ] {
        let error = smooth(&path, Some(CameraPoses::Topic(poses.clone())), settings).unwrap_err().to_string();
        assert!(error.contains(problem), "{poses:?}: {error}");
    }
}
