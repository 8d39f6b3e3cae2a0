//! Formats of scanners and lidars, meshes and NumPy archives.

use std::io::{Cursor, Write};
use std::path::Path;

use e57::{E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform, Translation};
use planish::io::{self, Contents, Encoding, Format};
use planish::{AttributeValues, OrganizedCloud, PointCloud, Xyz};
use planish_tests::data::folder;

fn cloud(count: usize) -> PointCloud {
    let mut cloud = PointCloud::new((0..count).map(|i| [0.1 * i as f32, 0.25, -1.5 + i as f32]).collect());
    cloud.set_attribute("intensity", (0..count).map(|i| 0.5 * i as f32).collect::<Vec<_>>());
    cloud
}

fn write_and_read(cloud: &PointCloud, name: &str) -> (Format, PointCloud) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    io::write_cloud(&path, cloud, Encoding::Binary).unwrap();
    read(&path)
}

fn read(path: &Path) -> (Format, PointCloud) {
    match io::read(path).unwrap() {
        (format, Contents::General(cloud)) => (format, cloud),
        (format, _) => panic!("{format:?} of an unorganized cloud"),
    }
}

fn decode(bytes: &[u8], format: Format) -> Result<PointCloud, String> {
    match io::decode(bytes, Some(format)).map_err(|error| error.to_string())? {
        (_, Contents::General(cloud)) => Ok(cloud),
        _ => panic!("no unorganized cloud"),
    }
}

/// Returns an E57 file with two scans: the first turned, far away and with an invalid point; the second with colours.
fn two_scans() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
    writer.set_coordinate_metadata(Some("EPSG:25832".into()));
    writer.set_creation(Some(e57::DateTime { gps_time: 1234.5, atomic_reference: false }));
    let double = RecordDataType::Double { min: None, max: None };
    let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
    let position = || axes.clone().map(|name| Record { name, data_type: double.clone() }).to_vec();
    let state = RecordDataType::Integer { min: 0, max: 2 };
    let first = [position(), vec![Record { name: RecordName::CartesianInvalidState, data_type: state }]].concat();
    let mut scan = writer.add_pointcloud("{first}", first).unwrap();
    scan.set_name(Some("cellar".into()));
    // A rotation of 90° about z.
    let half = 0.5f64.sqrt();
    scan.set_transform(Some(Transform {
        rotation: Quaternion { w: half, x: 0.0, y: 0.0, z: half },
        translation: Translation { x: 500_000.0, y: 5_000_000.0, z: 120.0 },
    }));
    for (p, state) in [([1.0, 0.0, 0.5], 0), ([9.0, 9.0, 9.0], 2), ([0.0, 2.0, 0.25], 0)] {
        let mut values = p.map(RecordValue::Double).to_vec();
        values.push(RecordValue::Integer(state));
        scan.add_point(values).unwrap();
    }
    scan.finalize().unwrap();
    let channels = [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue];
    let channel = |name| Record { name, data_type: RecordDataType::Integer { min: 0, max: 255 } };
    let intensity = RecordDataType::ScaledInteger { min: 0, max: 4095, scale: 0.5, offset: 10.0 };
    let intensity = Record { name: RecordName::Intensity, data_type: intensity };
    let second = [position(), channels.map(channel).to_vec(), vec![intensity]].concat();
    let mut scan = writer.add_pointcloud("{second}", second).unwrap();
    let limit = |value| Some(RecordValue::ScaledInteger(value));
    scan.set_intensity_limits(Some(e57::IntensityLimits { intensity_min: limit(2), intensity_max: limit(4000) }));
    scan.set_original_guids(Some(vec!["{raw}".into()]));
    let colour = [7, 8, 9].map(RecordValue::Integer).into_iter().chain([RecordValue::ScaledInteger(80)]);
    let colour: Vec<RecordValue> = colour.collect();
    scan.add_point([&[500_003.0, 5_000_001.0, 121.0].map(RecordValue::Double)[..], &colour].concat()).unwrap();
    scan.finalize().unwrap();
    writer.finalize().unwrap();
    drop(writer);
    bytes.into_inner()
}

