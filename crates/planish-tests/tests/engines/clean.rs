//! Outliers, voxels and boxes, compared with the most direct computation of each.

use planish::clean::{outside_box, radius_outliers, statistical_outliers, voxel_downsample};
use planish::{AttributeValues, PointCloud, PointsView};
use planish_tests::data::bunny;
use planish_tests::scenes::{simulated, small_camera};

type Points = Vec<[f32; 3]>;

/// Returns named clouds: points of a frame with an isolated pair and a stray point, repeated points, small clouds, and
/// holes.
fn clouds() -> Vec<(&'static str, Points)> {
    let mut frame: Points = simulated(3, false, small_camera()).positions().iter().step_by(20).collect();
    frame.extend([[5.0, 5.0, 5.0], [5.0, 5.001, 5.0], [-30.0, 2.0, 1.0]]);
    let mut repeated: Points = bunny().positions.iter().collect();
    repeated.extend([[0.1, 0.1, 0.1]; 40]);
    repeated.extend([[2.0, 0.0, 0.0]; 3]);
    vec![
        ("frame", frame),
        ("bunny with repeated points", repeated),
        ("three points", vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 3.0, 0.0]]),
        ("one point", vec![[1.0, 2.0, 3.0]]),
        ("coincident points", vec![[1.0, 2.0, 3.0]; 50]),
        ("holes", vec![[f32::NAN; 3]; 20]),
        ("nothing", Vec::new()),
    ]
}

fn is_valid(p: &[f32; 3]) -> bool {
    p.iter().all(|value| value.is_finite())
}

/// Returns the squared distances of a point to all other valid points, ascending.
fn squares(points: &[[f32; 3]], i: usize) -> Vec<f64> {
    let others = (0..points.len()).filter(|&other| other != i && is_valid(&points[other]));
    let square = |other: usize| (0..3).map(|axis| f64::from(points[other][axis] - points[i][axis]).powi(2)).sum();
    let mut squares: Vec<f64> = others.map(square).collect();
    squares.sort_by(f64::total_cmp);
    squares
}

#[test]
fn statistical_outliers_are_those_of_the_definition() {
    for (name, points) in clouds() {
        for (neighbours, deviations) in [(1, 2.0), (8, 1.0), (50, 1.5)] {
            let found = statistical_outliers(&PointsView::from_rows(&points).unwrap(), neighbours, deviations).unwrap();
            // These clouds are small enough to compute the statistics from all points, not only from every n-th.
            let mean = |i: usize| {
                let nearest: Vec<f64> = squares(&points, i).into_iter().take(neighbours).collect();
                nearest.iter().map(|square| square.sqrt()).sum::<f64>() / nearest.len().max(1) as f64
            };
            let means: Vec<Option<f64>> = (0..points.len()).map(|i| is_valid(&points[i]).then(|| mean(i))).collect();
            let known: Vec<f64> = means.iter().flatten().copied().collect();
            let average = known.iter().sum::<f64>() / known.len().max(1) as f64;
            let variance =
                known.iter().map(|mean| (mean - average).powi(2)).sum::<f64>() / (known.len().max(2) - 1) as f64;
            let most = average + f64::from(deviations) * variance.sqrt();
            for (i, mean) in means.iter().enumerate() {
                let Some(mean) = mean else {
                    assert!(!found[i], "{name}: a hole is no outlier");
                    continue;
                };
                // If a mean is about equal to the threshold, rounding decides.
                if (mean - most).abs() > 1e-5 * most {
                    assert_eq!(found[i], *mean > most, "{name}, {neighbours} neighbours, point {i}: {mean} {most}");
                }
            }
        }
    }
}

#[test]
fn radius_outliers_are_those_of_the_definition() {
    for (name, points) in clouds() {
        for (radius_m, least) in [(0.01f32, 2), (0.05, 12), (1.5, 1), (100.0, 5)] {
            let found = radius_outliers(&PointsView::from_rows(&points).unwrap(), radius_m, least).unwrap();
            let most = f64::from(radius_m).powi(2);
            for i in 0..points.len() {
                let squares = if is_valid(&points[i]) { squares(&points, i) } else { vec![0.0; least] };
                if squares.iter().all(|square| (square - most).abs() > 1e-5 * most) {
                    let within = squares.iter().filter(|square| **square <= most).count();
                    assert_eq!(found[i], within < least, "{name}, {radius_m} m, point {i} has {within}");
                }
            }
        }
    }
}

