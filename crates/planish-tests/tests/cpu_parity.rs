//! The CPU engine against the f64 reference, at every SIMD level of this machine (docs/method.md, section 9).

use planish::{OrganizedCloud, Radius, SimdLevel, SmoothParams, Smoothed};
use planish_tests::data::{real_frames, skip};
use planish_tests::engines::{TestEngine, parameter_grid, radius_m};
use planish_tests::scenes::{nasty_scenes, simulated, small_camera};
use planish_tests::tolerances::{Agreement, assert_invariants};

/// Runs every level and the reference on all clouds with each setting; says what section 9 misses.
fn compare(name: &str, clouds: &[OrganizedCloud], grid: &[SmoothParams]) -> Vec<String> {
    let mut misses = Vec::new();
    for &params in grid {
        let references: Vec<Smoothed> =
            clouds.iter().map(|cloud| TestEngine::REFERENCE.smooth(cloud, params)).collect();
        for level in SimdLevel::available() {
            let what = format!("{name}, {}, {params:?}", level.name());
            let mut agreement = Agreement::default();
            for (cloud, reference) in clouds.iter().zip(&references) {
                let result = TestEngine::cpu(level).smooth(cloud, params);
                assert_invariants(cloud, &result, radius_m(cloud, params), &what);
                agreement.add(&result, reference, radius_m(cloud, params));
            }
            misses.extend(agreement.misses().into_iter().map(|miss| format!("{what}: {miss}")));
        }
    }
    misses
}

fn assert_none(misses: &[String]) {
    assert!(misses.is_empty(), "{} misses:\n{}", misses.len(), misses.join("\n"));
}

#[test]
fn every_level_of_this_machine_is_tested() {
    let names: Vec<_> = SimdLevel::available().map(SimdLevel::name).collect();
    println!("SIMD levels: {}", names.join(" "));
    for level in SimdLevel::ALL.into_iter().filter(|level| !names.contains(&level.name())) {
        skip(&format!("SIMD level {}: not on this machine", level.name()));
    }
    assert!(names.contains(&SimdLevel::best().name()));
}

#[test]
fn simulated_frames_agree_over_the_whole_grid() {
    let clouds = [(1, false), (2, true)].map(|(seed, room)| simulated(seed, room, small_camera()));
    assert_none(&compare("simulated", &clouds, &parameter_grid()));
}

#[test]
fn real_frames_agree() {
    let sample = [
        SmoothParams::paper(),
        SmoothParams::default(),
        SmoothParams { window: 1, degree: 2, ..SmoothParams::paper() },
    ];
    let grid = parameter_grid();
    let frames = real_frames("the CPU engine on real frames");
    let (mut misses, count) = (Vec::new(), frames.len());
    for (i, frame) in frames.into_iter().enumerate() {
        // The grid is dealt out among the frames; each also gets the usual settings.
        let dealt = grid.iter().skip(i).step_by(count);
        let settings: Vec<_> = sample.iter().chain(dealt).copied().collect();
        misses.extend(compare(frame.name, &[frame.cloud], &settings));
    }
    assert_none(&misses);
}

#[test]
fn nasty_clouds_keep_the_invariants() {
    let corners = [
        SmoothParams::paper(),
        SmoothParams::default(),
        SmoothParams { window: 7, stride: 8, ..SmoothParams::default() },
        SmoothParams { window: 1, degree: 1, ..SmoothParams::paper() },
        SmoothParams { radius: Radius::Fixed { radius_m: 1e-6 }, ..SmoothParams::paper() },
        SmoothParams { radius: Radius::Fixed { radius_m: 1e3 }, bandwidth_m: Some(1e-3), ..SmoothParams::paper() },
        SmoothParams { radius: Radius::Fixed { radius_m: 1e3 }, bandwidth_m: Some(1e3), ..SmoothParams::paper() },
    ];
    for scene in nasty_scenes() {
        for params in corners {
            for level in SimdLevel::available() {
                let what = format!("{}, {}, {params:?}", scene.name, level.name());
                let result = TestEngine::cpu(level).smooth(&scene.cloud, params);
                assert_invariants(&scene.cloud, &result, radius_m(&scene.cloud, params), &what);
            }
        }
    }
}

#[test]
fn ordinary_small_clouds_agree_too() {
    let mut misses = Vec::new();
    let skipped = ["denormal coordinates", "huge coordinates"];
    for scene in nasty_scenes().iter().filter(|scene| !skipped.contains(&scene.name)) {
        misses.extend(compare(
            scene.name,
            std::slice::from_ref(&scene.cloud),
            &[SmoothParams::paper(), SmoothParams::default()],
        ));
    }
    assert_none(&misses);
}
