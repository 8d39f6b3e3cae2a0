//! Filled holes: they continue the surface around them, are flagged, and never cross a step.

use std::sync::Arc;

use planish::evaluate::{FillEvaluation, cut_holes};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{
    Camera, DepthFrame, DepthView, IntoFrame, OrganizedCloud, Origin, Outputs, PointsView, SensorPose, Session,
    SessionEvent, Settings, Smoothed, SmoothedMut, Status, Xyz,
};
use planish_tests::data::skip;
use planish_tests::engines::test_adapter;

const WIDTH: usize = 160;
const HEIGHT: usize = 120;

fn camera() -> Camera {
    Camera::new((WIDTH, HEIGHT), [131.25; 2], [79.5, 59.5])
}

/// Returns a frame with the given depths in millimetres by column and row; 0 is a hole.
fn frame(depth_mm: impl Fn(usize, usize) -> u16) -> DepthFrame {
    DepthFrame::new(camera(), (0..WIDTH * HEIGHT).map(|i| depth_mm(i % WIDTH, i / WIDTH)).collect()).unwrap()
}

fn smoothed_by(settings: &str, outputs: Outputs, frame: &DepthFrame) -> Smoothed {
    let mut session = Session::new(settings.parse::<Settings>().unwrap()).unwrap();
    session.set_outputs(outputs);
    let mut smoothed = Smoothed::default();
    session.smooth(frame, &mut smoothed).unwrap();
    smoothed
}

fn smoothed(settings: &str, frame: &DepthFrame) -> Smoothed {
    smoothed_by(settings, Outputs::POINTS, frame)
}

/// Returns true if the points, standard errors and status of all results are equal bit for bit.
fn are_same(found: &[Smoothed], expected: &[Smoothed]) -> bool {
    let bits = |smoothed: &Smoothed| -> Vec<u32> {
        let values = smoothed.points.as_slices().into_iter().chain(smoothed.sigma.as_deref());
        values.flatten().map(|value| value.to_bits()).collect()
    };
    let is_same = |(a, b): (&Smoothed, &Smoothed)| a.status == b.status && bits(a) == bits(b);
    found.len() == expected.len() && found.iter().zip(expected).all(is_same)
}

/// Returns true if every pixel of a block is filled, and false if no pixel is; panics if only some are.
fn is_filled(smoothed: &Smoothed, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>) -> bool {
    let status = smoothed.status.as_ref().unwrap();
    let pixels = rows.clone().flat_map(|v| columns.clone().map(move |u| v * WIDTH + u));
    let filled = pixels.filter(|&i| status[i] == Status::Filled).count();
    assert!(filled == 0 || filled == columns.len() * rows.len(), "{filled} pixels of {columns:?} {rows:?}");
    filled > 0
}

/// Returns the depth of a sloping wall at a pixel, in millimetres.
fn wall_mm(u: usize, v: usize) -> f64 {
    let slope = 0.3 * (u as f64 - 79.5) / 131.25 + 0.1 * (v as f64 - 59.5) / 131.25;
    1500.0 / (1.0 - slope)
}

