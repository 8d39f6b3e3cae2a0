//! Round trips through every format, and files in the layout of other programs.

use std::fs;
use std::path::Path;

use planish::io::{self, Contents, Encoding, Format};
use planish::{
    Attribute, AttributeValues, Camera, DepthImage, DepthView, OrganizedCloud, PointCloud, PositionColumns, Precision,
    SensorPose, Xyz,
};
use planish_tests::data::{folder, general_cloud};
use proptest::collection::vec;
use proptest::prelude::*;

/// Returns any f32 except NaN, which is not equal to itself. Other tests compare NaN by its bits.
fn real() -> impl Strategy<Value = f32> {
    prop_oneof![any::<f32>().prop_filter("NaN", |x| !x.is_nan()), Just(f32::INFINITY), -10f32..10.0, Just(0.0)]
}

fn values(len: usize) -> impl Strategy<Value = AttributeValues> {
    prop_oneof![
        vec(any::<i8>(), len).prop_map(Into::into),
        vec(any::<u8>(), len).prop_map(Into::into),
        vec(any::<i16>(), len).prop_map(Into::into),
        vec(any::<u16>(), len).prop_map(Into::into),
        vec(any::<i32>(), len).prop_map(Into::into),
        vec(any::<u32>(), len).prop_map(Into::into),
        vec(any::<i64>(), len).prop_map(Into::into),
        vec(any::<u64>(), len).prop_map(Into::into),
        vec(real(), len).prop_map(Into::into),
        vec(any::<f64>().prop_filter("NaN", |x| !x.is_nan()), len).prop_map(Into::into),
    ]
}

/// Returns a point other than the sensor's position, which would be a hole on a grid.
fn point() -> impl Strategy<Value = [f32; 3]> {
    [real(), real(), real()].prop_map(|point| if point == [0.0; 3] { [0.0, 0.0, 1.0] } else { point })
}

fn attributes(points: usize) -> impl Strategy<Value = Vec<Attribute>> {
    let attribute =
        (prop_oneof![Just("_".to_owned()), "[a-w][a-z_]{2,8}"], 1usize..4).prop_flat_map(move |(name, count)| {
            values(points * count).prop_map(move |values| Attribute { name: name.clone(), count, values })
        });
    vec(attribute, 0..4).prop_map(|mut attributes| {
        // The index makes names unique; padding keeps its name.
        for (k, attribute) in attributes.iter_mut().enumerate().filter(|(_, a)| a.name != "_") {
            attribute.name.push_str(&k.to_string());
        }
        attributes
    })
}

/// Returns a cloud on a grid, with any fields before, between and after x, y and z.
fn cloud() -> impl Strategy<Value = OrganizedCloud> {
    (1usize..9, 2usize..6).prop_flat_map(|(width, height)| {
        let n = width * height;
        (vec(point(), n), attributes(n), any::<[f32; 7]>(), any::<u64>()).prop_map(
            move |(points, attributes, viewpoint, places)| {
                let columns = attributes.len() + 3;
                let mut free: Vec<usize> = (0..columns).collect();
                let index = [0, 1, 2].map(|axis| free.remove((places >> (8 * axis)) as usize % free.len()));
                let mut cloud = PointCloud::new(points.into_iter().collect::<Xyz>());
                cloud.attributes = attributes;
                cloud.position_columns = PositionColumns { index, ..PositionColumns::default() };
                let viewpoint = viewpoint.map(|v| if v.is_finite() { f64::from(v) } else { 0.0 });
                cloud.pose = SensorPose::from_viewpoint(viewpoint);
                OrganizedCloud::new(width, height, cloud).unwrap()
            },
        )
    })
}