#[test]
fn scans_of_an_e57_are_one_cloud_in_the_frame_of_the_file_and_are_written_back_each_in_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let [input, output] = ["in.e57", "out.e57"].map(|name| folder.path().join(name));
    std::fs::write(&input, two_scans()).unwrap();
    let (format, cloud) = read(&input);
    assert_eq!((format, cloud.len(), cloud.valid_points()), (Format::E57, 4, 3));
    let at = |i: usize| [0, 1, 2].map(|axis| cloud.origin_m[axis] + f64::from(cloud.positions.get(i)[axis]));
    for (i, expected) in [(0, [500_000.0, 5_000_001.0, 120.5]), (2, [499_998.0, 5_000_000.0, 120.25])] {
        assert!(at(i).iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-6), "{:?}", at(i));
    }
    assert_eq!(at(3), [500_003.0, 5_000_001.0, 121.0]);
    let values = |name: &str| cloud.attribute(name).unwrap().values.clone();
    assert_eq!(values("scan"), AttributeValues::U16(vec![0, 0, 0, 1]));
    assert_eq!(values("green"), AttributeValues::U8(vec![0, 0, 0, 8]));

    io::write_cloud(&output, &cloud, Encoding::Binary).unwrap();
    let again = read(&output).1;
    assert_eq!((again.len(), again.valid_points(), again.origin_m), (4, 3, cloud.origin_m));
    // Compare as text, because NaN is not equal to NaN.
    assert_eq!(format!("{:?}", again.attributes), format!("{:?}", cloud.attributes));
    let reader = e57::E57Reader::from_file(&output).unwrap();
    let scans = reader.pointclouds();
    assert_eq!(scans.iter().map(|scan| scan.records).collect::<Vec<_>>(), [3, 1]);
    assert_eq!(scans[0].name.as_deref(), Some("cellar"));
    assert_eq!(scans[0].transform.as_ref().unwrap().translation.y, 5_000_000.0);
    assert_eq!(reader.coordinate_metadata(), Some("EPSG:25832"));
    assert_eq!(reader.creation().unwrap().gps_time, 1234.5);
    let limits = scans[1].intensity_limits.as_ref().unwrap();
    assert_eq!(limits.intensity_min, Some(RecordValue::Double(11.0)));
    assert_eq!(limits.intensity_max, Some(RecordValue::Double(2010.0)));
    assert_eq!(scans[1].original_guids.as_deref(), Some(&["{raw}".to_owned()][..]));
}

