//! The reference engine on surfaces whose exact shape is known.

use planish::{
    CloudParams, Edges, FrameParams, FrameRadius, OrganizedCloud, PointCloud, Smoothed, Smoother, SmootherOptions,
    Status, Xyz, auto_choice, gpu_adapters,
};
use planish_tests::engines::TestEngine;
use planish_tests::scenes::{grid, height_field};

fn smooth(cloud: &OrganizedCloud, params: FrameParams) -> Smoothed {
    TestEngine::REFERENCE.smooth(cloud, params)
}

fn params(degree: u32) -> FrameParams {
    FrameParams::paper().with_degree(degree)
}

/// Returns the largest distance of the inner points (whole windows) from the surface to which `distance` measures.
fn worst(cloud: &OrganizedCloud, smoothed: &Smoothed, distance: impl Fn([f64; 3]) -> f64) -> f64 {
    let (width, height) = (cloud.width(), cloud.height());
    let inner =
        (0..width * height).filter(|i| (4..width - 4).contains(&(i % width)) && (4..height - 4).contains(&(i / width)));
    inner.map(|i| distance(smoothed.points.get(i).map(f64::from)).abs()).fold(0.0, f64::max)
}

#[test]
fn a_plane_stays_where_it_is_at_every_degree() {
    for degree in 1..=3 {
        let plane = height_field(41, 0.003, |x, y| 1.0 + 0.3 * x - 0.2 * y);
        let smoothed = smooth(&plane, params(degree));
        let slope = (1.0f64 + 0.09 + 0.04).sqrt();
        // The input itself is rounded to f32, whose error at 1 m is up to 6e-8 m.
        assert!(worst(&plane, &smoothed, |[x, y, z]| (z - 1.0 - 0.3 * x + 0.2 * y) / slope) < 1e-7);
        let normals = smoothed.normals.unwrap();
        let n = normals.get(20 * 41 + 20).map(f64::from);
        for (component, expected) in n.into_iter().zip([0.3 / slope, -0.2 / slope, -1.0 / slope]) {
            assert!((component - expected).abs() < 1e-5, "{n:?}");
        }
        assert!(smoothed.curvature.unwrap()[20 * 41 + 20] < 1e-9);
        assert_eq!(smoothed.status.unwrap()[20 * 41 + 20], Status::of_degree(degree));
    }
}

#[test]
fn a_sphere_keeps_its_radius_from_degree_2_on() {
    // The radius is 0.1 m and a window reaches 9 mm. A plane fit cuts off about half of the cap's height; a parabola
    // deviates from the sphere only in the fourth order.
    let sphere = height_field(41, 0.003, |x, y| 1.1 - (0.01 - x * x - y * y).max(0.0).sqrt());
    let distance = |[x, y, z]: [f64; 3]| (x * x + y * y + (z - 1.1) * (z - 1.1)).sqrt() - 0.1;
    let inner = |degree| {
        let smoothed = smooth(&sphere, params(degree));
        let near = (0..41 * 41usize).filter(|i| (i % 41).abs_diff(20).max((i / 41).abs_diff(20)) <= 8);
        near.map(|i| distance(smoothed.points.get(i).map(f64::from)).abs()).fold(0.0, f64::max)
    };
    let errors = [1, 2, 3].map(inner);
    assert!((1e-4..4e-4).contains(&errors[0]), "{errors:?}");
    assert!(errors[1] < 1e-5 && errors[2] < 1e-5, "{errors:?}");
}

