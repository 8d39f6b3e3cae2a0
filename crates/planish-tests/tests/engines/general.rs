//! Unorganized clouds: the fast engines against the reference, and properties that hold for any cloud.

use planish::agreement::Agreement;
use planish::{
    CloudParams, CloudRadius, Edges, Engine, Outputs, PointsView, SensorModel, SensorPose, SimdLevel, Smoothed,
    Smoother, SmootherOptions, Status, Strength,
};
use planish_tests::bits::{bits, of_points};
use planish_tests::data::{bunny, folder, general_cloud, skip};
use planish_tests::engines::{TestEngine, is_software, test_adapter};
use planish_tests::scenes::{simulated, small_camera};

pub(super) type Points = Vec<[f32; 3]>;

/// A generator of random numbers that are the same in every run.
pub(super) struct Random(pub(super) u64);

impl Random {
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a number with a nearly normal distribution.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.between(-0.5, 0.5)).sum()
    }
}

/// Returns the GPU engine, if there is an adapter.
fn gpu() -> Option<TestEngine> {
    if test_adapter().is_none() {
        skip("unorganized clouds on a GPU: no adapter");
    }
    test_adapter().map(|_| TestEngine::gpu(false))
}

fn engines() -> Vec<(String, TestEngine)> {
    let cpu = SimdLevel::available().map(|level| (level.name().to_owned(), TestEngine::cpu(level)));
    cpu.chain(gpu().map(|gpu| ("gpu".to_owned(), gpu))).collect()
}

/// Returns [`engines`] and the GPU engine with bounds checks, which doubles the compile time on a software adapter.
fn all_engines() -> Vec<(String, TestEngine)> {
    let checked = gpu().map(|gpu| ("gpu with checks".to_owned(), TestEngine { bounds_checks: true, ..gpu }));
    engines().into_iter().chain(checked).collect()
}

/// Returns one engine of each kind, for tests that do not depend on arithmetic.
fn kinds() -> Vec<TestEngine> {
    [TestEngine::cpu(SimdLevel::best()), TestEngine::REFERENCE].into_iter().chain(gpu()).collect()
}

pub(super) fn smooth(engine: TestEngine, points: &[[f32; 3]], params: CloudParams) -> Smoothed {
    engine.smooth(PointsView::from_rows(points).unwrap(), params)
}

/// Returns a noisy sphere with stray and repeated points. Like a scanner's view, it is thousands of times denser
/// towards one pole.
pub(super) fn uneven_sphere(count: usize, seed: u64) -> Points {
    let mut random = Random(seed);
    let mut points: Points = (0..count)
        .map(|_| {
            let (turn, up) = (random.between(0.0, std::f64::consts::TAU), random.between(0.0, 1.0).powi(6));
            let polar = 0.02 + 3.0 * up;
            let radius = 1.0 + 0.001 * random.normal();
            [polar.sin() * turn.cos(), polar.sin() * turn.sin(), polar.cos()].map(|value| (0.3 * radius * value) as f32)
        })
        .collect();
    for stray in points.iter_mut().step_by(97) {
        *stray = stray.map(|value| 1.7 * value);
    }
    for i in (0..count).step_by(11) {
        points[i] = points[count / 2];
    }
    points
}

/// Returns the points of a simulated camera frame, without their grid.
pub(super) fn frame_points(seed: u64) -> Points {
    simulated(seed, seed.is_multiple_of(2), small_camera()).positions().iter().collect()
}

/// Returns every third point of [`frame_points`], for tests that do not depend on the number of points.
pub(super) fn few_frame_points(seed: u64) -> Points {
    frame_points(seed).into_iter().step_by(3).collect()
}