#[test]
fn a_hole_in_a_wall_becomes_the_wall_in_every_output() {
    let in_hole = |u: usize, v: usize| (70..78).contains(&u) && (40..52).contains(&v);
    let frame = frame(|u, v| if in_hole(u, v) { 0 } else { wall_mm(u, v).round() as u16 });
    let outputs = Outputs::ALL.with_depth(true).with_depth_m(true).with_sigma(true);
    for engine in ["cpu", "reference"] {
        let result = smoothed_by(&format!("engine={engine} fill=8"), outputs, &frame);
        assert!(is_filled(&result, 70..78, 40..52));
        let status = result.status.as_ref().unwrap();
        assert_eq!(status.iter().filter(|status| **status == Status::Filled).count(), 96);
        let (depth, depth_m) = (result.depth.as_ref().unwrap(), result.depth_m.as_ref().unwrap());
        let (sigma, normals) = (result.sigma.as_ref().unwrap(), result.normals.as_ref().unwrap());
        let expected = [0.3, 0.1, -1.0].map(|axis: f32| axis / 1.1f32.sqrt());
        let dot = |a: [f32; 3], b: [f32; 3]| (0..3).map(|axis| a[axis] * b[axis]).sum::<f32>();
        for i in (0..WIDTH * HEIGHT).filter(|&i| status[i] == Status::Filled) {
            let (u, v) = (i % WIDTH, i / WIDTH);
            let point = result.points.get(i);
            assert!((f64::from(point[2]) - 1e-3 * wall_mm(u, v)).abs() < 5e-4, "{engine} ({u}, {v}): {point:?}");
            assert!((point[0] / point[2] - (u as f32 - 79.5) / 131.25).abs() < 1e-6);
            assert_eq!((depth_m[i], depth[i]), (point[2], frame.camera.raw_depth(point[2])));
            let normal = normals.get(i);
            assert!(dot(normal, expected).abs() > 0.999, "{normal:?} {expected:?}");
            assert!(dot(normal, point) < 0.0, "towards the sensor");
            assert!(sigma[i] > 0.0 && result.curvature.as_ref().unwrap()[i].is_finite());
            assert!(result.neighbours.as_ref().unwrap()[i] > 8);
        }
        // Sigma is larger in the middle of the hole than at its rim.
        assert!(sigma[46 * WIDTH + 74] > sigma[46 * WIDTH + 70]);
        let mask = result.origin_mask().unwrap();
        assert_eq!([mask[46 * WIDTH + 74], mask[0]], [Origin::Filled, Origin::Measured].map(Origin::mask_value));
    }
    assert!(!is_filled(&smoothed_by("fill=7", outputs, &frame), 70..78, 40..52), "too wide");
    let unfilled = smoothed_by("engine=cpu", outputs, &frame);
    assert!(!unfilled.has_filled());
}

#[test]
fn steps_gaps_between_objects_and_borders_stay_open() {
    // The left half is near, and the hole lies across the step.
    let across = frame(|u, v| match (u, v) {
        (75..83, 50..58) => 0,
        (..79, _) => 1000,
        _ => 2000,
    });
    let settings = "engine=cpu sensor=azure-kinect fill=16";
    assert!(!is_filled(&smoothed(settings, &across), 75..83, 50..58));
    // Two fingers in front of a wall, with nothing measured between them.
    let fingers = frame(|u, v| match (u, v) {
        (60..70 | 76..86, 20..) => 1000,
        (70..76, 20..) => 0,
        _ => 2000,
    });
    let result = smoothed(settings, &fingers);
    let status = result.status.as_ref().unwrap();
    let filled = (0..WIDTH * HEIGHT).filter(|&i| status[i] == Status::Filled).count();
    assert_eq!(filled, 0, "the gap belongs to the wall or to nothing");
    // Holes that reach the border have no rim there.
    let cut = frame(|u, v| if u < 5 || v < 3 { 0 } else { 1500 });
    assert!(!smoothed(settings, &cut).has_filled());
    // This hole is as narrow as a crack, but its sides belong to two surfaces.
    let crack = frame(|u, _| match u {
        79..81 => 0,
        ..79 => 1000,
        _ => 1500,
    });
    assert!(!smoothed(settings, &crack).has_filled());
}

#[test]
fn a_shadow_becomes_the_surface_behind_where_the_sensor_casts_it() {
    let gpu = test_adapter().map(|adapter| format!("engine=gpu adapter={}", adapter.index));
    for engine in std::iter::once("engine=cpu".to_owned()).chain(gpu) {
        check_shadows(&engine);
    }
}

fn check_shadows(engine: &str) {
    // A box at 1 m in front of a wall at 2 m. A Kinect's shadow is 0.075 * 131.25 * (1 - 1/2) = 4.9 pixels wide.
    let with_shadow = |shadow: std::ops::Range<usize>| {
        frame(move |u, v| match (u, v) {
            (60..100, 30..90) => 1000,
            (u, 30..90) if shadow.contains(&u) => 0,
            _ => 2000,
        })
    };
    let count = |smoothed: &Smoothed| {
        let status = smoothed.status.as_ref().unwrap();
        let filled: Vec<usize> = (0..WIDTH * HEIGHT).filter(|&i| status[i] == Status::Filled).collect();
        assert!(filled.iter().all(|&i| (smoothed.points.z()[i] - 2.0).abs() < 0.02));
        filled.len()
    };
    let left = with_shadow(54..60);
    // Not all of the shadow is filled, because pixels next to the box may belong to the box.
    assert!(count(&smoothed(&format!("{engine} sensor=kinect1 fill=12"), &left)) > 100);
    assert_eq!(count(&smoothed(&format!("{engine} sensor=azure-kinect fill=12"), &left)), 0, "it casts none");
    assert!(
        count(&smoothed(&format!("{engine} sensor=kinect1 fill=12"), &with_shadow(100..106))) > 100,
        "a mirrored frame"
    );
    // This hole is much wider than the shadow that these depths explain.
    assert_eq!(count(&smoothed(&format!("{engine} sensor=kinect1 fill=32"), &with_shadow(30..60))), 0);
}