#[test]
fn normals_of_an_e57_are_in_the_frame_of_the_points_and_face_their_scanner() {
    // Two scanners, 100 m apart, each with a floor 1.5 m below it in the file's frame. The second scanner is turned
    // by 90° about x.
    let half = 0.5f64.sqrt();
    let scanners = [[0.0, 0.0, 1.5], [100.0, 0.0, 1.5]];
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
    for (number, [x, y, z]) in scanners.into_iter().enumerate() {
        let turn = if number == 0 { [1.0, 0.0] } else { [half, half] };
        let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
        let axis = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
        let mut scan = writer.add_pointcloud(&format!("{{{number}}}"), axes.map(axis).to_vec()).unwrap();
        scan.set_transform(Some(Transform {
            rotation: Quaternion { w: turn[0], x: turn[1], y: 0.0, z: 0.0 },
            translation: Translation { x, y, z },
        }));
        for i in 0..900 {
            let (u, v) = (0.1 * f64::from(i % 30) - 1.5, 0.1 * f64::from(i / 30) - 1.5);
            // The points of the second scan are (u, v, -1.5) rotated back by 90°.
            let p = if number == 0 { [u, v, -1.5] } else { [u, -1.5, -v] };
            scan.add_point(p.map(RecordValue::Double).to_vec()).unwrap();
        }
        scan.finalize().unwrap();
    }
    writer.finalize().unwrap();
    drop(writer);
    let mut cloud = decode(&bytes.into_inner(), Format::E57).unwrap();
    assert_eq!(cloud.scanners_m().unwrap(), scanners.map(Some));
    let mut smoothed = planish::Smoothed::default();
    let outputs = planish::Outputs::POINTS.with_normals(true);
    let options = planish::SmootherOptions::new(planish::Engine::Cpu, outputs);
    let mut smoother = planish::Smoother::open_clouds(planish::CloudParams::default(), &options).unwrap();
    smoother.smooth(planish::IntoFrame::into_frame(&cloud).unwrap(), &mut smoothed).unwrap();
    // Turn all normals away from their scanners; `apply` must turn them back.
    let normals = smoothed.normals.as_mut().unwrap();
    for i in 0..normals.len() {
        let n = normals.get(i);
        normals.set(i, if n[2] > 0.0 { n.map(|value| -value) } else { n });
    }
    cloud.apply(&smoothed, outputs).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("n.e57");
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    let again = read(&path).1;
    for cloud in [&cloud, &again] {
        let AttributeValues::F32(up) = &cloud.attribute("normal_z").unwrap().values else { panic!("f32") };
        assert!(up.iter().all(|z| *z > 0.999), "up in the file's frame");
    }
    // The file has normals in the frames of the scans, like the points.
    let mut reader = e57::E57Reader::from_file(&path).unwrap();
    let scans = reader.pointclouds();
    let place = scans[1]
        .prototype
        .iter()
        .position(|record| matches!(&record.name, RecordName::Unknown { name, .. } if name == "normalY"));
    let first = reader.pointcloud_raw(&scans[1]).unwrap().next().unwrap().unwrap();
    let RecordValue::Single(y) = first[place.unwrap()] else { panic!("single") };
    assert!(y > 0.999, "{y}");
}

#[test]
fn arrays_that_name_the_same_are_all_kept() {
    let mut cloud = cloud(3);
    let vector = |name: &str, first: u8| planish::Attribute {
        name: name.into(),
        count: 3,
        values: (first..first + 9).collect::<Vec<u8>>().into(),
    };
    cloud.attributes = vec![vector("rgb", 1), vector("colors", 20)];
    cloud.set_attribute("red", vec![7.5f32, 8.5, 9.5]);
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["a.npz", "b.npz"].map(|name| folder.path().join(name));
    io::write_cloud(&first, &cloud, Encoding::Binary).unwrap();
    let read_once = read(&first).1;
    assert_eq!(read_once.attributes.len(), 3, "{:?}", read_once.attributes);
    assert_eq!(read_once.attribute("red"), cloud.attribute("red"));
    cloud.attributes.truncate(2);
    io::write_cloud(&first, &cloud, Encoding::Binary).unwrap();
    let read_once = read(&first).1;
    io::write_cloud(&second, &read_once, Encoding::Binary).unwrap();
    let twice = read(&second).1;
    assert_eq!(twice.attributes, read_once.attributes);
    assert_eq!(twice.attribute("blue").unwrap().values, vec![3u8, 6, 9].into());
    assert_eq!(twice.attribute("colors"), cloud.attribute("colors"));
    // The order of the arrays does not matter.
    cloud.attributes.reverse();
    io::write_cloud(&first, &cloud, Encoding::Binary).unwrap();
    let other_order = read(&first).1;
    assert_eq!(other_order.attribute("blue"), twice.attribute("blue"));
    assert_eq!(other_order.attribute("colors"), twice.attribute("colors"));
}