fn organized(path: &Path) -> OrganizedCloud {
    match io::read(path).unwrap().1 {
        Contents::Organized(cloud) => cloud,
        other => panic!("not organized: {other:?}"),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn pcd_keeps_every_field_type_count_order_and_the_viewpoint(cloud in cloud()) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.pcd");
        for encoding in [Encoding::Ascii, Encoding::Binary, Encoding::BinaryCompressed] {
            io::write_cloud(&path, &cloud, encoding).unwrap();
            prop_assert_eq!(&organized(&path), &cloud);
        }
    }

    #[test]
    fn ply_keeps_every_scalar_field_it_can_hold(mut cloud in cloud()) {
        // PLY has no padding, no 64-bit integers, and one value per property. Another test covers the pose, since it
        // is written as a matrix.
        cloud.points.attributes.retain(|a| {
            a.name != "_" && a.count == 1 && !matches!(a.values, AttributeValues::I64(_) | AttributeValues::U64(_))
        });
        cloud.points.position_columns.index = [0, 1, 2];
        cloud.points.pose = SensorPose::IDENTITY;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.ply");
        for encoding in [Encoding::Ascii, Encoding::Binary] {
            io::write_cloud(&path, &cloud, encoding).unwrap();
            prop_assert_eq!(&organized(&path), &cloud);
        }
    }

    #[test]
    fn depth_images_are_lossless(width in 1usize..20, height in 1usize..20, seed in any::<u16>()) {
        let raw = (0..width * height).map(|i| (i as u16).wrapping_mul(seed)).collect();
        let image = DepthImage { width, height, raw };
        let folder = tempfile::tempdir().unwrap();
        for name in ["depth.png", "depth.tiff", "depth.npy"] {
            let path = folder.path().join(name);
            io::write_depth(&path, &image).unwrap();
            prop_assert_eq!(io::read(&path).unwrap().1, Contents::Depth(image.clone()));
        }
    }

    #[test]
    fn npy_points_are_lossless(points in vec(point(), 12)) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.npy");
        let general = PointCloud::new(points.iter().copied().collect());
        io::write_cloud(&path, &general, Encoding::Binary).unwrap();
        prop_assert_eq!(io::read(&path).unwrap().1, Contents::General(general.clone()));
        let grid = OrganizedCloud::new(4, 3, general).unwrap();
        io::write_cloud(&path, &grid, Encoding::Binary).unwrap();
        prop_assert_eq!(organized(&path), grid);
    }

    #[test]
    fn lzf_is_lossless(data in vec(prop_oneof![Just(0u8), 0u8..4, any::<u8>()], 0..3000)) {
        let stream = planish::internal::lzf::compress(&data);
        prop_assert!(stream.len() <= data.len() + data.len() / 32 + 1);
        prop_assert_eq!(planish::internal::lzf::decompress(&stream, data.len()).unwrap(), data);
    }

    #[test]
    fn lzf_survives_any_bytes(stream in vec(any::<u8>(), 0..200), size in 0usize..5000) {
        let _ = planish::internal::lzf::decompress(&stream, size);
    }
}

#[test]
fn packed_colours_and_holes_keep_their_bits_in_every_pcd_encoding() {
    // Opaque colours are NaN as floats; 0x00000001 is denormal.
    let colours = [0xffff_0000u32, 0xff80_40c0, 0x00ff_8040, 1, 0];
    let mut points = PointCloud::new(Xyz::filled(5, f32::NAN));
    points.set_attribute("rgb", colours.map(f32::from_bits).to_vec());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("colour.pcd");
    for encoding in [Encoding::Ascii, Encoding::Binary, Encoding::BinaryCompressed] {
        io::write_cloud(&path, &points, encoding).unwrap();
        let Contents::General(read) = io::read(&path).unwrap().1 else { panic!("points") };
        let bits: Vec<u32> = match &read.attribute("rgb").unwrap().values {
            AttributeValues::F32(values) => values.iter().map(|v| v.to_bits()).collect(),
            AttributeValues::U32(values) => values.clone(),
            other => panic!("{other:?}"),
        };
        assert_eq!(bits, colours, "{encoding:?}");
        assert!((0..5).all(|i| !read.positions.is_finite(i)));
    }
}

