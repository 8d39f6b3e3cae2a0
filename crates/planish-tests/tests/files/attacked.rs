//! Regression tests for faults that attacks on the readers and writers found.

use std::fs;

use planish::compare::compare;
use planish::io::{self, Contents, Encoding, Format, ReadOptions};
use planish::source::{self, OwnedFrame, SourceOptions, TumRecorder};
use planish::stream::{FolderSink, SinkFormat, Stream, StreamOptions};
use planish::{Attribute, DepthFrame, Outputs, PointCloud, SensorPose, Settings, rig};
use tempfile::TempDir;

fn read(format: Format, bytes: &[u8]) -> Result<(Contents, Vec<String>), String> {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join(format!("a.{}", format.name().to_ascii_lowercase()));
    fs::write(&path, bytes).unwrap();
    let file = io::read_file(&path, &ReadOptions::default()).map_err(|error| error.to_string())?;
    Ok((file.contents, file.notes))
}

fn read_cloud(format: Format, bytes: &[u8]) -> (PointCloud, Vec<String>) {
    match read(format, bytes) {
        Ok((Contents::General(cloud), notes)) => (cloud, notes),
        other => panic!("{other:?}"),
    }
}

fn values(cloud: &PointCloud, name: &str) -> Vec<f64> {
    let values = &cloud.attribute(name).unwrap().values;
    (0..values.len()).map(|i| values.get_f64(i)).collect()
}

