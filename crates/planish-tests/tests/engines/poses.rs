//! Clouds in any coordinate frame (docs/method.md, section 11): rigid motions change only the coordinate frame, and no
//! cloud loses its points.

use planish::agreement::{Agreement, POSITION_999_M, radii_m};
use planish::{
    Camera, DepthFrame, Distortion, FrameParams, OrganizedCloud, Outputs, PointsView, Project, RangeRule, SensorPose,
    SimdLevel, Smoothed, Status,
};
use planish_tests::engines::{TestEngine, test_adapter};
use planish_tests::poses::{BASE, moved, rotate, transform};
use planish_tests::scenes::{simulated, small_camera};
use proptest::prelude::*;

/// Returns the fast engines of this machine with their names.
fn engines() -> Vec<(&'static str, TestEngine)> {
    let cpu = ("cpu", TestEngine::cpu(SimdLevel::best()));
    let gpu = test_adapter().map(|_| ("gpu", TestEngine::gpu(true)));
    if gpu.is_none() {
        eprintln!("SKIP poses on the GPU: no adapter");
    }
    [cpu].into_iter().chain(gpu).collect()
}

fn pose() -> impl Strategy<Value = SensorPose> {
    ([-1.0..1.0, -1.0..1.0, -1.0..1.0f64], [-3.0..3.0, -3.0..3.0, -3.0..3.0f64]).prop_map(|(turn, position_m)| {
        let length: f64 = turn.iter().map(|c| c * c).sum::<f64>().sqrt().max(1e-3);
        let (sin, cos) = (1.5 * length).sin_cos();
        SensorPose {
            position_m,
            orientation: [cos, sin * turn[0] / length, sin * turn[1] / length, sin * turn[2] / length],
        }
    })
}

/// Compares a result in a moved coordinate frame with the result in the camera's coordinate frame.
fn assert_moved(what: &str, found: &Smoothed, own: &Smoothed, pose: &SensorPose, radii_m: &[f64]) {
    let mut expected = own.clone();
    for i in 0..own.points.len() {
        expected.points.set(i, transform(pose, own.points.get(i).map(f64::from)).map(|value| value as f32));
    }
    let mut agreement = Agreement::default();
    agreement.add(found, &expected, |i| radii_m[i]);
    // The moved points are rounded to f32 in another frame. On every engine, this puts a few of them on the other
    // side of a threshold.
    let misses = [1.0 - agreement.equal_status(), agreement.position_m(0.999), agreement.position_m(0.9999)];
    assert!(misses[0] <= 3e-4 && misses[1] <= POSITION_999_M && misses[2] <= 3e-4, "{what}: {misses:?}");
    let (normals, own_normals) = (found.normals.as_ref().unwrap(), own.normals.as_ref().unwrap());
    // Compare only surfaces, because the normals of isolated groups of few points are rounding noise.
    let curvature = own.curvature.as_ref().unwrap();
    let is_surface = |i: usize| own.neighbours.as_ref().unwrap()[i] >= 12 && curvature[i] < 0.02;
    let off = (0..normals.len()).filter(|&i| is_surface(i) && normals.is_finite(i)).filter(|&i| {
        let expected = rotate(pose, own_normals.get(i).map(f64::from));
        let cosine: f64 = normals.get(i).into_iter().zip(expected).map(|(a, b)| f64::from(a) * b).sum();
        cosine < 0.9999
    });
    assert!(off.count() <= normals.len() / 500, "{what}: normals");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_rigid_motion_of_cloud_and_pose_moves_the_result(pose in pose(), paper in any::<bool>()) {
        let own = simulated(3, true, small_camera());
        let params = if paper { FrameParams::paper() } else { FrameParams::default().with_stride(1) };
        let cloud = moved(&own, pose);
        let radii = radii_m(&own, params);
        let of_own = TestEngine::REFERENCE.smooth(&own, params);
        let reference = TestEngine::REFERENCE.smooth(&cloud, params);
        assert_moved("reference", &reference, &of_own, &pose, &radii);
        for (name, engine) in engines() {
            let result = engine.smooth(&cloud, params);
            assert_moved(name, &result, &of_own, &pose, &radii);
            let mut agreement = Agreement::default();
            agreement.add(&result, &reference, |i| radii[i]);
            let misses = agreement.misses();
            assert!(misses.is_empty(), "{name}: {misses:?}");
        }
    }
}

