//! Files of other programs, rebuilt from public reports of reading errors.

mod las;
mod pages;

use std::fs;

use las::las;
use planish::PointCloud;
use planish::io::{self, Contents, Encoding, FileRead, ReadOptions};

/// Writes bytes to a file with the given name and reads that file.
fn read_as(name: &str, bytes: &[u8]) -> Result<FileRead, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    io::read_file(&path, &ReadOptions::default()).map_err(|error| error.to_string())
}

fn cloud_as(name: &str, bytes: &[u8]) -> (PointCloud, Vec<String>) {
    match read_as(name, bytes) {
        Ok(FileRead { contents: Contents::General(cloud), notes, .. }) => (cloud, notes),
        other => panic!("{name}: {other:?}"),
    }
}

fn names(cloud: &PointCloud) -> Vec<&str> {
    cloud.attributes.iter().map(|attribute| attribute.name.as_str()).collect()
}

/// Writes a cloud to a file with the given name and returns the file's bytes.
fn written(cloud: &PointCloud, name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    io::write_cloud(&path, cloud, Encoding::Binary).unwrap();
    fs::read(path).unwrap()
}

/// Returns an ASCII PLY file with two points and an additional property of the given name.
fn ply_with(property: &str) -> String {
    format!(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
         property float {property}\nend_header\n1 2 3 4\n5 6 7 8\n"
    )
}

#[test]
fn names_of_ply_properties_are_any_text_without_spaces_and_come_back() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["scalar_Illuminance_(PCV)", "scalar_Coord._Z", "scalar_C2C_distances[<5]", "Intensität", "a-b/c%"] {
        let (cloud, _) = cloud_as("a.ply", ply_with(name).as_bytes());
        assert_eq!(names(&cloud), [name]);
        for encoding in [Encoding::Ascii, Encoding::Binary] {
            let path = folder.path().join("out.ply");
            io::write_cloud(&path, &cloud, encoding).unwrap();
            let Contents::General(again) = io::read(&path).unwrap().1 else { panic!("points") };
            assert_eq!(again.attributes, cloud.attributes, "{name}");
        }
        let (again, _) = cloud_as("a.csv", &written(&cloud, "out.csv"));
        assert_eq!(names(&again), [name], "through CSV");
    }
}

#[test]
fn lists_of_vertices_are_dropped_with_a_note() {
    let header = |storage: &str| {
        format!(
            "ply\nformat {storage} 1.0\nelement vertex 2\nproperty float x\nproperty list uchar int seen_by\nproperty float \
             y\nproperty float z\nend_header\n"
        )
    };
    let ascii = header("ascii") + "1 2 8 9 2 3\n4 0 5 6\n";
    let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_be_bytes()).collect::<Vec<u8>>();
    let (one, two) = ([floats(&[1.0]), vec![1, 0, 0, 0, 9], floats(&[2.0, 3.0])].concat(), floats(&[4.0]));
    let binary = [header("binary_big_endian").into_bytes(), one, two, vec![0], floats(&[5.0, 6.0])].concat();
    let over_lines = header("ascii") + "1\n2 8\n9 2 3\n4\n0\n5 6\n";
    for bytes in [ascii.as_bytes(), over_lines.as_bytes(), &binary] {
        let (cloud, notes) = cloud_as("a.ply", bytes);
        assert_eq!((cloud.positions.get(0), cloud.positions.get(1)), ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0]));
        assert_eq!(notes, ["list properties of the vertices are dropped: seen_by"]);
        assert!(read_as("a.ply", &bytes[..bytes.len() - 3]).is_err());
    }
    // A value is missing, and the next record follows.
    for body in ["1 2 8 9 2\n4 0 5 6\n7 0 8 9\n", "1 2 8\n4 0 5 6\n"] {
        assert!(read_as("a.ply", (header("ascii") + body).as_bytes()).is_err(), "{body:?}");
    }
}