#[test]
fn scans_with_invalid_poses_are_refused_and_a_rotation_of_zero_is_noted_once() {
    let read = |w: f64, x_m: f64| {
        let mut bytes = Cursor::new(Vec::new());
        let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
        for scan in ["{a}", "{b}"] {
            let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
            let axis = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
            let mut scan = writer.add_pointcloud(scan, axes.map(axis).to_vec()).unwrap();
            scan.set_transform(Some(Transform {
                rotation: Quaternion { w, x: 0.0, y: 0.0, z: 0.0 },
                translation: Translation { x: x_m, y: 0.0, z: 0.0 },
            }));
            scan.add_point([1.0, 2.0, 3.0].map(RecordValue::Double).to_vec()).unwrap();
            scan.finalize().unwrap();
        }
        writer.finalize().unwrap();
        drop(writer);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.e57");
        std::fs::write(&path, bytes.into_inner()).unwrap();
        io::read_file(&path, &io::ReadOptions::default()).map_err(|error| error.to_string())
    };
    assert_eq!(read(1.0, 5.0).unwrap().notes, Vec::<String>::new());
    let unset = read(0.0, 5.0).unwrap();
    assert_eq!(unset.notes, ["scans whose rotation is zero are read without rotation"]);
    let io::Contents::General(cloud) = unset.contents else { panic!() };
    let second = [0, 1, 2].map(|axis| cloud.origin_m[axis] + f64::from(cloud.positions.get(1)[axis]));
    assert_eq!(second, [6.0, 2.0, 3.0]);
    for (w, x_m, expected) in [(2.0, 5.0, "length 1"), (f64::NAN, 5.0, "length 1"), (1.0, f64::NAN, "position")] {
        let error = read(w, x_m).unwrap_err();
        assert!(error.contains("a scan has an invalid pose") && error.contains(expected), "{error}");
    }
}

#[test]
fn what_is_left_out_of_a_file_is_noted() {
    let folder = tempfile::tempdir().unwrap();
    let notes = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        io::read_file(&path, &io::ReadOptions::default()).unwrap().notes
    };
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
    let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
    let axis = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
    let mut scan = writer.add_pointcloud("{scan}", axes.map(axis).to_vec()).unwrap();
    scan.add_point([1.0, 2.0, 3.0].map(RecordValue::Double).to_vec()).unwrap();
    scan.finalize().unwrap();
    let mut image = writer.add_image("{image}").unwrap();
    let properties = e57::VisualReferenceImageProperties { width: 1, height: 1 };
    image.add_visual_reference(e57::ImageFormat::Png, &mut &[1u8, 2, 3, 4][..], properties, None).unwrap();
    image.finalize().unwrap();
    writer.finalize().unwrap();
    drop(writer);
    assert_eq!(notes("a.e57", &bytes.into_inner()), ["an image is dropped"]);
    assert_eq!(notes("a.xyz", b"# by hand\n1 2 3\n4 5 6 # here\n# end\n"), ["3 comments are dropped"]);
    let rounded = "the column id has integers beyond 2^53, which are rounded";
    assert_eq!(notes("id.csv", b"x,y,z,id,far\n1,2,3,9007199254740993,1e20\n"), [rounded]);
    assert_eq!(notes("a.csv", b"x,y,z\n1,2,3\n"), Vec::<String>::new());
    let mesh = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float \
                z\nelement face 1\n\
                property list uchar int vertex_indices\nend_header\n0 0 1\n1 0\n";
    assert_eq!(notes("a.ply", mesh.as_bytes()), ["elements other than vertices are dropped: face (1)"]);
}

#[test]
fn any_field_goes_through_an_e57() {
    let mut cloud = cloud(5);
    cloud.set_attribute("label", vec![1u8, 2, 3, 4, 250]);
    cloud.set_attribute("normal_x", vec![0.5f32; 5]);
    cloud.set_attribute("gps_time", vec![1e9 + 0.25; 5]);
    cloud.set_attribute("reflectance", vec![-3i16, 2, 1, 0, 5]);
    // A name that XML does not allow.
    cloud.set_attribute("-1e300rgb", vec![7.0f32; 5]);
    let again = write_and_read(&cloud, "cloud.e57").1;
    assert_eq!(again.positions, cloud.positions);
    assert_eq!(again.attribute("normal_x"), cloud.attribute("normal_x"));
    for (name, expected) in [("label", [1.0, 2.0, 3.0, 4.0, 250.0]), ("reflectance", [-3.0, 2.0, 1.0, 0.0, 5.0])] {
        let found = match &again.attribute(name).unwrap().values {
            AttributeValues::U8(values) => values.iter().map(|&value| f64::from(value)).collect::<Vec<_>>(),
            AttributeValues::I32(values) => values.iter().map(|&value| f64::from(value)).collect(),
            other => panic!("{name}: {other:?}"),
        };
        assert_eq!(found, expected);
    }
    assert_eq!(again.attribute("gps_time"), cloud.attribute("gps_time"));
    assert_eq!(again.attribute("_-1e300rgb").unwrap().values, AttributeValues::F32(vec![7.0; 5]));
}