#[test]
fn nothing_is_filled_against_a_measurement_or_far_outside_the_frame() {
    // The slanted pole in front of a wall is too thin for a surface at a Kinect's noise, so smoothing loses its
    // pixels.
    let camera = Camera::new((320, 240), [525.0; 2], [160.0, 120.0]);
    let is_pole = |i: usize| (i % 320).wrapping_sub(i / 320 / 3 + 100) < 3;
    let raw = (0..320 * 240).map(|i| if is_pole(i) { 800 } else { 1500 }).collect();
    let result = smoothed("engine=cpu fill=8", &DepthFrame::new(camera, raw).unwrap());
    let status = result.status.as_ref().unwrap();
    let pole: Vec<Status> = (0..320 * 240).filter(|&i| is_pole(i)).map(|i| status[i]).collect();
    let count = |wanted: Status| pole.iter().filter(|status| **status == wanted).count();
    assert!(count(Status::TooFew) > 100 && count(Status::Filled) == 0, "{:?}", result.status_counts());
    // A pillar's shadow on a side wall. The wall is 4 m away at the shadow and recedes towards the pillar.
    for (background_mm, limit_m) in [(6000, 4.0 / 0.9), (4050, 4.05 * 1.01)] {
        let corridor = self::frame(|u, v| match (u, v) {
            (80..110, 10..110) => 800,
            (70..80, 10..110) => 0,
            (..70, _) => (1000.0 / (0.25 + 0.004 * (69.0 - u as f64))) as u16,
            _ => background_mm,
        });
        let result = smoothed("engine=cpu sensor=kinect1 fill=12", &corridor);
        let status = result.status.as_ref().unwrap();
        let filled = (0..WIDTH * HEIGHT).filter(|&i| status[i] == Status::Filled).map(|i| result.points.z()[i]);
        let (count, farthest_m) = filled.fold((0, 0.0f32), |(count, most), z_m| (count + 1, most.max(z_m)));
        assert!(count > 100 && farthest_m < limit_m + 0.01, "{count} pixels up to {farthest_m} m");
    }
}

#[test]
fn another_colour_in_a_hole_is_another_object() {
    let in_hole = |i: usize| (70..76).contains(&(i % WIDTH)) && (40..46).contains(&(i / WIDTH));
    let frame = frame(|u, v| if in_hole(v * WIDTH + u) { 0 } else { 1500 });
    let coloured = |inside: [u8; 3]| {
        let rgb = (0..WIDTH * HEIGHT).flat_map(|i| if in_hole(i) { inside } else { [200, 190, 180] }).collect();
        frame.clone().with_rgb(rgb)
    };
    let is_whole = |frame: &DepthFrame| is_filled(&smoothed("engine=cpu fill=8", frame), 70..76, 40..46);
    assert!(is_whole(&coloured([190, 195, 185])) && !is_whole(&coloured([20, 20, 25])));
    // The same holds for a cloud with PCL's `rgb` field.
    let cloud = |inside| coloured(inside).deproject().unwrap();
    let has_filled = |cloud: &OrganizedCloud| {
        let mut result = Smoothed::default();
        Session::new("engine=cpu fill=8".parse().unwrap()).unwrap().smooth(cloud, &mut result).unwrap();
        let mut written = cloud.points.clone();
        written.apply(&result, Outputs::POINTS).unwrap();
        assert_eq!(written.attribute("status").is_some(), result.has_filled(), "files flag filled points");
        result.has_filled()
    };
    assert!(has_filled(&cloud([190, 195, 185])) && !has_filled(&cloud([20, 20, 25])));
}