#[test]
fn intensity_before_colour_is_told_from_colour_before_intensity() {
    let line = |i: u32, first: bool| {
        let (grey, intensity) = (40 + 3 * (i % 60), (97 * i) % 251);
        let colour = format!("{} {} {}", grey, grey + 4, grey + 9);
        let cells = if first { format!("{intensity} {colour}") } else { format!("{colour} {intensity}") };
        format!("{i} {} 1.5 {cells}\n", i / 7)
    };
    for (first, expected) in
        [(true, ["intensity", "red", "green", "blue"]), (false, ["red", "green", "blue", "intensity"])]
    {
        let text: String = (0..100).map(|i| line(i, first)).collect();
        assert_eq!(names(&cloud_as("a.txt", text.as_bytes()).0), expected);
    }
}

#[test]
fn points_of_an_ascii_ply_may_extend_over_lines() {
    let header = ply_with("q").replace("1 2 3 4\n5 6 7 8\n", "");
    for body in ["1 2 3\n4\n5 6 7\n8\n", "1 2 3 4 5 6 7 8\n", "1\n2\n3\n4\n5\n6\n7\n8"] {
        let (cloud, _) = cloud_as("a.ply", format!("{header}{body}").as_bytes());
        assert_eq!(cloud.positions.get(1), [5.0, 6.0, 7.0], "{body:?}");
    }
    let ind = format!("{header}1 2 3 -nan(ind)\n5 6 7 1.#QNAN\n");
    assert!(cloud_as("a.ply", ind.as_bytes()).0.attribute("q").unwrap().values.get_f64(1).is_nan());
    // Each of these files has one value too few or too many.
    for body in ["1 2 3\n5 6 7 8\n4\n", "1 2 3 4\n5 6 7\n", "1 2 3 4 9\n5 6 7 8\n", "1 2 3 4\n5 6\n7 8 9\n"] {
        assert!(read_as("a.ply", format!("{header}{body}").as_bytes()).is_err(), "{body:?}");
    }
}

#[test]
fn what_is_wrong_with_a_ply_header_is_said_in_a_sentence_with_its_line() {
    let header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    let body = "end_header\n1 2 3\n";
    for (line, problem) in [
        ("property int64 t\n", "line 7 of the PLY header, \"property int64 t\": \"int64\" is not a PLY type"),
        ("Created by a modeller\n", "line 7 of the PLY header, \"Created by a modeller\": unknown keyword"),
        ("property float a b\n", "without white space"),
        ("property list float int a\n", "the count of a list must be an integer"),
        ("element face many\n", "\"many\" is not a number of elements"),
        ("property float x\n", "two properties of element \"vertex\" have the same name, \"x\""),
        ("format ascii 2.0\n", "and version 1.0"),
    ] {
        let error = read_as("a.ply", format!("{header}{line}{body}").as_bytes()).unwrap_err();
        assert!(error.contains(problem) && !error.contains("ParseError"), "{line}: {error}");
    }
}

#[test]
fn text_in_other_encodings_is_read() {
    let ply = ply_with("q").replace("element vertex", "comment M\u{fc}ller\nelement vertex");
    let pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n\
               DATA ascii\n1 2 3\n5 6 7\n";
    let files = [
        ("a.ply", ply.as_str()),
        ("a.xyz", "# Gel\u{e4}nde\n1 2 3\n5 6 7\n"),
        ("a.csv", "x,y,z,Intensit\u{e4}t\n1,2,3,4\n5,6,7,8\n"),
        ("a.obj", "# M\u{fc}ller\nv 1 2 3\nv 5 6 7\n"),
        ("a.pcd", pcd),
    ];
    for (name, text) in files {
        let latin_1: Vec<u8> = text.chars().map(|c| c as u8).collect();
        let marked = [b"\xef\xbb\xbf", text.as_bytes()].concat();
        let utf_16: Vec<u8> = "\u{feff}".encode_utf16().chain(text.encode_utf16()).flat_map(u16::to_le_bytes).collect();
        for bytes in [latin_1, marked, utf_16] {
            let (cloud, _) = cloud_as(name, &bytes);
            assert_eq!((cloud.len(), cloud.positions.get(1)), (2, [5.0, 6.0, 7.0]), "{name}");
        }
    }
    let camera = b"\xef\xbb\xbf{\"fx\":525,\"fy\":525,\"cx\":319.5,\"cy\":239.5}";
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("c.json"), camera).unwrap();
    assert_eq!(io::read_camera(&folder.path().join("c.json"), None).unwrap().fx, 525.0);
}