#[test]
fn coordinates_in_f64_far_from_the_origin_keep_their_millimetres() {
    let header = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n";
    let body = "637000.123 5800000.456 120.5\n637001.127 5800001.459 121.25\n";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("far.pcd");
    fs::write(&path, format!("{header}{body}")).unwrap();
    let (format, contents) = io::read(&path).unwrap();
    assert_eq!(format, Format::Pcd);
    let Contents::General(cloud) = &contents else { panic!("points") };
    assert_eq!(cloud.origin_m, [637_000.0, 5_800_000.0, 0.0]);
    assert!((cloud.positions.x()[0] - 0.123).abs() < 1e-6);
    for name in ["again.pcd", "again.ply"] {
        let again = folder.path().join(name);
        io::write_cloud(&again, cloud, Encoding::Binary).unwrap();
        assert_eq!(io::read(&again).unwrap().1, contents);
    }
}

#[test]
fn formats_are_told_by_content_before_extension() {
    let folder = tempfile::tempdir().unwrap();
    let image = DepthImage { width: 3, height: 2, raw: vec![1, 2, 3, 4, 5, 6] };
    let png = folder.path().join("depth.png");
    io::write_depth(&png, &image).unwrap();
    let misnamed = folder.path().join("depth.pcd");
    fs::rename(&png, &misnamed).unwrap();
    assert_eq!(io::read(&misnamed).unwrap(), (Format::DepthPng, Contents::Depth(image)));
}