pub(super) fn settings() -> Vec<CloudParams> {
    let general = CloudParams::default();
    let fixed = general.with_radius_m(0.06);
    let robust = general.with_edges(Edges::Robust);
    vec![
        general,
        general.with_degree(3),
        general.with_radius(CloudRadius::Neighbours { count: 12 }).with_degree(1),
        general.with_radius(CloudRadius::Neighbours { count: 150 }).with_ridge(1e-2),
        fixed,
        fixed.with_degree(3).with_bandwidth_m(Some(0.02)),
        fixed.with_radius_m(0.2),
        robust,
        robust.with_degree(1),
        robust.with_degree(3),
        robust.with_radius_m(0.06),
        robust.with_radius_m(0.1).with_ridge(1e-2).with_bandwidth_m(Some(0.05)),
        CloudParams::for_sensor(SensorModel::KINECT_V1, Strength::DEFAULT),
        CloudParams::for_sensor(SensorModel::AZURE_KINECT, Strength::LIGHT).with_edges(Edges::Off).with_degree(3),
    ]
}

fn assert_near(found: &Smoothed, expected: &Smoothed, what: &str) {
    let mut agreement = Agreement::default();
    agreement.add(found, expected, |_| 0.0);
    let misses = agreement.misses();
    assert!(misses.is_empty(), "{what}: {misses:?}");
}

fn assert_agree(engines: &[(String, TestEngine)], name: &str, points: &[[f32; 3]], params: CloudParams) {
    let expected = smooth(TestEngine::REFERENCE, points, params);
    for (engine_name, engine) in engines {
        assert_near(&smooth(*engine, points, params), &expected, &format!("{name}, {engine_name}, {params:?}"));
    }
}

#[test]
fn every_engine_agrees_with_the_reference() {
    let engines = engines();
    let room = few_frame_points(2);
    for params in settings().into_iter().step_by(4) {
        assert_agree(&engines, "room", &room, params);
        // Fixed radii contain many of the sphere's points; the ignored test of every setting covers them.
        if matches!(params.radius, CloudRadius::Neighbours { .. }) {
            assert_agree(&engines, "sphere", &uneven_sphere(6000, 3), params);
        }
    }
}

#[test]
#[ignore = "takes a minute; the gate runs it"]
fn every_engine_agrees_with_the_reference_in_every_setting() {
    for (i, params) in settings().into_iter().enumerate() {
        // On a software adapter, the shader with bounds checks is compiled for only a third of the settings.
        let engines = if is_software() && i % 3 != 0 { engines() } else { all_engines() };
        assert_agree(&engines, "frame", &frame_points(1), params);
        assert_agree(&engines, "room", &frame_points(2), params);
        assert_agree(&engines, "sphere", &uneven_sphere(6000, 3), params);
        let bunny: Points = bunny().positions.iter().collect();
        assert_agree(&engines, "bunny", &bunny, params);
        [1, 2, 7, 33].into_iter().for_each(|n| assert_agree(&engines, "few", &uneven_sphere(33, 5)[..n], params));
    }
    // With this many neighbours the sphere's stray points reach the pole, where their radii depend on the last digits
    // of sums.
    let wide = CloudParams::default().with_edges(Edges::Robust).with_degree(3);
    let wide = wide.with_radius(CloudRadius::Neighbours { count: 100 });
    let engines = engines();
    assert_agree(&engines, "frame", &frame_points(1), wide);
    assert_agree(&engines, "room", &frame_points(2), wide);
}

#[test]
fn real_clouds_agree() {
    assert_real_clouds_agree(5);
}

#[test]
#[ignore = "takes seconds; the gate runs it"]
fn denser_real_clouds_agree() {
    assert_real_clouds_agree(3);
}

/// Uses every `one_of`-th point of each cloud.
fn assert_real_clouds_agree(one_of: usize) {
    let engines = engines();
    let Some(data) = folder("unorganized clouds") else { return };
    for name in ["unorganized/milk_color.pcd", "unorganized/room_scan1.pcd"] {
        let points: Points = general_cloud(&data, name).positions.iter().step_by(one_of).collect();
        assert_agree(&engines, name, &points, CloudParams::default());
        // The room is not tested with edges: at the scanner's foot it has so many points that lavapipe ends a loop
        // early, which is an error.
        if name.contains("milk") {
            assert_agree(&engines, name, &points, CloudParams::default().with_edges(Edges::Robust));
        }
    }
}

