//! LAS and LAZ: only the positions change, and false claims are refused.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use laz::LazVlr;
use laz::laszip::{ChunkTable, ChunkTableEntry};
use planish::PointCloud;
use planish::io::{self, Contents, Encoding, Format};
use planish_tests::data::{folder, general_cloud};

/// Returns the header and the point records of a LAS file.
fn las_records(path: &Path) -> (las::Header, Vec<u8>) {
    let mut reader = las::Reader::from_path(path).unwrap();
    let records = reader.read_all().unwrap().raw_bytes().to_vec();
    (reader.header().clone(), records)
}

#[test]
fn las_files_keep_every_bit_but_those_of_the_positions() {
    let Some(data) = folder("LAS") else { return };
    let folder = tempfile::tempdir().unwrap();
    for name in
        ["readers/simple.las", "unorganized/simple.laz", "unorganized/autzen_trim.laz", "readers/append-bug.laz"]
    {
        let input = data.join(name);
        let mut cloud = general_cloud(&data, name);
        let (header, records) = las_records(&input);
        assert_eq!(cloud.len() as u64, header.number_of_points(), "{name}");
        for extension in ["las", "laz"] {
            let output = folder.path().join(format!("out.{extension}"));
            io::write_cloud(&output, &cloud, Encoding::Binary).unwrap();
            let (written, copied) = las_records(&output);
            assert!(copied == records, "{name}");
            let (before, after) = (header.vlrs(), written.vlrs());
            let kept =
                |vlrs: &[las::Vlr]| vlrs.iter().filter(|v| v.user_id != "laszip encoded").cloned().collect::<Vec<_>>();
            assert_eq!(kept(before), kept(after), "{name}");
            assert_eq!((written.transforms(), written.version()), (header.transforms(), header.version()), "{name}");
            assert_eq!(
                io::read(&output).unwrap().0,
                if extension == "las" { io::Format::Las } else { io::Format::Laz }
            );
        }

        // Fields without a LAS counterpart become extra bytes with a description.
        let output = folder.path().join("more.laz");
        cloud.set_attribute("normal_x", (0..cloud.len()).map(|i| i as f32).collect::<Vec<f32>>());
        cloud.set_attribute("status", vec![3u8; cloud.len()]);
        io::write_cloud(&output, &cloud, Encoding::Binary).unwrap();
        let Contents::General(copy) = io::read(&output).unwrap().1 else { panic!("points") };
        assert_eq!(copy.attributes, cloud.attributes, "{name}");
        assert_eq!((&copy.positions, copy.origin_m), (&cloud.positions, cloud.origin_m), "{name}");
    }
}

#[test]
fn other_clouds_become_las_and_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.laz");
    let mut cloud = PointCloud::new([[0.5, -2.25, 1.0], [f32::NAN; 3], [3.0, 4.0, 5.5]].into_iter().collect());
    cloud.origin_m = [432_000.0, 5_600_000.0, 120.0];
    cloud.set_attribute("rgb", vec![0x00ff_8001u32, 0, 0x0001_0203]);
    cloud.set_attribute("intensity", vec![7u16, 8, 9]);
    cloud.set_attribute("depth", vec![1.5f64, 2.5, -3.5]);
    io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
    let Contents::General(copy) = io::read(&path).unwrap().1 else { panic!("points") };
    // The file does not contain the hole.
    assert_eq!(copy.len(), 2);
    for (i, from) in [0, 2].into_iter().enumerate() {
        for axis in 0..3 {
            let of = |cloud: &PointCloud, i: usize| cloud.origin_m[axis] + f64::from(cloud.positions.get(i)[axis]);
            assert!((of(&copy, i) - of(&cloud, from)).abs() < 1e-5, "{i} {axis}");
        }
    }
    let values = |name: &str| copy.attribute(name).unwrap().values.clone();
    assert_eq!(values("red"), vec![0xff * 257u16, 257].into());
    assert_eq!(values("intensity"), vec![7u16, 9].into());
    assert_eq!(values("depth"), vec![1.5f64, -3.5].into());
    cloud.set_attribute("intensity", vec![7.5f32, 8.0, 9.0]);
    assert!(io::write_cloud(&path, &cloud, Encoding::Binary).unwrap_err().to_string().contains("intensity"));
}