#[test]
fn results_do_not_depend_on_engine_threads_flight_or_pose() {
    let (scene, pose) = Scene::tabletop(5);
    let truth = scene.render(&camera(), &pose);
    let simulator = DepthSimulator::new(DepthNoise::default(), camera(), 5);
    let frames: Vec<DepthFrame> = (0..4)
        .map(|t| {
            let mut frame = simulator.frame(&truth, t).unwrap();
            cut_holes(&mut frame, 6, t);
            frame
        })
        .collect();
    let outputs = Outputs::POINTS.with_status(true).with_sigma(true);
    let all = |settings: &str| -> Vec<Smoothed> {
        frames.iter().map(|frame| smoothed_by(settings, outputs, frame)).collect()
    };
    let expected = all("engine=cpu threads=1 fill=8");
    let filled = |smoothed: &Smoothed| smoothed.status_counts().unwrap()[Status::Filled as usize];
    let counts: Vec<usize> = expected.iter().map(filled).collect();
    assert!(counts.iter().all(|count| *count > 150), "{counts:?}");
    assert!(are_same(&all("engine=cpu threads=3 fill=8"), &expected));
    // Frames in flight have the same results, also with temporal smoothing.
    for settings in ["engine=cpu threads=1 fill=8", "engine=cpu threads=1 fill=8 temporal=steady"] {
        let new = || {
            let mut session = Session::new(settings.parse().unwrap()).unwrap();
            session.set_outputs(outputs);
            session
        };
        let (mut alone, mut flying, mut found) = (new(), new(), Vec::new());
        let expected: Vec<Smoothed> = frames
            .iter()
            .map(|frame| {
                let mut smoothed = Smoothed::default();
                alone.smooth(frame, &mut smoothed).unwrap();
                smoothed
            })
            .collect();
        for frame in &frames {
            if flying.in_flight() > 0 && flying.in_flight() >= flying.max_in_flight() {
                found.extend(flying.receive().unwrap().map(planish::SmoothedView::into_smoothed));
            }
            flying.submit(Arc::new(frame.clone()), Smoothed::default()).unwrap();
        }
        while let Some(view) = flying.receive().unwrap() {
            found.push(view.into_smoothed());
        }
        assert!(are_same(&found, &expected), "{settings}");
    }
    // Other engines differ slightly, so single pixels may be filled or not. The GPU fills the holes of frames without
    // colours itself.
    let mut engines = vec!["engine=reference fill=8".to_owned()];
    match test_adapter() {
        Some(adapter) => engines.push(format!("engine=gpu adapter={} fill=8", adapter.index)),
        None => skip("no Vulkan adapter"),
    }
    for settings in engines {
        for (found, expected) in all(&settings).iter().zip(&expected) {
            let (found_status, status) = (found.status.as_ref().unwrap(), expected.status.as_ref().unwrap());
            let is_filled = |i: &usize| status[*i] == Status::Filled && found_status[*i] == Status::Filled;
            let same: Vec<usize> = (0..status.len()).filter(is_filled).collect();
            assert!(same.len() as f64 > 0.99 * filled(expected).max(filled(found)) as f64, "{settings}");
            let off_m = |i: usize| (found.points.z()[i] - expected.points.z()[i]).abs();
            assert!(same.iter().all(|&i| off_m(i) < 1e-3 * expected.points.z()[i]), "{settings}");
        }
    }
    // Smooth the first frame in a coordinate frame other than the sensor's, and without a camera.
    let cloud = frames[0].deproject().unwrap();
    let pose = SensorPose::from_viewpoint([1.0, -2.0, 0.5, 0.5, -0.5, 0.5, -0.5]);
    let moved: Xyz = (0..cloud.positions().len())
        .map(|i| {
            let point = cloud.positions().get(i).map(f64::from);
            let turned = pose.rotation().map(|row| (0..3).map(|axis| row[axis] * point[axis]).sum::<f64>());
            [turned[0] + 1.0, turned[1] - 2.0, turned[2] + 0.5].map(|value| value as f32)
        })
        .collect();
    let mut session = Session::new("engine=cpu threads=1 fill=8".parse().unwrap()).unwrap();
    let mut of_moved = Smoothed::default();
    let view = PointsView::from_planes(moved.x(), moved.y(), moved.z()).unwrap();
    session.smooth(view.with_grid(WIDTH, HEIGHT).unwrap().with_pose(pose).unwrap(), &mut of_moved).unwrap();
    let (found, expected) = (filled(&of_moved), filled(&expected[0]));
    assert!(found.abs_diff(expected) as f64 <= 0.02 * expected as f64, "{found} {expected}");
}

