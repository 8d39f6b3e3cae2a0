//! LAS files of other programs with errors in their headers.

use std::fs;

use planish::io::{self, Contents, Encoding};

use super::{cloud_as, read_as, written};

/// Returns a LAS file of 40 points in the given minor version and point format.
pub(super) fn las(minor: u8, format: u8) -> Vec<u8> {
    let mut builder = las::Builder::from((1, minor));
    builder.point_format = las::point::Format::new(format).unwrap();
    builder.transforms = las::Vector {
        x: las::Transform { scale: 0.01, offset: 600_000.0 },
        y: las::Transform { scale: 0.01, offset: 800_000.0 },
        z: las::Transform { scale: 0.01, offset: 0.0 },
    };
    let mut writer = las::Writer::new(std::io::Cursor::new(Vec::new()), builder.into_header().unwrap()).unwrap();
    for i in 0..40 {
        let has_time = format != 0 && format != 2;
        let mut point =
            las::Point { x: 637_012.24 + 117.31 * f64::from(i), y: 849_028.31, z: 431.66, ..Default::default() };
        point.gps_time = has_time.then_some(0.0);
        point.waveform = matches!(format, 4 | 5).then(Default::default);
        writer.write_point(point).unwrap();
    }
    writer.close().unwrap();
    writer.into_inner().unwrap().into_inner()
}

fn set<const N: usize>(bytes: &mut [u8], at: usize, value: [u8; N]) {
    bytes[at..at + N].copy_from_slice(&value);
}

#[test]
fn las_headers_with_wrong_counts_are_read_with_a_note() {
    let mut records = las(2, 1);
    set(&mut records, 100, 1u32.to_le_bytes());
    let (cloud, notes) = cloud_as("a.las", &records);
    assert_eq!(cloud.len(), 40);
    assert_eq!(notes, ["the number of records before the points is 0, but the header states 1"]);

    let mut legacy = las(4, 1);
    set(&mut legacy, 107, 7u32.to_le_bytes());
    let (cloud, notes) = cloud_as("a.las", &legacy);
    assert_eq!(cloud.len(), 40);
    assert!(notes[0].contains("40 points, but 7 in the legacy field"), "{notes:?}");

    let mut extended = las(4, 6);
    set(&mut extended, 235, 1_000_000_000_000u64.to_le_bytes());
    set(&mut extended, 243, 1u32.to_le_bytes());
    let (cloud, notes) = cloud_as("a.las", &extended);
    assert_eq!(cloud.len(), 40);
    assert!(notes[0].contains("1 extended records at offset 1000000000000, but only 0 can be read"), "{notes:?}");
    // Reading in parts, as for clouds larger than memory, also gives all points and a note.
    let folder = tempfile::tempdir().unwrap();
    for bytes in [&records, &legacy, &extended] {
        let path = folder.path().join("a.las");
        fs::write(&path, bytes).unwrap();
        let mut points = 0;
        let (_, notes) = io::read_in_parts(&path, 30, |part| points += part.len()).unwrap();
        assert_eq!((points, notes.len()), (40, 1));
    }

    for (minor, stated, note) in
        [(2, 0u32, "no points; all 40 points of the file"), (2, 30, "only the 30 points stated")]
    {
        let mut fewer = las(minor, 1);
        set(&mut fewer, 107, stated.to_le_bytes());
        let (cloud, notes) = cloud_as("a.las", &fewer);
        assert_eq!(cloud.len(), if stated == 0 { 40 } else { 30 });
        assert!(notes[0].contains(note), "{notes:?}");
    }

    let mut newer = las(4, 6);
    newer[25] = 6;
    let error = read_as("a.las", &newer).unwrap_err();
    assert!(error.contains("LAS 1.6 is not supported; expected 1.0 to 1.5"), "{error}");
}

#[test]
fn las_1_5_is_read_as_1_4() {
    let bytes = las(4, 6);
    let (expected, _) = cloud_as("a.las", &bytes);
    // The header of 1.5 appends the range of times and their offset to that of 1.4.
    let mut newer = [&bytes[..375], &[0; 18], &bytes[375..]].concat();
    newer[25] = 5;
    newer[6] |= 1 << 6;
    set(&mut newer, 94, 393u16.to_le_bytes());
    let points_at = u32::from_le_bytes(bytes[96..100].try_into().unwrap());
    set(&mut newer, 96, (points_at + 18).to_le_bytes());
    set(&mut newer, 107, 0u32.to_le_bytes());
    set(&mut newer, 247, 40u64.to_le_bytes());
    set(&mut newer, 391, 1400i16.to_le_bytes());
    let (cloud, notes) = cloud_as("a.las", &newer);
    assert_eq!((cloud.len(), &cloud.attributes), (40, &expected.attributes));
    assert!(notes[0].contains("LAS 1.4") && notes[1].contains("1400 million"), "{notes:?}");
    for name in ["out.las", "out.laz"] {
        assert_eq!(cloud_as(name, &written(&cloud, name)).0.len(), 40);
    }
}

#[test]
fn las_headers_keep_their_bytes_and_waveforms_are_not_lost_in_silence() {
    let mut bytes = las(2, 1);
    set(&mut bytes, 26, *b"M\xfcller\0\0");
    set(&mut bytes, 90, [0, 0]);
    set(&mut bytes, 92, 2023u16.to_le_bytes());
    let (cloud, _) = cloud_as("a.las", &bytes);
    for name in ["out.las", "out.laz"] {
        assert_eq!(written(&cloud, name)[26..94], bytes[26..94], "{name}");
    }
    let mut waves = las(3, 4);
    waves[6] |= 2;
    let (_, notes) = cloud_as("a.las", &waves);
    assert_eq!(notes, ["its waveforms are dropped; the points keep only their references to them"]);
}

#[test]
fn coordinates_of_las_keep_their_digits_in_every_format() {
    let (cloud, _) = cloud_as("a.las", &las(2, 1));
    let text = String::from_utf8(written(&cloud, "out.csv")).unwrap();
    let second = text.lines().nth(2).unwrap();
    assert!(second.starts_with("637129.55,849028.31,431.66,"), "{second}");
    let folder = tempfile::tempdir().unwrap();
    for name in ["out.ply", "out.pcd", "out.npz", "out.e57", "out.xyz", "out.laz"] {
        let path = folder.path().join(name);
        io::write_cloud(&path, &cloud, Encoding::Binary).unwrap();
        let Contents::General(again) = io::read(&path).unwrap().1 else { panic!("{name}") };
        for i in 0..40 {
            let expected = [637_012.24 + 117.31 * i as f64, 849_028.31, 431.66];
            let found = [0, 1, 2].map(|axis| again.coordinate(axis, i));
            let is_same = (0..3).all(|axis| (found[axis] - expected[axis]).abs() < 1e-8);
            assert!(is_same, "{name}: {found:?} instead of {expected:?}");
        }
    }
}