#[test]
fn numpys_own_files_are_read() {
    // A float64 array of shape (2, 3) and a float32 depth of shape (2, 2), as numpy.save writes them.
    let npy = |descr: &str, shape: &str, data: Vec<u8>| {
        let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
        while (header.len() + 11) % 64 != 0 {
            header.push(' ');
        }
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.bytes());
        bytes.extend(data);
        bytes
    };
    let points: Vec<u8> = [1.0f64, 2.0, 3.0, 4.0, 5.0, 6.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let (_, contents) = io::decode(&npy("<f8", "(2, 3)", points), None).unwrap();
    let mut expected = PointCloud::new([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]].into_iter().collect());
    expected.position_columns.precision = Precision::F64;
    assert_eq!(contents, Contents::General(expected));
    let depth: Vec<u8> = [1.5f32, 0.0, 2.5, 3.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let (_, contents) = io::decode(&npy("<f4", "(2, 2)", depth), None).unwrap();
    let Contents::DepthMetres { width, height, depth_m } = contents else { panic!("depth in metres") };
    let camera = Camera::new((width, height), [2.0, 2.0], [0.5, 0.5]);
    let cloud = DepthView::from_metres(&depth_m, &camera).unwrap().deproject().unwrap();
    assert_eq!(cloud.positions().get(2), [-0.25 * 2.5, 0.25 * 2.5, 2.5]);
    assert!(!cloud.positions().is_finite(1));
    // Big-endian values, and three indices of which the first varies fastest (Fortran order).
    let big_endian: Vec<u8> = [1u16, 2, 300, 4].iter().flat_map(|v| v.to_be_bytes()).collect();
    let (_, contents) = io::decode(&npy(">u2", "(2, 2)", big_endian), None).unwrap();
    assert_eq!(contents, Contents::Depth(DepthImage { width: 2, height: 2, raw: vec![1, 2, 300, 4] }));
    let (height, width) = (2, 4);
    let value = |v: usize, u: usize, axis: usize| (100 * v + 10 * u + axis) as f32;
    let by_first: Vec<u8> = (0..3)
        .flat_map(|axis| (0..width).flat_map(move |u| (0..height).map(move |v| value(v, u, axis))))
        .flat_map(f32::to_le_bytes)
        .collect();
    let fortran = npy("<f4", "(2, 4, 3)", by_first);
    let at = fortran.windows(5).position(|window| window == b"False").unwrap();
    let fortran = [&fortran[..at], b"True ", &fortran[at + 5..]].concat();
    let (_, contents) = io::decode(&fortran, None).unwrap();
    let Contents::Organized(cloud) = contents else { panic!("points on a grid") };
    for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
        assert_eq!(cloud.positions().get(v * width + u), [0, 1, 2].map(|axis| value(v, u, axis)));
    }
    assert!(io::decode(&npy("<f4", "(9, 9999999999)", vec![0; 16]), None).is_err());
    let wide: Vec<u8> = [1i32, -2, 300, 4].iter().flat_map(|value| value.to_le_bytes()).collect();
    let (_, contents) = io::decode(&npy("<i4", "(2, 2)", wide), None).unwrap();
    assert_eq!(contents, Contents::Depth(DepthImage { width: 2, height: 2, raw: vec![1, 0, 300, 4] }));
    let too_large: Vec<u8> = [1i32, 2, 3, 70_000].iter().flat_map(|value| value.to_le_bytes()).collect();
    assert!(io::decode(&npy("<i4", "(2, 2)", too_large), None).unwrap_err().to_string().contains("70000"));
    let half: Vec<u8> = [0x3c00u16; 8].iter().flat_map(|value| value.to_le_bytes()).collect();
    let (_, contents) = io::decode(&npy("<f2", "(2, 4, 1)", half), None).unwrap();
    assert_eq!(contents, Contents::DepthMetres { width: 4, height: 2, depth_m: vec![1.0; 8] });
    // Points with fields, as columns and as records.
    let rows: Vec<u8> =
        (0..20u8).flat_map(|i| [f32::from(i), 0.5, 1.5, 10.0, 20.0, 30.0]).flat_map(f32::to_le_bytes).collect();
    let (_, Contents::General(cloud)) = io::decode(&npy("<f4", "(20, 6)", rows), None).unwrap() else {
        panic!("points")
    };
    assert_eq!(cloud.rgb().unwrap()[7], [10, 20, 30]);
    let record =
        |i: u8| [f32::from(i).to_le_bytes().as_slice(), &[0; 8], &[i, 0], &[9; 4], &1.5f64.to_le_bytes()].concat();
    let records: Vec<u8> = (0..4).flat_map(record).collect();
    let typed = "[('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('ring', '<u2'), ('', '|V4'), ('t', '<f8', (1,))]";
    let mut bytes = npy("<f4", "(4,)", records);
    let at = bytes.windows(5).position(|window| window == b"'<f4'").unwrap();
    bytes.splice(at..at + 5, typed.bytes());
    let length = u16::from_le_bytes([bytes[8], bytes[9]]) + typed.len() as u16 - 5;
    bytes[8..10].copy_from_slice(&length.to_le_bytes());
    let (_, Contents::General(cloud)) = io::decode(&bytes, None).unwrap() else { panic!("points") };
    assert_eq!((cloud.positions.x()[3], cloud.attribute("ring").unwrap().values.get_f64(3)), (3.0, 3.0));
    assert_eq!(cloud.attribute("t").unwrap().values.get_f64(0), 1.5);
}

/// PCL stores one field after the other, and in each field all values of a point together.
#[test]
fn compressed_fields_of_several_values_are_laid_out_as_by_pcl() {
    let mut points = PointCloud::new([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]].into_iter().collect());
    points.attributes.push(Attribute { name: "h".into(), count: 3, values: vec![7i32, 8, 9, 10, 11, 12].into() });
    let file = io::encode_cloud(io::Format::Pcd, &points, Encoding::BinaryCompressed).unwrap();
    let header = b"DATA binary_compressed\n";
    let at = file.windows(header.len()).position(|window| window == header).unwrap() + header.len();
    let size = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
    let raw = planish::internal::lzf::decompress(&file[at + 8..at + 8 + size(at)], size(at + 4)).unwrap();
    let floats = [1f32, 4.0, 2.0, 5.0, 3.0, 6.0].map(f32::to_le_bytes);
    let integers = [7i32, 8, 9, 10, 11, 12].map(i32::to_le_bytes);
    assert_eq!(raw, [floats, integers].concat().concat());
}