#[test]
fn real_e57_files_are_read_or_refused() {
    let Some(data) = folder("real E57 files") else { return };
    let read = |name: &str| io::read(&data.join("readers").join(name)).map_err(|error| error.to_string());
    let (format, Contents::General(cloud)) = read("tinyCartesianFloatRgb.e57").unwrap() else { panic!("no cloud") };
    assert!(format == Format::E57 && cloud.rgb().is_some() && cloud.valid_points() == cloud.len() && cloud.len() > 1);
    let error = read("corrupt_crc.e57").err().unwrap();
    assert!(error.contains("damaged E57") && error.len() < 400, "{error}");
    // A file that other readers could not read.
    assert!(read("read_error.e57").is_ok_and(|(_, contents)| contents.shape().0 > 1000));
    // Whatever the contents, reading must not panic.
    let _ = read("empty_pc.e57");
}

#[test]
fn an_archive_has_its_fields_and_its_grid() {
    let mut cloud = cloud(6);
    cloud.set_attribute("label", vec![1u8, 2, 3, 4, 5, 6]);
    let (format, again) = write_and_read(&cloud, "cloud.npz");
    assert_eq!((format, &again.positions, &again.attributes), (Format::Npz, &cloud.positions, &cloud.attributes));

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("grid.npz");
    let organized = OrganizedCloud::new(3, 2, cloud.clone()).unwrap();
    io::write_cloud(&path, &organized, Encoding::Binary).unwrap();
    let (_, Contents::Organized(again)) = io::read(&path).unwrap() else { panic!("the grid is lost") };
    assert_eq!((again.width(), &again.points.attributes), (3, &cloud.attributes));
}

#[test]
fn lidar_scans_are_told_apart_by_their_names() {
    let mut cloud = cloud(7);
    let (format, again) = write_and_read(&cloud, "000000.bin");
    assert_eq!((format, &again.positions, &again.attributes), (Format::KittiBin, &cloud.positions, &cloud.attributes));
    cloud.set_attribute("ring", vec![3.0f32; 7]);
    let (format, again) = write_and_read(&cloud, "000000.pcd.bin");
    assert_eq!((format, &again.attributes), (Format::NuScenesBin, &cloud.attributes));
    assert!(decode(&[0; 33], Format::KittiBin).unwrap_err().contains("33 bytes"));
    let folder = tempfile::tempdir().unwrap();
    let error = io::write_cloud(&folder.path().join("a.bin"), &cloud, Encoding::Binary).unwrap_err();
    assert!(error.to_string().contains("the field ring"), "{error}");
}