#[test]
fn a_gpu_fills_holes_before_it_returns_results_also_in_place() {
    let Some(adapter) = test_adapter() else { return skip("no Vulkan adapter") };
    let new = |outputs| {
        let settings = format!("engine=gpu adapter={} fill=12 sensor=kinect1", adapter.index);
        let mut session = Session::new(settings.parse().unwrap()).unwrap();
        session.set_outputs(outputs);
        session
    };
    let (scene, pose) = Scene::tabletop(6);
    let truth = scene.render(&camera(), &pose);
    let mut frame = DepthSimulator::new(DepthNoise::default(), camera(), 6).frame(&truth, 0).unwrap();
    cut_holes(&mut frame, 6, 6);
    let frame = DepthFrame::new(camera(), frame.raw).unwrap();
    let outputs = Outputs::DEPTH.with_status(true).with_sigma(true);
    let mut session = new(outputs);
    let mut expected = Smoothed::default();
    session.smooth(&frame, &mut expected).unwrap();
    assert!(expected.has_filled() && expected.points.is_empty() && expected.sigma.is_some());
    let is_same = |found: &Smoothed| {
        let bits =
            |smoothed: &Smoothed| smoothed.sigma.as_ref().unwrap().iter().map(|m| m.to_bits()).collect::<Vec<_>>();
        (&found.depth, &found.status) == (&expected.depth, &expected.status) && bits(found) == bits(&expected)
    };
    session.submit_in_place(&frame).unwrap();
    let in_place = session.receive().unwrap().unwrap();
    assert!(in_place.points().is_none() && is_same(&in_place.into_smoothed()));
    session.submit(Arc::new(frame.clone()), Smoothed::default()).unwrap();
    assert!(is_same(&session.receive().unwrap().unwrap().into_smoothed()));
    let (mut depth, mut status) = (vec![0; WIDTH * HEIGHT], vec![Status::Hole; WIDTH * HEIGHT]);
    let into = SmoothedMut::new().with_depth(&mut depth).with_status(&mut status);
    session.smooth_into(&frame, into).unwrap();
    assert_eq!((Some(&depth), Some(&status)), (expected.depth.as_ref(), expected.status.as_ref()));
    // A fleet of GPUs fills holes too. With a CPU among its devices, the session fills them.
    for devices in [adapter.index.to_string(), format!("{},cpu", adapter.index)] {
        let mut fleet = new(outputs);
        let mut settings: Settings = "fill=12 sensor=kinect1".parse().unwrap();
        settings.set("devices", devices.as_str()).unwrap();
        fleet.set_settings(settings).unwrap();
        fleet.set_outputs(outputs);
        for _ in 0..3 {
            fleet.submit(Arc::new(frame.clone()), Smoothed::default()).unwrap();
        }
        while let Some(found) = fleet.receive().unwrap() {
            let found = found.into_smoothed();
            let filled = |smoothed: &Smoothed| smoothed.status_counts().unwrap()[Status::Filled as usize];
            let (found_px, expected_px) = (filled(&found), filled(&expected));
            assert!(found_px.abs_diff(expected_px) <= expected_px / 50, "{devices}: {found_px} {expected_px}");
            assert!(found.points.is_empty() && found.sigma.is_some());
        }
    }
    // The session fills frames with colours, which the GPU does not have: the colours keep holes open.
    let mut again = Smoothed::default();
    let rgb = |value: u8| frame.clone().with_rgb(vec![value; 3 * WIDTH * HEIGHT]);
    session.smooth(&rgb(90), &mut again).unwrap();
    assert!(again.has_filled() && again.points.is_empty());
    let error = session.submit_in_place(&rgb(90)).unwrap_err().to_string();
    assert!(error.contains("fill = 12"), "{error}");
    // The same session returns to frames without colours, and to other outputs.
    session.smooth(&frame, &mut again).unwrap();
    assert!(is_same(&again));
    session.set_outputs(Outputs::POINTS.with_status(true));
    session.smooth(&frame, &mut again).unwrap();
    assert_eq!((&again.status, again.sigma.is_none(), again.points.len()), (&expected.status, true, WIDTH * HEIGHT));
}