#[test]
fn a_quadratic_surface_is_reproduced_from_degree_2_on() {
    let quadratic = |x: f64, y: f64| 1.0 + 2.0 * x * x - 1.5 * x * y + y * y;
    let cloud = height_field(31, 0.002, quadratic);
    let distance = |[x, y, z]: [f64; 3]| z - quadratic(x, y);
    let errors = [1, 2, 3].map(|degree| worst(&cloud, &smooth(&cloud, params(degree)), distance));
    // At degree 1, the error is the mean of the quadratic over the window, at most 2 * 3 * (4 mm)². At higher
    // degrees, the ridge of 1e-3 leaves about 2 % of that error, in proportion to the ridge.
    assert!((2e-5..1e-4).contains(&errors[0]), "{errors:?}");
    assert!(errors[1] < 2e-6, "{errors:?}");
    assert!(errors[2] < 2e-6, "{errors:?}");
    let damped = worst(&cloud, &smooth(&cloud, params(2).with_ridge(1e-2)), distance);
    assert!((5.0 * errors[1]..12.0 * errors[1]).contains(&damped), "{damped} {errors:?}");
}

#[test]
fn the_normals_of_a_cubic_surface_need_degree_3() {
    // In a symmetric window, a cubic term changes the slope, not the height.
    let cubic = |x: f64, y: f64| 1.0 + 30.0 * x * x * x - 20.0 * x * y * y;
    let cloud = height_field(31, 0.002, cubic);
    let worst_normal_rad = |degree| {
        let normals = smooth(&cloud, params(degree)).normals.unwrap();
        let angle = |(u, v): (usize, usize)| {
            let [x, y] = [u, v].map(|pixel| (pixel as f64 - 15.0) * 0.002);
            let slopes = [90.0 * x * x - 20.0 * y * y, -40.0 * x * y];
            let length = (1.0 + slopes[0] * slopes[0] + slopes[1] * slopes[1]).sqrt();
            let n = normals.get(v * 31 + u).map(f64::from);
            let off = [n[0] - slopes[0] / length, n[1] - slopes[1] / length, n[2] + 1.0 / length];
            off.iter().map(|c| c * c).sum::<f64>().sqrt()
        };
        (4..27).flat_map(|v| (4..27).map(move |u| (u, v))).map(angle).fold(0.0, f64::max)
    };
    let errors = [2, 3].map(worst_normal_rad);
    assert!((5e-4..5e-3).contains(&errors[0]), "{errors:?}");
    assert!(errors[1] < 2e-4, "{errors:?}");
}

#[test]
fn too_few_neighbours_lines_and_small_neighbourhoods_have_their_status() {
    let nan = [f32::NAN; 3];
    let at = |u: usize, v: usize| [0.002 * u as f32, 0.002 * v as f32, 1.0];
    let status_of = |keep: &dyn Fn(usize, usize) -> bool| {
        let cloud = grid(9, 9, |u, v| if keep(u, v) { at(u, v) } else { nan });
        let smoothed = smooth(&cloud, FrameParams::paper());
        let (status, neighbours) = (smoothed.status.unwrap()[4 * 9 + 4], smoothed.neighbours.unwrap()[4 * 9 + 4]);
        (status, neighbours, smoothed.points.get(4 * 9 + 4))
    };
    // Two neighbours are too few, so the point becomes a hole.
    let (status, neighbours, point) = status_of(&|u, v| (u, v) == (4, 4) || (u, v) == (5, 4));
    assert_eq!((status, neighbours), (Status::TooFew, 2));
    assert!(point[0].is_nan());
    // A row of points is a line, so the point stays.
    let (status, neighbours, point) = status_of(&|_, v| v == 4);
    assert_eq!((status, neighbours, point), (Status::Degenerate, 7, at(4, 4)));
    // 3 to 5 neighbours allow a plane, 6 to 9 degree 2, 10 or more degree 3.
    let spots = [(4, 4), (5, 4), (4, 5), (6, 5), (5, 6), (3, 3), (2, 4), (4, 2), (6, 3), (3, 6)];
    for n in 3..=10 {
        let (status, neighbours, _) = status_of(&|u, v| spots[..n].contains(&(u, v)));
        let expected = Status::of_degree(if n < 6 {
            1
        } else if n < 10 {
            2
        } else {
            3
        });
        assert_eq!((status, neighbours as usize), (expected, n));
    }
}

