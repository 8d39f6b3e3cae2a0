use std::sync::Arc;

use super::*;
use crate::camera::Camera;
use crate::frame::{DepthFrame, PointsView};
use crate::neighbours::tests::Random;
use crate::status::Status;
use crate::testing::{DepthNoise, Scene, simulated};
use crate::{Edges, Params, PointCloud, SensorPose, Smoother, Xyz};

fn camera(width: usize) -> Camera {
    let height = width * 3 / 4;
    let focal_length_px = 525.0 * width as f64 / 640.0;
    Camera::new((width, height), [focal_length_px; 2], [width as f64 / 2.0 - 0.5, height as f64 / 2.0 - 0.5])
}

fn frame(width: usize) -> DepthFrame {
    simulated(Scene::tabletop(1), DepthNoise::default(), camera(width), 1)
}

fn session(text: &str) -> Session {
    Session::new(format!("{text} engine=cpu").parse().unwrap()).unwrap()
}

fn same_bits(one: &Xyz, other: &Xyz) -> bool {
    let bits = |points: &Xyz| points.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>();
    bits(one) == bits(other)
}

#[test]
fn shapes_and_kinds_may_change_from_frame_to_frame() {
    let mut session = session("grid=off");
    let mut smoothed = Smoothed::default();
    for width in [64, 48, 64] {
        let frame = frame(width);
        session.smooth(&frame, &mut smoothed).unwrap();
        // The session decides the window as the smoother does.
        let params = FrameParams::default();
        let mut smoother = Smoother::open(params, Engine::Cpu, (width, width * 3 / 4)).unwrap();
        let mut alone = Smoothed::default();
        smoother.smooth(&frame, &mut alone).unwrap();
        assert!(same_bits(&smoothed.points, &alone.points), "{width}");
    }
    let cloud = frame(48).deproject().unwrap().points;
    session.smooth(&cloud, &mut smoothed).unwrap();
    assert_eq!((smoothed.width, smoothed.height), (cloud.len(), 1));
    assert_eq!(session.engine(), Some(Engine::Cpu));
    assert!(matches!(session.take_events()[..], [SessionEvent::SensorRecognized { .. }]));
}

#[test]
fn frames_in_flight_keep_their_order_when_the_shape_changes() {
    let mut session = session("");
    let widths = [64, 64, 48, 64];
    let mut received = Vec::new();
    for width in widths {
        while session.in_flight() > 0 && session.in_flight() >= session.max_in_flight() {
            received.push(session.receive().unwrap().unwrap().shape().0);
        }
        session.submit(Arc::new(frame(width)), Smoothed::default()).unwrap();
    }
    while let Some(view) = session.receive().unwrap() {
        received.push(view.shape().0);
    }
    assert_eq!(received, widths);
    assert_eq!(session.in_flight(), 0);
}

#[test]
fn settings_change_from_the_next_frame_on() {
    let frame = frame(64);
    let (mut session, mut light, mut strong) = (session("preset=light"), Smoothed::default(), Smoothed::default());
    session.smooth(&frame, &mut light).unwrap();
    session.set_settings("preset=strong engine=cpu".parse().unwrap()).unwrap();
    session.smooth(&frame, &mut strong).unwrap();
    assert!(!same_bits(&light.points, &strong.points));
    let Params::Frame(params) = session.params_for(&frame).unwrap().0 else { panic!("a frame") };
    assert_eq!(params, FrameParams::for_sensor(SensorModel::KINECT_V1, crate::Strength::STRONG));
}

#[test]
fn a_sensor_is_estimated_once_and_reported() {
    let frame = frame(320);
    let mut kept = session("sensor=auto").with_kept_sensor(true);
    let mut smoothed = Smoothed::default();
    kept.smooth(&frame, &mut smoothed).unwrap();
    kept.smooth(&frame, &mut smoothed).unwrap();
    assert!(matches!(kept.take_events()[..], [SessionEvent::SensorEstimated { .. }]));
    // Too few depths for an estimate.
    let few = DepthFrame::new(Camera::new((3, 2), [4.0; 2], [1.0, 0.5]), vec![1000; 6]).unwrap();
    kept.smooth(&few, &mut smoothed).unwrap();
    let mut each = session("sensor=auto");
    each.smooth(&frame, &mut smoothed).unwrap();
    let error = each.smooth(&few, &mut smoothed).unwrap_err();
    assert!(error.to_string().contains("too few depths"), "{error}");
}

