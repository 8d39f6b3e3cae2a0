//! Unorganized clouds on a GPU: clouds that are smoothed in parts because they exceed its capacity, and drivers that
//! end loops early.

use planish::{CloudParams, Edges, EngineError, Error, Outputs, PointsView, Smoothed, Smoother};
use planish_tests::engines::{TestEngine, is_software, test_adapter};

use super::general::{Points, Random, few_frame_points, frame_points, settings, smooth, uneven_sphere};

/// Returns the number of points that differ by more than rounding between a cloud smoothed on the GPU in parts and at
/// once, or `None` if its points reach too many others to smooth it in parts.
fn differing_in_parts(points: &[[f32; 3]], params: CloudParams, points_at_once: usize) -> Option<usize> {
    let whole = smooth(TestEngine::gpu(false), points, params);
    let options = TestEngine { bounds_checks: false, ..TestEngine::in_parts(points_at_once) }.options(Outputs::ALL);
    let mut parts = Smoothed::default();
    let mut smoother = Smoother::open_clouds(params, &options).unwrap();
    match smoother.smooth(PointsView::from_rows(points).unwrap(), &mut parts) {
        Err(Error::Engine(EngineError::Crowded { .. })) => return None,
        result => result.unwrap(),
    }
    let status = |smoothed: &Smoothed, i: usize| smoothed.status.as_ref().map(|status| status[i]);
    let is_same = |i: usize| {
        let [found, expected] = [parts.points.get(i), whole.points.get(i)];
        let is_near = |axis: usize| {
            let close = (found[axis] - expected[axis]).abs() < 1e-5;
            close || (found[axis].is_nan() && expected[axis].is_nan())
        };
        status(&parts, i) == status(&whole, i) && (0..3).all(is_near)
    };
    Some((0..points.len()).filter(|&i| !is_same(i)).count())
}

#[test]
fn clouds_in_parts_are_as_those_at_once() {
    if test_adapter().is_none() {
        return;
    }
    // A point may differ if it reaches more of the cloud than the device holds, or if the radii of its neighbours are
    // much larger than its own.
    let room = few_frame_points(2);
    let general = CloudParams::default();
    let robust = general.with_edges(Edges::Robust);
    for params in [general, robust.with_radius_m(0.06)] {
        let differing = differing_in_parts(&room, params, 3500);
        assert!(differing.is_some_and(|differing| differing <= 2), "{differing:?} of the room, {params:?}");
    }
    // Scanners write missing returns as identical points far from the others. All of them take one run, not one run
    // each.
    let mut with_zeros = room.clone();
    (0..with_zeros.len()).step_by(40).for_each(|i| with_zeros[i] = [0.0; 3]);
    let differing = differing_in_parts(&with_zeros, general, 6000);
    assert!(differing.is_some_and(|differing| differing <= 2), "{differing:?} with zeros");
}

#[test]
#[ignore = "takes a minute; the gate runs it"]
fn clouds_in_parts_are_as_those_at_once_in_every_setting() {
    if test_adapter().is_none() {
        return;
    }
    let room = frame_points(2);
    let step = if is_software() { 2 } else { 1 };
    let settings: Vec<_> = settings().into_iter().step_by(step).collect();
    let (mut done, all) = (0, settings.len());
    for params in settings {
        let Some(differing) = differing_in_parts(&room, params, 9000) else { continue };
        assert!(differing <= room.len() / 5000, "{differing} of the room, {params:?}");
        done += 1;
    }
    // With many neighbours, or with edges kept, points reach much of such a small cloud, which then cannot be split.
    assert!(2 * done > all, "{done} of {all}");
}

#[test]
fn points_that_reach_more_than_a_gpu_takes_are_an_error() {
    if test_adapter().is_none() {
        return;
    }
    let sphere = uneven_sphere(6000, 3);
    let mut one_place = sphere.clone();
    one_place[..4500].fill(sphere[0]);
    let general = CloudParams::default();
    let options = TestEngine::in_parts(4000).options(Outputs::POINTS);
    for (points, params) in [(&sphere, general.with_radius_m(0.2)), (&one_place, general)] {
        let mut smoother = Smoother::open_clouds(params, &options).unwrap();
        let smooth = |smoother: &mut Smoother, points| {
            smoother.smooth(PointsView::from_rows(points).unwrap(), &mut Smoothed::default())
        };
        let error = smooth(&mut smoother, points).unwrap_err().to_string();
        assert!(error.contains("holds at most 4000 points at once"), "{error}");
        smooth(&mut smoother, &sphere[..100]).unwrap();
    }
}

#[test]
#[ignore = "takes seconds; the gate runs it"]
fn a_driver_that_ends_loops_early_is_an_error() {
    if test_adapter().is_none() {
        return;
    }
    // The centre of the ball has more neighbours than lavapipe's loops have rounds; a GPU handles all of them. Each
    // point on the surface reaches a quarter of the others.
    let mut random = Random(3);
    let on_surface = |random: &mut Random| {
        let (turn, z) = (random.between(0.0, std::f64::consts::TAU), random.between(-1.0, 1.0));
        let across = (1.0 - z * z).sqrt();
        [across * turn.cos(), across * turn.sin(), z].map(|value| value as f32)
    };
    let mut points: Points = (0..70_000).map(|_| on_surface(&mut random)).collect();
    points.push([0.0; 3]);
    let params = CloudParams::default().with_radius_m(1.01).with_degree(1);
    let mut smoother = Smoother::open_clouds(params, &TestEngine::gpu(false).options(Outputs::ALL)).unwrap();
    let mut found = Smoothed::default();
    match smoother.smooth(PointsView::from_rows(&points).unwrap(), &mut found) {
        Ok(()) => assert_eq!(found.neighbours.unwrap()[70_000], 70_001),
        Err(error) => assert!(error.to_string().contains("ended a loop early"), "{error}"),
    }
}
