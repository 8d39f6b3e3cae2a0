//! Video of a moving camera (docs/method.md, section 16): state that follows surfaces, with given and estimated motion.

use planish::evaluate::flat_pixels;
use planish::internal::{RigidTransform, TemporalReference};
use planish::io::read_trajectory;
use planish::simulate::{DepthNoise, Event, Sequence, Truth};
use planish::source::{OwnedFrame, Source};
use planish::stream::{Stream, StreamOptions};
use planish::{
    Camera, CameraMotion, DepthFrame, Distortion, Error, OrganizedCloud, Outputs, SensorModel, SensorPose, Session,
    Settings, Smoothed, TemporalFilter, TemporalParams, Xyz,
};

const CAMERA: Camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);

/// A frame of a simulated video.
struct Seen {
    truth: Truth,
    frame: DepthFrame,
    pose: SensorPose,
}

fn video(event: Event, frames: u64) -> Vec<Seen> {
    video_of(CAMERA, event, frames)
}

fn video_of(camera: Camera, event: Event, frames: u64) -> Vec<Seen> {
    let mut sequence = Sequence::new(event, camera, DepthNoise::default(), 2);
    let seen = |number| {
        let seen = sequence.frame(number).unwrap();
        Seen { truth: seen.truth.clone(), frame: seen.frame.clone(), pose: seen.pose.sensor_pose().unwrap() }
    };
    (0..frames).map(seen).collect()
}

fn session(settings: &str) -> Session {
    let settings: Settings = format!("engine=cpu {settings}").parse().unwrap();
    let mut session = Session::new(settings).unwrap().with_kept_window(true);
    session.set_outputs(Outputs::DEPTH.with_depth(false).with_depth_m(true));
    session
}

/// Smooths a video with or without its poses, and returns the depth of each frame in metres.
fn smoothed_depth(video: &[Seen], settings: &str, uses_poses: bool) -> Vec<Vec<f32>> {
    let mut session = session(settings);
    let mut smoothed = Smoothed::default();
    let depth = |seen: &Seen| {
        if uses_poses {
            session.set_camera_pose(Some(seen.pose)).unwrap();
        }
        session.smooth(&seen.frame, &mut smoothed).unwrap();
        smoothed.depth_m.clone().unwrap()
    };
    video.iter().map(depth).collect()
}

/// Returns the RMS error on flat surfaces in metres, without the first 8 frames and without errors of 5 % or more.
fn rms_m(video: &[Seen], depths_m: &[Vec<f32>]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (seen, depth_m) in video.iter().zip(depths_m).skip(8) {
        let flat = flat_pixels(&seen.truth, 3);
        for (i, (&found, &expected)) in depth_m.iter().zip(seen.truth.points.z()).enumerate() {
            let off_m = f64::from(found - expected);
            if flat[i] && off_m.abs() < 0.05 * f64::from(expected) {
                sum += off_m * off_m;
                count += 1.0;
            }
        }
    }
    f64::sqrt(sum / count)
}