#[test]
fn columns_of_text_are_read_as_other_programs_write_them() {
    // CloudCompare writes the number of points below the titles.
    let (cloud, _) = cloud_as("a.asc", b"//X Y Z R G B Intensity\n2\n1 2 3 10 20 30 0.5\n5 6 7 40 50 60 0.25\n");
    assert_eq!(names(&cloud), ["red", "green", "blue", "intensity"]);
    let cut = read_as("a.asc", b"//X Y Z\n3\n1 2 3\n5 6 7\n").unwrap_err();
    assert!(cut.contains("states 3 points, but has 2"), "{cut}");
    // These names differ only in their brackets.
    let (cloud, _) = cloud_as("a.csv", b"x,y,z,d (mean),d (max)\n1,2,3,4,5\n5,6,7,8,9\n");
    assert_eq!(names(&cloud), ["d_(mean)", "d_(max)"]);
    // Column titles of maps and of ParaView.
    for header in ["Easting,Northing,Elevation", "Points:0,Points:1,Points:2", "X (m),Y (m),Z (m)"] {
        let (cloud, _) = cloud_as("a.csv", format!("{header}\n1,2,3\n5,6,7\n").as_bytes());
        assert_eq!(cloud.positions.get(1), [5.0, 6.0, 7.0], "{header}");
    }
    // Decimal commas.
    for text in ["1,5 2,5 3,5\n4,5 5,5 6,5\n", "x;y;z\n1,5;2,5;3,5\n4,5;5,5;6,5\n", "1,5\t2,5\t3,5\n4,5\t5,5\t6,5\n"] {
        let (cloud, _) = cloud_as("a.txt", text.as_bytes());
        assert_eq!(cloud.positions.get(1), [4.5, 5.5, 6.5], "{text:?}");
    }
    // A column r alone may be a range or a reflectance, so it does not become red.
    assert_eq!(names(&cloud_as("a.csv", b"x,y,z,r\n1,2,3,4\n5,6,7,8\n").0), ["r"]);
    assert_eq!(names(&cloud_as("a.csv", b"x,y,z,R,G,B\n1,2,3,4,5,6\n").0), ["red", "green", "blue"]);
    // Units in the names.
    let (cloud, notes) = cloud_as("a.csv", b"X (mm),Y (mm),Z (mm)\n1000,2000,3000\n");
    assert_eq!((cloud.positions.get(0), notes[0].contains("mm are converted to metres")), ([1.0, 2.0, 3.0], true));
    assert!(read_as("a.csv", b"x [m],y [m],z [ft]\n1,2,3\n").unwrap_err().contains("different units"));
    // Quotes, tabs, comments in prose, colours, Excel's first line, and line ends of old Macs.
    for (text, fields) in [
        ("x,y,z,label\n1,2,3,\"car, red\"\n5,6,7,\"a\"\n", 0),
        ("x,y,z,label\n1,2,3,\n5,6,7,tree\n", 0),
        ("x,y,z,color,i\n1,2,3,#ff0000,5\n5,6,7,#00ff00,6\n", 1),
        ("# x y z in metres\n1 2 3\n5 6 7\n", 0),
        ("Point ID\tX\tY\tZ\n1\t1\t2\t3\n2\t5\t6\t7\n", 1),
        ("sep=;\nx;y;z\n1;2;3\n5;6;7\n", 0),
        ("1 2 3 # a;b\n5 6 7\n", 0),
        ("1,2,3\r5,6,7\r", 0),
    ] {
        let (cloud, _) = cloud_as("a.txt", text.as_bytes());
        assert_eq!((cloud.positions.get(1), cloud.attributes.len()), ([5.0, 6.0, 7.0], fields), "{text:?}");
    }
    // A comma before a space is not a decimal comma.
    for text in ["0, 0, 0\n.5, .5, 1.5\n", "1, 2, 3, 4\n5, 6, 7, 8\n"] {
        assert_eq!(cloud_as("a.txt", text.as_bytes()).0.len(), 2, "{text:?}");
    }
    // Columns of words, missing values.
    let (cloud, notes) = cloud_as("a.csv", b"x,y,z,class,q\n1,2,3,tree,NA\n5,6,7,car,2\n");
    assert_eq!(names(&cloud), ["q"]);
    assert_eq!(notes, ["columns with words instead of numbers are dropped: class"]);
    let (cloud, notes) = cloud_as("a.xyz", b"1 2 3 tree\n5 6 7 car\n");
    assert_eq!((names(&cloud).len(), notes.len()), (0, 1));
}

