//! Files with false claims: each is refused with a message that names the problem, without a panic or a huge
//! allocation.

use std::fs;

use planish::io::{self, Encoding, Format};
use planish::{DepthImage, PointCloud, Xyz};
use proptest::prelude::*;

fn error(bytes: &[u8], format: Format) -> String {
    io::decode(bytes, Some(format)).expect_err("a refusal").to_string()
}

/// Returns a PCD file with this body, whose header is valid except for the replaced lines.
fn pcd(changes: &[(&str, &str)], body: &str) -> Vec<u8> {
    let mut text = String::from("# .PCD v0.7\n");
    let defaults = [
        ("VERSION", "0.7"),
        ("FIELDS", "x y z"),
        ("SIZE", "4 4 4"),
        ("TYPE", "F F F"),
        ("COUNT", "1 1 1"),
        ("WIDTH", "2"),
        ("HEIGHT", "1"),
        ("VIEWPOINT", "0 0 0 1 0 0 0"),
        ("POINTS", "2"),
        ("DATA", "ascii"),
    ];
    for (key, value) in defaults {
        let value = changes.iter().find(|(changed, _)| *changed == key).map_or(value, |(_, value)| value);
        text.push_str(&format!("{key} {value}\n"));
    }
    (text + body).into_bytes()
}