#[test]
fn moving_state_and_the_test_for_motion_equal_the_reference() {
    // The length of a row is not a multiple of a vector's length, and the lens has distortion.
    let odd = Camera::new((309, 230), [262.5; 2], [159.5, 119.5]);
    let distortion = Distortion::from_opencv(&[0.08, -0.05, 0.001, -0.002, 0.01]).unwrap();
    let cases = [
        (true, SensorModel::KINECT_V1, CAMERA),
        (true, SensorModel::AZURE_KINECT, odd),
        (true, SensorModel::KINECT_V1, odd.with_distortion(distortion)),
        (false, SensorModel::KINECT_V1, CAMERA),
    ];
    for (knows_motion, sensor, camera) in cases {
        let video = video_of(camera.with_distortion(Distortion::NONE), Event::MovingCamera, 12);
        let alone = smoothed_depth(&video, "", false);
        let mut fast = TemporalFilter::new(TemporalParams::STEADY, sensor).unwrap();
        let mut reference = TemporalReference::new(TemporalParams::STEADY, sensor);
        let (mut off, mut all, mut averaged) = (0, 0, 0);
        for (t, depth_m) in alone.iter().enumerate() {
            let mut found = depth_m.clone();
            let mut expected: Vec<f64> = depth_m.iter().map(|&z| f64::from(z)).collect();
            if knows_motion {
                let motion = CameraMotion::between(camera, &video[t.saturating_sub(1)].pose, &video[t].pose).unwrap();
                fast.smooth_moved(&motion, &mut found).unwrap();
                let previous_from_current = motion.previous_from_current.transform().unwrap();
                reference.smooth_moved(&camera, &previous_from_current, &mut expected);
            } else {
                fast.smooth(camera.width, camera.height, &mut found).unwrap();
                reference.smooth(camera.width, camera.height, &mut expected);
            }
            for (i, (&found, &expected)) in found.iter().zip(&expected).enumerate() {
                let same = found.is_nan() == expected.is_nan() && fast.is_carried(i) == reference.is_carried(i);
                let distance_m = if found.is_nan() { 0.0 } else { (f64::from(found) - expected).abs() };
                all += 1;
                off += usize::from(!same || distance_m > 2e-5);
                averaged += usize::from(fast.frames(i) > 4.0);
            }
        }
        // Different rounding puts single pixels on the other side of a threshold.
        assert!(off * 500 <= all, "{knows_motion} {sensor:?}: {off} of {all} differ");
        assert_eq!(averaged * 5 > all, knows_motion, "{knows_motion} {sensor:?}: {averaged} of {all} are means");
    }
}

#[test]
fn poses_and_tracking_halve_the_error_of_a_moving_camera_and_without_them_nothing_smears() {
    let video = video(Event::MovingCamera, 30);
    let alone = rms_m(&video, &smoothed_depth(&video, "", false));
    let steady = rms_m(&video, &smoothed_depth(&video, "temporal=steady", false));
    let with_poses = rms_m(&video, &smoothed_depth(&video, "temporal=steady", true));
    let tracked = rms_m(&video, &smoothed_depth(&video, "track=true", false));
    assert!(steady < 1.03 * alone, "{steady} {alone}");
    assert!(with_poses < 0.75 * alone, "{with_poses} {alone}");
    assert!(tracked < 1.05 * with_poses, "{tracked} {with_poses}");
}

#[test]
fn a_camera_at_rest_may_be_tracked() {
    let video = video(Event::Still, 30);
    let steady = smoothed_depth(&video, "temporal=steady", false);
    let tracked = smoothed_depth(&video, "track=true", false);
    assert!(rms_m(&video, &tracked) < 1.02 * rms_m(&video, &steady));
    let mut session = session("track=true");
    let mut smoothed = Smoothed::default();
    for seen in &video[..4] {
        session.smooth(&seen.frame, &mut smoothed).unwrap();
    }
    let [x, y, z] = session.camera_motion().unwrap().previous_from_current.position_m;
    assert!(x.hypot(y).hypot(z) < 0.001, "{x} {y} {z}");
}

#[test]
fn the_number_of_threads_changes_no_bit_of_a_tracked_video() {
    let video = video(Event::MovingCamera, 6);
    let one = smoothed_depth(&video, "track=true threads=1", false);
    let three = smoothed_depth(&video, "track=true threads=3", false);
    let bits = |frames: &[Vec<f32>]| frames.iter().flatten().map(|z| z.to_bits()).collect::<Vec<u32>>();
    assert_eq!(bits(&one), bits(&three));
}