#[test]
fn vertices_of_meshes_are_points() {
    let obj = b"# a mesh\nmtllib x\nv 0 0 1 1 0 0.5\nv 1.5 0 0 0 0 0\nvn 0 0 1\nvt 0 0\nf 1 2 2\n";
    let cloud = decode(obj, Format::Obj).unwrap();
    assert_eq!(cloud.positions, Xyz::from_iter([[0.0, 0.0, 1.0], [1.5, 0.0, 0.0]]));
    assert_eq!(cloud.rgb().unwrap(), [[255, 0, 128], [0, 0, 0]]);
    assert!(decode(b"v 1 2\n", Format::Obj).unwrap_err().contains("line 1"));
    assert!(decode(b"f 1 2 3\n", Format::Obj).unwrap_err().contains("has no vertices"));

    let corners = [[0.0f32; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0; 3]];
    let text: String = corners
        .chunks(3)
        .map(|triangle| {
            let lines: String = triangle.iter().map(|[x, y, z]| format!("vertex {x} {y} {z}\n")).collect();
            format!("facet normal 0 0 1\nouter loop\n{lines}endloop\nendfacet\n")
        })
        .collect();
    let mut binary = vec![b' '; 80];
    binary.extend_from_slice(&2u32.to_le_bytes());
    for triangle in corners.chunks(3) {
        let values =
            [[0.0; 3]].iter().chain(triangle).flatten().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        binary.extend([&values[..], &[0, 0]].concat());
    }
    for bytes in [format!("solid a\n{text}endsolid a\n").into_bytes(), binary.clone()] {
        let cloud = decode(&bytes, Format::Stl).unwrap();
        assert_eq!(cloud.positions, Xyz::from_iter([corners[0], corners[1], corners[2], corners[5]]));
    }
    assert!(decode(&binary[..binary.len() - 1], Format::Stl).unwrap_err().contains("2 triangles"));
}