/// Writes a cloud as LAS and reads it back.
fn through_las(cloud: &PointCloud) -> Result<PointCloud, planish::IoError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.las");
    io::write_cloud(&path, cloud, Encoding::Binary)?;
    let Contents::General(copy) = io::read(&path)?.1 else { panic!("points") };
    Ok(copy)
}

#[test]
fn extra_bytes_of_las_keep_their_places_whatever_is_added() {
    // The file has bytes that no record describes, and a described field with the name of a standard field.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odd.las");
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(6).unwrap();
    builder.point_format.extra_bytes = 6;
    let mut description = vec![0u8; 192];
    description[2] = 3;
    description[4..13].copy_from_slice(b"intensity");
    let vlr = las::Vlr { user_id: "LASF_Spec".into(), record_id: 4, description: String::new(), data: description };
    builder.vlrs.push(vlr);
    let mut writer = las::Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
    for i in 0..3u8 {
        let extra_bytes = vec![77, 0, i, 1, 2, 3];
        let gps_time = Some(f64::from(i));
        let point = las::Point { x: f64::from(i), intensity: 9, gps_time, extra_bytes, ..Default::default() };
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    let Contents::General(mut cloud) = io::read(&path).unwrap().1 else { panic!("points") };
    let values = |cloud: &PointCloud, name: &str| cloud.attribute(name).unwrap().values.clone();
    assert_eq!(values(&cloud, "intensity"), vec![9u16; 3].into());
    assert_eq!(values(&cloud, "extra_0"), vec![77u16; 3].into());
    cloud.set_attribute("curvature", vec![0.25f32; 3]);
    let copy = through_las(&cloud).unwrap();
    assert_eq!(values(&copy, "curvature"), vec![0.25f32; 3].into());
    assert_eq!(values(&copy, "intensity"), vec![9u16; 3].into());
    let rest = vec![0u8, 1, 2, 3, 1, 1, 2, 3, 2, 1, 2, 3];
    assert!(copy.attributes.iter().any(|attribute| attribute.values == rest.clone().into()), "{:?}", copy.attributes);
    // Add another field to the copy.
    let mut twice = copy;
    twice.set_attribute("status", vec![4u8; 3]);
    let copy = through_las(&twice).unwrap();
    assert_eq!((values(&copy, "status"), values(&copy, "curvature")), (vec![4u8; 3].into(), vec![0.25f32; 3].into()));

    // 400 fields, whose descriptions follow the points, and 9000, which are too many for one record.
    let mut wide = PointCloud::new([[1.0; 3], [2.0; 3]].into_iter().collect());
    (0..400).for_each(|i| wide.set_attribute(&format!("c{i}"), vec![i as f32, 0.5]));
    let mut copy = through_las(&wide).unwrap();
    copy.set_attribute("curvature", vec![0.25f32; 2]);
    let copy = through_las(&copy).unwrap();
    assert_eq!(values(&copy, "curvature"), vec![0.25f32; 2].into());
    assert_eq!(values(&copy, "c399"), vec![399f32, 0.5].into());
    (400..9000).for_each(|i| {
        wide.attributes.push(planish::Attribute { name: format!("c{i}"), count: 1, values: vec![0f64; 2].into() })
    });
    assert!(through_las(&wide).unwrap_err().to_string().contains("record"));

    // A small cloud keeps its shape, and NaN does not become a number.
    let mut tiny = PointCloud::new([[1e-6; 3], [2e-6, 0.0, -1e-6]].into_iter().collect());
    let copy = through_las(&tiny).unwrap();
    assert!((copy.origin_m[0] + f64::from(copy.positions.x()[1]) - 2e-6).abs() < 1e-11);
    tiny.set_attribute("intensity", vec![f32::NAN, 1.0]);
    assert!(through_las(&tiny).unwrap_err().to_string().contains("intensity"));
}

#[test]
fn scaled_extra_bytes_are_numbers_everywhere_and_the_same_bytes_in_las() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scaled.las");
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(6).unwrap();
    // An i32 in hundredths; two u16, the second in halves with an offset of 100; an i64 that f64 cannot represent.
    builder.point_format.extra_bytes = 4 + 4 + 8;
    let mut data = Vec::new();
    let mut describe = |name: &[u8], number: u8, options: u8, scales_and_offsets: [f64; 6]| {
        let mut description = vec![0u8; 192];
        (description[2], description[3]) = (number, options);
        description[4..4 + name.len()].copy_from_slice(name);
        for (k, value) in scales_and_offsets.into_iter().enumerate() {
            description[112 + 8 * k..120 + 8 * k].copy_from_slice(&value.to_le_bytes());
        }
        data.extend(description);
    };
    describe(b"temperature", 6, 8, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]);
    describe(b"pair", 13, 8 | 16, [1.0, 0.5, 0.0, 0.0, 100.0, 0.0]);
    describe(b"time", 8, 8, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]);
    builder.vlrs.push(las::Vlr { user_id: "LASF_Spec".into(), record_id: 4, description: String::new(), data });
    let mut writer = las::Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
    for (i, temperature) in [53506i32, -1, i32::MAX].into_iter().enumerate() {
        let pair = [7u16, 3].map(u16::to_le_bytes).concat();
        let extra_bytes = [&temperature.to_le_bytes()[..], &pair, &(i64::MAX - 1).to_le_bytes()].concat();
        let point = las::Point { x: i as f64, gps_time: Some(0.0), extra_bytes, ..Default::default() };
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    let Contents::General(cloud) = io::read(&path).unwrap().1 else { panic!("points") };
    let values = |name: &str| cloud.attribute(name).unwrap().values.clone();
    assert_eq!(values("temperature"), vec![535.06, -0.01, 21_474_836.47].into());
    assert_eq!(values("pair"), vec![7.0, 101.5, 7.0, 101.5, 7.0, 101.5].into());
    assert_eq!(values("time"), vec![i64::MAX - 1; 3].into());
    let csv = folder.path().join("scaled.csv");
    io::write_cloud(&csv, &cloud, Encoding::Ascii).unwrap();
    let text = std::fs::read_to_string(&csv).unwrap();
    assert!(text.lines().nth(1).unwrap().ends_with("535.06,7,101.5,9223372036854775806"), "{text}");
    let copy = folder.path().join("copy.las");
    io::write_cloud(&copy, &cloud, Encoding::Binary).unwrap();
    assert_eq!(las_records(&copy).1, las_records(&path).1);
    // Values of another type are rounded to the scale of the field.
    let mut cloud = cloud;
    cloud.set_attribute("temperature", vec![535.0625f32, -1.0, 2.0]);
    io::write_cloud(&copy, &cloud, Encoding::Binary).unwrap();
    let Contents::General(again) = io::read(&copy).unwrap().1 else { panic!("points") };
    assert_eq!(again.attribute("temperature").unwrap().values, vec![535.06, -1.0, 2.0].into());
}