#[test]
fn small_clouds_agree_and_lose_nothing() {
    let all = uneven_sphere(40, 5);
    let (general, robust) = (CloudParams::default(), CloudParams::default().with_edges(Edges::Robust));
    for params in [general, robust, robust.with_radius_m(0.4), CloudParams::paper().with_radius_m(0.5)] {
        // One smoother smooths clouds of every size, one after the other.
        let open = |engine: TestEngine| Smoother::open_clouds(params, &engine.options(Outputs::ALL)).unwrap();
        let mut reference = open(TestEngine::REFERENCE);
        let mut smoothers: Vec<_> = engines().into_iter().map(|(name, engine)| (name, open(engine))).collect();
        for count in (1..14).chain([16, 17, 31, 32, 33, 40]) {
            let smooth = |smoother: &mut Smoother| {
                let mut smoothed = Smoothed::default();
                smoother.smooth(PointsView::from_rows(&all[..count]).unwrap(), &mut smoothed).unwrap();
                smoothed
            };
            let expected = smooth(&mut reference);
            for (name, smoother) in &mut smoothers {
                let (found, what) = (smooth(smoother), format!("{count} points, {name}, {params:?}"));
                assert_near(&found, &expected, &what);
                assert!(found.status.unwrap().into_iter().all(Status::has_point), "{what}");
            }
        }
    }
}

#[test]
fn holes_stay_holes_at_their_index_and_stray_points_stay_where_they_are() {
    let mut points = few_frame_points(1);
    let stray = [0.3, 0.2, -7.0];
    points[100] = stray;
    let holes: Vec<usize> = (0..points.len()).filter(|&i| points[i][2].is_nan()).chain([7, 5000]).collect();
    holes.iter().for_each(|&i| points[i] = [f32::NAN, 0.0, 1.0]);
    for engine in kinds() {
        let name = engine.engine.name();
        let found = smooth(engine, &points, CloudParams::default());
        let status = found.status.as_ref().unwrap();
        assert!(holes.iter().all(|&i| status[i] == Status::Hole && found.points.get(i)[0].is_nan()), "{name}");
        assert_eq!((status[100], found.points.get(100)), (Status::Isolated, stray), "{name}");
        assert!(
            found.normals.as_ref().unwrap().get(100)[0].is_nan() && found.curvature.as_ref().unwrap()[100].is_nan()
        );
        let kept = status.iter().filter(|status| status.has_point()).count();
        assert_eq!(kept, points.len() - holes.len(), "{name}");

        let removed = smooth(engine, &points, CloudParams::default().with_remove_isolated(true));
        assert_eq!(removed.status.unwrap()[100], Status::TooFew, "{name}");
        assert!(removed.points.get(100)[0].is_nan(), "{name}");
    }
}

#[test]
fn points_farther_than_the_engines_see_are_isolated_and_change_no_other() {
    let near = few_frame_points(1);
    let mut points = near.clone();
    points.extend([[2e18, 1.0, 0.0]; 40]);
    points.extend([[3e18, 1.0, 1.0], [1.0, -2e18, 0.0], [0.0, 0.0, f32::MAX]]);
    let far = near.len()..points.len();
    let all = [CloudParams::default(), CloudParams::default().with_edges(Edges::Robust)];
    for params in all.into_iter().chain([CloudParams::default().with_radius_m(0.05)]) {
        for (name, engine) in engines() {
            let [alone, found] = [&near, &points].map(|points| smooth(engine, points, params));
            let status = found.status.as_ref().unwrap();
            assert!(far.clone().all(|i| status[i] == Status::Isolated && found.points.get(i) == points[i]), "{name}");
            assert_eq!(status[..near.len()], alone.status.as_ref().unwrap()[..], "{name}");
            let moved =
                |i: usize| (0..3).any(|axis| (found.points.get(i)[axis] - alone.points.get(i)[axis]).abs() > 1e-5);
            assert!(!(0..near.len()).any(moved), "{name}");
        }
    }
}