#[test]
fn no_point_moves_further_than_the_radius() {
    // The polynomial could run away between these separate patches.
    let cloud = grid(40, 40, |u, v| {
        let jitter = ((u * 7919 + v * 104729) % 17) as f32 * 1e-3;
        [0.003 * u as f32, 0.003 * v as f32, 1.0 + jitter + if u % 5 < 2 { 0.01 } else { 0.0 }]
    });
    for (radius_m, edges) in
        [0.005, 0.01, 0.02].into_iter().flat_map(|radius_m| [Edges::Off, Edges::Robust].map(|edges| (radius_m, edges)))
    {
        let params = FrameParams::paper().with_radius(FrameRadius::Fixed { radius_m }).with_edges(edges);
        let smoothed = smooth(&cloud, params);
        for (p, q) in cloud.positions().iter().zip(smoothed.points.iter()) {
            let moved = (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f32>().sqrt();
            assert!(q[0].is_nan() || moved <= radius_m + 1e-6);
        }
    }
}

#[test]
fn the_sensor_radius_follows_the_rule() {
    // At 1 m, 49 candidates at stride 3 and pitch 2 mm reach 25 mm diagonally; the radius is 2 * 9 * 2 mm = 36 mm. A
    // point 32 mm in front (r = 35 mm there) therefore has neighbours, and one 37 mm in front has only itself.
    let neighbours = |lift: f32| {
        let cloud = grid(41, 41, |u, v| {
            let z = if (u, v) == (20, 20) { 1.0 - lift } else { 1.0 };
            [(u as f32 - 20.0) * 0.002 * z, (v as f32 - 20.0) * 0.002 * z, z]
        });
        let smoothed = smooth(&cloud, FrameParams::default().with_window(3).with_stride(3).with_average_blocks(false));
        smoothed.neighbours.unwrap()[20 * 41 + 20]
    };
    assert_eq!(neighbours(0.0), 49);
    assert!(neighbours(0.032) > 1);
    assert_eq!(neighbours(0.037), 1);
}

#[test]
fn a_general_cloud_keeps_order_count_and_survives_repeated_coordinates() {
    // 40,000 points on the plane z = 1, and 1,000 at one position, which trees that split on coordinates handle
    // badly.
    let mut points: Vec<[f32; 3]> =
        (0..40_000).map(|i| [(i % 200) as f32 * 0.01, (i / 200) as f32 * 0.01, 1.0]).collect();
    points.extend([[5.0, 5.0, 1.0]; 1000]);
    points.push([f32::NAN; 3]);
    let cloud = PointCloud::new(points.iter().copied().collect::<Xyz>());
    let params = CloudParams::paper().with_radius_m(0.025);
    let smoothed = TestEngine::REFERENCE.smooth(&cloud, params);
    assert_eq!((smoothed.width, smoothed.height, smoothed.points.len()), (41_001, 1, 41_001));
    let status = smoothed.status.as_ref().unwrap();
    assert_eq!(status[100 * 200 + 100], Status::Polynomial3);
    assert_eq!(smoothed.neighbours.as_ref().unwrap()[100 * 200 + 100], 21);
    assert_eq!(status[40_500], Status::Degenerate);
    assert_eq!(status[41_000], Status::Hole);
    let moved = points.iter().zip(smoothed.points.iter()).filter(|(p, q)| (p[2] - q[2]).abs() > 1e-6);
    assert_eq!(moved.count(), 0);

    let single = TestEngine { threads: Some(1), ..TestEngine::REFERENCE }.smooth(&cloud, params);
    assert_eq!(format!("{single:?}"), format!("{smoothed:?}"), "threads change nothing");
    let (chosen, _) = auto_choice(&gpu_adapters());
    let opened = Smoother::open_clouds(params, &SmootherOptions::default()).unwrap();
    assert_eq!(opened.engine(), chosen);
}
