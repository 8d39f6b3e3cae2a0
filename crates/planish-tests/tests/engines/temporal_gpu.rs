//! Temporal smoothing on a GPU, which keeps the state of the video, equals that on the CPU. The tests run on lavapipe
//! or a real GPU.

use std::sync::Arc;

use planish::simulate::{DepthNoise, Event, Sequence};
use planish::{Camera, DepthFrame, Engine, OrganizedCloud, Outputs, SensorPose, Session, Settings, Smoothed, Status};
use planish_tests::bits::bits;
use planish_tests::data::skip;
use planish_tests::engines::{TestEngine, test_adapter};

/// Camera whose width and height are multiples neither of a tile's 16 pixels nor of the 4 pixels that share a word.
const CAMERA: Camera = Camera::new((309, 230), [262.5; 2], [159.5, 119.5]);
const EVERYTHING: Outputs = Outputs::ALL.with_depth(true).with_depth_m(true).with_frames(true);

/// Returns false without a GPU adapter, after printing SKIP.
fn has_adapter(test: &str) -> bool {
    if test_adapter().is_none() {
        skip(&format!("{test}: no GPU adapter"));
    }
    test_adapter().is_some()
}

/// Returns the frames of a simulated video, and the camera's pose for each frame.
fn video(event: Event, frames: u64) -> Vec<(Arc<DepthFrame>, SensorPose)> {
    let mut sequence = Sequence::new(event, CAMERA, DepthNoise::default(), 2);
    let seen = |number| {
        let seen = sequence.frame(number).unwrap();
        (Arc::new(seen.frame.clone()), seen.pose.sensor_pose().unwrap())
    };
    (0..frames).map(seen).collect()
}

fn session(engine: Engine, outputs: Outputs) -> Session {
    let settings: Settings = format!("temporal=steady engine={}", engine.name()).parse().unwrap();
    let options = match engine {
        Engine::Gpu => TestEngine::gpu(true).options(Outputs::POINTS),
        _ => TestEngine::REFERENCE.options(Outputs::POINTS),
    };
    let mut session = Session::new(settings).unwrap().with_kept_window(true).with_options(options);
    session.set_outputs(outputs);
    session
}

/// Counts the pixels that differ between two results by more than the tolerance between engines.
fn differing(found: &Smoothed, expected: &Smoothed) -> usize {
    let (found_frames, expected_frames) = (found.frames.as_ref().unwrap(), expected.frames.as_ref().unwrap());
    let (found_status, expected_status) = (found.status.as_ref().unwrap(), expected.status.as_ref().unwrap());
    let (found_m, expected_m) = (found.depth_m.as_ref().unwrap(), expected.depth_m.as_ref().unwrap());
    let (found_raw, expected_raw) = (found.depth.as_ref().unwrap(), expected.depth.as_ref().unwrap());
    let differs = |&i: &usize| {
        let [found_point, expected_point] = [&found.points, &expected.points].map(|points| points.get(i));
        let far = |a: f32, b: f32, most: f32| a.is_nan() != b.is_nan() || (a - b).abs() > most;
        found_point.iter().zip(expected_point).any(|(a, b)| far(*a, b, 6e-4))
            || far(found_m[i], expected_m[i], 6e-4)
            || found_raw[i].abs_diff(expected_raw[i]) > 1
            || found_status[i] != expected_status[i]
            || (found_frames[i] - expected_frames[i]).abs() > 0.2
    };
    (0..found.points.len()).filter(differs).count()
}