/// Returns the unit vector from the sensor to a point.
fn direction(pose: &SensorPose, p: [f32; 3]) -> [f64; 3] {
    let ray = [0, 1, 2].map(|k| f64::from(p[k]) - pose.position_m[k]);
    let length = ray.iter().map(|c| c * c).sum::<f64>().sqrt();
    ray.map(|c| c / length)
}

#[test]
fn points_moved_along_rays_stay_on_them_and_have_the_depth_that_comes_out() {
    let camera = small_camera();
    let own = simulated(7, true, camera);
    let mut posed = moved(&own, BASE);
    posed.camera = Some(camera);
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        for (cloud, pose) in [(&own, SensorPose::IDENTITY), (&posed, BASE)] {
            for params in [FrameParams::paper(), FrameParams::default().with_stride(1)] {
                let params = params.with_project(Project::Ray);
                let smoothed = engine.smooth_to(cloud, params, Outputs::ALL.with_depth(true));
                let (depth, mut found) = (smoothed.depth.as_ref().unwrap(), 0);
                for i in (0..depth.len()).filter(|&i| smoothed.points.is_finite(i)) {
                    let (before, after) = (cloud.positions().get(i), smoothed.points.get(i));
                    let turned = direction(&pose, before).into_iter().zip(direction(&pose, after));
                    let off = turned.map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
                    // Both points are rounded to f32; at 5 m, to 2.4e-7 m per coordinate.
                    assert!(off < 1.5e-6, "{name}, {params:?}, pixel {i}: {off:e}");
                    let inverse = [0, 1, 2].map(|k| f64::from(after[k]) - pose.position_m[k]);
                    let axis = rotate(&pose, [0.0, 0.0, 1.0]);
                    let z: f64 = (0..3).map(|k| axis[k] * inverse[k]).sum();
                    assert!((f64::from(depth[i]) - 1e3 * z).abs() < 0.51, "{name}, pixel {i}: {} {z}", depth[i]);
                    found += 1;
                }
                assert!(found > 10_000, "{name}: {found}");
            }
        }
    }
}

fn share_with_points(smoothed: &Smoothed, cloud: &OrganizedCloud) -> f64 {
    let points = smoothed.status.as_ref().unwrap().iter().filter(|status| status.has_normal()).count();
    points as f64 / cloud.points.valid_points() as f64
}

/// Returns a wall of 64x48 points, 2 m in front of a camera with a Kinect's field of view.
fn wall() -> OrganizedCloud {
    let camera = Camera::new((64, 48), [52.5; 2], [31.5, 23.5]);
    DepthFrame::new(camera, vec![2000; 64 * 48]).unwrap().deproject().unwrap()
}

#[test]
fn walls_in_other_frames_come_out_whole_and_face_their_sensor() {
    let overhead = SensorPose { position_m: [0.0, 0.0, 4.0], orientation: [0.0, 1.0, 0.0, 0.0] };
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        for pose in [BASE, overhead] {
            let cloud = moved(&wall(), pose);
            let forgotten = {
                let mut cloud = cloud.clone();
                cloud.points.pose = SensorPose::IDENTITY;
                cloud
            };
            // Some programs write the sensor's position but not its orientation.
            let unturned = {
                let mut cloud = cloud.clone();
                cloud.points.pose.orientation = SensorPose::IDENTITY.orientation;
                cloud
            };
            for params in [FrameParams::default().with_stride(1), FrameParams::paper().with_radius_m(0.15)] {
                for (how, cloud) in [("posed", &cloud), ("without its pose", &forgotten), ("unturned", &unturned)] {
                    let smoothed = engine.smooth(cloud, params);
                    assert_eq!(share_with_points(&smoothed, cloud), 1.0, "{name}, {how}, {params:?}");
                    if how == "without its pose" {
                        continue;
                    }
                    let normals = smoothed.normals.as_ref().unwrap();
                    let away = |i: usize| {
                        let (p, n) = (cloud.positions().get(i), normals.get(i));
                        (0..3).map(|k| n[k] * (p[k] - pose.position_m[k] as f32)).sum::<f32>() > 0.0
                    };
                    assert!(!(0..normals.len()).any(away), "{name}, {how}: normals face away");
                }
            }
        }
    }
}

