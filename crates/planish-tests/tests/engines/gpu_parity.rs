//! The GPU engine against the f64 reference (docs/method.md, section 9), on the adapter of
//! [`test_adapter`](planish_tests::engines::test_adapter): a real GPU, otherwise lavapipe.

use planish::agreement::{Agreement, radii_m};
use planish::simulate::{DepthNoise, DepthSimulator, Scene};
use planish::{Camera, DepthFrame, DepthView, FrameParams, Outputs, SimdLevel, Status};
use planish_tests::bits::bits;
use planish_tests::data::skip;
use planish_tests::engines::{TestEngine, is_software, test_adapter};
use planish_tests::parity::{self, Subject};
use planish_tests::scenes::small_camera;

/// Returns the GPU engine with and without the shader's bounds checks, or nothing if there is no adapter.
fn both_builds(test: &str) -> Vec<Subject> {
    match test_adapter() {
        None => {
            skip(&format!("{test}: no GPU adapter"));
            Vec::new()
        }
        Some(adapter) => {
            let subject = |checks| (format!("{}, checks {checks}", adapter.name), TestEngine::gpu(checks));
            vec![subject(true), subject(false)]
        }
    }
}

#[test]
#[ignore = "takes minutes: the gate runs it"]
fn simulated_frames_agree_over_the_whole_grid() {
    parity::simulated_frames_agree(&both_builds("the GPU engine on simulated frames"));
}

#[test]
#[ignore = "takes minutes: the gate runs it"]
fn real_frames_agree() {
    // Only without bounds checks, which cost a software adapter minutes; the simulated frames compare both builds. A
    // software adapter also smooths only 2 whole frames, for the same reason.
    let subjects = both_builds("the GPU engine on real frames");
    let whole = if is_software() { 2 } else { usize::MAX };
    parity::real_frames_agree(subjects.get(1..).unwrap_or_default(), whole, "the GPU engine on real frames");
}

#[test]
fn nasty_clouds_keep_the_invariants() {
    // Only the build that users run, because each build takes a software adapter seconds to compile.
    let subjects = both_builds("the GPU engine on nasty clouds");
    parity::nasty_clouds_keep_the_invariants(subjects.get(1..).unwrap_or_default());
}

#[test]
#[ignore = "the gate runs it"]
fn nasty_clouds_keep_the_invariants_with_checks_of_bounds() {
    let subjects = both_builds("the GPU engine with checks of bounds on nasty clouds");
    parity::nasty_clouds_keep_the_invariants(subjects.get(..1).unwrap_or_default());
}

#[test]
fn ordinary_small_clouds_agree_too() {
    parity::ordinary_small_clouds_agree(&both_builds("the GPU engine on small clouds"));
}

fn frame(seed: u64) -> DepthFrame {
    let camera = small_camera();
    let (scene, pose) = Scene::tabletop(seed);
    let truth = scene.render(&camera, &pose);
    DepthSimulator::new(DepthNoise::default(), camera, seed).frame(&truth, 0).unwrap()
}

#[test]
fn the_shaders_checks_of_bounds_change_no_bit() {
    for pair in both_builds("bounds checks").chunks(2) {
        for params in [FrameParams::paper(), FrameParams::default(), FrameParams::paper().with_degree(1)] {
            let [checked, unchecked] = [&pair[0], &pair[1]].map(|(_, engine)| engine.smooth(&frame(3), params));
            assert!(bits(&checked) == bits(&unchecked), "{params:?}");
        }
    }
}

#[test]
fn a_depth_frame_gives_what_its_cloud_gives() {
    for (subject, engine) in both_builds("depth frames") {
        let mut depth = frame(4);
        depth.raw[777] = planish::SATURATED_DEPTH;
        let cloud = depth.deproject().unwrap();
        for params in [FrameParams::paper(), FrameParams::default()] {
            let mut agreement = Agreement::default();
            let radii_m = radii_m(&cloud, params);
            agreement.add(&engine.smooth(&depth, params), &engine.smooth(&cloud, params), |i| radii_m[i]);
            assert_eq!(agreement.equal_status(), 1.0, "{subject}");
            assert_eq!(agreement.position_m(1.0), 0.0, "{subject}");
        }
    }
}

/// The depth of the first pixel gives a point beyond the range of f32.
#[test]
fn depth_whose_point_is_infinite_is_a_hole() {
    let camera = Camera::new((160, 120), [50.0; 2], [79.5, 59.5]);
    let mut metres = vec![0.2; 160 * 120];
    metres[0] = f32::MAX;
    let depth = DepthView::from_metres(&metres, &camera).unwrap();
    let engines = both_builds("depth near the limit of f32").into_iter().map(|(_, engine)| engine);
    for engine in engines.chain([TestEngine::cpu(SimdLevel::best()), TestEngine::REFERENCE]) {
        for params in [FrameParams::paper(), FrameParams::default()] {
            let smoothed = engine.smooth(depth, params);
            assert_eq!(smoothed.status.unwrap()[0], Status::Hole);
            assert!(!smoothed.points.is_finite(0) && smoothed.points.is_finite(1));
        }
    }
}

#[test]
fn depth_out_is_the_references_to_the_unit() {
    for (subject, engine) in both_builds("depth as an output") {
        let depth = frame(5);
        for params in [FrameParams::paper(), FrameParams::default().with_stride(5)] {
            let raw = |engine: TestEngine| engine.smooth_to(&depth, params, Outputs::DEPTH).depth.unwrap();
            let (found, expected) = (raw(engine), raw(TestEngine::REFERENCE));
            let differ: Vec<_> = found.iter().zip(&expected).filter(|(a, b)| a != b).collect();
            assert!(differ.len() * 1000 < found.len(), "{subject}: {} of {}", differ.len(), found.len());
            assert!(differ.iter().all(|(a, b)| a.abs_diff(**b) <= 1), "{subject}: {differ:?}");

            // Raw depth is the depth in metres, rounded to depth units.
            let outputs = Outputs::DEPTH.with_depth_m(true);
            let smoothed = engine.smooth_to(&depth, params, outputs);
            let (raw, depth_m) = (smoothed.depth.unwrap(), smoothed.depth_m.unwrap());
            assert!(raw.iter().zip(&depth_m).all(|(&raw, &m)| raw == depth.camera.raw_depth(m)), "{subject}");
        }
    }
}