#[test]
fn outputs_change_and_a_bad_frame_leaves_the_session_usable() {
    let frame = frame(64);
    let mut session = session("");
    let mut smoothed = Smoothed::default();
    session.set_outputs(Outputs::POINTS.with_normals(true));
    session.smooth(&frame, &mut smoothed).unwrap();
    assert!(smoothed.normals.is_some());
    let short = DepthFrame::unchecked(camera(64), vec![1000; 10]);
    assert!(matches!(session.smooth(&short, &mut smoothed), Err(Error::Frame(_))));
    session.smooth(&frame, &mut smoothed).unwrap();
    session.submit(Arc::new(frame), Smoothed::default()).unwrap();
    let busy = session.smooth(&short, &mut smoothed).unwrap_err();
    assert!(matches!(busy, Error::Frame(_) | Error::Engine(EngineError::Full { .. })), "{busy}");
}

#[test]
fn one_call_smooths_one_frame() {
    let settings = "engine=cpu outputs=points+status".parse().unwrap();
    let smoothed = smooth(&frame(64), &settings).unwrap();
    assert!(smoothed.status.is_some() && smoothed.points.len() == 64 * 48);
    assert!(smooth(&frame(64), &"radius=sensor".parse().unwrap()).is_ok());
}

#[test]
fn the_sides_of_a_thin_wall_stay_apart() {
    let mut random = Random(11);
    let side = |i: usize| if i.is_multiple_of(2) { 0.025 } else { -0.025 };
    let points: Vec<[f32; 3]> = (0..10_000)
        .map(|i| {
            let noise = (0..12).map(|_| random.next()).sum::<f32>() - 6.0;
            [1.4 * random.next(), 1.4 * random.next(), side(i) + 0.01 * noise]
        })
        .collect();
    let rms_m = |settings: &str| {
        let mut smoothed = Smoothed::default();
        session(settings).smooth(PointsView::from_rows(&points).unwrap(), &mut smoothed).unwrap();
        let square = smoothed.points.z().iter().enumerate().map(|(i, z)| (z - side(i)).powi(2)).sum::<f32>();
        (square / points.len() as f32).sqrt()
    };
    let (chosen_m, forty_m) = (rms_m(""), rms_m("neighbours=40"));
    assert!(chosen_m < 0.0097 && forty_m > 0.012, "{chosen_m} {forty_m}");
}

#[test]
fn neighbours_are_chosen_by_the_noise_of_each_cloud_and_reported() {
    let mut random = Random(3);
    let mut plane = |noise_m: f32| -> Vec<[f32; 3]> {
        let mut normal = || (0..12).map(|_| random.next()).sum::<f32>() - 6.0;
        (0..6000).map(|i| [0.01 * (i % 80) as f32, 0.01 * (i / 80) as f32, 1.0 + noise_m * normal()]).collect()
    };
    let (noisy, quiet) = (plane(0.02), plane(0.0));
    let mut session = session("grid=off");
    let mut smoothed = Smoothed::default();
    let mut chosen = |session: &mut Session, points: &[[f32; 3]]| {
        let view = PointsView::from_rows(points).unwrap();
        // One event, although the cloud is examined twice.
        session.prepare(view).unwrap();
        session.smooth(view, &mut smoothed).unwrap();
        let events = session.take_events();
        let [
            SessionEvent::NeighboursChosen(CloudChoice {
                neighbours,
                edges: Edges::Off,
                passes,
                noise_m: Some(noise_m),
            }),
        ] = events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!(passes, if noise_m > 0.01 { 2 } else { 1 });
        assert_eq!(session.cloud_estimate().unwrap().noise_m, noise_m);
        (neighbours, noise_m)
    };
    let (most, noise_m) = chosen(&mut session, &noisy);
    assert!(most > 600 && (0.018..0.022).contains(&noise_m), "{most} {noise_m}");
    let (least, noise_m) = chosen(&mut session, &quiet);
    assert!(least == 40 && noise_m < 1e-6, "{least} {noise_m}");
    session.set_settings("preset=light engine=cpu grid=off".parse().unwrap()).unwrap();
    assert_eq!(chosen(&mut session, &noisy).0, most.div_ceil(2));
    // Streams keep 40 neighbours, and so do clouds in flight.
    let view = PointsView::from_rows(&noisy).unwrap();
    let mut forty = |session: &mut Session| {
        let mut expected = Smoothed::default();
        self::session("neighbours=40").smooth(view, &mut expected).unwrap();
        session.smooth(view, &mut smoothed).unwrap();
        same_bits(&smoothed.points, &expected.points)
    };
    let mut fixed = self::session("grid=off").with_cloud_estimates(false);
    assert!(forty(&mut fixed) && fixed.take_events().is_empty());
    assert!(!forty(&mut self::session("grid=off")));
    // Strays do not change the choice.
    let mut strays = noisy.clone();
    for i in (0..6000).step_by(100) {
        strays[i][2] += 0.4 + 0.01 * random.next();
    }
    let chosen = |points: &[[f32; 3]]| CloudEstimate::of(&PointsView::from_rows(points).unwrap()).unwrap();
    let (with, without) = (chosen(&strays), chosen(&noisy));
    assert!((with.noise_m / without.noise_m - 1.0).abs() < 0.1, "{with:?} {without:?}");
    assert!(with.neighbours * 2 > without.neighbours, "{with:?} {without:?}");
}

