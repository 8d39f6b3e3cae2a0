//! Clouds larger than memory: tiles give the same result as the whole cloud.

use std::fs;
use std::path::{Path, PathBuf};

use planish::io::{self, Contents, Encoding};
use planish::tiles::{TileOptions, TilesReport, bytes_in_memory, smooth_tiles};
use planish::{
    AttributeValues, Engine, IntoFrame, Outputs, PointCloud, Progress, SensorPose, Settings, Smoothed, Smoother,
    SmootherOptions,
};
use planish_tests::data::folder;
use planish_tests::engines::{TestEngine, test_adapter};

fn read(path: &Path) -> PointCloud {
    match io::read(path).unwrap().1 {
        Contents::General(cloud) => cloud,
        _ => panic!("{} is an unorganized cloud", path.display()),
    }
}

/// Returns a wavy field far from the origin, denser on one side, with repeated points and a stray point, in scattered
/// order.
fn field(points: usize) -> PointCloud {
    let position = |i: usize| {
        let i = (i * 7919) % points;
        let spread = |k: f64| ((i as f64 + 0.5) * k).fract();
        let (x, y) = (spread(0.754_877_666).powi(2), spread(0.569_840_291));
        let noise = 0.01 * (spread(0.323_7) - 0.5);
        [60.0 * x, 30.0 * y, (0.3 * 60.0 * x).sin() * (0.2 * 30.0 * y).cos() + noise].map(|value| value as f32)
    };
    let mut cloud = PointCloud::new((0..points).map(position).collect());
    for i in (0..points).step_by(50) {
        let p = cloud.positions.get(i);
        cloud.positions.set(i + 1, p);
    }
    cloud.positions.as_mut_slices()[2][77] = 40.0;
    cloud.origin_m = [637_000.0, 849_000.0, 100.0];
    cloud.set_attribute("intensity", (0..points).map(|i| (i % 60_000) as u16).collect::<Vec<_>>());
    cloud.set_attribute("classification", (0..points).map(|i| (i % 19) as u8).collect::<Vec<_>>());
    cloud.set_attribute("deviation", (0..points).map(|i| 0.125 * i as f32).collect::<Vec<_>>());
    cloud
}

fn cpu() -> SmootherOptions {
    SmootherOptions::new(Engine::Cpu, Outputs::ALL)
}

const BY_DENSITY: &str = "neighbours=40";

fn parsed(settings: &str) -> Settings {
    settings.parse().unwrap()
}

fn fields() -> Outputs {
    Outputs::POINTS.with_normals(true).with_status(true)
}

fn whole(cloud: &PointCloud, settings: &str) -> PointCloud {
    whole_by(&cpu(), cloud, settings)
}

fn whole_by(smoother: &SmootherOptions, cloud: &PointCloud, settings: &str) -> PointCloud {
    let mut smoothed = Smoothed::default();
    let mut smoother = Smoother::open_clouds(parsed(settings).cloud_params().unwrap(), smoother).unwrap();
    smoother.smooth(cloud.into_frame().unwrap(), &mut smoothed).unwrap();
    let mut result = cloud.clone();
    result.apply(&smoothed, fields()).unwrap();
    result
}

/// Smooths a file in tiles and writes another file, with 1 / `share` of the memory that the whole file needs.
fn in_tiles(input: &Path, output: &Path, settings: &str, share: u64) -> TilesReport {
    in_tiles_by(cpu(), input, output, settings, share)
}

fn in_tiles_by(smoother: SmootherOptions, input: &Path, output: &Path, settings: &str, share: u64) -> TilesReport {
    let bytes = bytes_in_memory(input).unwrap() / share;
    let options = TileOptions::new(parsed(settings), smoother, bytes).with_fields(fields());
    let progress = Progress::default();
    let report = smooth_tiles(input, output, &options, &progress).unwrap();
    assert!(report.tiles as u64 >= share, "{report:?}");
    assert!((progress.share() - 1.0).abs() < 0.01, "{}", progress.share());
    report
}