#[test]
fn text_compressed_by_gzip_is_read() {
    let gzip = |bytes: &[u8]| {
        let mut to = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        std::io::Write::write_all(&mut to, bytes).unwrap();
        to.finish().unwrap()
    };
    for (name, text) in [("a.xyz.gz", "1 2 3\n5 6 7\n"), ("a.ply.gz", &ply_with("q")), ("a.gz", "1 2 3\n5 6 7\n")] {
        assert_eq!(cloud_as(name, &gzip(text.as_bytes())).0.len(), 2, "{name}");
    }
    let cut = gzip(b"1 2 3\n5 6 7\n");
    assert!(read_as("a.xyz.gz", &cut[..cut.len() - 9]).unwrap_err().contains("damaged gzip"));
}

#[test]
fn a_colour_without_a_number_leaves_the_others() {
    let (cloud, notes) = cloud_as("a.obj", b"v 1 2 3 1 0.5 0\nv 5 6 7 nan 0.5 1\n");
    assert_eq!(cloud.rgb().unwrap(), [[255, 128, 0], [0, 128, 255]]);
    assert_eq!(notes, ["1 colour values are missing; they become 0"]);
    let (cloud, notes) = cloud_as("a.obj", b"v 1 2 3\nv 5 6 7 255 128 1\nv 1 1 1 1\n");
    assert_eq!(cloud.rgb().unwrap(), [[0; 3], [255, 128, 1], [0; 3]]);
    assert_eq!(notes, ["2 of 3 vertices have no colour; they are black"]);
}

/// Returns the little-endian bytes of f32 values.
fn floats(values: impl IntoIterator<Item = f32>) -> Vec<u8> {
    values.into_iter().flat_map(f32::to_le_bytes).collect()
}

#[test]
fn the_number_of_columns_of_a_lidar_s_bin_is_found_or_asked_for() {
    // Returns a pseudorandom number in [0, 1).
    let noise = |i: usize, k: usize| ((i * 7919 + k * 104_729) as f32 * 0.618_034).fract();
    let points = 500;
    let xyz = |i: usize| [30.0 * noise(i, 1) - 15.0, 30.0 * noise(i, 2) - 15.0, 4.0 * noise(i, 3) - 2.0];
    let file = |rest: &dyn Fn(usize) -> Vec<f32>| {
        floats((0..points).flat_map(|i| xyz(i).into_iter().chain(rest(i)).collect::<Vec<_>>()))
    };
    let colours = |i: usize| [4, 5, 6].map(|k| (255.0 * noise(i, k)).floor()).to_vec();
    for (bytes, expected) in [
        (file(&|_| vec![]), ""),
        (file(&|i| vec![(100.0 * noise(i, 4)).floor() / 100.0]), "intensity"),
        (file(&|i| vec![(255.0 * noise(i, 4)).floor(), (i % 32) as f32]), "intensity ring"),
        (file(&colours), "red green blue"),
        (file(&|i| colours(i).iter().map(|value| value / 255.0).collect()), "red green blue"),
    ] {
        let (cloud, notes) = cloud_as("a.bin", &bytes);
        assert_eq!((cloud.len(), names(&cloud).join(" ").as_str()), (points, expected));
        assert!(notes[0].contains("columns are read as x y z"), "{notes:?}");
        assert_eq!(written(&cloud, "out.bin"), bytes, "{expected}");
    }
    // Waymo's points, converted by mmdetection3d, have intensity, elongation and time.
    let waymo = file(&|i| vec![noise(i, 4), 1.5 * noise(i, 5), 1.55e15]);
    assert!(read_as("a.bin", &waymo).unwrap_err().contains("number of columns"));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.bin");
    fs::write(&path, &waymo).unwrap();
    let read = io::read_file(&path, &ReadOptions::default().with_columns(Some(6))).unwrap();
    assert_eq!(read.contents.shape(), (points, 1));
    // These positions could also be colours or intensities.
    let unit_cube = floats((0..3 * points).map(|i| noise(i, 1)));
    assert!(read_as("a.bin", &unit_cube).unwrap_err().contains("number"));
    // Raw depth is recognized.
    let raw: Vec<u8> = (0..3072u16).flat_map(|i| (1500 + i % 700).to_le_bytes()).collect();
    assert!(read_as("a.bin", &raw).unwrap_err().contains("raw depth"));
}