#[test]
fn damaged_las_files_are_refused() {
    let Some(data) = folder("damaged LAS") else { return };
    for name in ["readers/simple.las", "unorganized/simple.laz"] {
        let bytes = fs::read(data.join(name)).unwrap();
        for cut in [5, 100, 230, 400, bytes.len() / 2, bytes.len() - 1] {
            let error = io::decode(&bytes[..cut], None).unwrap_err().to_string();
            assert!(error.len() < 300, "{name} {cut}: {error}");
        }
        // This header states more points than the file contains.
        let mut lying = bytes.clone();
        lying[107..111].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(io::decode(&lying, None).is_err(), "{name}");
        let mut scaleless = bytes;
        scaleless[131..139].copy_from_slice(&0f64.to_le_bytes());
        assert!(io::decode(&scaleless, None).unwrap_err().to_string().contains("scales"), "{name}");
    }
}

#[test]
fn layers_larger_than_their_chunk_are_refused_before_anything_is_allocated() {
    // Point formats from 6 on are compressed in layers, whose sizes follow the first point of a chunk.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.laz");
    let cloud = PointCloud::new((0..1000).map(|i| [i as f32, 0.5 * i as f32, (i % 7) as f32]).collect());
    io::write_cloud(&file, &cloud, Encoding::Binary).unwrap();
    let bytes = fs::read(&file).unwrap();
    assert!(io::decode(&bytes, Some(Format::Laz)).is_ok());
    let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let record = usize::from(u16::from_le_bytes([bytes[105], bytes[106]]));
    assert!(bytes[104] & 0x3f >= 6, "written in point format {}", bytes[104] & 0x3f);
    let sizes_at = number(96) + 8 + record + 4;
    for layer in 0..9 {
        let mut lying = bytes.clone();
        lying[sizes_at + 4 * layer..][..4].copy_from_slice(&0xffff_fff0u32.to_le_bytes());
        let error = io::decode(&lying, Some(Format::Laz)).unwrap_err().to_string();
        assert!(error.contains("but its layers need"), "{error}");
        // The error is the same if the file is read in parts.
        fs::write(&file, &lying).unwrap();
        let error = io::read_in_parts(&file, 1 << 20, |_| ()).unwrap_err().to_string();
        assert!(error.contains("a.laz") && error.contains("but its layers need"), "{error}");
    }
}

