//! The temporal filter (docs/method.md, section 16): equal to its reference, honest about values that it carries
//! over, and without trails.

use std::sync::Arc;

use planish::internal::{TemporalReference, Threads};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    Camera, DepthFrame, Engine, FrameParams, OrganizedCloud, Outputs, PointsView, SensorModel, SensorPose, Session,
    Settings, Smoothed, Smoother, TemporalFilter, TemporalParams, Xyz,
};
use planish_tests::scenes::small_camera;

pub const WIDTH: usize = 160;
pub const HEIGHT: usize = 120;

/// A generator of random numbers that are the same in every run.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as f64 + 0.5) / f64::from(1u32 << 31)
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

fn filter(params: TemporalParams) -> TemporalFilter {
    TemporalFilter::new(params, SensorModel::KINECT_V1).unwrap()
}

/// Returns a wall at 2 m with the noise that remains after smoothing a Kinect's frames.
fn noisy_wall(random: &mut Random) -> Vec<f32> {
    (0..WIDTH * HEIGHT).map(|_| (2.0 + 0.35 * 1.8e-3 * 4.0 * random.normal()) as f32).collect()
}

/// Returns smoothed frames of a camera at rest: a room, a bar that moves across it, and holes that come and go.
fn sequence(frames: u64) -> Vec<Vec<f32>> {
    let camera = small_camera();
    let (scene, pose) = Scene::room(5);
    let truth = scene.render(&camera, &pose);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera, 5);
    let outputs = Outputs::DEPTH.with_depth(false).with_depth_m(true);
    let mut smoother = Smoother::open_with(
        FrameParams::default(),
        &planish::SmootherOptions::new(Engine::Cpu, outputs),
        (WIDTH, HEIGHT),
    )
    .unwrap();
    let mut random = Random(9);
    let mut smoothed = Smoothed::default();
    (0..frames)
        .map(|t| {
            smoother.smooth(&simulator.frame(&truth, t).unwrap(), &mut smoothed).unwrap();
            let mut depth_m = smoothed.depth_m.clone().unwrap();
            for (i, z) in depth_m.iter_mut().enumerate() {
                let (u, v) = (i % WIDTH, i / WIDTH);
                if (5 * t as usize..5 * t as usize + 12).contains(&u) && v > 30 {
                    *z = (0.9 + 0.001 * random.normal()) as f32;
                } else if random.uniform() < 0.02 {
                    *z = f32::NAN;
                }
            }
            depth_m
        })
        .collect()
}