#[test]
fn points_at_the_sensor_are_holes() {
    let cloud = |points: &[[f32; 3]]| {
        let cloud =
            planish::OrganizedCloud::from_positions(2, points.len() / 2, points.iter().copied().collect()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.pcd");
        io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
        let read = io::read_file(&path, &ReadOptions::default()).unwrap();
        let Contents::Organized(cloud) = read.contents else { panic!("a grid") };
        (cloud.points.valid_points(), read.notes.len())
    };
    assert_eq!(cloud(&[[0.0; 3], [0.1, 0.0, 1.0], [0.0; 3], [0.1, 0.1, 1.0]]), (2, 1));
    assert_eq!(cloud(&[[0.0; 3], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [0.1, 0.1, 1.0]]), (3, 1));
    // Height maps around the origin have no hole there.
    assert_eq!(cloud(&[[0.0; 3], [1.0, 0.0, 0.1], [0.0, 1.0, 0.1], [1.0, 1.0, 0.2]]), (4, 0));
    assert_eq!(cloud(&[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]), (4, 0));
    assert_eq!(cloud(&[[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, -0.1]]), (4, 0));
}

#[test]
fn lengths_in_other_units_become_metres() {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = PointCloud::new([[100.0, 200.0, 1000.0], [300.0, 0.0, 2000.0]].into_iter().collect());
    cloud.set_attribute("q", vec![1u8, 2]);
    let path = folder.path().join("mm.ply");
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    let read = |unit: &str| {
        let options = ReadOptions::default().with_unit(Some(unit.parse().unwrap()));
        io::read_file(&path, &options).unwrap()
    };
    let FileRead { contents: Contents::General(found), notes, .. } = read("mm") else { panic!("points") };
    assert_eq!(
        (found.positions.get(1), &notes[..]),
        ([0.3, 0.0, 2.0], &["lengths in mm are converted to metres".to_owned()][..])
    );
    assert!(read("m").notes.is_empty());
    let inch = read("inch").contents;
    let Contents::General(inch) = inch else { panic!("points") };
    assert_eq!(inch.positions.get(0), [2.54, 5.08, 25.4]);
    assert!("furlong".parse::<io::LengthUnit>().unwrap_err().to_string().contains("mm, cm, m, inch or ft"));
    // The scales of a LAS file are in the file's own unit.
    let path = folder.path().join("mm.las");
    fs::write(&path, las(2, 1)).unwrap();
    let millimetres =
        io::read_file(&path, &ReadOptions::default().with_unit(Some(io::LengthUnit::MILLIMETRE))).unwrap();
    let Contents::General(found) = millimetres.contents else { panic!("points") };
    assert_eq!(millimetres.notes.len(), 2);
    let (again, _) = cloud_as("out.las", &written(&found, "out.las"));
    for (axis, expected) in [637.012_24, 849.028_31, 0.431_66].into_iter().enumerate() {
        let coordinates = [found.coordinate(axis, 0), again.coordinate(axis, 0)];
        assert!(coordinates.iter().all(|found| (found - expected).abs() < 1e-5), "{coordinates:?} {expected}");
    }
}

#[test]
fn scans_without_colour_beside_coloured_ones_are_marked() {
    use e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut bytes, "{file}").unwrap();
    let double = |name| Record { name, data_type: RecordDataType::Double { min: None, max: None } };
    let byte = |name| Record { name, data_type: RecordDataType::Integer { min: 0, max: 255 } };
    let axes = || [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ].map(double);
    let colours = || [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue].map(byte);
    for (number, colour) in [Some(200i64), None].into_iter().enumerate() {
        let prototype = axes().into_iter().chain(colours().into_iter().filter(|_| colour.is_some())).collect();
        let mut scan = writer.add_pointcloud(&format!("{{{number}}}"), prototype).unwrap();
        let values = [1.0, 2.0, 3.0].map(RecordValue::Double).into_iter();
        scan.add_point(values.chain(colour.iter().flat_map(|c| [*c; 3].map(RecordValue::Integer))).collect()).unwrap();
        scan.finalize().unwrap();
    }
    writer.finalize().unwrap();
    drop(writer);
    let (cloud, notes) = cloud_as("a.e57", &bytes.into_inner());
    assert_eq!(notes, ["1 of 2 scans have no colour; their points are black, and marked in color_invalid"]);
    let marks = &cloud.attribute("color_invalid").unwrap().values;
    assert_eq!((cloud.rgb().unwrap(), [0, 1].map(|i| marks.get_f64(i))), (vec![[200; 3], [0; 3]], [0.0, 1.0]));
    let (again, notes) = cloud_as("b.e57", &written(&cloud, "b.e57"));
    assert_eq!((again.attribute("color_invalid"), notes.len()), (cloud.attribute("color_invalid"), 0));
}

