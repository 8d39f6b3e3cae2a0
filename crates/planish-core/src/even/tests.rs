use std::sync::Arc;

use super::*;
use crate::cloud::PointCloud;
use crate::frame::PointsView;
use crate::neighbours::tests::Random;
use crate::outputs::Outputs;
use crate::session::{Session, smooth};
use crate::settings::Settings;
use crate::status::Status;

fn settings(text: &str) -> Settings {
    text.parse().unwrap()
}

/// Returns points of the unit sphere, displaced in all directions, followed by a stray point and a hole.
fn noisy_sphere(noise_m: f32) -> Vec<[f32; 3]> {
    let mut random = Random(5);
    let mut in_ball = || loop {
        let p = Vec3::from_array(std::array::from_fn(|_| 2.0 * random.next() - 1.0));
        if (0.01..1.0).contains(&p.length_squared()) {
            return p;
        }
    };
    // Sums of nine vectors are nearly normal; noise that is uniform would look like the two sides of a wall.
    let mut points: Vec<_> = (0..4000)
        .map(|_| {
            let noise: Vec3 = (0..9).map(|_| in_ball()).sum();
            (in_ball().normalize() + 0.75 * noise_m * noise).to_array()
        })
        .collect();
    points.push([9.0, 9.0, 9.0]);
    points.push([f32::NAN; 3]);
    points
}

/// Returns the share of points within 0.3 spacings of another point, and the RMS distance from the sphere.
fn clumped_and_off(points: &[Vec3]) -> (f64, f64) {
    let spacing_m = (4.0 * std::f32::consts::PI / points.len() as f32 * 2.0 / 3f32.sqrt()).sqrt();
    let is_clumped = |i: usize| (0..points.len()).any(|j| j != i && points[i].distance(points[j]) < 0.3 * spacing_m);
    let clumped = (0..points.len()).filter(|&i| is_clumped(i)).count();
    let off = points.iter().map(|point| f64::from(point.length() - 1.0).powi(2)).sum::<f64>() / points.len() as f64;
    (clumped as f64 / points.len() as f64, off.sqrt())
}

#[test]
fn clumps_dissolve_along_the_surface_on_any_number_of_threads() {
    let points = noisy_sphere(0.02);
    let view = PointsView::from_rows(&points).unwrap();
    let smoothed_by = |text: &str| smooth(view, &settings(text)).unwrap();
    let on_sphere =
        |smoothed: &Smoothed| (0..4000).map(|i| Vec3::from_array(smoothed.points.get(i))).collect::<Vec<_>>();
    let plain = on_sphere(&smoothed_by("engine=cpu"));
    let even = smoothed_by("engine=cpu even=true outputs=points+status");
    assert_eq!((&even.normals, even.status.as_ref().unwrap()[4000]), (&None, Status::Isolated));
    assert_eq!(even.points.get(4000), [9.0; 3]);
    assert!(even.points.get(4001)[0].is_nan());
    let even_points = on_sphere(&even);
    let ((clumps, off), (fewer, still_off)) = (clumped_and_off(&plain), clumped_and_off(&even_points));
    assert!(clumps > 0.2 && fewer < 0.05, "{clumps} {fewer}");
    assert!(still_off < 1.05 * off, "{off} {still_off}");
    let moves = plain.iter().zip(&even_points).map(|(from, to)| from.distance(*to));
    let farthest = moves.clone().fold(0.0, f32::max);
    // A point may move by 1.5 standard deviations, each estimated from 17 points.
    assert!((0.01..0.06).contains(&farthest), "{farthest}");
    let one = smoothed_by("engine=cpu even=true threads=1");
    assert_eq!(on_sphere(&one), even_points);
    let status = even.status.as_ref().unwrap();
    assert_eq!(status.iter().filter(|status| status.has_normal()).count(), 4000);
}

#[test]
fn noiseless_points_hardly_move() {
    let points = noisy_sphere(0.0);
    let view = PointsView::from_rows(&points).unwrap();
    let [plain, even] =
        ["", " even=true"].map(|even| smooth(view, &settings(&format!("engine=cpu neighbours=20{even}"))).unwrap());
    for i in 0..4000 {
        let distance = Vec3::from_array(plain.points.get(i)).distance(Vec3::from_array(even.points.get(i)));
        assert!(distance < 2e-3, "{i}: {distance}");
    }
}

#[test]
fn the_sides_of_a_thin_plate_stay_where_they_are() {
    // The sides are as far apart as the points of a side, which are clumped.
    let mut random = Random(3);
    let mut jitter = || 0.006 * (random.next() - 0.5);
    let place = |i: usize| (0.01 * (i / 2 % 60) as f32, 0.01 * (i / 2 / 60) as f32, 0.01 * (i % 2) as f32);
    let measured: Vec<[f32; 3]> = (0..7200)
        .map(|i| {
            let (x, y, z) = place(i);
            [x + jitter(), y + jitter(), z + 4.0 * jitter()]
        })
        .collect();
    // The result of perfect smoothing.
    let mut smoothed = Smoothed::default();
    smoothed.prepare(7200, 1, Outputs::POINTS.with_normals(true));
    for (i, [x, y, _]) in measured.iter().enumerate() {
        smoothed.points.set(i, [*x, *y, place(i).2]);
        smoothed.normals.as_mut().unwrap().set(i, [0.0, 0.0, 1.0]);
    }
    let before: Vec<_> = smoothed.points.iter().collect();
    space_evenly(&PointsView::from_rows(&measured).unwrap(), &mut smoothed);
    let moved = before.iter().zip(smoothed.points.iter()).map(|(from, to)| Vec3::from_array(*from).distance(to.into()));
    assert!(moved.fold(0.0, f32::max) > 1e-3);
    assert!((0..7200).all(|i| (smoothed.points.get(i)[2] - place(i).2).abs() < 2e-4));
}

#[test]
fn few_and_equal_points_are_no_problem() {
    for count in [0, 1, 2, 5, 17] {
        let points: Vec<[f32; 3]> = (0..count).map(|i| [0.01 * (i / 2) as f32, 0.0, 1.0]).collect();
        let smoothed = smooth(PointsView::from_rows(&points).unwrap(), &settings("engine=cpu even=true")).unwrap();
        assert!((0..count).all(|i| smoothed.points.get(i).iter().all(|value| value.is_finite())));
    }
}

#[test]
fn frames_in_flight_refuse_it_and_frames_on_a_grid_ignore_it() {
    let points = noisy_sphere(0.01);
    let cloud = PointCloud::new(points.iter().copied().collect());
    let mut session = Session::new(settings("engine=cpu even=true")).unwrap();
    let error = session.submit(Arc::new(cloud), Smoothed::default()).unwrap_err().to_string();
    assert!(error.contains("even = true is not allowed: only for clouds that are smoothed one by one"), "{error}");
    assert_eq!(settings("even=true").unused_by_frames(), ["even"]);
    assert!(!settings("even=true").rebuilds_grid() && settings("even=false").rebuilds_grid());
    let mut session = Session::new(settings("engine=cpu even=true")).unwrap();
    session.set_outputs(Outputs::POINTS.with_curvature(true));
    let mut smoothed = Smoothed::default();
    session.smooth(PointsView::from_rows(&points).unwrap(), &mut smoothed).unwrap();
    assert!(smoothed.normals.is_none() && smoothed.curvature.is_some());
    assert_eq!(session.outputs(), Outputs::POINTS.with_curvature(true));
}