#[test]
fn the_filter_equals_its_reference_over_a_sequence() {
    let sensors = [("kinect1", SensorModel::KINECT_V1), ("azure-kinect", SensorModel::AZURE_KINECT)];
    for (name, sensor) in sensors {
        let params = TemporalParams::STEADY.with_hold_frames(2);
        let mut fast = TemporalFilter::new(params, sensor).unwrap();
        let mut reference = TemporalReference::new(params, sensor);
        let (mut pixels, mut off, mut far_off, mut carried) = (0, 0, 0, 0);
        for (t, frame) in sequence(30).into_iter().enumerate() {
            let mut found = frame.clone();
            fast.smooth(WIDTH, HEIGHT, &mut found).unwrap();
            let mut expected: Vec<f64> = frame.iter().map(|&z| f64::from(z)).collect();
            reference.smooth(WIDTH, HEIGHT, &mut expected);
            for (i, (&found, &expected)) in found.iter().zip(&expected).enumerate() {
                let same_flags = found.is_nan() == expected.is_nan() && fast.is_carried(i) == reference.is_carried(i);
                let distance =
                    if found.is_nan() || expected.is_nan() { 0.0 } else { (f64::from(found) - expected).abs() };
                let frames = f64::from(fast.frames(i)) - reference.frames(i);
                pixels += 1;
                off += usize::from(!same_flags || distance > 1e-5 || frames.abs() > 0.02);
                far_off += usize::from(!same_flags || distance > 6e-4);
                carried += usize::from(fast.is_carried(i));
                assert!(distance < 0.05, "{name}, frame {t}, pixel {i}: {found} {expected}");
            }
        }
        assert!(carried > 1000, "{name}: the sequence must have carried values, not {carried}");
        assert!(off * 1000 <= pixels && far_off * 10_000 <= pixels, "{name}: {off} and {far_off} of {pixels} differ");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let frames = sequence(8);
    let run = |threads| {
        let pool = Threads::open(Some(threads)).unwrap();
        let mut filter = filter(TemporalParams::STEADY.with_hold_frames(1));
        let mut last = Vec::new();
        for frame in &frames {
            last.clone_from(frame);
            pool.install(|| filter.smooth(WIDTH, HEIGHT, &mut last)).unwrap();
        }
        let bits: Vec<u32> = last.iter().map(|z| z.to_bits()).collect();
        let known: Vec<(u32, bool)> =
            (0..WIDTH * HEIGHT).map(|i| (filter.frames(i).to_bits(), filter.is_carried(i))).collect();
        (bits, known)
    };
    let one = run(1);
    for threads in [2, 3, 7] {
        assert!(run(threads) == one, "{threads} threads");
    }
}

#[test]
fn noise_of_a_scene_at_rest_falls_to_what_sixteen_frames_leave() {
    let mut random = Random(1);
    let mut filter = filter(TemporalParams::STEADY);
    let (mut before, mut after, mut bias) = (0.0, 0.0, 0.0);
    for t in 0..60 {
        let raw = noisy_wall(&mut random);
        let mut smoothed = raw.clone();
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        if t >= 30 {
            let squares = |values: &[f32]| values.iter().map(|&z| (f64::from(z) - 2.0).powi(2)).sum::<f64>();
            (before, after) = (before + squares(&raw), after + squares(&smoothed));
            bias += smoothed.iter().map(|&z| f64::from(z) - 2.0).sum::<f64>();
        }
    }
    // A recursive mean with weight 1/16 leaves 1/sqrt(31) of white noise.
    let left = (after / before).sqrt();
    assert!((0.17..0.24).contains(&left), "{left}");
    assert!(bias.abs() / (30.0 * (WIDTH * HEIGHT) as f64) < 2e-5, "{bias}");
}

#[test]
fn a_still_frame_does_not_drift() {
    let first = sequence(1).remove(0);
    let mut filter = filter(TemporalParams::STEADY);
    let mut last = Vec::new();
    for _ in 0..10_000 {
        last.clone_from(&first);
        filter.smooth(WIDTH, HEIGHT, &mut last).unwrap();
    }
    for (i, (&was, &is)) in first.iter().zip(&last).enumerate() {
        assert!(was.is_nan() && is.is_nan() || (was - is).abs() <= 3e-7 * was, "pixel {i}: {was} became {is}");
        assert!(was.is_nan() || (filter.frames(i) - 16.0).abs() < 0.01, "{}", filter.frames(i));
    }
}

#[test]
fn scenes_that_alternate_leave_no_trace_of_each_other() {
    let mut random = Random(3);
    let mut filter = filter(TemporalParams::STEADY);
    for t in 0..20 {
        let offset_m = if t % 2 == 0 { 0.0 } else { 0.5 };
        let raw: Vec<f32> = noisy_wall(&mut random).into_iter().map(|z| z + offset_m).collect();
        let mut smoothed = raw.clone();
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        assert_eq!(raw, smoothed, "frame {t}");
    }
}

#[test]
fn a_moving_edge_leaves_no_trail() {
    let mut random = Random(4);
    let mut filter = filter(TemporalParams::STEADY);
    for t in 0..30 {
        let edge = 10 + 4 * t;
        let mut smoothed = noisy_wall(&mut random);
        (0..smoothed.len()).filter(|i| (edge..edge + 30).contains(&(i % WIDTH))).for_each(|i| smoothed[i] -= 0.7);
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        for (i, &z) in smoothed.iter().enumerate() {
            let truth = if (edge..edge + 30).contains(&(i % WIDTH)) { 1.3 } else { 2.0 };
            assert!((z - truth).abs() < 0.02, "frame {t}, pixel {i}: {z} for {truth}");
        }
    }
}

#[test]
fn a_slow_surface_is_followed() {
    let mut random = Random(6);
    let mut filter = filter(TemporalParams::STEADY);
    // The surface moves by a third of sigma per frame, which no single frame shows.
    let step_m = 0.0024;
    let mut lags = Vec::new();
    for t in 0..60 {
        let mut smoothed: Vec<f32> = noisy_wall(&mut random).into_iter().map(|z| z - step_m * t as f32).collect();
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        let mean = smoothed.iter().map(|&z| f64::from(z)).sum::<f64>() / smoothed.len() as f64;
        lags.push(mean - (2.0 - f64::from(step_m) * f64::from(t)));
    }
    let lag = lags[30..].iter().sum::<f64>() / 30.0;
    // A mean of 16 frames would lag by 15 steps.
    assert!(lag < 1.5 * f64::from(step_m), "{lag}");
}

#[test]
fn holes_stay_holes_unless_they_are_to_be_held_and_then_they_are_flagged() {
    let mut random = Random(7);
    for hold_frames in [0, 2] {
        let mut filter = filter(TemporalParams::STEADY.with_hold_frames(hold_frames));
        let hole = 60 * WIDTH + 80;
        for t in 0..40 {
            let mut smoothed = noisy_wall(&mut random);
            // The pixel is seen for 20 frames, is a hole for four, and is then seen again.
            let is_hole = (20..24).contains(&t);
            if is_hole {
                smoothed[hole] = 0.0;
            }
            filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
            let is_held = is_hole && t < 20 + hold_frames;
            assert_eq!(smoothed[hole].is_nan(), is_hole && !is_held, "frame {t}");
            assert_eq!(filter.is_carried(hole), is_held, "frame {t}");
            assert_eq!(filter.frames(hole) > 0.0, !is_hole || is_held, "frame {t}");
            assert!(!is_held || (smoothed[hole] - 2.0).abs() < 0.005);
        }
    }
}

#[test]
fn a_covered_camera_is_forgotten_and_starts_again() {
    let mut random = Random(8);
    let mut filter = filter(TemporalParams::STEADY);
    for t in 0..60 {
        let is_covered = (20..40).contains(&t);
        let raw: Vec<f32> = if is_covered { vec![f32::NAN; WIDTH * HEIGHT] } else { noisy_wall(&mut random) };
        let mut smoothed = raw.clone();
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        let unchanged = raw.iter().zip(&smoothed).all(|(a, b)| a.to_bits() == b.to_bits());
        assert_eq!(unchanged, is_covered || t == 0 || t == 40, "frame {t}");
        assert!(!is_covered || (0..raw.len()).all(|i| filter.frames(i) == 0.0 && !filter.is_carried(i)));
    }
}

#[test]
fn exact_depth_and_coarse_steps_are_handled() {
    // Without noise every change is real.
    let mut exact = TemporalFilter::new(TemporalParams::STEADY, SensorModel::EXACT).unwrap();
    for t in 0..10 {
        let raw: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| 1.0 + 0.001 * (i % 7) as f32 + 0.01 * t as f32).collect();
        let mut smoothed = raw.clone();
        exact.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        assert_eq!(raw, smoothed, "frame {t}");
    }
    // Depth has steps of 1 mm, far below the noise of the model. The learnt noise must not collapse, or a step would
    // count as a new surface.
    let mut random = Random(2);
    let mut filter = filter(TemporalParams::STEADY);
    for t in 0..200 {
        let mut smoothed: Vec<f32> =
            (0..WIDTH * HEIGHT).map(|_| if random.uniform() < 0.3 { 1.001 } else { 1.0 }).collect();
        filter.smooth(WIDTH, HEIGHT, &mut smoothed).unwrap();
        let frames: f32 = (0..smoothed.len()).map(|i| filter.frames(i)).sum::<f32>() / smoothed.len() as f32;
        assert!(t < 50 || frames > 14.0, "frame {t}: {frames}");
    }
}