#[test]
fn lying_pcd_headers_are_refused_with_a_reason() {
    let body = "1 2 3\n4 5 6\n";
    assert!(io::decode(&pcd(&[], body), None).is_ok());
    type Changes<'a> = &'a [(&'a str, &'a str)];
    let cases: [(Changes<'_>, &str, &str); 22] = [
        (&[("POINTS", "1000000000000000000")], body, "POINTS is 1000000000000000000, but WIDTH x HEIGHT is 2 x 1"),
        (&[("POINTS", "1000000000000000000"), ("WIDTH", "1000000000000000000")], body, "exceed the limit of 2^28"),
        (&[("POINTS", "200000000"), ("WIDTH", "200000000")], body, "truncated"),
        (&[("POINTS", "200000000"), ("WIDTH", "200000000"), ("DATA", "binary")], body, "truncated"),
        (&[("POINTS", "3")], body, "POINTS is 3, but WIDTH x HEIGHT is 2 x 1 = 2"),
        (&[("WIDTH", "18446744073709551615"), ("HEIGHT", "18446744073709551615")], body, "exceed the limit of 2^28"),
        (&[("SIZE", "3 4 4")], body, "field \"x\" has TYPE \"F\" and SIZE \"3\""),
        (&[("SIZE", "2 4 4")], body, "4 or 8 for F"),
        (&[("SIZE", "4 4")], body, "SIZE has 2 entries for 3 FIELDS"),
        (&[("TYPE", "F F Q")], body, "field \"z\" has TYPE \"Q\""),
        (&[("COUNT", "1 1 0")], body, "more than 2 values"),
        (&[("COUNT", "1 1 9999999999")], body, "COUNT 9999999999"),
        (&[("COUNT", "1 1 -1")], body, "COUNT \"-1\" is invalid; expected one whole number"),
        (&[("FIELDS", "x y w")], body, "missing field z"),
        (&[("FIELDS", "")], body, "no FIELDS"),
        (&[("WIDTH", "two")], body, "WIDTH \"two\" is invalid; expected one whole number"),
        (&[("VIEWPOINT", "0 0 0")], body, "expected 7 numbers"),
        (&[("VERSION", "0.8")], body, "version \"0.8\"; expected"),
        (&[("DATA", "zip")], body, "unknown DATA \"zip\""),
        (&[], "1.0 2.0 3.0\n4.0 5.0\n", "fewer than 3 values"),
        (&[], "1 2 3\n4 5 6 7\n", "more than"),
        (&[], "1 2 3\n4 five 6\n", "\"five\" is not a value of field \"y\""),
    ];
    for (changes, body, expected) in cases {
        let message = error(&pcd(changes, body), Format::Pcd);
        assert!(message.contains(expected), "{changes:?}: {message}");
    }
}

#[test]
fn lying_compressed_sizes_are_refused() {
    let sizes = |compressed: u32, size: u32, data: &[u8]| {
        let mut bytes = pcd(&[("DATA", "binary_compressed")], "");
        bytes.extend(compressed.to_le_bytes());
        bytes.extend(size.to_le_bytes());
        bytes.extend(data);
        error(&bytes, Format::Pcd)
    };
    assert!(sizes(9, 25, &[0; 9]).contains("hold 25 bytes, but the header states 2 points of 12 bytes"));
    assert!(sizes(1000, 24, &[0; 9]).contains("1000 compressed bytes, but 9 follow"));
    assert!(sizes(u32::MAX, 24, &[0; 9]).contains("truncated"));
    assert!(sizes(2, 24, &[0, 7]).contains("less than the stated"));
    assert!(error(&pcd(&[("DATA", "binary_compressed")], "abc"), Format::Pcd).contains("sizes"));
    let huge = [("DATA", "binary_compressed"), ("WIDTH", "268435456"), ("POINTS", "268435456")];
    let mut bytes = pcd(&huge, "");
    bytes.extend([2, 0, 0, 0, 0, 0, 0, 0xc0, 0, 7]);
    assert!(io::decode(&bytes, None).is_err());
}

#[test]
fn files_that_are_something_else_are_refused() {
    assert!(error(b"", Format::Pcd).contains("empty"));
    assert!(error(b"hello world, this is no cloud\n", Format::Pcd).contains("not an entry of a PCD header"));
    assert!(error(&[0xff; 100_000], Format::Pcd).contains("no end"));
    assert!(error(b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", Format::Ply).contains("vertex"));
    assert!(error(b"ply\nnonsense\n", Format::Ply).contains("PLY"));
    let million = b"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000000\nproperty float x\nproperty \
                    float y\nproperty float z\nend_header\n";
    assert!(error(million, Format::Ply).contains("truncated"));
    let grid = b"ply\nformat ascii 1.0\nobj_info num_cols 5\nobj_info num_rows 5\nelement vertex 1\nproperty float \
                 x\nproperty float y\nproperty float z\nend_header\n1 2 3\n";
    assert!(error(grid, Format::Ply).contains("5 x 5"));
    assert!(error(b"\x89PNG\r\n\x1a\n....", Format::DepthPng).contains("damaged PNG"));
    assert!(error(b"II*\0....", Format::DepthTiff).contains("damaged TIFF"));
    assert!(error(b"\x93NUMPY\x01\x00\xff\xff", Format::Npy).contains("NPY header of 65535 bytes"));
    let nothing = io::decode(b"just words", None).unwrap_err().to_string();
    assert!(nothing.contains("expected PCD, PLY"), "{nothing}");
}

/// Returns valid files of many formats, for tests that damage them.
fn samples() -> Vec<(Format, Vec<u8>)> {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = PointCloud::new((0..40).map(|i| [i as f32, 1.0, 2.0]).collect::<Xyz>());
    cloud.set_attribute("rgb", vec![1.0f32; 40]);
    let image = DepthImage { width: 8, height: 5, raw: (0..40).collect() };
    let mut files = Vec::new();
    let mut keep = |name: &str, format| {
        files.push((format, fs::read(folder.path().join(name)).unwrap()));
    };
    for (name, encoding) in
        [("a.pcd", Encoding::Ascii), ("b.pcd", Encoding::Binary), ("c.pcd", Encoding::BinaryCompressed)]
    {
        io::write_cloud(&folder.path().join(name), &cloud, encoding).unwrap();
        keep(name, Format::Pcd);
    }
    for (name, encoding) in [("a.ply", Encoding::Ascii), ("b.ply", Encoding::Binary)] {
        io::write_cloud(&folder.path().join(name), &cloud, encoding).unwrap();
        keep(name, Format::Ply);
    }
    io::write_cloud(&folder.path().join("a.npy"), &cloud, Encoding::Binary).unwrap();
    keep("a.npy", Format::Npy);
    for (name, format) in [("a.npz", Format::Npz), ("a.e57", Format::E57)] {
        io::write_cloud(&folder.path().join(name), &cloud, Encoding::Binary).unwrap();
        keep(name, format);
    }
    for (name, format) in [("d.png", Format::DepthPng), ("d.tiff", Format::DepthTiff), ("d.npy", Format::Npy)] {
        io::write_depth(&folder.path().join(name), &image).unwrap();
        keep(name, format);
    }
    files
}

#[test]
fn every_truncation_of_every_format_is_an_error_or_whole() {
    for (format, bytes) in samples() {
        for end in 0..bytes.len() {
            // Text may lose its last newline or the last digits of its last number and still be complete.
            let cut = io::decode(&bytes[..end], Some(format));
            assert!(cut.is_err() || end + 12 >= bytes.len(), "{format:?} cut at {end} of {}", bytes.len());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_files_never_panic(sample in 0usize..11, hits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let (format, mut bytes) = samples().swap_remove(sample);
        for (index, value) in hits {
            let at = index.index(bytes.len());
            bytes[at] = value;
        }
        let _ = io::decode(&bytes, Some(format));
    }
}

#[test]
fn writing_where_nothing_can_be_written_says_so_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = PointCloud::new(Xyz::filled(3, 1.0));
    let write = |name: &str| io::write_cloud(&folder.path().join(name), &cloud, Encoding::Binary);
    assert!(write("missing/cloud.pcd").unwrap_err().to_string().contains("does not exist"));
    assert!(write("cloud.abc").unwrap_err().to_string().contains("expected .pcd"));
    assert!(write("cloud.png").unwrap_err().to_string().contains("cannot store points"));
    fs::create_dir(folder.path().join("taken.pcd")).unwrap();
    assert!(write("taken.pcd").unwrap_err().to_string().contains("path is a folder"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "only the folder is there");

    let mut uneven = cloud.clone();
    uneven.set_attribute("intensity", vec![1.0f32; 2]);
    let error = io::write_cloud(&folder.path().join("uneven.pcd"), &uneven, Encoding::Binary).unwrap_err();
    assert!(error.to_string().contains("intensity has 2 values; expected 3"), "{error}");
}

#[test]
fn numbers_too_large_for_their_type_are_refused_instead_of_becoming_holes() {
    let ply = |kind: &str, value: &str| {
        let properties = ["x", "y", "z"].map(|axis| format!("property {kind} {axis}\n")).concat();
        format!("ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n0 0 1\n{value} 0 1\n").into_bytes()
    };
    let stl = b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1e39 0 0\nvertex 0 1 0\n".to_vec();
    let mut depth = Vec::new();
    depth.extend(b"\x93NUMPY\x01\x00");
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 4), }\n";
    depth.extend((header.len() as u16).to_le_bytes());
    depth.extend(header.as_bytes());
    depth.extend((0..16).flat_map(|i| if i == 5 { 1e300f64 } else { 1.5 }.to_le_bytes()));
    for (format, bytes) in [
        (Format::Ply, ply("float", "1e39")),
        (Format::Ply, ply("double", "-1e400")),
        (Format::Pcd, pcd(&[], "1 2 3\n4 5e38 6\n")),
        (Format::Csv, b"x,y,z\n0,0,1\n1e400,0,1\n".to_vec()),
        (Format::Stl, stl),
        (Format::Npy, depth),
    ] {
        let text = error(&bytes, format);
        assert!(
            ["1e39", "1e400", "5e38", "3.4e38", "line 2"].iter().any(|word| text.contains(word)),
            "{format:?}: {text}"
        );
    }
    // Holes may be written as infinite.
    assert!(io::decode(&ply("float", "inf"), Some(Format::Ply)).is_ok());
    assert!(io::decode(&pcd(&[], "1 2 3\n-inf nan 6\n"), None).is_ok());
}

#[test]
fn georeferenced_points_are_not_written_to_formats_of_f32() {
    let mut cloud = PointCloud::new((0..300).map(|i| [0.01 * i as f32, 0.013 * i as f32, 0.5]).collect());
    let encode = |cloud: &PointCloud| io::encode_cloud(Format::KittiBin, cloud, Encoding::Binary);
    encode(&cloud).unwrap();
    cloud.origin_m = [500_000.0, 5_400_000.0, 300.0];
    assert!(encode(&cloud).unwrap_err().to_string().contains("f32"));
}