#[test]
fn most_of_a_hole_is_filled_within_its_stated_error() {
    let mut session = Session::new("engine=cpu fill=8".parse().unwrap()).unwrap();
    session.set_outputs(Outputs::POINTS.with_sigma(true));
    let mut filling = FillEvaluation::default();
    for seed in 31..33 {
        let camera = Camera::kinect_v1();
        for (scene, pose) in [Scene::tabletop(seed), Scene::room(seed)] {
            let truth = scene.render(&camera, &pose);
            let mut frame = DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap();
            let cut = cut_holes(&mut frame, 8, seed);
            let mut smoothed = Smoothed::default();
            session.smooth(&frame, &mut smoothed).unwrap();
            filling.add(&truth, &frame, &cut, smoothed.points.z(), smoothed.sigma.as_deref());
        }
    }
    let report = filling.report();
    assert!(report.cut.pixels > 20_000 && report.cut.filled > 0.85 && report.cut.rms_mm < 8.0, "{report:?}");
    assert!((0.58..0.80).contains(&report.cut.within_one) && report.cut.over_three < 0.03, "{report:?}");
    assert!(report.cut.wrong < 0.002 && report.own.wrong < 0.02, "{report:?}");
}

#[test]
fn what_cannot_be_filled_or_flagged_is_refused_or_reported() {
    let settings = |text: &str| text.parse::<Settings>();
    assert!(settings("fill=0").unwrap_err().to_string().contains("fill = 0 is not allowed: 1 to 64 pixels"));
    assert!(settings("fill=65").is_err() && settings("fill=64").is_ok());
    let frame = frame(|u, v| wall_mm(u, v) as u16);
    let mut session = Session::new(settings("engine=cpu fill=8").unwrap()).unwrap();
    session.set_outputs(Outputs::POINTS);
    let mut smoothed = Smoothed::default();
    session.smooth(&frame, &mut smoothed).unwrap();
    assert!(smoothed.status.is_some(), "the status is added where there is room");
    let error = session.submit(Arc::new(frame.clone()), Smoothed::default()).unwrap_err().to_string();
    assert!(error.contains("fill = 8 is not allowed: only if status is among the outputs"), "{error}");
    let error = session.submit_in_place(&frame).unwrap_err().to_string();
    assert!(error.contains("fill = 8"), "{error}");
    // An unorganized cloud has no pixels to fill.
    let cloud = frame.deproject().unwrap().points;
    let error = session.smooth(&cloud, &mut smoothed).unwrap_err().to_string();
    assert!(error.contains("fill = 8 is not allowed: only for frames on a grid"), "{error}");
    // The grid of a turning scanner is not a camera's.
    let of_scanner = |i: usize| {
        let (azimuth, elevation) = (0.02 * (i % WIDTH) as f32, 0.01 * (i / WIDTH) as f32 - 0.5);
        let ray = [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()];
        ray.map(|axis| 3.0 * axis)
    };
    let points: Xyz = (0..WIDTH * HEIGHT).map(of_scanner).collect();
    let cloud = OrganizedCloud::from_positions(WIDTH, HEIGHT, points).unwrap();
    session.take_events();
    for _ in 0..2 {
        session.smooth(&cloud, &mut smoothed).unwrap();
    }
    assert_eq!(session.take_events().iter().filter(|event| **event == SessionEvent::NotFilled).count(), 1);
    // Depth in metres is filled like raw depth.
    let metres: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| if i == 5000 { f32::NAN } else { 1.5 }).collect();
    let camera = camera();
    session.smooth(DepthView::from_metres(&metres, &camera).unwrap().into_frame().unwrap(), &mut smoothed).unwrap();
    assert_eq!(smoothed.status.as_ref().unwrap()[5000], Status::Filled);
}