#[test]
fn bad_parameters_and_shapes_are_refused_and_any_shape_works() {
    let refused = |params: TemporalParams| TemporalFilter::new(params, SensorModel::KINECT_V1).unwrap_err().to_string();
    assert!(refused(TemporalParams::STEADY.with_frames(f32::NAN)).contains("temporal.frames"));
    assert!(refused(TemporalParams::STEADY.with_frames(17.0)).contains("1 to 16"));
    assert!(refused(TemporalParams::STEADY.with_hold_frames(9)).contains("0 to 8"));
    let error = filter(TemporalParams::STEADY).smooth(3, 2, &mut [1.0; 5]).unwrap_err();
    assert_eq!(error.to_string(), "the depth has 5 values; expected 6");
    let mut filter = filter(TemporalParams::STEADY.with_hold_frames(8));
    for (width, height) in [(1, 1), (1, 37), (41, 1), (15, 17), (16, 16), (33, 2), (0, 0), (0, 4)] {
        for _ in 0..3 {
            let mut depth_m = vec![1.5; width * height];
            filter.smooth(width, height, &mut depth_m).unwrap();
            assert!(depth_m.iter().all(|z| (z - 1.5).abs() < 1e-6), "{width} x {height}");
        }
    }
    // A change of shape restarts the filter, and so does a reset.
    let mut depth_m = vec![1.5; 12];
    filter.smooth(4, 3, &mut depth_m).unwrap();
    filter.smooth(4, 3, &mut depth_m).unwrap();
    assert_eq!(filter.frames(11), 2.0);
    filter.reset();
    filter.smooth(4, 3, &mut depth_m).unwrap();
    assert_eq!(filter.frames(11), 1.0);
}