/// Asserts that two clouds agree: points to about a step of the file's coordinates, almost all normals to 1e-3, and
/// all other fields exactly.
fn assert_same(found: &PointCloud, expected: &PointCloud, step_m: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    assert!((0..found.len()).all(|i| found.positions.is_finite(i) == expected.positions.is_finite(i)), "{what}");
    let coordinate =
        |cloud: &PointCloud, axis: usize, i: usize| cloud.origin_m[axis] + f64::from(cloud.positions.get(i)[axis]);
    let far =
        |i: usize| (0..3).map(|k| (coordinate(found, k, i) - coordinate(expected, k, i)).abs()).fold(0.0, f64::max);
    let steps: Vec<f64> = (0..found.len()).map(|i| far(i) / step_m).collect();
    // Coordinates between two steps may be rounded to either.
    let differing = steps.iter().filter(|&&steps| steps > 0.5).count();
    let farther = steps.iter().filter(|&&steps| steps > 1.5).count();
    assert!(differing * 5 < found.len() && farther == 0, "{what}: {differing} {farther}");
    for attribute in &expected.attributes {
        let same = found.attribute(&attribute.name).unwrap();
        if attribute.name.starts_with("normal_") {
            let (AttributeValues::F32(same), AttributeValues::F32(values)) = (&same.values, &attribute.values) else {
                panic!("normals are f32")
            };
            let off = same.iter().zip(values).filter(|(a, b)| (**a - **b).abs() > 1e-3).count();
            assert!(off * 1000 < found.len(), "{what}: {} of {off} points", attribute.name);
        } else {
            assert_eq!(same.values, attribute.values, "{what}: {}", attribute.name);
        }
    }
}

/// Asserts that the folder contains only these files.
fn assert_only(folder: &Path, files: &[&Path]) {
    let found: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(found.iter().all(|path| files.contains(&path.as_path())) && found.len() == files.len(), "{found:?}");
}

#[test]
fn tiles_give_what_the_whole_cloud_gives() {
    let folder = tempfile::tempdir().unwrap();
    let (las, laz, out) = (folder.path().join("a.las"), folder.path().join("a.laz"), folder.path().join("out.las"));
    let cloud = field(60_000);
    io::write_cloud(&las, &cloud, Encoding::Binary).unwrap();
    io::write_cloud(&laz, &cloud, Encoding::Binary).unwrap();
    for (settings, input, share) in [
        (BY_DENSITY, &laz, 4),
        ("radius=0.6", &las, 4),
        ("neighbours=40 remove_isolated=true degree=1", &las, 3),
        ("radius=0.3 degree=3", &laz, 8),
        ("neighbours=40 edges=robust", &las, 2),
        ("edges=robust radius=0.4", &laz, 4),
    ] {
        let what = format!("{settings}, {share}");
        let report = in_tiles(input, &out, settings, share);
        let expected = folder.path().join("expected.las");
        io::write_cloud(&expected, &whole(&read(input), settings), Encoding::Binary).unwrap();
        let (found, expected) = (read(&out), read(&expected));
        assert_same(&found, &expected, 1e-5, &what);
        assert_eq!(found.len() < cloud.len(), settings.contains("remove_isolated"), "{what}");
        assert_eq!((report.points, report.status_counts.iter().sum()), (cloud.len(), cloud.len()), "{what}");
        // Only a few points, such as the stray point, may reach beyond the halo of their tile.
        assert!(report.reaching_beyond < 30, "{report:?}");
        fs::remove_file(folder.path().join("expected.las")).unwrap();
        assert_only(folder.path(), &[&las, &laz, &out]);
    }
}

/// Returns the same PLY file in big-endian byte order; all of its values must have 4 bytes.
fn big_endian(ply: &[u8]) -> Vec<u8> {
    let end = b"end_header\n";
    let at = ply.windows(end.len()).position(|window| window == end).unwrap() + end.len();
    let header = std::str::from_utf8(&ply[..at]).unwrap().replace("little_endian", "big_endian");
    let values = ply[at..].chunks_exact(4).flat_map(|value| [value[3], value[2], value[1], value[0]]);
    header.into_bytes().into_iter().chain(values).collect()
}

