//! The comparison that every fast engine must pass: against the f64 reference over the grid of parameters, on
//! simulated, real and nasty clouds (docs/method.md, section 9).

use planish::agreement::{Agreement, radii_m};
use planish::{FrameParams, FrameRadius, OrganizedCloud, Project, SensorPose, Smoothed};

use crate::data::real_frames;
use crate::engines::{TestEngine, parameter_grid};
use crate::poses::moved;
use crate::scenes::{grid, nasty_scenes, simulated, small_camera};
use crate::tolerances::assert_invariants;

/// An engine and its name.
pub type Subject = (String, TestEngine);

/// Pose of a sensor that is rotated about all axes and away from the origin, as on a robot arm.
const TURNED: SensorPose = SensorPose { position_m: [0.4, -0.7, 0.9], orientation: [0.7, 0.1, -0.5, 0.5] };

/// Runs every engine and the reference on all clouds with each setting, once in the clouds' own coordinate frame and
/// once as seen by a rotated sensor. Returns the violated limits of docs/method.md, section 9.
fn compare(name: &str, clouds: &[OrganizedCloud], grid: &[FrameParams], subjects: &[Subject]) -> Vec<String> {
    let turned: Vec<_> = clouds.iter().map(|cloud| moved(cloud, TURNED)).collect();
    let mut misses = compare_in_frame(name, clouds, grid, subjects);
    misses.extend(compare_in_frame(&format!("{name}, turned"), &turned, grid, subjects));
    misses
}

fn compare_in_frame(name: &str, clouds: &[OrganizedCloud], grid: &[FrameParams], subjects: &[Subject]) -> Vec<String> {
    let mut misses = Vec::new();
    for &params in grid {
        let references: Vec<Smoothed> =
            clouds.iter().map(|cloud| TestEngine::REFERENCE.smooth(cloud, params)).collect();
        for (cloud, reference) in clouds.iter().zip(&references) {
            assert_invariants(cloud, reference, &radii_m(cloud, params), &format!("{name}, reference, {params:?}"));
        }
        for (subject, engine) in subjects {
            let what = format!("{name}, {subject}, {params:?}");
            let mut agreement = Agreement::with_params(params);
            for (cloud, reference) in clouds.iter().zip(&references) {
                let result = engine.smooth(cloud, params);
                let radii_m = radii_m(cloud, params);
                assert_invariants(cloud, &result, &radii_m, &what);
                agreement.add(&result, reference, |i| radii_m[i]);
            }
            misses.extend(agreement.misses().into_iter().map(|miss| format!("{what}: {miss}")));
        }
    }
    misses
}

fn assert_none(misses: &[String]) {
    assert!(misses.is_empty(), "{} misses:\n{}", misses.len(), misses.join("\n"));
}

/// Compares the engines with the reference on two simulated frames, over the whole parameter grid.
///
/// # Panics
/// If an engine does not agree.
pub fn simulated_frames_agree(subjects: &[Subject]) {
    let clouds = [(1, false), (2, true)].map(|(seed, room)| simulated(seed, room, small_camera()));
    assert_none(&compare("simulated", &clouds, &parameter_grid(), subjects));
}

/// Compares the engines with the reference on the real frames. The first `whole` frames are compared with the usual
/// settings. Quarters of all frames share the settings of the parameter grid, and are also compared as seen by a
/// rotated sensor.
///
/// # Panics
/// If an engine does not agree.
pub fn real_frames_agree(subjects: &[Subject], whole: usize, test: &str) {
    let usual = [FrameParams::paper(), FrameParams::default(), FrameParams::paper().with_window(1).with_degree(2)];
    let settings_of_grid = parameter_grid();
    let frames = real_frames(test);
    let (mut misses, count) = (Vec::new(), 4 * frames.len());
    for (i, frame) in frames.into_iter().enumerate() {
        for k in 0..4 {
            let settings: Vec<_> = settings_of_grid.iter().skip(4 * i + k).step_by(count).copied().collect();
            misses.extend(compare(frame.name, &[quarter(&frame.cloud, k)], &settings, subjects));
        }
        if i < whole {
            misses.extend(compare_in_frame(frame.name, &[frame.cloud], &usual, subjects));
        }
    }
    assert_none(&misses);
}

/// Returns quarter `k` (0 to 3) of a cloud.
pub fn quarter(cloud: &OrganizedCloud, k: usize) -> OrganizedCloud {
    let (width, height) = (cloud.width() / 2, cloud.height() / 2);
    let (left, top) = (k % 2 * width, k / 2 * height);
    grid(width, height, |u, v| cloud.positions().get((top + v) * cloud.width() + left + u))
}

/// Checks that the invariants hold for difficult clouds at the corners of the parameter space.
///
/// # Panics
/// If an invariant is violated.
pub fn nasty_clouds_keep_the_invariants(subjects: &[Subject]) {
    let corners = [
        FrameParams::paper(),
        FrameParams::default(),
        FrameParams::default().with_window(7).with_stride(8),
        FrameParams::paper().with_window(1).with_degree(1),
        FrameParams::default().with_project(Project::Ray),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 3.0 }).with_project(Project::Ray),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 1e-6 }),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 1e3 }).with_bandwidth_m(Some(1e-3)),
        FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m: 1e3 }).with_bandwidth_m(Some(1e3)),
    ];
    for scene in nasty_scenes() {
        for params in corners {
            for (subject, engine) in subjects {
                let what = format!("{}, {subject}, {params:?}", scene.name);
                for cloud in [&scene.cloud, &moved(&scene.cloud, TURNED)] {
                    let result = engine.smooth(cloud, params);
                    assert_invariants(cloud, &result, &radii_m(cloud, params), &what);
                }
            }
        }
    }
}

/// Compares the engines with the reference on the difficult clouds, except those with numbers near the limits of f32.
///
/// # Panics
/// If an engine does not agree.
pub fn ordinary_small_clouds_agree(subjects: &[Subject]) {
    let mut misses = Vec::new();
    let skipped = ["denormal coordinates", "huge coordinates"];
    for scene in nasty_scenes().iter().filter(|scene| !skipped.contains(&scene.name)) {
        // Use windows that do not adapt to the resolution, because these clouds are smaller than any frame.
        let settings = [FrameParams::paper(), FrameParams::default().with_stride(5)];
        misses.extend(compare(scene.name, std::slice::from_ref(&scene.cloud), &settings, subjects));
    }
    assert_none(&misses);
}
