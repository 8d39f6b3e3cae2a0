//! Clouds with odd values in every format: the file returns the same values, or the writer refuses.

use planish::io::{self, Contents, Encoding, ReadOptions};
use planish::{PointCloud, Precision, Xyz};
use proptest::collection::vec;
use proptest::prelude::*;

/// Extension, encoding, and the largest error of a coordinate in metres beyond the rounding to f32.
const FORMATS: [(&str, Encoding, f64); 14] = [
    ("pcd", Encoding::Ascii, 0.0),
    ("pcd", Encoding::Binary, 0.0),
    ("pcd", Encoding::BinaryCompressed, 0.0),
    ("ply", Encoding::Ascii, 0.0),
    ("ply", Encoding::Binary, 0.0),
    ("npy", Encoding::Binary, 0.0),
    ("npz", Encoding::Binary, 0.0),
    ("las", Encoding::Binary, 5.1e-4),
    ("laz", Encoding::Binary, 5.1e-4),
    ("e57", Encoding::Binary, 0.0),
    ("csv", Encoding::Binary, 1e-5),
    ("xyz", Encoding::Binary, 1e-5),
    ("pts", Encoding::Binary, 1e-5),
    ("bin", Encoding::Binary, 0.0),
];

fn odd() -> impl Strategy<Value = f32> {
    prop_oneof![
        6 => -5.0f32..5.0,
        1 => prop::sample::select(vec![0.0, -0.0, 1e-42, f32::MIN_POSITIVE, 1e-20, -1e9, 1e20, -1e38, f32::MAX, f32::MIN]),
        1 => prop::sample::select(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN]),
    ]
}

fn origin() -> impl Strategy<Value = f64> {
    prop::sample::select(vec![0.0, 0.0, -3.5, 1000.5, 485_000.25, -5_400_000.75, 1e9])
}

fn cloud() -> impl Strategy<Value = PointCloud> {
    let points = vec([odd(), odd(), odd()], 0..12);
    let name = prop::sample::select(vec!["intensity", "a b", "a,b", "\"", "x_", "rgb", "normal_x", "é", "time"]);
    let precision = prop::sample::select(vec![Precision::AsNeeded, Precision::F32, Precision::F64]);
    (points, [origin(), origin(), origin()], name, odd(), precision).prop_map(
        |(points, origin_m, name, value, precision)| {
            let mut cloud = PointCloud::new(points.into_iter().collect::<Xyz>());
            cloud.origin_m = origin_m;
            cloud.position_columns.precision = precision;
            let values: Vec<f32> = (0..cloud.len()).map(|i| if i == 0 { value } else { i as f32 }).collect();
            cloud.set_attribute(name, values);
            cloud
        },
    )
}

fn general(contents: Contents) -> PointCloud {
    match contents {
        Contents::General(cloud) => cloud,
        Contents::Organized(cloud) => cloud.points,
        contents => panic!("{contents:?}"),
    }
}

/// Returns the finite points in f64.
fn finite(cloud: &PointCloud) -> Vec<[f64; 3]> {
    let point = |i: usize| [0, 1, 2].map(|axis| cloud.coordinate(axis, i));
    (0..cloud.len()).map(point).filter(|point| point.iter().all(|value| value.is_finite())).collect()
}

fn check(cloud: &PointCloud, (extension, encoding, error_m): (&str, Encoding, f64)) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd").with_extension(extension);
    if let Err(error) = io::write_cloud(&path, cloud, encoding) {
        assert!(error.to_string().len() > 20 && !path.exists(), "{error}");
        return;
    }
    // The number of columns of a lidar's .bin cannot be detected from a few points, so state it.
    let options = ReadOptions::default().with_columns((extension == "bin").then_some(4));
    let read = io::read_with(&path, &options);
    let read = general(read.unwrap_or_else(|error| panic!("{error}: {cloud:?}")).1);
    let (meant, got) = (finite(cloud), finite(&read));
    assert_eq!(meant.len(), got.len(), "{extension}: {meant:?} {got:?}");
    for (meant, got) in meant.iter().zip(&got) {
        for axis in 0..3 {
            let origin_m = cloud.origin_m[axis];
            // Coordinates in four bytes are rounded. By default, only coordinates up to 1000 m are written in four
            // bytes.
            let size = match cloud.position_columns.precision {
                _ if extension == "bin" => meant[axis].abs(),
                Precision::F32 => meant[axis].abs(),
                _ => meant[axis].abs().min(1000.0).max((meant[axis] - origin_m).abs()),
            };
            let allowed = error_m + 2e-7 * size + 1e-12 * meant[axis].abs() + 1e-30;
            let difference = (meant[axis] - got[axis]).abs();
            assert!(difference <= allowed, "{extension} {encoding:?}: {} became {}", meant[axis], got[axis]);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn every_format_gives_back_what_was_meant_or_nothing_is_written(cloud in cloud()) {
        for format in FORMATS {
            check(&cloud, format);
        }
    }
}