#[test]
fn files_of_other_programs_say_what_converts_them() {
    let folder = tempfile::tempdir().unwrap();
    for (name, expected) in
        [("scan.fls", "export E57"), ("run.bag", "ROS"), ("mesh.fbx", "PLY"), ("a.ptg", "CloudCompare")]
    {
        let path = folder.path().join(name);
        std::fs::write(&path, [7u8; 64]).unwrap();
        let error = io::read(&path).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_pts_with_fewer_points_than_it_announces_is_cut_short() {
    assert_eq!(decode(b"2\n0 0 1 5\n1 0 1 6\n", Format::Text).unwrap().len(), 2);
    assert!(decode(b"3\n0 0 1 5\n1 0 1 6\n", Format::Text).unwrap_err().contains("states 3 points, but has 2"));
}

#[test]
fn points_that_are_left_where_they_are_keep_every_digit_of_f64() {
    // A tile in UTM coordinates with a stray point at the origin, which must not cost the others their digits.
    let far = |i: usize| [518_972.989 + 0.137 * i as f64, 5_006_236.629 - 9.31 * i as f64, 42.333 + 0.001 * i as f64];
    let points: Vec<[f64; 3]> = std::iter::once([0.0; 3]).chain((0..2000).map(far)).collect();
    let folder = tempfile::tempdir().unwrap();
    let text: String = points.iter().map(|[x, y, z]| format!("{x:.3} {y:.3} {z:.3}\n")).collect();
    std::fs::write(folder.path().join("in.xyz"), text).unwrap();
    for name in ["a.npy", "a.pcd", "a.e57", "a.laz"] {
        let path = folder.path().join(name);
        io::write_cloud(
            &path,
            &read(&folder.path().join("in.xyz")).1.select(&(1..2001).collect::<Vec<_>>()),
            Encoding::Binary,
        )
        .unwrap();
        let again = folder.path().join(format!("again-{name}"));
        io::write_cloud(&again, &read(&path).1, Encoding::Binary).unwrap();
        let csv = folder.path().join("out.csv");
        io::write_cloud(&csv, &read(&again).1, Encoding::Binary).unwrap();
        let text = std::fs::read_to_string(&csv).unwrap();
        for (line, p) in text.lines().skip(1).zip(&points[1..]) {
            let found: Vec<f64> = line.split(',').take(3).map(|cell| cell.parse().unwrap()).collect();
            for axis in 0..3 {
                assert!((found[axis] - (p[axis] * 1e3).round() / 1e3).abs() < 1e-6, "{name}: {line} for {p:?}");
            }
        }
    }
}

#[test]
fn arrays_of_numpy_users_become_normals_colours_and_points_in_any_order() {
    let mut cloud = cloud(4);
    for name in ["red", "green", "blue"] {
        cloud.set_attribute(name, vec![1u8, 2, 3, 200]);
    }
    for (name, value) in [("normal_x", 0.0f32), ("normal_y", 0.6), ("normal_z", -0.8)] {
        cloud.set_attribute(name, vec![value; 4]);
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.npz");
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let has = |name: &[u8]| bytes.windows(name.len()).any(|window| window == name);
    assert!(has(b"normals.npy") && has(b"rgb.npy") && !has(b"red.npy"));
    let again = read(&path).1;
    assert_eq!(again.rgb().unwrap(), cloud.rgb().unwrap());
    assert_eq!(again.attribute("normal_y"), cloud.attribute("normal_y"));

    // Column-major order, as in a transposed numpy array.
    let header = "{'descr': '<f4', 'fortran_order': True, 'shape': (2, 3), }";
    let mut npy = [b"\x93NUMPY\x01\x00", &(118u16).to_le_bytes()[..], format!("{header:<117}\n").as_bytes()].concat();
    npy.extend([1.0f32, 2.0, 10.0, 20.0, 100.0, 200.0].into_iter().flat_map(f32::to_le_bytes));
    assert_eq!(decode(&npy, Format::Npy).unwrap().positions, Xyz::from_iter([[1.0, 10.0, 100.0], [2.0, 20.0, 200.0]]));
}

#[test]
fn texts_and_records_beside_the_points_of_an_npz_are_left_out_and_said() {
    let cloud = PointCloud::new([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]].into_iter().collect());
    let array = |descr: &str, shape: &str| {
        let dict = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
        [b"\x93NUMPY\x01\x00", &(dict.len() as u16).to_le_bytes()[..], dict.as_bytes(), &[0; 64]].concat()
    };
    let arrays = [
        ("points.npy", io::encode_cloud(Format::Npy, &cloud, Encoding::Binary).unwrap()),
        ("units.npy", array("'<U1'", "()")),
        ("names.npy", array("[('a', '<f4')]", "(2,)")),
        ("label.npy", array("'|u1'", "(2,)")),
        ("other.npy", array("'|u1'", "(3,)")),
    ];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.npz");
    let mut writer = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    for (name, bytes) in arrays {
        writer.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        writer.write_all(&bytes).unwrap();
    }
    writer.finish().unwrap();
    let io::FileRead { contents, notes, .. } = io::read_file(&path, &io::ReadOptions::default()).unwrap();
    let Contents::General(read) = contents else { panic!("a cloud") };
    let names: Vec<&str> = read.attributes.iter().map(|attribute| attribute.name.as_str()).collect();
    assert_eq!((read.positions, names), (cloud.positions, vec!["label"]));
    let left_out = ["units", "names", "other"].iter().zip(&notes).all(|(name, note)| note.contains(name));
    assert!(left_out && notes.len() == 3, "{notes:?}");
    assert!(notes[2].contains("[3]") && notes[2].contains("2 points"), "{notes:?}");
}

/// Returns an E57 file of `scans` scans with one point and `fields` fields each; the names of the fields differ in
/// every scan.
fn with_many_fields(scans: usize, fields: usize) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
    writer.register_extension(e57::Extension::new("own", "https://example.com/own")).unwrap();
    let single = RecordDataType::Single { min: None, max: None };
    for scan in 0..scans {
        let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
        let own = (0..fields)
            .map(|field| RecordName::Unknown { namespace: "own".into(), name: format!("f{}", scan * fields + field) });
        let record = |name| Record { name, data_type: single.clone() };
        let prototype: Vec<Record> = axes.into_iter().chain(own).map(record).collect();
        let mut scan = writer.add_pointcloud(&format!("{{{scan}}}"), prototype).unwrap();
        scan.add_point(vec![RecordValue::Single(1.0); 3 + fields]).unwrap();
        scan.finalize().unwrap();
    }
    writer.finalize().unwrap();
    drop(writer);
    bytes.into_inner()
}

#[test]
fn scans_of_many_different_fields_are_bounded() {
    let cloud = decode(&with_many_fields(10, 100), Format::E57).unwrap();
    assert_eq!((cloud.len(), cloud.attributes.len()), (10, 1001));
    let error = decode(&with_many_fields(40, 100), Format::E57).unwrap_err();
    assert!(error.contains("more than 1000 different fields"), "{error}");
}