#[test]
fn a_georeferenced_grid_keeps_its_points_and_its_millimetres() {
    let spacing = 0.05;
    let origin = [437_512.0, 5_417_233.0, 312.0];
    let height = |u: usize, v: usize| 0.3 * (0.1 * u as f64).sin() + 0.02 * v as f64;
    let rows: Vec<[f64; 3]> = (0..80 * 60)
        .map(|i| {
            let (u, v) = (i % 80, i / 80);
            [origin[0] + spacing * u as f64, origin[1] + spacing * v as f64, origin[2] + height(u, v)]
        })
        .collect();
    let view = PointsView::from_rows_f64(&rows).unwrap().with_grid(80, 60).unwrap().with_origin(origin).unwrap();
    assert!(matches!(view.range_rule(), RangeRule::Constant { spacing_m } if (spacing_m - spacing).abs() < 0.01));
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        let smoothed = engine.smooth(view, FrameParams::default().with_stride(1));
        assert!(smoothed.status.as_ref().unwrap().iter().all(|status| status.has_normal()), "{name}");
        let normals = smoothed.normals.as_ref().unwrap();
        assert!(normals.z().iter().all(|z| *z > 0.0), "{name}: they face up");
        for i in (0..rows.len()).filter(|i| (8..72).contains(&(i % 80)) && (8..52).contains(&(i / 80))) {
            let z = height(i % 80, i / 80);
            assert!(
                (f64::from(smoothed.points.z()[i]) - z).abs() < 2e-2,
                "{name}, {i}: {z} {}",
                smoothed.points.z()[i]
            );
        }
    }
}

#[test]
fn every_layout_of_input_and_output_has_the_same_bits() {
    use planish::{SmoothedMut, Smoother};
    let cloud = moved(&simulated(2, false, small_camera()), BASE);
    let (rows, rows_f64): (Vec<[f32; 3]>, Vec<[f64; 3]>) =
        cloud.positions().iter().map(|p| (p, p.map(f64::from))).unzip();
    let outputs = Outputs::ALL;
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        for pose in [BASE, SensorPose::IDENTITY] {
            let views = [
                PointsView::from_planes(cloud.positions().x(), cloud.positions().y(), cloud.positions().z()).unwrap(),
                PointsView::from_rows(&rows).unwrap(),
                PointsView::from_rows_f64(&rows_f64).unwrap(),
            ]
            .map(|view| view.with_grid(160, 120).unwrap().with_pose(pose).unwrap());
            let params = FrameParams::default().with_stride(1);
            let expected = engine.smooth(views[0], params);
            let mut smoother = Smoother::open_with(params, &engine.options(outputs), (160, 120)).unwrap();
            for view in views {
                let len = view.len();
                let (mut points, mut normals) = (vec![[0f32; 3]; len], vec![[7f32; 4]; len]);
                let (mut curvature, mut neighbours) = (vec![0f32; len], vec![0u32; len]);
                let mut status = vec![Status::Hole; len];
                let out = SmoothedMut::new()
                    .with_points(&mut points)
                    .with_normals(&mut normals)
                    .with_curvature(&mut curvature)
                    .with_status(&mut status)
                    .with_neighbours(&mut neighbours);
                smoother.smooth_into(view, out).unwrap();
                let bits = |v: [f32; 3]| v.map(f32::to_bits);
                assert!(points.iter().zip(expected.points.iter()).all(|(a, b)| bits(*a) == bits(b)), "{name}");
                let expected_normals = expected.normals.as_ref().unwrap();
                let of_row = |row: &[f32; 4]| bits([row[0], row[1], row[2]]);
                assert!(normals.iter().zip(expected_normals.iter()).all(|(a, b)| of_row(a) == bits(b)), "{name}");
                assert!(normals.iter().all(|row| row[3] == 7.0), "{name}: the fourth value is the caller's");
                assert_eq!(status, *expected.status.as_ref().unwrap());
                assert_eq!(neighbours, *expected.neighbours.as_ref().unwrap());
                let expected = expected.curvature.as_ref().unwrap();
                assert!(curvature.iter().zip(expected).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
            let mut short = vec![[0f32; 3]; 10];
            let error = smoother.smooth_into(views[0], SmoothedMut::new().with_points(&mut short)).unwrap_err();
            assert!(error.to_string().contains("10 values; expected 19200"), "{error}");
            let mut depth = vec![0; views[0].len()];
            let error = smoother.smooth_into(views[0], SmoothedMut::new().with_depth(&mut depth)).unwrap_err();
            assert!(error.to_string().contains("without the output depth"), "{error}");
        }
    }
}

#[test]
fn depth_in_metres_and_with_strides_is_the_same_frame() {
    use planish::DepthView;
    let camera = small_camera();
    let cloud = simulated(1, true, camera);
    let raw: Vec<u16> = cloud.positions().z().iter().map(|&z| camera.raw_depth(z)).collect();
    let metres: Vec<f32> = raw.iter().map(|&raw| camera.depth_m(raw)).collect();
    let padded = |row: &[u16]| row.iter().copied().chain([9; 11]).collect::<Vec<_>>();
    let strided: Vec<u16> = raw.chunks(160).flat_map(padded).collect();
    let outputs = Outputs::ALL.with_depth(true);
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        let expected = engine.smooth_to(DepthView::new(&raw, &camera).unwrap(), FrameParams::default(), outputs);
        for view in [
            DepthView::from_metres(&metres, &camera).unwrap(),
            DepthView::with_row_stride(&strided, 171, &camera).unwrap(),
        ] {
            let found = engine.smooth_to(view, FrameParams::default(), outputs);
            assert_eq!(format!("{found:?}"), format!("{expected:?}"), "{name}");
        }
    }
}