#[test]
fn a_video_on_a_gpu_equals_that_on_the_cpu() {
    if !has_adapter("a video on a GPU") {
        return;
    }
    let cases = [(Event::SlowObject, false), (Event::MovingCamera, false), (Event::MovingCamera, true)];
    for (event, knows_pose) in cases {
        let (mut on_cpu, mut on_gpu) = (session(Engine::Cpu, EVERYTHING), session(Engine::Gpu, EVERYTHING));
        let (mut expected, mut found) = (Smoothed::default(), Smoothed::default());
        let (mut off, mut all, mut averaged, mut carried) = (0, 0, 0, 0);
        for (frame, pose) in video(event, 16) {
            for (session, smoothed) in [(&mut on_cpu, &mut expected), (&mut on_gpu, &mut found)] {
                session.set_camera_pose(knows_pose.then_some(pose)).unwrap();
                session.smooth(&*frame, smoothed).unwrap();
            }
            off += differing(&found, &expected);
            all += found.points.len();
            averaged += found.frames.as_ref().unwrap().iter().filter(|&&frames| frames > 4.0).count();
            carried += found.status.as_ref().unwrap().iter().filter(|&&status| status == Status::Carried).count();
        }
        // The session filtered the CPU's frames, and the device filtered its own.
        assert!(on_cpu.temporal_filter().is_some() && on_gpu.temporal_filter().is_none());
        assert_eq!(on_gpu.camera_motion().is_some(), knows_pose);
        let averages = event != Event::MovingCamera || knows_pose;
        let is_used = carried > 0 && averaged > all / 3;
        assert!(is_used || !averages, "{event:?}: {carried} carried, {averaged} of {all} pixels average four frames");
        // Different rounding puts single pixels on the other side of a threshold.
        assert!(off * 10_000 < all, "{event:?}, pose known: {knows_pose}: {off} of {all} pixels differ");
    }
}

#[test]
fn frames_in_flight_of_a_video_on_a_gpu_equal_those_one_by_one() {
    if !has_adapter("frames in flight of a video") {
        return;
    }
    let frames = video(Event::SlowObject, 12);
    let mut alone = session(Engine::Gpu, EVERYTHING);
    let mut smoothed = Smoothed::default();
    let mut one_by_one = |frame: &DepthFrame| {
        alone.smooth(frame, &mut smoothed).unwrap();
        (bits(&smoothed), smoothed.frames.clone().unwrap())
    };
    let expected: Vec<_> = frames.iter().map(|(frame, _)| one_by_one(frame)).collect();
    for in_place in [false, true] {
        let mut in_flight = session(Engine::Gpu, EVERYTHING);
        let mut found = Vec::new();
        let mut keep = |session: &mut Session| {
            let received = session.receive().unwrap().map(planish::SmoothedView::into_smoothed);
            found.extend(received.map(|smoothed| (bits(&smoothed), smoothed.frames.unwrap())));
        };
        for (frame, _) in &frames {
            if in_flight.in_flight() > 0 && in_flight.in_flight() == in_flight.max_in_flight() {
                keep(&mut in_flight);
            }
            match in_place {
                true => in_flight.submit_in_place(&**frame).unwrap(),
                false => in_flight.submit(Arc::clone(frame), Smoothed::default()).unwrap(),
            }
        }
        while in_flight.in_flight() > 0 {
            keep(&mut in_flight);
        }
        assert!(found == expected, "in place: {in_place}");
    }
}

#[test]
fn a_video_on_a_gpu_starts_again_where_it_must() {
    if !has_adapter("a new video on a GPU") {
        return;
    }
    let frames = video(Event::SlowObject, 4);
    let mut session = session(Engine::Gpu, Outputs::DEPTH.with_frames(true));
    let mut smoothed = Smoothed::default();
    let mut most_frames = |session: &mut Session, frame: &DepthFrame| {
        session.smooth(frame, &mut smoothed).unwrap();
        // The result has only the requested outputs.
        assert!(smoothed.points.is_empty() && smoothed.status.is_none() && smoothed.depth.is_some());
        smoothed.frames.as_ref().unwrap().iter().fold(0.0f32, |most, &frames| most.max(frames))
    };
    let [first, second, third, fourth] = [0, 1, 2, 3].map(|i| &*frames[i].0);
    assert_eq!(most_frames(&mut session, first), 1.0);
    assert!(most_frames(&mut session, second) > 1.5);
    session.restart_video();
    assert_eq!(most_frames(&mut session, third), 1.0);
    assert!(most_frames(&mut session, fourth) > 1.5);
    // The video restarts after a gap in time, with the first known pose, with other settings, and with a closed
    // engine.
    session.set_frame_time(Some(0.0));
    assert!(most_frames(&mut session, first) > 1.5);
    session.set_frame_time(Some(60.0));
    assert_eq!(most_frames(&mut session, second), 1.0);
    session.set_camera_pose(Some(frames[0].1)).unwrap();
    assert_eq!(most_frames(&mut session, third), 1.0);
    assert!(most_frames(&mut session, fourth) > 1.5);
    session.set_settings("temporal=steady engine=gpu preset=light".parse().unwrap()).unwrap();
    assert_eq!(most_frames(&mut session, first), 1.0);
    session.close();
    assert_eq!(most_frames(&mut session, second), 1.0);
}