/// Returns points with noise on a cube of 2 x 2 x 2 m or on a sphere with a diameter of 2 m.
fn noisy_shape(is_cube: bool, count: usize, noise_m: f32) -> Vec<[f32; 3]> {
    let mut random = Random(17);
    let mut point = || {
        let p = [(); 3].map(|()| 2.0 * random.next() - 1.0);
        let normal = [(); 3].map(|()| (0..12).map(|_| random.next()).sum::<f32>() - 6.0);
        // A vector of three normal deviates has a uniformly distributed direction.
        let length = normal.map(|x| x * x).iter().sum::<f32>().sqrt();
        let on_sphere = normal.map(|x| x / length);
        let face = (3.0 * random.next()) as usize;
        let on_cube = std::array::from_fn(|axis| if axis == face { 1.0f32.copysign(p[axis]) } else { p[axis] });
        let noise = [(); 3].map(|()| noise_m * ((0..12).map(|_| random.next()).sum::<f32>() - 6.0));
        let exact: [f32; 3] = if is_cube { on_cube } else { on_sphere };
        [0, 1, 2].map(|axis| exact[axis] + noise[axis])
    };
    (0..count).map(|_| point()).collect()
}

/// Returns the RMS distance in metres from the surface of the cube or the sphere.
fn rms_from_shape(points: &Xyz, is_cube: bool) -> f32 {
    let distance = |p: [f32; 3]| {
        if !is_cube {
            return p.map(|x| x * x).iter().sum::<f32>().sqrt() - 1.0;
        }
        let outside = p.map(|x| x.abs() - 1.0);
        let beyond = outside.map(|x| x.max(0.0).powi(2)).iter().sum::<f32>().sqrt();
        beyond + outside.into_iter().fold(f32::NEG_INFINITY, f32::max).min(0.0)
    };
    (points.iter().map(|p| distance(p).powi(2)).sum::<f32>() / points.len() as f32).sqrt()
}

/// Smooths a wall of two sides with nearly normal noise. Returns the choice, and the ratio of the mean square distance
/// from the sides after smoothing to that before it.
fn smoothed_wall(half_m: f32, noise_m: f32, seed: u64) -> (CloudChoice, f64) {
    let mut random = Random(seed);
    let mut deviate = |sigma: f32| sigma * ((0..12).map(|_| random.next()).sum::<f32>() - 6.0);
    let points: Vec<[f32; 3]> = (0..10_000)
        .map(|i| {
            let (row, column) = (i / 2 / 70, i / 2 % 70);
            let side = if i % 2 == 0 { half_m } else { -half_m };
            [0.01 * column as f32 + deviate(noise_m), 0.01 * row as f32 + deviate(noise_m), side + deviate(noise_m)]
        })
        .collect();
    let mut session = Session::new("engine=cpu".parse().unwrap()).unwrap();
    let mut smoothed = Smoothed::default();
    session.smooth(PointsView::from_rows(&points).unwrap(), &mut smoothed).unwrap();
    let off = |z: f32| f64::from((z.abs() - half_m).powi(2));
    let (raw, left) = points
        .iter()
        .zip(smoothed.points.z())
        .fold((0.0, 0.0), |(raw, left), (point, z)| (raw + off(point[2]), left + off(*z)));
    (session.cloud_choice().unwrap(), left / raw)
}