#[test]
fn ply_in_tiles_is_the_same_with_its_holes_types_and_pose() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    // This cloud is written as doubles, because it is far from the origin.
    let far = field(30_000);
    let mut near = field(90_000);
    near.origin_m = [0.0; 3];
    // More consecutive holes than a tile has points.
    for i in (3..80_000).step_by(3).chain(50_000..80_000) {
        near.positions.as_mut_slices()[1][i] = f32::NAN;
    }
    near.attributes.retain(|attribute| attribute.name == "deviation");
    // The sensor is below, which reverses the normals.
    near.pose = SensorPose::from_viewpoint([30.0, 15.0, -50.0, 1.0, 0.0, 0.0, 0.0]);
    io::write_cloud(&file("far.ply"), &far, Encoding::Binary).unwrap();
    io::write_cloud(&file("near.ply"), &near, Encoding::Binary).unwrap();
    io::write_cloud(&file("text.ply"), &near, Encoding::Ascii).unwrap();
    fs::write(file("turned.ply"), big_endian(&fs::read(file("near.ply")).unwrap())).unwrap();
    for (name, settings) in [
        ("far.ply", BY_DENSITY),
        ("near.ply", "radius=0.8"),
        ("near.ply", "neighbours=40 remove_isolated=true"),
        ("near.ply", "sensor=exact"),
        ("text.ply", BY_DENSITY),
        ("turned.ply", BY_DENSITY),
    ] {
        let (input, out, expected) = (file(name), file("out.ply"), file("expected.ply"));
        in_tiles(&input, &out, settings, 3);
        let cloud = read(&input);
        io::write_cloud(&expected, &whole(&cloud, settings), Encoding::Binary).unwrap();
        let (found, expected) = (read(&out), read(&expected));
        assert_same(&found, &expected, 1e-5, name);
        assert_eq!((found.pose, found.position_columns), (expected.pose, expected.position_columns), "{name}");
        let is_text = |path: &Path| fs::read(path).unwrap().starts_with(b"ply\nformat ascii");
        assert_eq!(is_text(&out), is_text(&input), "{name}");
    }
    assert!(read(&file("turned.ply")).positions.x() == near.positions.x());
}

#[test]
fn ply_that_has_no_parts_is_left_to_be_read_whole() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.ply");
    let with = |elements: &str| {
        fs::write(&file, format!("ply\nformat ascii 1.0\n{elements}end_header\n0 0 1\n1 0 1\n0 1 1\n1 1 1\n")).unwrap();
        bytes_in_memory(&file)
    };
    let vertices = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n";
    assert!(with(vertices).is_some());
    assert!(with(&format!("{vertices}element face 0\nproperty list uchar int vertex_indices\n")).is_some());
    assert!(with(&format!("obj_info num_cols 2\nobj_info num_rows 2\n{vertices}")).is_none());
    assert!(with(&format!("element other 0\nproperty float a\n{vertices}")).is_none());
    assert!(with(&vertices.replace("float z", "int Z")).is_some());
    assert!(with(&vertices.replace("float z", "float w")).is_none());
    assert!(with(&vertices.replace("float z", "float y")).is_none());
    let out = folder.path().join("out.las");
    let options = TileOptions::new(parsed(BY_DENSITY), cpu(), 1 << 20);
    let error = smooth_tiles(&file, &out, &options, &Progress::default()).unwrap_err().to_string();
    assert!(error.contains(".las or .laz, or both .ply"), "{error}");
}