#[test]
fn what_the_shaders_do_not_know_is_filtered_by_the_session() {
    if !has_adapter("videos that a GPU does not filter") {
        return;
    }
    let frames = video(Event::SlowObject, 3);
    // The session filters points with a stated viewpoint, and frames of a camera whose motion is estimated.
    let mut turned: OrganizedCloud = frames[0].0.deproject().unwrap();
    turned.points.pose = SensorPose::from_viewpoint([0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
    let mut smoothed = Smoothed::default();
    let mut of_points = session(Engine::Gpu, Outputs::ALL.with_frames(true));
    let mut tracked = session(Engine::Gpu, Outputs::ALL.with_frames(true));
    tracked.set_settings("temporal=steady track=true engine=gpu".parse().unwrap()).unwrap();
    for _ in 0..2 {
        of_points.smooth(&turned, &mut smoothed).unwrap();
        tracked.smooth(&*frames[0].0, &mut smoothed).unwrap();
    }
    let most = |smoothed: &Smoothed| smoothed.frames.as_ref().unwrap().iter().fold(0.0f32, |most, &n| most.max(n));
    assert_eq!(most(&smoothed), 2.0);
    assert!(of_points.temporal_filter().is_some() && tracked.temporal_filter().is_some());
}

#[test]
fn clouds_on_the_grid_that_they_lost_are_no_video_on_a_gpu_either() {
    if !has_adapter("clouds that lost their grid") {
        return;
    }
    let mut of_video = session(Engine::Gpu, Outputs::ALL);
    let (mut first, mut second) = (Smoothed::default(), Smoothed::default());
    let cloud = |number: usize| {
        let frame = &video(Event::Still, 2)[number].0;
        let mut points = frame.deproject().unwrap().points;
        let valid: Vec<usize> = (0..points.len()).filter(|&i| points.positions.is_finite(i)).collect();
        points = points.select(&valid);
        points
    };
    let clouds = [cloud(0), cloud(1)];
    of_video.smooth(&clouds[0], &mut first).unwrap();
    of_video.smooth(&clouds[1], &mut second).unwrap();
    let mut alone = session(Engine::Gpu, Outputs::ALL);
    alone.set_settings("engine=gpu".parse().unwrap()).unwrap();
    let mut expected = Smoothed::default();
    alone.smooth(&clouds[1], &mut expected).unwrap();
    assert!(bits(&second) == bits(&expected));
}

#[test]
fn frames_in_flight_of_a_video_before_a_gap_keep_their_counts() {
    if !has_adapter("a gap with frames in flight") {
        return;
    }
    let frames = video(Event::SlowObject, 3);
    for settings in ["temporal=steady engine=gpu", "track=true engine=gpu"] {
        let mut session = session(Engine::Gpu, Outputs::POINTS.with_frames(true));
        session.set_settings(settings.parse().unwrap()).unwrap();
        session.set_outputs(Outputs::POINTS.with_frames(true));
        for (frame, _) in &frames[..2] {
            session.submit(Arc::clone(frame), Smoothed::default()).unwrap();
        }
        session.restart_video();
        session.submit(Arc::clone(&frames[2].0), Smoothed::default()).unwrap();
        let mut most = Vec::new();
        while let Some(view) = session.receive().unwrap() {
            most.push(view.frames().unwrap().iter().fold(0.0f32, |most, &frames| most.max(frames)));
        }
        assert_eq!(most, [1.0, 2.0, 1.0], "{settings}");
    }
}