#[test]
fn real_pcd_files_survive_the_way_there_and_back() {
    let Some(data) = folder("real PCD files") else { return };
    let temporary = tempfile::tempdir().unwrap();
    let path = temporary.path().join("copy.pcd");
    for name in ["kinect/office1.pcd", "kinect/milk_cartoon_all_small_clorox.pcd", "kinect/capture0001.pcd"] {
        let cloud = planish::io::read_organized(&data.join(name)).unwrap();
        for encoding in [Encoding::Binary, Encoding::BinaryCompressed] {
            io::write_cloud(&path, &cloud, encoding).unwrap();
            let copy = organized(&path);
            let bits =
                |cloud: &OrganizedCloud| cloud.positions().iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>();
            assert_eq!(bits(&copy), bits(&cloud), "{name}");
            assert_eq!(copy.points.rgb(), cloud.points.rgb(), "{name}");
        }
    }
    let bunny = general_cloud(&data, "unorganized/bun0.pcd");
    io::write_cloud(&path, &bunny, Encoding::Ascii).unwrap();
    assert_eq!(io::read(&path).unwrap().1, Contents::General(bunny));
}

#[test]
fn the_same_kinect_frame_as_tiff_and_as_pcd_is_the_same_cloud() {
    let Some(data) = folder("TIFF against PCD") else { return };
    let cloud = planish::io::read_organized(&data.join("kinect/frame_20121214T142255.814212.pcd")).unwrap();
    let tiff = data.join("kinect/frame_20121214T142255.814212_depth.tiff");
    let depth = planish::io::read_depth_frame(&tiff, Camera::kinect_v1()).unwrap().deproject().unwrap();
    for (i, (p, q)) in cloud.positions().iter().zip(depth.positions().iter()).enumerate() {
        assert_eq!(cloud.positions().is_finite(i), depth.positions().is_finite(i));
        // The driver uses another principal point, which does not change z.
        assert!(p[2].is_nan() || (p[2] - q[2]).abs() < 1e-6, "{p:?} {q:?}");
    }
}