#[test]
fn the_largest_tile_decides_the_number_of_neighbours() {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("a.las"), folder.path().join("out.las"));
    // Waves with noise of about half the spacing.
    let noise =
        |i: usize| 0.1 * [1, 7, 31, 101].map(|k| ((k * i) as f64 * 0.414_213_562).fract() - 0.5).iter().sum::<f64>();
    let spread = |i: usize, k: f64| ((i as f64 + 0.5) * k).fract();
    let position = |i: usize| {
        let (x, y) = (20.0 * spread(i, 0.754_877_666), 20.0 * spread(i, 0.569_840_291));
        [x, y, 0.5 * (2.0 * x).sin() * (2.0 * y).cos() + noise(i)].map(|value| value as f32)
    };
    io::write_cloud(&input, &PointCloud::new((0..30_000).map(position).collect()), Encoding::Binary).unwrap();
    let report = in_tiles(&input, &out, "", 3);
    let estimate = report.cloud_estimate.unwrap();
    let count = estimate.neighbours;
    assert!(
        count > 100 && report.params == parsed(&format!("neighbours={count}")).cloud_params().unwrap(),
        "{report:?}"
    );
    let noise_m = ((0..30_000).map(|i| noise(i).powi(2)).sum::<f64>() / 3e4).sqrt();
    assert!((f64::from(estimate.noise_m) / noise_m - 1.0).abs() < 0.2, "{noise_m} {report:?}");
    let expected = folder.path().join("expected.las");
    io::write_cloud(&expected, &whole(&read(&input), &format!("neighbours={count}")), Encoding::Binary).unwrap();
    assert_same(&read(&out), &read(&expected), 1e-5, "chosen");
    // Only one pass is allowed, whatever the noise.
    let two = TileOptions::new(parsed("passes=2"), cpu(), 1 << 20);
    let error = smooth_tiles(&input, &out, &two, &Progress::default()).unwrap_err().to_string();
    assert!(error.contains("passes = 2 is not allowed: 1 for a file that is smoothed in tiles"), "{error}");
    let even = TileOptions::new(parsed("even=true"), cpu(), 1 << 20);
    let error = smooth_tiles(&input, &out, &even, &Progress::default()).unwrap_err().to_string();
    assert!(error.contains("even = true is not allowed: only for a file that fits into memory"), "{error}");
    // The preset `light` has half as many neighbours.
    let light = in_tiles(&input, &out, "preset=light", 3).params;
    assert_eq!(light, parsed(&format!("neighbours={}", count.div_ceil(2))).cloud_params().unwrap());
}

#[test]
fn a_real_scan_in_tiles_is_the_same() {
    let Some(data) = folder("an aerial scan in tiles") else { return };
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (data.join("unorganized/autzen_trim.laz"), folder.path().join("out.laz"));
    in_tiles(&input, &out, BY_DENSITY, 4);
    let expected = folder.path().join("expected.laz");
    io::write_cloud(&expected, &whole(&read(&input), BY_DENSITY), Encoding::Binary).unwrap();
    // Coordinates of this file are whole hundredths of a foot, and so are the differences.
    assert_same(&read(&out), &read(&expected), 0.01, "autzen");
}

#[test]
fn tiles_on_a_gpu_give_what_the_whole_cloud_gives_there() {
    if test_adapter().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (las, out) = (folder.path().join("a.las"), folder.path().join("out.las"));
    let cloud = field(16_000);
    io::write_cloud(&las, &cloud, Encoding::Binary).unwrap();
    let gpu = TestEngine::gpu(false).options(Outputs::ALL);
    // `in_parts` cannot hold a whole tile.
    let in_parts = TestEngine { bounds_checks: false, ..TestEngine::in_parts(2500) }.options(Outputs::ALL);
    for (settings, smoother) in [(BY_DENSITY, &gpu), ("radius=0.6", &gpu), (BY_DENSITY, &in_parts)] {
        let report = in_tiles_by(smoother.clone(), &las, &out, settings, 3);
        assert_eq!((report.engine, report.points), (Engine::Gpu, cloud.len()));
        // With radii by density, points such as the stray one reach beyond their halo; with a fixed radius, no point
        // does.
        let by_density = settings == BY_DENSITY;
        assert!(report.reaching_beyond < 30 && (report.reaching_beyond > 0) == by_density, "{report:?}");
        let expected = folder.path().join("expected.las");
        io::write_cloud(&expected, &whole_by(&gpu, &read(&las), settings), Encoding::Binary).unwrap();
        assert_same(&read(&out), &read(&expected), 1e-5, settings);
    }
}