fn refused(bytes: &[u8], format: Format) -> String {
    io::decode(bytes, Some(format)).expect_err("an error").to_string()
}

#[test]
fn headers_shorter_than_their_versions_are_refused() {
    let cloud = PointCloud::new((0..10).map(|i| [1.0, 2.0, i as f32]).collect());
    for format in [Format::Las, Format::Laz] {
        let mut bytes = io::encode_cloud(format, &cloud, Encoding::Binary).unwrap();
        io::decode(&bytes, Some(format)).unwrap();
        bytes[94] -= 1;
        let error = refused(&bytes, format);
        assert!(error.contains("the header has"), "{error}");
    }
}

/// Returns a LAZ file of 1000 points.
fn compressed() -> Vec<u8> {
    let cloud = PointCloud::new((0..1000).map(|i| [i as f32, 0.5 * i as f32, (i % 7) as f32]).collect());
    io::encode_cloud(Format::Laz, &cloud, Encoding::Binary).unwrap()
}

#[test]
fn points_compressed_as_others_are_refused() {
    let mut bytes = compressed();
    bytes[105] -= 1;
    let error = refused(&bytes, Format::Laz);
    assert!(error.contains("in the LASzip record"), "{error}");
}

#[test]
fn a_chunk_that_ends_beyond_the_file_is_refused_though_its_layers_fill_it() {
    let mut bytes = compressed();
    io::decode(&bytes, Some(Format::Laz)).unwrap();
    let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let points_at = number(96) as usize;
    let user_at = bytes.windows(14).position(|window| window == b"laszip encoded").unwrap();
    let description = LazVlr::from_buffer(&bytes[user_at + 52..points_at]).unwrap();
    let table_at = number(points_at) as usize;
    let mut reader = Cursor::new(&bytes);
    reader.set_position(points_at as u64);
    let chunk = ChunkTable::read_from(reader, &description).unwrap()[0];
    // The first layer and the chunk both state this number of additional bytes.
    let more = 0x7000_0000u32;
    let layer_at = points_at + 8 + usize::from(u16::from_le_bytes([bytes[105], bytes[106]])) + 4;
    let layer = number(layer_at) + more;
    let mut table = ChunkTable::default();
    table.push(ChunkTableEntry { byte_count: chunk.byte_count + u64::from(more), ..chunk });
    bytes[layer_at..layer_at + 4].copy_from_slice(&layer.to_le_bytes());
    bytes.truncate(table_at);
    table.write_to(&mut bytes, &description).unwrap();
    bytes.extend([0; 64]);
    let error = refused(&bytes, Format::Laz);
    assert!(error.contains("a chunk of") && error.contains("past the end of the file"), "{error}");
}