#[test]
fn clouds_in_the_world_are_smoothed_by_their_own_poses() {
    let video = video(Event::MovingCamera, 12);
    let expected = smoothed_depth(&video, "temporal=steady", true);
    let mut session = session("temporal=steady");
    session.set_outputs(Outputs::POINTS);
    let mut smoothed = Smoothed::default();
    for seen in &video {
        let transform: RigidTransform = seen.pose.transform().unwrap();
        let in_world = |p: [f32; 3]| transform.to_cloud(p.map(f64::from).into()).as_vec3().to_array();
        let points: Xyz = seen.frame.deproject().unwrap().positions().iter().map(in_world).collect();
        let mut cloud = OrganizedCloud::from_positions(CAMERA.width, CAMERA.height, points).unwrap();
        cloud.points.pose = seen.pose;
        session.smooth(&cloud, &mut smoothed).unwrap();
    }
    let motion = session.camera_motion().unwrap();
    assert!((motion.camera.fx - 262.5).abs() < 0.05 && (motion.camera.cy - 119.5).abs() < 0.05, "{motion:?}");
    let transform = video[11].pose.transform().unwrap();
    let (mut off, mut all) = (0, 0);
    for (point, &expected_m) in smoothed.points.iter().zip(&expected[11]) {
        let found_m = transform.to_sensor(point.map(f64::from).into()).z as f32;
        all += usize::from(expected_m.is_finite());
        off += usize::from(expected_m.is_finite() && (found_m - expected_m).abs() > 2e-4);
    }
    assert!(all > 50_000 && off * 200 < all, "{off} of {all}");
}

#[test]
fn gaps_in_time_begin_a_new_video_but_slow_frames_and_equal_stamps_do_not() {
    let video = video(Event::Still, 1);
    let frames_after = |times_s: &[Option<f64>]| {
        let mut session = session("temporal=steady");
        let mut smoothed = Smoothed::default();
        for &time_s in times_s {
            session.set_frame_time(time_s);
            session.smooth(&video[0].frame, &mut smoothed).unwrap();
        }
        let filter = session.temporal_filter().unwrap();
        let frames = (0..320 * 240).map(|i| filter.frames(i)).fold(0.0, f32::max);
        (frames.round(), session.gaps_in_time())
    };
    assert_eq!(frames_after(&[Some(0.0), Some(0.033), Some(0.066), Some(0.1)]), (4.0, 0));
    assert_eq!(frames_after(&[Some(0.0), Some(0.033), Some(0.066), Some(1.2)]), (1.0, 1));
    assert_eq!(frames_after(&[Some(5.0), Some(5.033), Some(4.9), Some(4.933)]), (2.0, 1));
    // Frames two seconds apart, with and without a shorter first interval, and timestamps that are all 0 or missing.
    assert_eq!(frames_after(&[Some(0.0), Some(0.9), Some(2.9), Some(4.9)]), (4.0, 0));
    assert_eq!(frames_after(&[Some(0.0), Some(2.0), Some(4.0), Some(6.0)]), (3.0, 1));
    assert_eq!(frames_after(&[Some(0.0); 4]), (4.0, 0));
    let mut alone = session("temporal=off");
    [0.0, 5.0].into_iter().for_each(|time_s| alone.set_frame_time(Some(time_s)));
    assert_eq!(alone.gaps_in_time(), 0);
    assert_eq!(frames_after(&[None, Some(f64::NAN), None, Some(9.0)]), (4.0, 0));
}

#[test]
fn bad_poses_and_contradictions_are_refused() {
    let mut session = session("temporal=steady");
    let bad = SensorPose::from_viewpoint([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]);
    assert!(session.set_camera_pose(Some(bad)).unwrap_err().to_string().contains("length 1"));
    assert!(CameraMotion::between(CAMERA, &bad, &SensorPose::IDENTITY).is_err());
    let mut filter = TemporalFilter::new(TemporalParams::STEADY, SensorModel::KINECT_V1).unwrap();
    let still = CameraMotion::between(CAMERA, &SensorPose::IDENTITY, &SensorPose::IDENTITY).unwrap();
    assert!(filter.smooth_moved(&still, &mut [1.0; 5]).unwrap_err().to_string().contains("5"));
    let error = "track=true temporal=off".parse::<Settings>().unwrap_err().to_string();
    assert_eq!(error, "track = true is not allowed: only with temporal=steady");
    let error = "track=true".parse::<Settings>().unwrap().check_no_video().unwrap_err().to_string();
    assert!(error.starts_with("track = true is not allowed: only for consecutive frames of a camera"), "{error}");
}

