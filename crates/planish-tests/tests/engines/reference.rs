//! The reference engine against PCL's own test values, the invariants, and real frames.

use planish::agreement::radii_m;
use planish::{CloudParams, Engine, FrameParams, FrameRadius, Project, Smoothed, Smoother};
use planish_tests::data::{bunny, real_frames};
use planish_tests::engines::TestEngine;
use planish_tests::parity::quarter;
use planish_tests::scenes::{nasty_scenes, simulated, small_camera};
use planish_tests::tolerances::assert_invariants;

fn smooth(cloud: &planish::OrganizedCloud, params: FrameParams, threads: usize) -> Smoothed {
    TestEngine { threads: Some(threads), ..TestEngine::REFERENCE }.smooth(cloud, params)
}

#[test]
fn general_mode_gives_the_values_of_pcls_own_test() {
    let cloud = bunny();
    let params = CloudParams::paper().with_radius_m(0.03).with_degree(2).with_bandwidth_m(Some(0.03));
    let smoothed = TestEngine::REFERENCE.smooth(&cloud, params);
    assert_eq!(smoothed.points.len(), 397);
    let normal = smoothed.normals.unwrap().get(0).map(f32::abs);
    let curvature = smoothed.curvature.unwrap()[0];
    let found = [smoothed.points.get(0), normal].concat();
    let expected = [0.005417, 0.113463, 0.040715, 0.111894, 0.594906, 0.795969];
    for (value, expected) in found.iter().zip(expected) {
        assert!((value - expected).abs() < 1e-3, "{found:?}");
    }
    assert!((curvature - 0.012019).abs() < 1e-3, "{curvature}");
}

#[test]
fn invariants_hold_on_nasty_clouds_whatever_the_threads() {
    let corners = [
        FrameParams::paper(),
        FrameParams::default(),
        FrameParams::default().with_window(7).with_stride(8),
        FrameParams::paper().with_window(1).with_degree(2),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 1e-6 }),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 1e3 }).with_bandwidth_m(Some(1e-3)),
    ];
    for scene in nasty_scenes() {
        for params in corners {
            let one = smooth(&scene.cloud, params, 1);
            assert_invariants(&scene.cloud, &one, &radii_m(&scene.cloud, params), scene.name);
            let three = smooth(&scene.cloud, params, 3);
            // Compare as text, because NaN is not equal to NaN.
            assert_eq!(format!("{one:?}"), format!("{three:?}"), "{}", scene.name);
        }
    }
}

#[test]
fn invariants_hold_on_simulated_frames() {
    for (seed, room) in [(1, false), (2, true)] {
        let cloud = simulated(seed, room, small_camera());
        for params in [FrameParams::paper(), FrameParams::default()] {
            assert_invariants(&cloud, &smooth(&cloud, params, 2), &radii_m(&cloud, params), "simulated");
        }
    }
}

#[test]
fn invariants_hold_on_real_frames() {
    // The parity tests cover whole frames with every setting.
    for (i, frame) in real_frames("reference on real frames").into_iter().enumerate() {
        // A sixteenth of the frame, next to its middle.
        let cloud = quarter(&quarter(&frame.cloud, i % 4), 3 - i % 4);
        let params = [FrameParams::paper(), FrameParams::default()][i % 2];
        let smoothed = smooth(&cloud, params, 2);
        assert_invariants(&cloud, &smoothed, &radii_m(&cloud, params), frame.name);
    }
}

#[test]
fn a_frame_of_another_shape_is_refused_with_both_shapes() {
    let mut smoother = Smoother::open(FrameParams::paper(), Engine::Reference, (50, 40)).unwrap();
    let cloud = simulated(1, false, small_camera());
    let error = smoother.smooth(&cloud, &mut Smoothed::default()).unwrap_err().to_string();
    assert!(error.contains("160x120") && error.contains("50x40"), "{error}");
}

#[test]
fn a_smoothed_depth_image_of_a_slanted_wall_lies_on_the_wall() {
    use planish::simulate::{DepthNoise, DepthSimulator, Pose, Scene, Shape};
    let camera = small_camera();
    let normal = [0.8, 0.0, -0.6];
    let scene = Scene { objects: vec![Shape::Plane { point_m: [0.0, 0.0, 1.2], normal }] };
    let truth = scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0));
    // Use independent noise, because the test is about geometry, not about the noise that a small window can remove.
    let noise =
        DepthNoise { dropout_incidence_deg: 89.0, fixed_pattern_rms: 0.0, temporal_rms: 0.6, ..DepthNoise::default() };
    let frame = DepthSimulator::new(noise, camera, 3).frame(&truth, 0).unwrap();
    let [smoothed, along_normals] = [Project::Ray, Project::Normal]
        .map(|project| TestEngine::REFERENCE.smooth(&frame, FrameParams::default().with_project(project)));

    // Returns the RMS error of z along the ray of each pixel, away from the border and where the wall is not too
    // grazing.
    let rms = |z: &[f32]| {
        let inner = (0..z.len())
            .filter(|&i| truth.points.z()[i] < 1.6)
            .filter(|i| (15..145).contains(&(i % 160)) && (15..105).contains(&(i / 160)));
        let errors: Vec<f64> = inner.map(|i| f64::from(z[i] - truth.points.z()[i])).filter(|e| e.is_finite()).collect();
        (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
    };
    let raw = frame.deproject().unwrap();
    let along_ray = smoothed.to_depth_m(&camera).unwrap();
    assert!(rms(&along_ray) < 0.5 * rms(raw.positions().z()), "{} {}", rms(&along_ray), rms(raw.positions().z()));
    // Points that moved along their rays have this depth themselves. If they move along normals instead, their z
    // undershoots the correction on a wall at 53°.
    assert!((rms(&along_ray) / rms(smoothed.points.z()) - 1.0).abs() < 1e-3);
    assert!(
        rms(&along_ray) < 0.8 * rms(along_normals.points.z()),
        "{} {}",
        rms(&along_ray),
        rms(along_normals.points.z())
    );
}