#[test]
fn lines_of_numbers_are_read_by_names_or_a_guess_and_come_back() {
    let names = |text: &str, format: io::Format| {
        let (_, Contents::General(cloud)) = io::decode(text.as_bytes(), Some(format)).unwrap() else {
            panic!("points")
        };
        let names: Vec<String> = cloud.attributes.iter().map(|attribute| attribute.name.clone()).collect();
        (cloud, names.join(" "))
    };
    use io::Format::{Csv, Text};
    let (cloud, found) = names("1 2 3\n4 5 6\n\n", Text);
    assert_eq!((cloud.len(), found.as_str()), (2, ""));
    assert_eq!(names("# made by hand\n1 2 3 9 0 1\n4 5 6 0 1 0\n", Text).1, "red green blue");
    assert_eq!(names("1 2 3 0 0.6 0.8\n4 5 6 0 1 0\n", Text).1, "normal_x normal_y normal_z");
    assert_eq!(names("2\n1 2 3 -700 255 0 7\n4 5 6 -650.5 1 2 3\n", Text).1, "intensity red green blue");
    // After a line with the number of points, columns have the order of PTS, whatever their values.
    assert_eq!(names("2\n1 2 3 182 26 100 238\n4 5 6 7 1 2 3\n", Text).1, "intensity red green blue");
    assert_eq!(names("1 2 3 26 100 238 182\n4 5 6 7 1 2 3\n", Text).1, "red green blue intensity");
    assert_eq!(names("1 2 3 9 8\n", Text).1, "column_4 column_5");
    // A last cell may be empty, and lines may end with a separator. A line with too few cells is an error.
    let (blank, found) = names("x,y,z,class\n1,2,3,\n2,3,4,5\n", Csv);
    assert_eq!((blank.len(), found.as_str()), (2, "class"));
    assert_eq!((names("x,y,z,\n1,2,3,\n2,3,4,\n", Csv).0.len(), names("1,2,3,\n2,3,4,\n", Csv).0.len()), (2, 2));
    assert_eq!(names("//X;Y;Z;Nx;Ny;Nz\n1;2;3;0;0;1\n", Text).1, "normal_x normal_y normal_z");
    let (cloud, found) = names("id,Z,\"Y\",x\n16777217,3,2,1e0\n5,-3,-2.5,nan\n", Csv);
    assert_eq!((cloud.positions.get(0), found.as_str()), ([1.0, 2.0, 3.0], "id"));
    assert!(cloud.positions.get(1)[0].is_nan());
    let (far, _) = names("632000.12 5600000.34 120.5\n632001.12 5600001.34 121.5\n", Text);
    assert_eq!(far.origin_m, [632_000.0, 5_600_000.0, 0.0]);

    let folder = tempfile::tempdir().unwrap();
    for (cloud, name) in [(&cloud, "c.csv"), (&far, "far.xyz"), (&far, "far.csv")] {
        let path = folder.path().join(name);
        io::write_cloud(&path, cloud, Encoding::Binary).unwrap();
        let Contents::General(copy) = io::read(&path).unwrap().1 else { panic!("points") };
        assert_eq!(
            format!("{:?} {:?}", copy.positions, copy.attributes),
            format!("{:?} {:?}", cloud.positions, cloud.attributes)
        );
    }
    // Empty cells, quotes, units, a byte order mark, Windows line ends, comments after numbers.
    let (cells, found) = names("\u{feff}X [m];\"Y [m]\";Z (m);A b;c\r\n1;2;3;;5\r\n4;5;6;7;\r\n", Csv);
    assert_eq!(found, "A_b c");
    let values = |name: &str| format!("{:?}", cells.attribute(name).unwrap().values);
    assert_eq!((values("A_b").as_str(), values("c").as_str()), ("F32([NaN, 7.0])", "F32([5.0, NaN])"));
    assert_eq!(names("  # by hand\n1 2 3 # here\n", Text).0.len(), 1);
    assert_eq!(names("1 2 3 0 0 1\n4 5 6 0 0 1\n", Text).1, "normal_x normal_y normal_z");
    assert_eq!(names("x,y,z\n", Csv).0.len(), 0);
    for (text, what) in [
        ("1 2 3\n4 5\n", "line 2"),
        ("x,y,z,class\n1,2,3,4\n7,8,2\n", "line 3 has 3 values instead of 4"),
        ("1 2 3\n\n4 five 6\n", "line 3"),
        ("alpha beta\n1 2\n", "column names"),
        ("1 2\n3 4\n", "three or more numbers"),
        ("\u{0}\u{1}", "binary"),
        ("x;y;z\n0,5,1;1;2\n", "not a number"),
        ("x,y,z\n1,000.5,2,3\n", "3 column names, but 4 numbers"),
        ("x,y,z,x\n1,2,3,4\n", "two columns"),
    ] {
        let error = io::decode(text.as_bytes(), Some(Text)).unwrap_err().to_string();
        assert!(error.contains(what), "{text:?}: {error}");
    }
    // The format is found without a known extension, as from standard input.
    for text in ["1 2 3\n4 5 6\n", "x,y,z\n1,2,3\n", &"0.25 0.5 0.125\n".repeat(1000)] {
        assert_eq!(io::decode(text.as_bytes(), None).unwrap().0, Text);
    }
    assert!(io::decode(b"some words\n1 2 3\n", None).is_err());
    assert!(io::decode(b"1 2 3\n\xff\xfe 4", Some(Text)).unwrap_err().to_string().contains("line 2"));
}