#[test]
fn depth_through_a_distorted_lens_agrees_on_all_engines() {
    let brown_conrady = Distortion::from_opencv(&[0.12, -0.25, 1e-3, -5e-4, 0.08]).unwrap();
    let fisheye = Distortion::of_model("equidistant", &[-0.02, 0.01, 0.002, -0.001]).unwrap();
    let camera = small_camera();
    let cloud = simulated(4, false, camera);
    let raw: Vec<u16> = cloud.positions().z().iter().map(|&z| camera.raw_depth(z)).collect();
    let outputs = Outputs::ALL.with_depth(true);
    for (distortion, params) in [
        (brown_conrady, FrameParams::paper()),
        (brown_conrady, FrameParams::default().with_stride(1)),
        (fisheye, FrameParams::default()),
    ] {
        let frame = DepthFrame::new(camera.with_distortion(distortion), raw.clone()).unwrap();
        let straight = frame.deproject().unwrap();
        assert!((straight.positions().x()[300] - cloud.positions().x()[300]).abs() > 1e-3, "the lens bends");
        let expected = TestEngine::REFERENCE.smooth_to(&frame, params, outputs);
        let radii = radii_m(&straight, params);
        for (name, engine) in engines() {
            let found = engine.smooth_to(&frame, params, outputs);
            let mut agreement = Agreement::default();
            agreement.add(&found, &expected, |i| radii[i]);
            let misses = agreement.misses();
            assert!(misses.is_empty(), "{name}: {misses:?}");
            let depths = found.depth.as_ref().unwrap().iter().zip(expected.depth.as_ref().unwrap());
            assert!(depths.filter(|(a, b)| a.abs_diff(**b) > 1).count() < 20, "{name}");
        }
    }
}

#[test]
fn a_moved_cloud_has_depth_along_its_cameras_rays() {
    let camera = small_camera();
    let own = simulated(5, true, camera);
    let mut cloud = moved(&own, BASE);
    cloud.camera = Some(camera);
    let outputs = Outputs::ALL.with_depth(true);
    for (name, engine) in [("reference", TestEngine::REFERENCE)].into_iter().chain(engines()) {
        let expected = engine.smooth_to(&own, FrameParams::paper(), outputs).depth.unwrap();
        let found = engine.smooth_to(&cloud, FrameParams::paper(), outputs).depth.unwrap();
        let far = found.iter().zip(&expected).filter(|(a, b)| a.abs_diff(**b) > 1).count();
        assert!(far < 20, "{name}: {far}");
    }
}

#[test]
fn threads_change_no_bit_of_a_moved_cloud() {
    let cloud = moved(&simulated(6, false, small_camera()), BASE);
    let of_threads = |threads| {
        let engine = TestEngine { threads: Some(threads), ..TestEngine::cpu(SimdLevel::best()) };
        format!("{:?}", engine.smooth(&cloud, FrameParams::default()))
    };
    let one = of_threads(1);
    assert!([2, 3, 8].into_iter().all(|threads| of_threads(threads) == one));
}