#[test]
fn the_sides_of_a_thin_wall_are_not_merged() {
    let (choice, left) = smoothed_wall(0.028, 0.02, 7);
    assert!(choice.neighbours <= 40 && choice.edges == Edges::Robust && choice.passes == 1, "{choice}");
    // A single surface in the middle of the wall would give a ratio of 2.4.
    assert!(left < 0.8, "{left}");
    // With as much noise, an eighth of the points shows the two sides in some clouds only.
    for seed in 1..9 {
        let (choice, left) = smoothed_wall(0.014, 0.015, seed);
        assert!(choice.neighbours <= 40 && left < 1.0, "{seed}: {choice}, {left}");
    }
    // Neighbourhoods of 40 points are wider than the wall, but its sides are clearly apart.
    let (choice, left) = smoothed_wall(0.007, 0.0025, 7);
    assert!(choice.neighbours < 40 && left < 1.0, "{choice}, {left}");
}

#[test]
fn edges_and_passes_are_chosen_by_shape_and_noise() {
    for (is_cube, noise_m, edges, passes, most) in [
        (true, 0.02, Edges::Robust, 1, 0.7),
        (true, 0.05, Edges::Robust, 2, 0.7),
        (false, 0.01, Edges::Off, 1, 1.0),
        (false, 0.05, Edges::Off, 2, 1.0),
    ] {
        let points = noisy_shape(is_cube, 8000, noise_m);
        let view = PointsView::from_rows(&points).unwrap();
        let mut smoothed = Smoothed::default();
        let mut session = session("");
        session.smooth(view, &mut smoothed).unwrap();
        let events = session.take_events();
        let [SessionEvent::NeighboursChosen(CloudChoice { neighbours, edges: chosen, passes: chosen_passes, .. })] =
            events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!((chosen, chosen_passes), (edges, passes), "{is_cube} {noise_m}");
        // Explicit settings give the same result; for two passes, so do two calls.
        let name = if edges == Edges::Off { "off" } else { "robust" };
        let mut again =
            smooth(view, &format!("engine=cpu neighbours={neighbours} edges={name} passes={passes}").parse().unwrap());
        assert!(same_bits(&again.as_ref().unwrap().points, &smoothed.points));
        if passes == 2 {
            let first = smooth(view, &"engine=cpu neighbours=20".parse().unwrap()).unwrap();
            let second = format!("engine=cpu neighbours={neighbours} edges={name}").parse().unwrap();
            let moved = PointCloud::new(first.points);
            again = smooth(&moved, &second);
            assert!(same_bits(&again.unwrap().points, &smoothed.points));
        }
        let mut into = vec![[0.0f32; 3]; points.len()];
        session.smooth_into(view, SmoothedMut::new().with_points(&mut into)).unwrap();
        assert!(into.iter().zip(smoothed.points.iter()).all(|(a, b)| *a == b));
        let rounded = smooth(view, &"engine=cpu edges=off passes=1".parse().unwrap()).unwrap();
        let (rms_m, rounded_m) = (rms_from_shape(&smoothed.points, is_cube), rms_from_shape(&rounded.points, is_cube));
        assert!(rms_m <= most * rounded_m, "{is_cube} {noise_m}: {rms_m} {rounded_m}");
    }
    // Holes stay where they are, and a wrong number is refused.
    let mut points = noisy_shape(false, 3000, 0.1);
    points[7] = [f32::NAN; 3];
    let view = PointsView::from_rows(&points).unwrap();
    let smoothed = smooth(view, &"engine=cpu passes=2".parse().unwrap()).unwrap();
    assert!(!smoothed.points.is_finite(7) && smoothed.points.is_finite(8));
    assert!("passes=3".parse::<Settings>().unwrap_err().to_string().contains("1 or 2"));
}

/// Returns the points of a frame without its grid; the first point is isolated.
fn frame_of_one_lonely_pixel() -> Vec<[f32; 3]> {
    let mut raw = vec![1000u16; 64 * 48];
    for v in 0..24 {
        raw[64 * v..64 * v + 24].fill(0);
    }
    raw[0] = 1000;
    let frame = DepthFrame::unchecked(camera(64), raw).deproject().unwrap();
    frame.positions().iter().filter(|p| p[2].is_finite()).collect()
}