#[test]
fn gps_times_of_any_value_go_through_laz() {
    // Differences of their bits exceed 2^63, where the original coders panic in builds with overflow checks.
    let odd = [0.0, -1e300, 1e300, f64::MAX, f64::MIN, -0.0, 5e-324, f64::INFINITY, f64::NEG_INFINITY, 1.5];
    let folder = tempfile::tempdir().unwrap();
    for format in [1, 6] {
        let mut builder = las::Builder::from((1, 4));
        builder.point_format = las::point::Format::new(format).unwrap();
        let [plain, compressed] = ["a.las", "a.laz"].map(|name| folder.path().join(format!("{format}{name}")));
        let mut writer = las::Writer::from_path(&plain, builder.into_header().unwrap()).unwrap();
        for i in 0..3000usize {
            let gps_time = Some(odd[(i * i + i / 7) % odd.len()]);
            writer.write_point(las::Point { x: i as f64, gps_time, ..Default::default() }).unwrap();
        }
        writer.close().unwrap();
        let read = |path: &Path| match io::read(path).unwrap().1 {
            Contents::General(cloud) => cloud,
            _ => panic!("no cloud"),
        };
        let cloud = read(&plain);
        io::write_cloud(&compressed, &cloud, Encoding::Binary).unwrap();
        assert_eq!(read(&compressed).attribute("gps_time"), cloud.attribute("gps_time"), "{format}");
        assert!(cloud.attribute("gps_time").is_some());
    }
}