#[test]
fn headers_of_pcd_are_read_as_pcl_reads_them() {
    let pcd = |fields: &str, counts: &str, data: &str| {
        format!(
            "# M\u{fc}ller\nVERSION 0.7\n{fields}\n{counts}\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n{data}\n1 2 3 4\n5 6 7 8\n"
        )
    };
    let floats = "SIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1";
    let none = "SIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 0 1";
    let integers = "SIZE 4 4 2 4\nTYPE I I U F\nCOUNT 1 1 1 1";
    for text in [
        pcd("FIELDS x y z q", floats, "DATA ASCII"),
        pcd("COLUMNS x y z q", floats, "DATA ascii"),
        pcd("FIELDS X Y Z q", floats, "DATA ascii"),
        pcd("FIELDS x y z none q", none, "DATA ascii"),
        pcd("FIELDS x y z q", integers, "DATA ascii"),
    ] {
        let latin_1: Vec<u8> = text.chars().map(|c| c as u8).collect();
        let (cloud, _) = cloud_as("a.pcd", &latin_1);
        assert_eq!((cloud.positions.get(1), names(&cloud)), ([5.0, 6.0, 7.0], vec!["q"]), "{text}");
    }
    // PLY coordinates may be integers or floats, with upper-case names.
    let ply = ply_with("q").replace("float x", "int X").replace("float y", "double Y").replace("float z", "uchar Z");
    let (cloud, _) = cloud_as("a.ply", ply.as_bytes());
    assert_eq!(cloud.positions.get(1), [5.0, 6.0, 7.0]);
}

/// PTX file with two scans from two places: the first without colours; the second with colours, turned by 90° about z
/// and moved.
const PTX: &str = "2\n1\n0 0 1\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n1 2 3 0.5\n0 0 0 0.5\n\
                   1\n1\n10 0 0\n0 1 0\n-1 0 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 0 0 1\n1 2 3 0.25 10 20 30\n";

#[test]
fn scans_of_a_ptx_are_in_the_frame_of_the_file() {
    let (cloud, notes) = cloud_as("a.ptx", PTX.as_bytes());
    assert_eq!([0, 1].map(|i| cloud.positions.get(i)), [[1.0, 2.0, 4.0], [8.0, 1.0, 3.0]]);
    assert_eq!(names(&cloud), ["intensity", "red", "green", "blue", "scan"]);
    assert_eq!(cloud.scanners_m().unwrap(), [Some([0.0, 0.0, 1.0]), Some([10.0, 0.0, 0.0])]);
    assert_eq!((cloud.rgb().unwrap()[1], notes.len()), ([10, 20, 30], 2));
    let first: String = PTX.lines().take(12).map(|line| format!("{line}\n")).collect();
    let (cloud, _) = cloud_as("a.ptx", first.as_bytes());
    assert_eq!((cloud.len(), cloud.pose.position_m, names(&cloud)), (1, [0.0, 0.0, 1.0], vec!["intensity"]));
    for (text, problem) in [
        (PTX.replace("1 2 3 0.25 10 20 30\n", ""), "truncated"),
        (PTX.replace("1 2 3 0.5\n", "1 2 3\n"), "line 11 of the PTX has 3 values"),
        (PTX.replacen('2', "-2", 1), "-2 columns"),
        ("hello\n".into(), "not numbers"),
    ] {
        let error = read_as("a.ptx", text.as_bytes()).unwrap_err();
        assert!(error.contains(problem), "{error}");
    }
}