#[test]
fn neither_threads_nor_the_order_of_the_points_change_a_bit() {
    // With more points than these, the curve of the index depends on a sample, and thus on the order of the points.
    let points = uneven_sphere(9000, 8);
    let engine = |threads| TestEngine { threads: Some(threads), ..TestEngine::cpu(SimdLevel::best()) };
    for params in [CloudParams::default(), CloudParams::default().with_radius_m(0.05)] {
        let expected = smooth(engine(1), &points, params);
        for threads in [2, 3, 8] {
            assert!(bits(&smooth(engine(threads), &points, params)) == bits(&expected), "{threads} threads");
        }
        let reversed: Points = points.iter().rev().copied().collect();
        let found = smooth(engine(2), &reversed, params);
        let last = points.len() - 1;
        for i in 0..points.len() {
            let bits = |point: [f32; 3]| point.map(f32::to_bits);
            assert_eq!(bits(found.points.get(last - i)), bits(expected.points.get(i)), "{i}");
        }
    }
}

#[test]
fn points_at_one_place_count_each_and_cost_nothing() {
    // If the cost were quadratic, this test would take minutes.
    let mut points = vec![[0.5, 0.25, 1.0]; 200_000];
    points.extend((0..2500).map(|i| [(i % 50) as f32 * 0.02, (i / 50) as f32 * 0.02, 1.0 + 0.001 * (i % 3) as f32]));
    for params in [CloudParams::default(), CloudParams::default().with_radius_m(0.07)] {
        for engine in kinds() {
            let engine_name = engine.engine.name();
            if engine_name == "reference" && params.radius == CloudParams::default().with_radius_m(0.07).radius {
                continue;
            }
            let found = smooth(engine, &points, params);
            let at = |i: usize| found.points.get(i);
            assert!((1..200_000).all(|i| at(i) == at(0)), "{engine_name}");
            assert!(found.neighbours.as_ref().unwrap()[0] >= 200_000, "{engine_name}");
        }
    }
    let all_one = smooth(TestEngine::cpu(SimdLevel::best()), &points[..1000], CloudParams::default());
    assert!(all_one.status.unwrap().iter().all(|&status| status == Status::Degenerate));
}

#[test]
fn a_dense_cluster_in_a_wide_cloud_costs_what_it_costs_alone() {
    // All points of the cluster are in one cell of the CPU index's curve; searching the whole cell would take
    // minutes. Stray points have the whole cluster as neighbours. The GPU gets a smaller cluster, because lavapipe
    // would end its loops early.
    let mut random = Random(9);
    let mut within = |count: usize, low: f64, high: f64| -> Points {
        (0..count).map(|_| [0.0; 3].map(|_: f64| random.between(low, high) as f32)).collect()
    };
    let (cluster, strays) = (within(100_000, 0.0, 1e-3), within(5000, -500.0, 500.0));
    let on_gpu = gpu().map(|gpu| (gpu, 4_000));
    for (engine, count) in [(TestEngine::cpu(SimdLevel::best()), 100_000)].into_iter().chain(on_gpu) {
        let points = [&cluster[..count], &strays[..count / 20]].concat();
        let found = smooth(engine, &points, CloudParams::default());
        assert!(found.points.iter().zip(&points).take(count).all(|(p, q)| (p[0] - q[0]).abs() < 1e-3));
    }
    // Every position of the cluster occurs twice, all copies after the originals. Each counts once in the density
    // around it.
    let twice = [&cluster[..600], &cluster[..600], &strays[..150]].concat();
    let expected = smooth(TestEngine::REFERENCE, &twice, CloudParams::default());
    for (name, engine) in engines() {
        let found = smooth(engine, &twice, CloudParams::default());
        // Compare only points of the cluster: the radii of the strays depend on its last digits (docs/method.md,
        // section 8).
        let far =
            |i: usize| (0..3).map(|k| (found.points.get(i)[k] - expected.points.get(i)[k]).abs()).fold(0.0, f32::max);
        let farthest = (0..1200).map(far).fold(0.0, f32::max);
        assert!(farthest < 1e-6, "{name}: {farthest}");
    }
}