#[test]
fn a_frame_without_its_grid_is_smoothed_on_it() {
    let mut random = Random(5);
    let mut raw: Vec<u16> = (0..64 * 48).map(|_| 1000 + (20.0 * random.next()) as u16).collect();
    raw.iter_mut().filter(|_| random.next() < 0.1).for_each(|raw| *raw = 0);
    let frame = DepthFrame::unchecked(camera(64), raw);
    let on_grid = frame.deproject().unwrap();
    let points: Vec<[f32; 3]> = on_grid.positions().iter().filter(|p| p[2].is_finite()).collect();
    let view = PointsView::from_rows(&points).unwrap();
    let (mut expected, mut found) = (Smoothed::default(), Smoothed::default());
    let outputs = Outputs::ALL;
    let mut session = session("");
    session.set_outputs(outputs);
    session.smooth(&on_grid, &mut expected).unwrap();
    assert_eq!((session.rebuilt_grid(), session.take_events().len()), (None, 0));
    session.prepare(view).unwrap();
    session.smooth(view, &mut found).unwrap();
    assert_eq!(session.rebuilt_grid(), Some((64, 48)));
    assert!(matches!(session.take_events()[..], [SessionEvent::GridRebuilt { width: 64, height: 48 }]));
    assert!(matches!(session.params_for(view).unwrap().0, Params::Frame(_)));
    let of_pixels = |values: &dyn Fn(usize) -> [f32; 3]| -> Vec<[f32; 3]> {
        (0..64 * 48).filter(|&i| on_grid.positions().is_finite(i)).map(values).collect()
    };
    let same = |a: Vec<[f32; 3]>, b: &crate::Xyz| {
        a.iter().flatten().map(|x| x.to_bits()).eq(b.iter().flatten().map(f32::to_bits))
    };
    assert!(same(of_pixels(&|i| expected.points.get(i)), &found.points));
    assert!(same(of_pixels(&|i| expected.normals.as_ref().unwrap().get(i)), found.normals.as_ref().unwrap()));
    assert_eq!((found.width, found.height), (points.len(), 1));
    // An isolated point keeps its position.
    let alone = frame_of_one_lonely_pixel();
    session.smooth(PointsView::from_rows(&alone).unwrap(), &mut found).unwrap();
    assert_eq!(session.rebuilt_grid(), Some((64, 48)));
    assert_eq!((found.points.get(0), found.status.as_ref().unwrap()[0]), (alone[0], Status::Isolated));
    session.smooth(view, &mut found).unwrap();
    // Into the caller's buffers.
    let mut into = vec![[0.0f32; 3]; points.len()];
    session.smooth_into(view, SmoothedMut::new().with_points(&mut into)).unwrap();
    assert!(same(into, &found.points));
    // Another cloud of the same size does not get the prepared grid.
    let mut moved = points.clone();
    moved[7][0] += 0.05;
    session.take_events();
    session.prepare(view).unwrap();
    session.smooth(PointsView::from_rows(&moved).unwrap(), &mut found).unwrap();
    assert_eq!(session.rebuilt_grid(), None);
    let events = session.take_events();
    assert!(matches!(events[..], [SessionEvent::GridRebuilt { .. }, SessionEvent::NeighboursChosen(_)]), "{events:?}");
    let pose = SensorPose::from_viewpoint([2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
    session.prepare(view).unwrap();
    session.smooth(view.with_pose(pose).unwrap(), &mut found).unwrap();
    assert_eq!(session.rebuilt_grid(), None);
    // Another frame with the same number of points replaces the prepared one.
    let nearer: Vec<_> = points.iter().map(|p| p.map(|value| 0.9 * value)).collect();
    session.prepare(view).unwrap();
    session.smooth(PointsView::from_rows(&nearer).unwrap(), &mut found).unwrap();
    assert_eq!(session.rebuilt_grid(), Some((64, 48)));
    assert!(found.points.z()[0] < 0.95);
    for settings in ["grid=off", "neighbours=20", "radius=0.03", "remove_isolated=true"] {
        let mut session = self::session(settings);
        session.smooth(view, &mut found).unwrap();
        assert_eq!(session.rebuilt_grid(), None, "{settings}");
    }
}