/// Returns a LAS file with coordinates in US survey feet or in metres.
fn las(in_feet: bool) -> Vec<u8> {
    let foot = r#"PROJCS["x",GEOGCS["y",UNIT["degree",0.0174532925199433]],UNIT["US survey foot",0.3048006096012192]]"#;
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(6).unwrap();
    builder.has_wkt_crs = true;
    let wkt = if in_feet {
        foot.to_owned()
    } else {
        foot.replace("US survey foot", "metre").replace("0.3048006096012192", "1")
    };
    builder.vlrs.push(las::Vlr {
        user_id: "LASF_Projection".into(),
        record_id: 2112,
        data: wkt.into_bytes(),
        ..Default::default()
    });
    let mut writer = las::Writer::new(std::io::Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    let per_metre = if in_feet { 3937.0 / 1200.0 } else { 1.0 };
    for i in 0..20 {
        let [x, y, z] = [3.0 + f64::from(i % 5), 5.0 + f64::from(i / 5), 2.0].map(|value| per_metre * value);
        writer.write_point(las::Point { x, y, z, gps_time: Some(0.0), ..Default::default() }).unwrap();
    }
    writer.close().unwrap();
    writer.into_inner().unwrap().into_inner()
}

#[test]
fn clouds_in_feet_and_in_metres_are_compared_and_merged_in_metres() {
    let [feet, metres] = [true, false].map(|in_feet| read_cloud(Format::Las, &las(in_feet)).0);
    assert!((feet.coordinate(0, 0) - 9.8425).abs() < 0.001, "the file's unit is kept");
    let found = compare(&Contents::General(feet.clone()), &Contents::General(metres.clone()), false).unwrap();
    assert!(found.distances.max < 1e-3 && found.unit == "m", "{found:?}");
    let (merged, notes) =
        rig::merge(vec![(feet.clone(), SensorPose::IDENTITY), (metres, SensorPose::IDENTITY)]).unwrap();
    assert!(notes.iter().any(|note| note.contains("ftUS are converted to metres")), "{notes:?}");
    for i in 0..20 {
        let apart = (0..3).map(|axis| (merged.coordinate(axis, i) - merged.coordinate(axis, i + 20)).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-3, "point {i}");
    }
    // Formats that do not state units cause a note. E57 files are in metres.
    let mut as_ply = feet.clone();
    let notes = io::adapt_fields(&mut as_ply, Format::Las, Format::Ply, None);
    assert!(notes.iter().any(|note| note.contains("US survey foot")) && as_ply.coordinate(0, 0) > 9.0, "{notes:?}");
    let mut as_e57 = feet;
    let notes = io::adapt_fields(&mut as_e57, Format::Las, Format::E57, None);
    assert!((as_e57.coordinate(0, 0) - 3.0).abs() < 1e-3 && notes.len() == 1, "{notes:?}");
}

#[test]
fn values_of_inverted_tiff_are_depth() {
    for (bits, value) in [(32u16, 700u32.to_le_bytes()), (0, 0.7f32.to_le_bytes())] {
        // A TIFF of 2x1 pixels whose white is 0, as unsigned integers or floats.
        let entries: [(u16, u16, u32, u32); 9] = [
            (256, 3, 1, 2),
            (257, 3, 1, 1),
            (258, 3, 1, 32),
            (259, 3, 1, 1),
            (262, 3, 1, 0),
            (273, 4, 1, 8),
            (277, 3, 1, 1),
            (279, 4, 1, 8),
            (339, 3, 1, if bits == 0 { 3 } else { 1 }),
        ];
        let mut bytes = b"II*\0\x10\0\0\0".to_vec();
        bytes.extend(value.repeat(2));
        bytes.extend((entries.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in entries {
            bytes.extend(tag.to_le_bytes());
            bytes.extend(kind.to_le_bytes());
            bytes.extend(count.to_le_bytes());
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([0; 4]);
        match read(Format::DepthTiff, &bytes).unwrap().0 {
            Contents::Depth(image) => assert_eq!(image.raw, [700, 700]),
            Contents::DepthMetres { depth_m, .. } => {
                assert!(depth_m.iter().all(|depth| (depth - 0.7).abs() < 1e-6), "{depth_m:?}");
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn stl_as_text_keeps_georeferenced_digits_and_capitals() {
    let text = b"solid a\nFACET NORMAL 0 0 1\nVERTEX 500000.123 4000000.456 1\nvertex 500001 4000000 1\n\
                 vertex 500000.123 4000000.456 1\nendsolid\n";
    let (cloud, _) = read_cloud(Format::Stl, text);
    assert_eq!(cloud.len(), 2, "equal corners are one point");
    assert_eq!([cloud.coordinate(0, 0), cloud.coordinate(1, 0)], [500_000.123, 4_000_000.456]);
}

#[test]
fn colours_and_matrices_that_do_not_fit_are_reported_or_refused() {
    let (of_shares, _) = read_cloud(Format::Off, b"COFF\n1 0 0\n0 0 1 0.5 0 1 255\n");
    assert_eq!(values(&of_shares, "red"), [128.0]);
    let (of_bytes, notes) = read_cloud(Format::Off, b"COFF\n2 0 0\n0 0 1 1 0 1 255\n0 1 1 1 300 -5 255\n");
    assert_eq!(values(&of_bytes, "red"), [1.0, 1.0]);
    assert!(notes[0].contains("2 colour values are not within 0 to 255"), "{notes:?}");
    let (_, notes) = read_cloud(Format::Obj, b"v 0 0 1 300 0 0\nv 1 0 1 -4 2 2\n");
    assert!(notes[0].contains("2 colour values"), "{notes:?}");

    let ptx = |last_column: &str, colour: &str| {
        format!(
            "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 {last_column}\n0 1 0 0\n0 0 1 0\n5 0 0 1\n1 1 1 0.5 {colour} 0 0\n"
        )
    };
    let (moved, notes) = read_cloud(Format::Ptx, ptx("0", "7").as_bytes());
    assert!(moved.coordinate(0, 0) == 6.0 && notes.is_empty(), "{notes:?}");
    let (_, notes) = read_cloud(Format::Ptx, ptx("0", "300").as_bytes());
    assert!(notes[0].contains("not integers from 0 to 255"), "{notes:?}");
    for (column, problem) in [("5", "last column"), ("nan", "not finite")] {
        let error = read(Format::Ptx, ptx(column, "7").as_bytes()).unwrap_err();
        assert!(error.contains(problem), "{error}");
    }
    let error = read(Format::Ptx, ptx("0", "7").replacen("1\n1\n", "0.5\n2\n", 1).as_bytes()).unwrap_err();
    assert!(error.contains("invalid size"), "{error}");
}

#[test]
fn units_that_planish_does_not_know_are_refused() {
    for unit in ["km", "um", "kilometres"] {
        let text = format!("x ({unit}),y ({unit}),z ({unit})\n1,2,3\n4,5,6\n");
        let error = read(Format::Csv, text.as_bytes()).unwrap_err();
        assert!(error.contains(unit) && error.contains("metres"), "{error}");
    }
    let (in_inches, notes) = read_cloud(Format::Csv, b"x [inches],y [inches],z [inches]\n1,2,3\n4,5,6\n");
    assert!((in_inches.coordinate(0, 0) - 0.0254).abs() < 1e-6 && !notes.is_empty());
    let (other_words, _) = read_cloud(Format::Csv, b"x (PCV),y (PCV),z (PCV)\n1,2,3\n4,5,6\n");
    assert_eq!(other_words.coordinate(0, 0), 1.0);
}

#[test]
fn cameras_that_contradict_themselves_are_refused() {
    let k = r#""K":[500,0,320,0,500,240,0,0,1]"#;
    for (text, problem) in [
        (format!(r#"{{{k},"fx":600,"fy":600,"cx":320,"cy":240}}"#), "fx = 600"),
        (format!(r#"{{{k},"depth_scale":0.001,"depth_units_per_metre":5000}}"#), "5000"),
    ] {
        let error = io::parse_camera(&text, None).unwrap_err().to_string();
        assert!(error.contains(problem) && error.contains("remove one of them"), "{error}");
    }
    let same =
        format!(r#"{{{k},"fx":500,"fy":500,"cx":320,"cy":240,"depth_scale":0.001,"depth_units_per_metre":1000}}"#);
    assert_eq!(io::parse_camera(&same, None).unwrap().depth_units_per_metre, 1000.0);
}

#[test]
fn integers_that_e57_cannot_store_are_refused() {
    let mut cloud = PointCloud::new([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]].into_iter().collect());
    let with = |cloud: &mut PointCloud, values: Vec<u64>| {
        cloud.attributes = vec![Attribute { name: "id".into(), count: 1, values: values.into() }];
        io::encode_cloud(Format::E57, &*cloud, Encoding::Binary).map_err(|error| error.to_string())
    };
    let error = with(&mut cloud, vec![1, u64::MAX]).unwrap_err();
    assert!(error.contains("18446744073709551615") && error.contains("id"), "{error}");
    let bytes = with(&mut cloud, vec![1, (1 << 53) + 1]).unwrap();
    let (_, notes) = read_cloud(Format::E57, &bytes);
    assert!(notes.iter().any(|note| note.contains("rounded")), "{notes:?}");
}

#[test]
fn readers_count_all_the_memory_of_narrow_columns() {
    let points = 200_000;
    let pcd = format!(
        "VERSION 0.7\nFIELDS x y z\nSIZE 1 1 1\nTYPE U U U\nCOUNT 1 1 1\nWIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA binary\n"
    );
    let ply = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {points}\nproperty uchar x\nproperty uchar y\nproperty uchar z\nend_header\n"
    );
    for (format, header) in [(Format::Pcd, pcd), (Format::Ply, ply)] {
        let bytes = [header.as_bytes(), &vec![7; 3 * points]].concat();
        // The file has 0.6 MB. Each point takes 12 bytes, and its coordinates are converted through f64.
        let within = |limit: u64| {
            let options = ReadOptions::default().with_max_memory_bytes(limit);
            io::decode_with(&bytes, Some(format), &options).is_ok()
        };
        assert!(!within(6_000_000) && within(10_000_000), "{format:?}");
    }
    let gltf = format!(r#"{{"asset":{{"version":"2.0"}},"nodes":[{}{{}}]}}"#, "{},".repeat(100_000));
    let options = ReadOptions::default().with_max_memory_bytes(20_000_000);
    let error = io::decode_with(gltf.as_bytes(), Some(Format::Gltf), &options).unwrap_err().to_string();
    assert!(error.contains("memory"), "{error}");
}

#[test]
fn lists_of_data_sets_name_no_files_outside_of_their_folder() {
    let folder = TempDir::new().unwrap();
    for name in ["../outside.png", "/etc/passwd", "depth/../../outside.png"] {
        fs::write(folder.path().join("depth.txt"), format!("1.0 {name}\n")).unwrap();
        let error = source::open(folder.path().to_str().unwrap(), &SourceOptions::default()).map(drop).unwrap_err();
        assert!(error.to_string().contains("outside the data set's folder"), "{error}");
    }
}

#[test]
fn saved_frames_have_names_of_their_own_that_lists_can_hold() {
    let (input, output) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let camera = planish_tests::scenes::small_camera();
    // The third name is taken, and so is the first that would replace it.
    let names = ["a-000002.png", "a.png", "a.tiff", "b c.png", "#d.png", "e\n99 f.png"];
    for (i, name) in names.iter().enumerate() {
        let raw = vec![900 + 10 * i as u16; camera.width * camera.height];
        let image = planish::DepthImage { width: camera.width, height: camera.height, raw };
        io::write_depth(&input.path().join(name), &image).unwrap();
    }
    let options = SourceOptions::default().with_camera(Some(camera));
    let source = source::open(input.path().to_str().unwrap(), &options).unwrap();
    let folder = output.path().join("saved");
    let mut settings: Settings = "engine=cpu".parse().unwrap();
    settings.outputs = Some(Outputs::DEPTH);
    let sink = FolderSink::create(&folder, SinkFormat::DepthPng, Outputs::DEPTH).unwrap();
    let statistics = Stream::new(source, StreamOptions::from_settings(settings).unwrap())
        .with_sinks(vec![Box::new(sink)])
        .run()
        .unwrap();
    assert_eq!((statistics.frames_out, statistics.failed_sinks), (6, 0));
    let files: Vec<String> =
        fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    let images = files.iter().filter(|name| name.ends_with(".png")).count();
    assert_eq!(images, 6, "{files:?}");
    // The folder is a data set that can be read again.
    let mut again = source::open(folder.to_str().unwrap(), &SourceOptions::default()).unwrap();
    let mut depths = Vec::new();
    while let Some(frame) = again.next_frame().unwrap() {
        let OwnedFrame::Depth(frame) = frame else { panic!("depth") };
        depths.push(frame.raw[frame.raw.len() / 2]);
    }
    depths.sort_unstable();
    assert_eq!(depths, [900, 910, 920, 930, 940, 950]);
}

#[test]
fn frames_of_equal_times_are_recorded_in_files_of_their_own() {
    let camera = planish_tests::scenes::small_camera();
    for times in [[1_700_000_000_000.0; 3], [1.7e18, 1.7e18 + 10.0, 1.7e18 + 20.0], [5.0, 5.000_000_2, 5.000_000_4]] {
        let folder = TempDir::new().unwrap();
        let mut recorder = TumRecorder::create(folder.path()).unwrap();
        for (i, time_s) in times.into_iter().enumerate() {
            let raw = vec![900 + i as u16; camera.width * camera.height];
            recorder.add(&DepthFrame::new(camera, raw).unwrap().with_timestamp_s(time_s)).unwrap();
        }
        assert_eq!(fs::read_dir(folder.path().join("depth")).unwrap().count(), 3, "{times:?}");
    }
}

#[test]
fn schemas_that_exceed_the_limit_together_are_refused() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("schemas.mcap");
    let options = mcap::WriteOptions::new().compression(None).profile("ros2").use_chunks(false);
    let mut writer = options.create(std::io::BufWriter::new(fs::File::create(&path).unwrap())).unwrap();
    for number in 1..=20 {
        writer.add_schema_with_id(number, &format!("a/msg/A{number}"), "ros2msg", &[b'#'; 1 << 20]).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let limited = ReadOptions::default().with_max_memory_bytes(30 << 20);
    for error in [
        planish::bag::recover(&path, &limited).map(drop).unwrap_err().to_string(),
        planish::bag::Survey::of(&path, &limited).map(drop).unwrap_err().to_string(),
    ] {
        assert!(error.contains("memory"), "{error}");
    }
    assert_eq!(fs::metadata(&path).unwrap().len() as usize, whole.len() / 2, "nothing was changed");
    planish::bag::recover(&path, &ReadOptions::default()).unwrap();
}

#[test]
fn poses_are_read_within_the_memory_limit() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("poses.txt");
    fs::write(&path, "1\n".repeat(100_000)).unwrap();
    let error = io::read_trajectory_with(&path, &ReadOptions::default().with_max_memory_bytes(1 << 20)).unwrap_err();
    assert!(error.to_string().contains("memory"), "{error}");
    let error = io::read_trajectory(&path).unwrap_err();
    assert!(error.to_string().contains("the first line has 1 numbers"), "{error}");
}

#[cfg(unix)]
#[test]
fn pipes_in_a_recording_of_libfreenect_do_not_hang() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("INDEX.txt"), "d-1.0-100.pgm\nd-2.0-200.pgm\n").unwrap();
    let pipe = std::ffi::CString::new(folder.path().join("d-1.0-100.pgm").to_str().unwrap()).unwrap();
    // SAFETY: the path ends with a zero byte.
    assert_eq!(unsafe { libc::mkfifo(pipe.as_ptr(), 0o600) }, 0);
    fs::write(folder.path().join("d-2.0-200.pgm"), vec![b'P'; 3 << 20]).unwrap();
    let mut source = source::open(folder.path().to_str().unwrap(), &SourceOptions::default()).unwrap();
    for problem in ["pipe", "not a libfreenect image"] {
        let error = source.next_frame().map(drop).unwrap_err().to_string();
        assert!(error.contains(problem), "{error}");
    }
}