#[test]
fn clouds_of_any_size_and_place_come_out_smoother() {
    let plane = |i: usize, random: &mut Random| {
        let (x, y) = ((i % 60) as f64 + 0.2 * random.normal(), (i / 60) as f64 + 0.2 * random.normal());
        [x, y, 0.3 * random.normal()]
    };
    for spacing_m in [1e-8, 1e-6, 1.0, 1e5] {
        let mut random = Random(4);
        let points: Points = (0..3600).map(|i| plane(i, &mut random).map(|value| (value * spacing_m) as f32)).collect();
        for (name, engine) in engines() {
            let found = smooth(engine, &points, CloudParams::default());
            let rms = |points: &mut dyn Iterator<Item = [f32; 3]>| {
                let (sum, count) = points.fold((0.0, 0), |(sum, n), p| (sum + f64::from(p[2]).powi(2), n + 1));
                (sum / f64::from(count)).sqrt()
            };
            let (after, before) = (rms(&mut found.points.iter()), rms(&mut points.iter().copied()));
            assert!(after < 0.5 * before, "{name}, {spacing_m}: {after:e} {before:e}");
        }
    }
    // Coordinates near the limits of f32, whose squares overflow or underflow.
    let mut wild = uneven_sphere(500, 6);
    (wild[3], wild[4], wild[5]) = ([3e38, 0.0, 0.0], [-3e38, 1e30, 0.0], [1e-40, 0.0, 1e-42]);
    for (name, engine) in engines() {
        for params in [CloudParams::default(), CloudParams::default().with_radius_m(1e3)] {
            let found = smooth(engine, &wild, params);
            assert!(found.points.iter().all(|p| p.iter().all(|value| value.is_finite())), "{name}, {params:?}");
        }
    }
}

#[test]
fn a_moved_sensor_turns_normals_and_moves_no_point() {
    let points = few_frame_points(1);
    let view = PointsView::from_rows(&points).unwrap();
    let behind = SensorPose { position_m: [0.0, 0.0, 50.0], ..SensorPose::IDENTITY };
    for engine in kinds() {
        let name = engine.engine.name();
        let own = engine.smooth(view, CloudParams::default());
        let turned = engine.smooth(view.with_pose(behind).unwrap(), CloudParams::default());
        assert_eq!(
            own.points.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>(),
            turned.points.iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>(),
            "{name}"
        );
        let facing = |found: &Smoothed, sensor_z: f32| {
            let normals = found.normals.as_ref().unwrap().iter().zip(found.points.iter());
            let towards = normals.filter(|([nx, ny, nz], [x, y, z])| nx * x + ny * y + nz * (z - sensor_z) <= 0.0);
            towards.count() as f64 / found.status.as_ref().unwrap().iter().filter(|s| s.has_normal()).count() as f64
        };
        assert!(facing(&own, 0.0) > 0.999 && facing(&turned, 50.0) > 0.999, "{name}");
    }
}

