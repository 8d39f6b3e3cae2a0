//! Merged points thinned to voxels: the fused cloud equals the general engine's result for the centroids, and the
//! points of every camera are moved onto that surface.

use planish::clean::voxel_downsample;
use planish::evaluate::{RigCase, RigEvaluation, RigReport, RigSuite};
use planish::rig::{RigSmoother, RigWay, merged_params_in_voxels};
use planish::{
    AttributeValues, Camera, Engine, FrameParams, Outputs, PointCloud, Smoothed, Smoother, SmootherOptions, Xyz,
};
use planish_tests::rigs::{frames_of, rig_of};

const VOXEL_M: f64 = 0.01;

fn case(seed: u64) -> RigCase {
    let camera = Camera::new((320, 240), [262.5; 2], [159.5, 119.5]);
    RigSuite { camera, ..RigSuite::new(3) }.case(seed).unwrap()
}

fn smoother(case: &RigCase, way: RigWay, voxel_m: Option<f64>) -> RigSmoother {
    let options = SmootherOptions::new(Engine::Cpu, Outputs::POINTS.with_normals(true).with_status(true));
    let params = vec![FrameParams::default(); case.cameras.len()];
    let general = merged_params_in_voxels(voxel_m.unwrap_or(VOXEL_M));
    let smoother = RigSmoother::new(&rig_of(case), way, &params, general, &options).unwrap();
    smoother.with_voxel_m(voxel_m)
}

/// Returns the expected fused cloud, computed by the public functions one after another.
fn by_hand(case: &RigCase) -> PointCloud {
    let rig = rig_of(case);
    let clouds: Vec<PointCloud> = case.cameras.iter().map(|camera| camera.frame.deproject().unwrap().points).collect();
    let placed: Vec<_> = clouds.iter().enumerate().map(|(i, cloud)| (i, rig.cameras[i].pose, cloud)).collect();
    let centroids = voxel_downsample(&planish::rig::fuse(&placed).unwrap(), VOXEL_M).unwrap();
    let options = SmootherOptions::new(Engine::Cpu, Outputs::POINTS);
    let mut smoothed = Smoothed::default();
    Smoother::open_clouds(merged_params_in_voxels(VOXEL_M), &options)
        .unwrap()
        .smooth(&centroids, &mut smoothed)
        .unwrap();
    let there: Vec<usize> = (0..centroids.len()).filter(|&i| smoothed.points.is_finite(i)).collect();
    let mut by_hand = centroids;
    by_hand.positions = smoothed.points;
    by_hand.select(&there)
}

fn cameras_of(cloud: &PointCloud) -> &[u8] {
    let Some(AttributeValues::U8(cameras)) = cloud.attribute("camera").map(|field| &field.values) else {
        panic!("the field camera")
    };
    cameras
}