#[test]
fn what_cannot_be_smoothed_in_tiles_is_an_error_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("a.las"), folder.path().join("out.las"));
    io::write_cloud(&input, &field(5000), Encoding::Binary).unwrap();
    let needed = bytes_in_memory(&input).unwrap();
    let smooth = |input: &Path, options: &TileOptions| {
        let result = smooth_tiles(input, &out, options, &Progress::default());
        result.expect_err("an error").to_string()
    };
    let options =
        |engine, bytes| TileOptions::new(parsed(BY_DENSITY), SmootherOptions::new(engine, Outputs::ALL), bytes);
    let found = smooth(&input, &options(Engine::Cpu, 10_000));
    let whole = format!("raise the limit (the whole file needs {} KiB)", needed.div_ceil(1 << 10));
    assert!(found.contains("a.las") && found.contains(&whole), "{found}");
    let found = smooth(&input, &options(Engine::Reference, needed / 3));
    assert!(found.contains("the CPU or GPU engine"), "{found}");
    let whole = fs::read(&input).unwrap();
    let cut = folder.path().join("cut.las");
    fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let found = smooth(&cut, &options(Engine::Cpu, needed / 3));
    assert!(found.contains("cut.las") && found.contains("cut"), "{found}");
    fs::write(&cut, "LASF").unwrap();
    assert!(smooth(&cut, &options(Engine::Cpu, needed)).contains("truncated"));
    assert!(bytes_in_memory(&cut).is_none() && bytes_in_memory(Path::new("none.las")).is_none());
    assert_only(folder.path(), &[&input, &cut]);
    // A file without points has nothing to smooth, but its output is written.
    io::write_cloud(&input, &PointCloud::new(Default::default()), Encoding::Binary).unwrap();
    smooth_tiles(&input, &out, &options(Engine::Cpu, needed), &Progress::default()).unwrap();
    assert_eq!(read(&out).len(), 0);
}

#[test]
fn normals_in_tiles_face_the_sensor_of_the_whole() {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("hall.las"), folder.path().join("out.las"));
    // The floor and the ceiling of a hall around the origin. A distant tile on its own would count as seen from
    // above.
    let spread = |i: usize, k: f64| 200.0 * ((i as f64 + 0.5) * k).fract() - 100.0;
    let position = |i: usize| {
        let z = if i.is_multiple_of(2) { -5.0 } else { 6.0 };
        [spread(i, 0.754_877_666), spread(i, 0.569_840_291), z].map(|value| value as f32)
    };
    let cloud = PointCloud::new((0..40_000).map(position).collect());
    io::write_cloud(&input, &cloud, Encoding::Binary).unwrap();
    let report = in_tiles(&input, &out, BY_DENSITY, 6);
    assert!(report.tiles > 4 && report.assumed_sensor_m.is_none() && !report.has_pose, "{report:?}");
    let smoothed = read(&out);
    let AttributeValues::F32(normals) = &smoothed.attribute("normal_z").unwrap().values else { panic!("f32") };
    let faces = |i: usize| if i.is_multiple_of(2) { normals[i] > 0.9 } else { normals[i] < -0.9 };
    assert!((0..cloud.len()).all(faces));
}

#[test]
fn what_a_file_in_tiles_says_is_kept_or_noted() {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("mesh.ply"), folder.path().join("out.ply"));
    io::write_cloud(&input, &field(40_000), Encoding::Ascii).unwrap();
    let text = fs::read_to_string(&input).unwrap();
    let face = "element face 1\nproperty list uchar int vertex_indices\nend_header";
    let text = text.replace("element vertex", "comment by hand\nelement vertex").replace("end_header", face);
    fs::write(&input, text + "3 0 1 2\n").unwrap();
    let report = in_tiles(&input, &out, BY_DENSITY, 3);
    assert!(report.tiles > 1, "{report:?}");
    assert_eq!(report.notes, ["elements other than vertices are dropped: face (1)"]);
    // The assumed sensor is above the field, in map coordinates.
    let sensor = report.assumed_sensor_m.unwrap();
    assert!(sensor[2] > 150.0 && (sensor[0] - 637_030.0).abs() < 50.0, "{sensor:?}");
    assert!(fs::read_to_string(&out).unwrap().contains("comment by hand\n"));
    let smoothed = read(&out);
    let AttributeValues::F32(normals) = &smoothed.attribute("normal_z").unwrap().values else { panic!("f32") };
    assert!(normals.iter().all(|z| z.is_nan() || *z > 0.0));
}