#[test]
fn ranges_and_rays_of_a_known_sensor_start_at_its_pose() {
    let points = few_frame_points(1);
    // The sensor moves 2 m back, and the cloud with it.
    let moved: Points = points.iter().map(|&[x, y, z]| [x, y, z - 2.0]).collect();
    let pose = SensorPose { position_m: [0.0, 0.0, -2.0], ..SensorPose::IDENTITY };
    let (view, moved) = (PointsView::from_rows(&points).unwrap(), PointsView::from_rows(&moved).unwrap());
    let params = CloudParams::for_sensor(SensorModel::KINECT_V1, Strength::DEFAULT);
    for engine in kinds() {
        let own = engine.smooth(view, params);
        let farthest = |other: &Smoothed, shift: f32| {
            let pairs = own.points.iter().zip(other.points.iter()).filter(|(p, _)| p[2].is_finite());
            let apart = pairs.map(|(p, q)| [0, 1, 2].map(|k| p[k] - q[k] - if k == 2 { shift } else { 0.0 }));
            apart.flatten().fold(0.0, |most: f32, value| most.max(value.abs()))
        };
        let there = farthest(&engine.smooth(moved.with_pose(pose).unwrap(), params), 2.0);
        assert!(there < 1e-4, "{} {there}", engine.engine.name());
        // From the origin, the cloud would be nearer, and its neighbourhoods smaller.
        let here = farthest(&engine.smooth(moved, params), 2.0);
        assert!(here > 1e-3, "{} {here}", engine.engine.name());
        // Points stay on their rays.
        let rays = points.iter().zip(own.points.iter()).filter(|(p, _)| p[2].is_finite());
        let off = rays.map(|(p, q)| (p[0] * q[2] - p[2] * q[0]).abs().max((p[1] * q[2] - p[2] * q[1]).abs()));
        assert!(off.fold(0.0, f32::max) < 1e-5, "{}", engine.engine.name());
    }
}

#[test]
fn only_what_is_asked_for_is_there() {
    let points = few_frame_points(1);
    let (engine, params) = (TestEngine::cpu(SimdLevel::best()), CloudParams::default());
    let view = PointsView::from_rows(&points).unwrap();
    let all = engine.smooth(view, params);
    let normals = engine.smooth_to(view, params, Outputs::POINTS.with_points(false).with_normals(true));
    assert!(normals.points.is_empty() && normals.status.is_none());
    assert!(normals.normals.as_ref().map(of_points) == all.normals.as_ref().map(of_points));
}

#[test]
fn progress_of_another_thread_grows_to_the_whole() {
    for (engine, count) in [(Engine::Cpu, 30_000), (Engine::Reference, 12_000)] {
        let points = uneven_sphere(count, 3);
        let mut smoother =
            Smoother::open_clouds(CloudParams::default(), &SmootherOptions::new(engine, Outputs::POINTS)).unwrap();
        let progress = smoother.progress().unwrap();
        assert_eq!(progress.share(), 0.0);
        let mut shares = vec![progress.share()];
        std::thread::scope(|scope| {
            let smoothing = scope.spawn(|| {
                smoother.smooth(PointsView::from_rows(&points).unwrap(), &mut Smoothed::default()).unwrap();
            });
            while !smoothing.is_finished() {
                let share = progress.share();
                if shares.last() != Some(&share) {
                    shares.push(share);
                }
            }
        });
        assert_eq!(progress.share(), 1.0);
        assert!(shares.len() > 3 && shares.is_sorted(), "{engine:?}: {} shares", shares.len());
    }
}

#[test]
fn a_frame_that_is_stopped_is_an_error_and_the_next_is_whole() {
    for (engine, count) in [(Engine::Cpu, 30_000), (Engine::Reference, 12_000)] {
        let points = uneven_sphere(count, 3);
        let mut smoother =
            Smoother::open_clouds(CloudParams::default(), &SmootherOptions::new(engine, Outputs::POINTS)).unwrap();
        let progress = smoother.progress().unwrap();
        let mut smoothed = Smoothed::default();
        let view = || PointsView::from_rows(&points).unwrap();
        let stopped = std::thread::scope(|scope| {
            let smoothing = scope.spawn(|| smoother.smooth(view(), &mut smoothed));
            // Wait until smoothing is under way.
            while progress.share() == 0.0 && !smoothing.is_finished() {
                std::thread::yield_now();
            }
            progress.stop();
            smoothing.join().unwrap()
        });
        assert_eq!(stopped.unwrap_err().to_string(), "smoothing was stopped", "{engine:?}");
        smoother.smooth(view(), &mut smoothed).unwrap();
        assert!((0..points.len()).all(|i| smoothed.points.is_finite(i)), "{engine:?}");
        assert_eq!(progress.share(), 1.0);
    }
}