#[test]
fn a_voxel_has_the_mean_of_its_points_and_fields() {
    let positions = [[0.125, 0.0, 0.25], [1.5, 0.0, 0.0], [0.375, 0.5, 0.75], [f32::NAN; 3], [-0.125, 0.0, 0.0]];
    // This point is nearer to the centroid of the first voxel than the voxel's other points.
    let positions = [&positions[..], &[[0.25, 0.25, 0.5]]].concat();
    let mut cloud = PointCloud::new(positions.into_iter().collect());
    cloud.set_attribute("intensity", vec![10u16, 7, 21, 0, 3, 16]);
    cloud.set_attribute("label", vec![4u8, 5, 9, 0, 2, 8]);
    // Text and lidar files have rings as floats.
    cloud.set_attribute("ring", vec![4.0f32, 5.0, 9.0, 0.0, 2.0, 8.0]);
    let packed = [0x0010_20ff_u32, 0x0001_0203, 0x0030_4001, 0, 0x00ff_ffff, 0x0020_3080].map(f32::from_bits);
    cloud.set_attribute("rgb", packed.to_vec());
    for (name, values) in
        [("normal_x", [1.0f32, 0.0, 0.0, 0.0, 1.0, 0.5]), ("normal_y", [0.0, 1.0, 1.0, 0.0, 0.0, 0.5])]
    {
        cloud.set_attribute(name, values.to_vec());
    }
    cloud.set_attribute("normal_z", vec![0.0f32; 6]);
    let thinned = voxel_downsample(&cloud, 1.0).unwrap();
    let found: Points = thinned.positions.iter().collect();
    // Voxels are in the order of their first points.
    assert_eq!(found, [[0.25, 0.25, 0.5], [1.5, 0.0, 0.0], [-0.125, 0.0, 0.0]]);
    let values = |name: &str| thinned.attribute(name).unwrap().values.clone();
    assert_eq!(values("intensity"), AttributeValues::U16(vec![16, 7, 3]));
    assert_eq!(values("label"), AttributeValues::U8(vec![8, 5, 2]));
    assert_eq!(values("ring"), AttributeValues::F32(vec![8.0, 5.0, 2.0]));
    let AttributeValues::F32(colour) = values("rgb") else { panic!("packed colours are floats") };
    assert_eq!(colour.iter().map(|value| value.to_bits()).collect::<Vec<_>>(), [0x0020_3080, 0x0001_0203, 0x00ff_ffff]);
    let half = 0.5f32.sqrt();
    assert_eq!(values("normal_x"), AttributeValues::F32(vec![half, 0.0, 1.0]));
    assert!(voxel_downsample(&cloud, 1e-7).is_err() && voxel_downsample(&cloud, 0.0).is_err());
    assert!(voxel_downsample(&cloud, f64::NAN).is_err());
    assert_eq!(voxel_downsample(&PointCloud::new(Default::default()), 1.0).unwrap().len(), 0);
}

#[test]
fn voxels_keep_georeferenced_coordinates_and_none_holds_two_points() {
    let mut cloud = bunny();
    cloud.origin_m = [637_000.25, 849_000.5, 400.0];
    let size = 0.02;
    let thinned = voxel_downsample(&cloud, size).unwrap();
    assert!(thinned.len() < cloud.len() / 2 && thinned.origin_m == cloud.origin_m);
    let cell = |p: [f32; 3]| [0, 1, 2].map(|k| ((cloud.origin_m[k] + f64::from(p[k])) / size).floor() as i64);
    let mut cells: Vec<_> = thinned.positions.iter().map(cell).collect();
    cells.sort_unstable();
    cells.dedup();
    assert_eq!(cells.len(), thinned.len());
    assert!(voxel_downsample(&thinned, size).unwrap().positions == thinned.positions);
}

#[test]
fn a_box_has_its_borders_inside_and_what_makes_no_sense_is_refused() {
    let points = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.1, 0.5, 0.5], [f32::NAN, 0.0, 0.0]];
    let view = PointsView::from_rows(&points).unwrap();
    assert_eq!(outside_box(&view, [0.0; 3], [1.0; 3]).unwrap(), [false, false, true, false]);
    assert!(outside_box(&view, [0.0; 3], [-1.0; 3]).is_err());
    assert!(outside_box(&view, [f64::NAN; 3], [1.0; 3]).is_err());
    assert!(statistical_outliers(&view, 0, 1.0).is_err() && statistical_outliers(&view, 5, f32::NAN).is_err());
    assert!(radius_outliers(&view, -1.0, 3).is_err() && radius_outliers(&view, 1.0, 0).is_err());
}