/// Returns frames of a resting camera in front of a wall at 2 m. A box of 30x30 pixels appears at 1.4 m in the last
/// frame.
pub fn video(frames: usize) -> Vec<Arc<DepthFrame>> {
    let mut random = Random(12);
    let camera = small_camera();
    (0..frames)
        .map(|t| {
            let raw = (0..WIDTH * HEIGHT).map(|i| {
                let is_box = t + 1 == frames && (40..70).contains(&(i % WIDTH)) && (40..70).contains(&(i / WIDTH));
                let z = if is_box { 1.4 } else { 2.0 };
                (1000.0 * (z + 1.8e-3 * z * z * random.normal())).round() as u16
            });
            Arc::new(DepthFrame::new(camera, raw.collect()).unwrap())
        })
        .collect()
}

pub fn steady(engine: &str) -> Settings {
    format!("temporal=steady engine={engine}").parse().unwrap()
}

/// Returns the standard deviation and the mean of depth in the right half of a frame.
fn spread_of(depth_m: &[f32]) -> (f64, f64) {
    let middle = (20..100).flat_map(|v| (80..150).map(move |u| v * WIDTH + u));
    let values: Vec<f64> = middle.map(|i| f64::from(depth_m[i])).filter(|z| z.is_finite()).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    ((values.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt(), mean)
}

#[test]
fn a_session_smooths_a_video_over_time_and_all_outputs_agree() {
    let frames = video(20);
    let outputs = Outputs::ALL.with_depth(true).with_depth_m(true);
    for engine in ["cpu", "reference"] {
        let mut session = Session::new(steady(engine)).unwrap();
        session.set_outputs(outputs.with_frames(true));
        let mut single = Session::new(format!("engine={engine}").parse().unwrap()).unwrap();
        single.set_outputs(outputs);
        let (mut smoothed, mut alone) = (Smoothed::default(), Smoothed::default());
        for frame in &frames[..19] {
            session.smooth(&**frame, &mut smoothed).unwrap();
            single.smooth(&**frame, &mut alone).unwrap();
        }
        let (over_time, mean) = spread_of(smoothed.depth_m.as_ref().unwrap());
        let (frames_of, status) = (smoothed.frames.as_ref().unwrap(), smoothed.status.as_ref().unwrap());
        let filter = session.temporal_filter().unwrap();
        let averaged = |i: usize| if status[i].has_point() { filter.frames(i).max(1.0) } else { 0.0 };
        assert!((0..WIDTH * HEIGHT).all(|i| frames_of[i] == averaged(i)));
        assert!(frames_of.iter().filter(|&&frames| frames > 10.0).count() > WIDTH * HEIGHT / 2);
        let (in_space, _) = spread_of(alone.depth_m.as_ref().unwrap());
        assert!(over_time < 0.4 * in_space, "{engine}: {over_time} of {in_space}");
        assert!((mean - 2.0).abs() < 3e-4, "{engine}: {mean}");
        assert_eq!((&smoothed.normals, &smoothed.neighbours), (&alone.normals, &alone.neighbours));
        let camera = small_camera();
        let (depth_m, raw) = (smoothed.depth_m.as_ref().unwrap(), smoothed.depth.as_ref().unwrap());
        for i in 0..WIDTH * HEIGHT {
            let [x, _, z] = smoothed.points.get(i);
            assert!(z.is_nan() == depth_m[i].is_nan() && (z.is_nan() || (z - depth_m[i]).abs() < 1e-6), "pixel {i}");
            assert_eq!(raw[i], camera.raw_depth(depth_m[i]), "pixel {i}");
            let ray = (((i % WIDTH) as f64 - 79.5) / 131.25) as f32;
            assert!(z.is_nan() || (x - ray * z).abs() < 2e-6, "pixel {i}: {x} is not on its ray at {z}");
        }
        // A new object is visible at once, without a trace of the wall.
        session.smooth(&*frames[19], &mut smoothed).unwrap();
        let depth_m = smoothed.depth_m.as_ref().unwrap();
        assert!((44..66).all(|v| (44..66).all(|u| (depth_m[v * WIDTH + u] - 1.4).abs() < 0.02)), "{engine}");
        assert!(session.temporal_filter().unwrap().frames(20 * WIDTH + 100) > 8.0);
        session.restart_video();
        session.smooth(&*frames[0], &mut smoothed).unwrap();
        assert_eq!(session.temporal_filter().unwrap().frames(20 * WIDTH + 100), 1.0);
    }
}

#[test]
fn frames_in_flight_and_frames_one_by_one_give_the_same_video() {
    let frames = video(12);
    let outputs = Outputs::DEPTH.with_status(true);
    let mut session = Session::new(steady("cpu")).unwrap();
    session.set_outputs(outputs);
    let mut in_flight = Session::new(steady("cpu")).unwrap();
    in_flight.set_outputs(outputs);
    let mut smoothed = Smoothed::default();
    for frame in &frames {
        session.smooth(&**frame, &mut smoothed).unwrap();
        in_flight.submit(Arc::clone(frame), Smoothed::default()).unwrap();
        let received = in_flight.receive().unwrap().unwrap().into_smoothed();
        // The result has only the requested outputs, although the filter needs more.
        assert!(received.points.is_empty() && received.depth_m.is_none());
        assert_eq!(received, smoothed);
    }
}

#[test]
fn a_single_pixel_that_changes_is_carried_over_for_one_frame_and_says_so() {
    let at = 60 * WIDTH + 110;
    let mut filter = filter(TemporalParams::STEADY);
    let mut random = Random(3);
    for t in 0..10 {
        let mut depth_m = noisy_wall(&mut random);
        if t >= 8 {
            depth_m[at] = 1.5;
        }
        filter.smooth(WIDTH, HEIGHT, &mut depth_m).unwrap();
        assert_eq!(filter.is_carried(at), t == 8, "frame {t}");
        assert!((depth_m[at] - if t == 9 { 1.5 } else { 2.0 }).abs() < 0.01, "frame {t}: {}", depth_m[at]);
    }
}

#[test]
fn a_cloud_with_a_pose_moves_along_its_rays() {
    let mut random = Random(5);
    let pose = SensorPose::from_viewpoint([1.0, -2.0, 0.5, 0.8, 0.6, 0.0, 0.0]);
    let transform = pose.transform().unwrap();
    let mut session = Session::new(steady("cpu")).unwrap();
    session.set_outputs(Outputs::POINTS.with_status(true));
    let (mut smoothed, mut first) = (Smoothed::default(), None);
    for _ in 0..16 {
        let points: Xyz = (0..WIDTH * HEIGHT)
            .map(|i| {
                let z = 2.0 + 1.8e-3 * 4.0 * random.normal();
                let [x, y] = [(i % WIDTH) as f64 - 79.5, (i / WIDTH) as f64 - 59.5].map(|u| u / 131.25 * z);
                transform.to_cloud([x, y, z].into()).as_vec3().to_array()
            })
            .collect();
        let mut cloud = OrganizedCloud::from_positions(WIDTH, HEIGHT, points).unwrap();
        cloud.points.pose = pose;
        session.smooth(&cloud, &mut smoothed).unwrap();
        first.get_or_insert_with(|| smoothed.clone());
    }
    let seen = |smoothed: &Smoothed| -> Vec<[f64; 3]> {
        let points = smoothed.points.iter();
        points.map(|p| transform.to_sensor(p.map(f64::from).into()).to_array()).collect()
    };
    let depths = |points: &[[f64; 3]]| points.iter().map(|p| p[2] as f32).collect::<Vec<f32>>();
    let (first, last) = (seen(&first.unwrap()), seen(&smoothed));
    assert!(spread_of(&depths(&last)).0 < 0.45 * spread_of(&depths(&first)).0);
    for (i, [x, y, z]) in last.into_iter().enumerate().filter(|(_, p)| p[2].is_finite()) {
        let [u, v] = [x / z * 131.25 + 79.5, y / z * 131.25 + 59.5];
        assert!((u - (i % WIDTH) as f64).abs() < 1e-3 && (v - (i / WIDTH) as f64).abs() < 1e-3, "{i}: {u} {v}");
    }
}

#[test]
fn a_video_keeps_its_sensor_and_starts_again_with_another_camera_or_after_a_gap() {
    let frames = video(9);
    let mut smoothed = Smoothed::default();
    // The sensor estimated from the first frame is used for all other frames.
    let mut session = Session::new("temporal=steady engine=cpu sensor=auto".parse().unwrap()).unwrap();
    for frame in &frames[..6] {
        session.smooth(&**frame, &mut smoothed).unwrap();
    }
    let at = 20 * WIDTH + 100;
    assert!(session.temporal_filter().unwrap().frames(at) > 5.0);

    let mut session = Session::new(steady("cpu")).unwrap();
    session.smooth(&*frames[0], &mut smoothed).unwrap();
    session.smooth(&*frames[1], &mut smoothed).unwrap();
    let other = DepthFrame::new(Camera::new((WIDTH, HEIGHT), [140.0; 2], [79.5, 59.5]), frames[2].raw.clone()).unwrap();
    session.smooth(&other, &mut smoothed).unwrap();
    assert_eq!(session.temporal_filter().unwrap().frames(at), 1.0);

    // A frame submitted before a gap belongs to the video before it.
    session.submit(Arc::clone(&frames[3]), Smoothed::default()).unwrap();
    session.restart_video();
    session.receive().unwrap().unwrap();
    session.smooth(&*frames[4], &mut smoothed).unwrap();
    assert_eq!(session.temporal_filter().unwrap().frames(at), 1.0);
}

#[test]
fn rigs_and_unorganized_clouds_are_not_videos() {
    let error = steady("cpu").check_no_video().unwrap_err().to_string();
    assert!(error.starts_with("temporal = steady is not allowed: only for consecutive frames of a camera"), "{error}");
    assert_eq!(steady("cpu").unused_by_clouds(), ["temporal"]);
    assert!("temporal=often".parse::<Settings>().unwrap_err().to_string().contains("off or steady"));
    let mut session = Session::new(steady("cpu")).unwrap();
    let mut random = Random(5);
    let points: Vec<[f32; 3]> =
        (0..2000).map(|_| [random.uniform() as f32, random.uniform() as f32, 0.01 * random.normal() as f32]).collect();
    let mut smoothed = Smoothed::default();
    session.smooth(PointsView::from_rows(&points).unwrap(), &mut smoothed).unwrap();
    assert!(session.temporal_filter().is_none());
}