/// Returns a LAZ file in the given point format, with a changed table of chunks.
fn with_table(format: u8, chunk_size: Option<u32>, change: impl Fn(&mut ChunkTableEntry)) -> Vec<u8> {
    let mut builder = las::Builder::from((1, 4));
    builder.point_format = las::point::Format::new(format).unwrap();
    builder.point_format.is_compressed = true;
    let mut writer = las::Writer::new(Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    for i in 0..1000 {
        let gps_time = writer.header().point_format().has_gps_time.then_some(f64::from(i));
        writer.write_point(las::Point { x: 0.01 * f64::from(i), gps_time, ..Default::default() }).unwrap();
    }
    writer.close().unwrap();
    let mut bytes = writer.into_inner().unwrap().into_inner();
    let number = |bytes: &[u8], at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let points_at = number(&bytes, 96) as usize;
    let record_at = bytes.windows(14).position(|window| window == b"laszip encoded").unwrap() + 52;
    let description = LazVlr::from_buffer(&bytes[record_at..points_at]).unwrap();
    let mut reader = Cursor::new(&bytes);
    reader.set_position(points_at as u64);
    let mut chunk = ChunkTable::read_from(reader, &description).unwrap()[0];
    change(&mut chunk);
    if let Some(chunk_size) = chunk_size {
        bytes[record_at + 12..record_at + 16].copy_from_slice(&chunk_size.to_le_bytes());
    }
    let description = LazVlr::from_buffer(&bytes[record_at..points_at]).unwrap();
    let mut table = ChunkTable::default();
    table.push(chunk);
    let table_at = number(&bytes, points_at) as usize;
    bytes.truncate(table_at);
    table.write_to(&mut bytes, &description).unwrap();
    bytes
}

#[test]
fn tables_of_chunks_that_state_more_than_the_file_has_are_refused_before_anything_is_allocated() {
    for format in [1, 6] {
        io::decode(&with_table(format, None, |_| ()), Some(Format::Laz)).unwrap();
        let all = |chunk: &mut ChunkTableEntry| chunk.point_count = 1000;
        io::decode(&with_table(format, Some(u32::MAX), all), Some(Format::Laz)).unwrap();
        let points = |chunk: &mut ChunkTableEntry| chunk.point_count = 2_147_483_647;
        let error = refused(&with_table(format, Some(u32::MAX), points), Format::Laz);
        assert!(error.contains("states 1000 points, but its chunk table states 2147483647"), "{error}");
    }
    let bytes = |chunk: &mut ChunkTableEntry| chunk.byte_count = 0x7fff_0000;
    let error = refused(&with_table(1, None, bytes), Format::Laz);
    assert!(error.contains("a chunk of 2147418112 bytes"), "{error}");
}

#[test]
fn strays_at_the_origin_cost_the_other_points_no_digits() {
    let mut cloud = PointCloud::new((0..3000).map(|i| [0.01 * (i % 50) as f32, 0.01 * (i / 50) as f32, 0.0]).collect());
    cloud.origin_m = [637_000.0, 5_400_000.0, 300.0];
    for i in 0..45 {
        cloud.positions.set(66 * i, [-637_000.0, -5_400_000.0, -300.0]);
    }
    let bytes = io::encode_cloud(Format::Las, &cloud, Encoding::Binary).unwrap();
    let Contents::General(found) = io::decode(&bytes, Some(Format::Las)).unwrap().1 else { panic!("points") };
    assert!(found.origin_m[1] > 5_399_000.0, "{:?}", found.origin_m);
    assert!((found.positions.x()[1] - found.positions.x()[2]).abs() > 0.009);
}

#[test]
fn the_unit_of_coordinates_is_read_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let survey_foot =
        r#"PROJCS["x",GEOGCS["y",UNIT["degree",0.0174532925199433]],UNIT["US survey foot",0.3048006096012192]]"#;
    let keys: Vec<u8> = [1u16, 1, 0, 1, 3076, 0, 1, 9002].iter().flat_map(|number| number.to_le_bytes()).collect();
    let records = [(2112, survey_foot.as_bytes().to_vec()), (34735, keys)];
    for (k, expected) in
        [Some(io::LengthUnit::US_SURVEY_FOOT), Some(io::LengthUnit::FOOT), None].into_iter().enumerate()
    {
        let mut builder = las::Builder::from((1, 4));
        builder.vlrs.extend(records.get(k).map(|(record_id, data)| las::Vlr {
            user_id: "LASF_Projection".into(),
            record_id: *record_id,
            data: data.clone(),
            ..Default::default()
        }));
        let path = folder.path().join(format!("{k}.las"));
        let mut writer = las::Writer::from_path(&path, builder.into_header().unwrap()).unwrap();
        writer.write_point(las::Point { x: 1.0, y: 2.0, z: 3.0, ..Default::default() }).unwrap();
        writer.close().unwrap();
        let unit = |path: &Path| {
            let Contents::General(cloud) = io::read(path).unwrap().1 else { panic!("points") };
            (io::LengthUnit::of_cloud(&cloud), cloud)
        };
        let expected = expected.unwrap_or(io::LengthUnit::METRE);
        let (found, cloud) = unit(&path);
        assert_eq!(found, expected);
        let copy = folder.path().join("copy.laz");
        io::write_cloud(&copy, &cloud, Encoding::Binary).unwrap();
        assert_eq!(unit(&copy).0, expected);
    }
    if let Some(data) = self::folder("LAS") {
        let cloud = general_cloud(&data, "unorganized/autzen_trim.laz");
        assert_eq!(io::LengthUnit::of_cloud(&cloud), io::LengthUnit::FOOT);
    }
}
