use fearless_simd::{Level, dispatch};

use super::*;

fn index_of(points: &[[f32; 3]]) -> PointIndex {
    let mut index = PointIndex::default();
    index.fill(&PointsView::from_rows(points).unwrap());
    index
}

fn scattered(count: usize) -> Vec<[f32; 3]> {
    let mut random = crate::neighbours::tests::Random(7);
    (0..count).map(|_| [random.next(), random.next(), 0.1 * random.next()]).collect()
}

#[test]
fn every_point_has_a_place_and_equal_points_share_theirs() {
    let mut points = scattered(1000);
    points[17] = [f32::NAN, 0.0, 0.0];
    points[400] = [0.0, f32::INFINITY, 0.0];
    for i in (0..1000).step_by(9) {
        points[i] = points[3];
    }
    // A stray point, and two equal points, one of which has -0 for a coordinate.
    points[5] = [1e30, -1e30, 0.0];
    points[6] = [0.0, 0.0, 0.0];
    points[7] = [-0.0, 0.0, 0.0];
    let index = index_of(&points);
    for (i, point) in points.iter().enumerate() {
        match index.place(i) {
            None => assert!(point.iter().any(|value| !value.is_finite()), "{i}"),
            Some(place) => assert_eq!(index.point(place), *point, "{i}"),
        }
    }
    assert_eq!(index.counts.iter().sum::<f32>(), 998.0);
    assert_eq!(index.len(), 998 - (index.counts[index.place(3).unwrap()] as usize - 1) - 1);
    assert!(index_of(&[]).leaves() == 0 && index_of(&[[f32::NAN; 3]; 40]).leaves() == 0);
}

#[test]
fn leaves_in_a_box_are_all_found_in_order() {
    let points = scattered(3000);
    let index = index_of(&points);
    let wanted = Bounds { low: [0.2, 0.3, 0.0], high: [0.35, 0.5, 0.06] };
    let mut found = Vec::new();
    dispatch!(Level::new(), simd => index.for_each_leaf(simd, &wanted, |leaf, _| found.push(leaf)));
    assert!(found.is_sorted());
    let within = |point: [f32; 3]| wanted.distance_squared(point) == 0.0;
    for place in 0..index.len() {
        assert!(!within(index.point(place)) || found.contains(&(place / LEAF)));
    }
    assert!(found.len() < index.leaves() / 4, "{} of {}", found.len(), index.leaves());
}

#[test]
fn the_nearest_come_first() {
    let points = scattered(500);
    let index = index_of(&points);
    let from = [0.5, 0.1, 0.2];
    let found: Vec<f32> = index.nearest(from).map(|(square, _)| square).collect();
    let mut expected: Vec<f32> =
        (0..index.len()).map(|place| Bounds::of_point(index.point(place)).distance_squared(from)).collect();
    expected.sort_by(f32::total_cmp);
    assert_eq!(found, expected);
}