#[test]
fn a_file_in_parts_has_every_point_once() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("a.laz");
    io::write_cloud(&input, &field(5000), Encoding::Binary).unwrap();
    let whole = read(&input);
    let (mut parts, mut intensities) = (Vec::new(), Vec::new());
    io::read_in_parts(&input, 1800, |part| {
        parts.push(part.len());
        match &part.attribute("intensity").unwrap().values {
            AttributeValues::U16(values) => intensities.extend_from_slice(values),
            other => panic!("{other:?}"),
        }
    })
    .unwrap();
    assert_eq!(parts, [1800, 1800, 1400]);
    assert_eq!(whole.attribute("intensity").unwrap().values, AttributeValues::U16(intensities));
}

#[test]
fn points_on_the_border_of_a_tile_and_far_away_ones_end_no_run() {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("a.las"), folder.path().join("out.las"));
    // A pole on a border of the tiles has as many points as small tiles hold. One more point is at the file's origin,
    // as in real files.
    let mut cloud = field(12_000);
    let pole = (0..1500).map(|i| [30.0, 15.0, 0.001 * i as f32]);
    cloud = PointCloud::new(cloud.positions.iter().chain(pole).chain([[-637_000.0, -849_000.0, -100.0]]).collect());
    cloud.origin_m = [637_000.0, 849_000.0, 100.0];
    io::write_cloud(&input, &cloud, Encoding::Binary).unwrap();
    let needed = bytes_in_memory(&input).unwrap();
    let mut smoothed = 0;
    for share in [2, 3, 4, 6, 9] {
        let options = TileOptions::new(parsed(BY_DENSITY), cpu(), needed / share).with_fields(fields());
        match smooth_tiles(&input, &out, &options, &Progress::default()) {
            Ok(report) => {
                assert_eq!(read(&out).len(), cloud.len(), "{report:?}");
                smoothed += 1;
            }
            Err(error) => {
                assert!(error.to_string().contains("raise the limit"), "{error}")
            }
        }
    }
    assert!(smoothed > 0);
}

#[test]
fn late_returns_of_old_files_and_impossible_scales_do_not_panic() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let input = file("a.las");
    // The header of an old file counts five returns, but its records can state seven.
    let mut builder = las::Builder::from((1, 2));
    builder.point_format = las::point::Format::new(1).unwrap();
    let mut writer = las::Writer::new(std::io::Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    let cloud = field(3000);
    for p in cloud.positions.iter() {
        let [x, y, z] = p.map(f64::from);
        let gps_time = Some(0.5);
        writer
            .write_point(las::Point { x, y, z, gps_time, return_number: 1, number_of_returns: 1, ..Default::default() })
            .unwrap();
    }
    writer.close().unwrap();
    let mut bytes = writer.into_inner().unwrap().into_inner();
    let points_at = u32::from_le_bytes([bytes[96], bytes[97], bytes[98], bytes[99]]) as usize;
    bytes[points_at + 14] = 7 | 7 << 3;
    fs::write(&input, &bytes).unwrap();
    let returns = |cloud: &PointCloud| cloud.attribute("return_number").unwrap().values.clone();
    let expected = returns(&read(&input));
    for output in [file("whole.las"), file("whole.laz")] {
        io::write_cloud(&output, &read(&input), Encoding::Binary).unwrap();
        assert_eq!(returns(&read(&output)), expected);
    }
    let tiled = file("tiled.laz");
    in_tiles(&input, &tiled, "radius=1.5", 2);
    assert_eq!(returns(&read(&tiled)), expected);

    bytes[131..139].copy_from_slice(&1e300f64.to_le_bytes());
    fs::write(&input, &bytes).unwrap();
    let error = io::read(&input).unwrap_err().to_string();
    assert!(error.contains("scales and offsets"), "{error}");
    assert!(bytes_in_memory(&input).is_none());
}

#[test]
fn a_stray_point_costs_the_others_no_digit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.las");
    let mut cloud = field(2000);
    cloud.positions.as_mut_slices()[0][9] = -637_000.0;
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    let found = read(&path);
    let farthest = (0..2000).filter(|&i| i != 9).map(|i| found.positions.x()[i].abs()).fold(0.0, f32::max);
    assert!(farthest < 100.0, "{farthest}");
}