const OFF: &str = "CNOFF\n# by hand\n2 1 0\n1 2 3 0 0 1 255 0 0\n5 6 7 0 1 0 0 255 0 255\n3 0 1 1\n";

#[test]
fn vertices_of_an_off_have_their_normals_and_colours() {
    let (cloud, _) = cloud_as("a.off", OFF.as_bytes());
    assert_eq!(names(&cloud), ["normal_x", "normal_y", "normal_z", "red", "green", "blue"]);
    assert_eq!((cloud.positions.get(1), cloud.rgb().unwrap()[1]), ([5.0, 6.0, 7.0], [0, 255, 0]));
    let (dark, _) = cloud_as("a.off", b"COFF\n2 0 0\n1 2 3 0 0 1 255\n5 6 7 1 0 1 255\n");
    assert_eq!(dark.rgb().unwrap(), [[0, 0, 1], [1, 0, 1]]);
    for text in ["OFF 2 0 0\n1 2 3\n5 6 7\n", "OFF2 0 0\n1 2 3\n5 6 7\n"] {
        assert_eq!(cloud_as("a.off", text.as_bytes()).0.len(), 2, "{text}");
    }
    for (text, problem) in [
        ("OFF\n3 0 0\n1 2 3\n5 6 7\n", "states 3 vertices, but has 2"),
        ("OFF\n2 0 0\n1 2 3\n5 6\n", "line 4"),
        ("4OFF\n1 0 0\n1 2 3 4\n", "unsupported OFF header"),
        ("OFF\nmany\n", "expected the numbers of vertices, faces and edges"),
        ("OFF\n999999999999 0 0\n", "states 999999999999 vertices"),
    ] {
        let error = read_as("a.off", text.as_bytes()).unwrap_err();
        assert!(error.contains(problem), "{error}");
    }
}

#[test]
fn damaged_files_of_every_kind_here_are_read_or_refused() {
    let pgm = [&b"P5\n4 2\n65535\n"[..], &[1; 16]].concat();
    let pfm = [&b"Pf\n2 2\n-1\n"[..], &[1; 16]].concat();
    let camera = br#"{"fx":525,"fy":525,"cx":319.5,"cy":239.5,"depth_scale":0.001,"roi":{"width":2,"height":2}}"#;
    let files: [(&str, Vec<u8>); 10] = [
        ("a.ptx", PTX.into()),
        ("a.off", OFF.into()),
        ("a.pgm", pgm),
        ("a.pfm", pfm),
        ("a.ply", ply_with("scalar_(q)").into()),
        ("a.csv", "x;y;z;name\n1,5;2;3;tree\n4;5;6;NA\n".into()),
        ("a.las", las(4, 6)),
        ("a.bin", floats((0..64).map(|i| i as f32))),
        ("a.npy", [&b"\x93NUMPY\x01\0V\0{'descr': [('x', '<f4'), ('y', '<f4'), ('z', '<f4')], 'fortran_order': False, 'shape': (2,), }\n"[..], &[0; 24]].concat()),
        ("camera", camera.to_vec()),
    ];
    let mut random = 1u32;
    let mut next = |below: usize| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (random >> 8) as usize % below.max(1)
    };
    let options = ReadOptions::default().with_max_memory_bytes(1 << 24);
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = folder.path().join(name);
        for _ in 0..400 {
            let mut bytes = bytes.clone();
            for _ in 0..=next(4) {
                let (at, value) = (next(bytes.len()), next(256) as u8);
                match next(4) {
                    0 => bytes.truncate(at),
                    1 => bytes.insert(at.min(bytes.len()), b"0123456789-. \n"[next(14)]),
                    _ if at < bytes.len() => bytes[at] = value,
                    _ => {}
                }
            }
            fs::write(&path, &bytes).unwrap();
            match name {
                "camera" => drop(io::read_camera_file(&path, None)),
                _ => drop(io::read_file(&path, &options)),
            }
        }
    }
}