#[test]
fn clouds_of_other_shapes_begin_again_and_a_blank_first_frame_hides_no_camera() {
    let cloud = |camera: Camera, depth_m: f32| {
        let raw = vec![(1000.0 * depth_m) as u16; camera.width * camera.height];
        let points = DepthFrame::new(camera, raw).unwrap().deproject().unwrap().positions().clone();
        OrganizedCloud::from_positions(camera.width, camera.height, points).unwrap()
    };
    let (mut session, mut smoothed) = (session("track=true"), Smoothed::default());
    session.set_outputs(Outputs::POINTS);
    let tall = Camera::new((240, 320), [262.5; 2], [119.5, 159.5]);
    let small = Camera::new((160, 120), [131.25; 2], [79.5, 59.5]);
    for camera in [CAMERA, small, tall, CAMERA] {
        session.smooth(&cloud(camera, 0.0), &mut smoothed).unwrap();
        assert!(session.camera_motion().is_none());
        for frame in 0..3 {
            session.smooth(&cloud(camera, 1.5 - 0.004 * frame as f32), &mut smoothed).unwrap();
        }
        let motion = session.camera_motion().unwrap();
        assert_eq!((motion.camera.width, motion.camera.height), (camera.width, camera.height));
        assert!((motion.previous_from_current.position_m[2] - 0.004).abs() < 5e-4, "{motion:?}");
        assert!(session.take_events().is_empty());
    }
    session.restart_video();
    assert!(session.camera_motion().is_none() && session.temporal_filter().is_none());
    // A grid of equal spacing in x and y does not match the pixels of any camera.
    let flat: Xyz = (0..160 * 120).map(|i| [0.01 * (i % 160) as f32, 0.01 * (i / 160) as f32, 1.5]).collect();
    let bent = flat.iter().map(|[x, y, z]| [x * x, y, z + 0.3 * x]).collect();
    let cloud = OrganizedCloud::from_positions(160, 120, bent).unwrap();
    for _ in 0..2 {
        session.smooth(&cloud, &mut smoothed).unwrap();
    }
    let events: Vec<String> = session.take_events().iter().map(ToString::to_string).collect();
    assert!(events.len() == 1 && events[0].contains("give the camera"), "{events:?}");
}

/// Frames with timestamps, in reverse order, and the source's `is_live`.
struct Stamped(Vec<DepthFrame>, bool);

impl Source for Stamped {
    fn next_frame(&mut self) -> Result<Option<OwnedFrame>, Error> {
        Ok(self.0.pop().map(OwnedFrame::Depth))
    }

    fn is_live(&self) -> bool {
        self.1
    }
}

#[test]
fn streams_take_poses_by_time_and_count_gaps_and_frames_without_a_pose() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("poses.txt");
    let line = |k: u32| format!("{} 0 0 {} 0 0 0 1\n", 0.1 * f64::from(k), 0.004 * f64::from(k));
    std::fs::write(&file, (0..20).map(line).collect::<String>()).unwrap();
    let run = |file: &std::path::Path, is_live: bool| {
        let frames = [0.0, 0.1, 0.2, 0.3, 5.0, 5.1]
            .map(|time_s| video(Event::Still, 1)[0].frame.clone().with_timestamp_s(time_s));
        let options = StreamOptions::from_settings("temporal=steady engine=cpu preset=light".parse().unwrap()).unwrap();
        let options = options.with_poses(Some(read_trajectory(file).unwrap()));
        Stream::new(Box::new(Stamped(frames.into_iter().rev().collect(), is_live)), options).run()
    };
    let statistics = run(&file, false).unwrap();
    assert_eq!((statistics.frames_out, statistics.gaps, statistics.without_pose), (6, 1, 2));
    std::fs::write(&file, "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    assert_eq!(run(&file, false).unwrap().without_pose, 5);
    assert!(run(&file, true).unwrap_err().to_string().contains("timestamps for a live source"));
}