#[test]
fn fused_points_are_the_smoothed_centroids_with_moments_in_flight_too() {
    let cases = [case(1), case(2), case(3), case(4)];
    let expected: Vec<PointCloud> = cases.iter().map(by_hand).collect();
    let check = |found: &PointCloud, i: usize| {
        assert!(found.positions == expected[i].positions && cameras_of(found) == cameras_of(&expected[i]), "{i}");
        assert_eq!((0..3u8).map(|camera| cameras_of(found).contains(&camera)).collect::<Vec<_>>(), [true; 3]);
    };
    // All cases have the same poses.
    let mut smoother = smoother(&cases[0], RigWay::Merged, Some(VOXEL_M));
    let mut fused = PointCloud::new(Xyz::default());
    let mut received = 0;
    for case in &cases {
        if smoother.next_fused(&frames_of(case), &mut fused).unwrap() {
            check(&fused, received);
            received += 1;
        }
    }
    assert!(smoother.in_flight() > 0);
    while smoother.receive_fused(&mut fused).unwrap() {
        check(&fused, received);
        received += 1;
    }
    assert_eq!(received, cases.len());
    // Receive one moment fused, and the next as the results of each camera.
    smoother.submit_in_place(&frames_of(&cases[1])).unwrap();
    smoother.submit(&frames_of(&cases[2])).unwrap();
    assert!(smoother.receive_fused(&mut fused).unwrap());
    check(&fused, 1);
    let own = smoother.receive().unwrap().unwrap();
    let now = smoother.smooth(&frames_of(&cases[2])).unwrap();
    for (own, now) in own.into_iter().zip(now) {
        let (own, now) = (own.unwrap().unwrap(), now.unwrap().unwrap());
        assert!(own.status == now.status && (own.width, own.height) == (320, 240));
        let same = |i: usize| own.points.get(i).map(f32::to_bits) == now.points.get(i).map(f32::to_bits);
        assert!((0..own.points.len()).all(same));
    }
    // Normals of the fused cloud face the cameras.
    smoother.next_fused(&frames_of(&cases[0]), &mut fused).unwrap();
    assert!(smoother.receive_fused(&mut fused).unwrap());
    let rig = rig_of(&cases[0]);
    let component = |name: &str, i: usize| match &fused.attribute(name).unwrap().values {
        AttributeValues::F32(values) => f64::from(values[i]),
        _ => panic!("f32"),
    };
    for (i, &camera) in cameras_of(&fused).iter().enumerate() {
        let lens = rig.cameras[usize::from(camera)].pose.position_m;
        let p = fused.positions.get(i);
        let normal = ["normal_x", "normal_y", "normal_z"].map(|name| component(name, i));
        let towards: f64 = (0..3).map(|axis| normal[axis] * (f64::from(p[axis]) - lens[axis])).sum();
        assert!(towards.is_nan() || towards <= 1e-6, "point {i} of camera {camera}");
    }
}

fn report(way: RigWay, voxel_m: Option<f64>) -> RigReport {
    let mut evaluation = RigEvaluation::default();
    for seed in 1..=2 {
        let case = case(seed);
        let results = smoother(&case, way, voxel_m).smooth(&frames_of(&case)).unwrap();
        let points: Vec<Xyz> = results.into_iter().map(|result| result.unwrap().unwrap().points).collect();
        evaluation.add(&case, &points);
    }
    evaluation.report()
}

#[test]
fn each_camera_s_points_lie_on_the_surface_of_the_voxels() {
    let each = report(RigWay::Each, None);
    let thinned = report(RigWay::Merged, Some(0.005));
    // Measured: 0.241 mm in voxels and 0.265 mm for `Each`.
    assert!(thinned.overlap_rmse_mm < 0.94 * each.overlap_rmse_mm, "{each:?} {thinned:?}");
    assert!(thinned.ghosting_mm < 0.2 * each.ghosting_mm, "{each:?} {thinned:?}");
    assert!(thinned.overlap_facet_deg < each.overlap_facet_deg, "{each:?} {thinned:?}");
    assert!(thinned.lost_share < 0.03, "{thinned:?}");
}

#[test]
fn what_is_no_size_is_refused_and_a_moment_without_frames_is_empty() {
    let case = case(1);
    for size_m in [0.0, -1.0, f64::NAN, 1e-9] {
        let mut smoother = smoother(&case, RigWay::Merged, None).with_voxel_m(Some(size_m));
        let error = smoother.smooth(&frames_of(&case)).unwrap_err().to_string();
        assert!(error.contains("voxel"), "{error}");
        let mut fused = PointCloud::new(Xyz::default());
        let next = (0..3).try_for_each(|_| smoother.next_fused(&frames_of(&case), &mut fused).map(drop));
        assert!(next.is_err() && smoother.in_flight() == 0);
    }
    let mut smoother = smoother(&case, RigWay::Merged, Some(VOXEL_M));
    let mut fused = PointCloud::new(Xyz::filled(7, 1.0));
    let nothing = vec![None; case.cameras.len()];
    smoother.submit_in_place(&nothing).unwrap();
    assert!(smoother.receive_fused(&mut fused).unwrap() && fused.is_empty());
    assert!(smoother.smooth(&nothing).unwrap().iter().all(Option::is_none));
}
