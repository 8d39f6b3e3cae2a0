//! Files with several depth images: TIFF with several pages, NumPy arrays of shape [N, H, W].

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use planish::io::{self, Contents, ReadOptions, Stack};
use planish::source::{self, OwnedFrame, SourceOptions};
use planish::{Camera, DepthImage};

use super::read_as;

const SHAPE: (usize, usize) = (24, 20);
const PAGES: usize = 3;

/// Returns the value of every pixel of a page, counted from 1.
fn value(page: usize) -> u16 {
    500 + 100 * u16::try_from(page).unwrap()
}

fn tiff() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    for page in 1..=PAGES {
        let pixels = vec![value(page); SHAPE.0 * SHAPE.1];
        encoder.write_image::<tiff::encoder::colortype::Gray16>(SHAPE.0 as u32, SHAPE.1 as u32, &pixels).unwrap();
    }
    bytes.into_inner()
}

/// Returns an array of shape [3, 20, 24], as u16 or, in metres, as f32.
fn npy(in_metres: bool, is_fortran: bool) -> Vec<u8> {
    let (descr, order) = (if in_metres { "<f4" } else { "<u2" }, if is_fortran { "True" } else { "False" });
    let dict =
        format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': ({PAGES}, {}, {}), }}\n", SHAPE.1, SHAPE.0);
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(u16::try_from(dict.len()).unwrap().to_le_bytes());
    bytes.extend(dict.as_bytes());
    for page in 1..=PAGES {
        for _ in 0..SHAPE.0 * SHAPE.1 {
            match in_metres {
                true => bytes.extend((f32::from(value(page)) / 1000.0).to_le_bytes()),
                false => bytes.extend(value(page).to_le_bytes()),
            }
        }
    }
    bytes
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut encoder, bytes).unwrap();
    encoder.finish().unwrap()
}

/// Returns the depth in millimetres, which must be the same at every pixel.
fn depth_mm(contents: &Contents) -> u16 {
    let values: Vec<u16> = match contents {
        Contents::Depth(DepthImage { raw, .. }) => raw.clone(),
        Contents::DepthMetres { depth_m, .. } => depth_m.iter().map(|depth| (1000.0 * depth).round() as u16).collect(),
        _ => panic!("{contents:?}"),
    };
    assert_eq!((contents.shape(), values.len()), (SHAPE, SHAPE.0 * SHAPE.1));
    assert!(values.iter().all(|value| *value == values[0]));
    values[0]
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn one_image_of_several_is_read_and_the_others_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let files =
        [("a.tiff", tiff()), ("a.npy", npy(false, false)), ("b.npy", npy(true, false)), ("a.tif.gz", gzip(&tiff()))];
    for (name, bytes) in files {
        let first = read_as(name, &bytes).unwrap();
        assert_eq!(depth_mm(&first.contents), value(1), "{name}");
        assert_eq!(first.notes, ["the file has 3 images; only image 1 is read"], "{name}");
        let path = write(folder.path(), name, &bytes);
        let stack = Stack::open(&path, &ReadOptions::default()).unwrap().unwrap();
        assert_eq!(stack.images(), PAGES);
        for page in 1..=PAGES {
            let (_, contents) = io::read_with(&path, &ReadOptions::default().with_image(Some(page))).unwrap();
            assert_eq!(depth_mm(&contents), value(page), "{name}");
            assert_eq!(stack.image(page).unwrap(), contents, "{name}");
        }
        for page in [0, PAGES + 1, usize::MAX] {
            let error = io::read_with(&path, &ReadOptions::default().with_image(Some(page))).unwrap_err().to_string();
            let expected = format!("there is no image {page}: the file has 3 images, counted from 1");
            assert!(error.ends_with(&expected), "{name}: {error}");
            assert_eq!(stack.image(page).unwrap_err().to_string(), expected);
        }
    }
    let error = read_as("f.npy", &npy(false, true)).unwrap_err();
    assert!(error.contains("Fortran order") && error.contains("ascontiguousarray"), "{error}");
}

#[test]
fn a_page_of_a_file_with_one_image_or_cloud_exists_only_if_it_is_the_first() {
    let folder = tempfile::tempdir().unwrap();
    let mut one = Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut one).unwrap();
    encoder.write_image::<tiff::encoder::colortype::Gray16>(2, 1, &[500, 600]).unwrap();
    let files = [("a.xyz", b"1 2 3\n4 5 6\n".to_vec()), ("a.tiff", one.into_inner())];
    for (name, bytes) in files {
        let path = write(folder.path(), name, &bytes);
        assert!(Stack::open(&path, &ReadOptions::default()).unwrap().is_none(), "{name}");
        assert!(io::read_with(&path, &ReadOptions::default().with_image(Some(1))).is_ok(), "{name}");
        let error = io::read_with(&path, &ReadOptions::default().with_image(Some(2))).unwrap_err().to_string();
        assert!(error.ends_with("there is no image 2: the file has one image, counted from 1"), "{error}");
    }
}

#[test]
fn a_file_with_several_images_plays_once_and_a_folder_plays_its_files_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(folder.path(), "2.tiff", &tiff());
    write(folder.path(), "1.npy", &npy(false, false));
    io::write_depth(
        &folder.path().join("3.png"),
        &DepthImage { width: SHAPE.0, height: SHAPE.1, raw: vec![900; SHAPE.0 * SHAPE.1] },
    )
    .unwrap();
    let options = SourceOptions::default().with_camera(Some(Camera::kinect_v1().with_shape((0, 0))));
    let played = |path: &Path| {
        let mut source = source::open(path.to_str().unwrap(), &options).unwrap();
        let mut frames = Vec::new();
        while let Some(frame) = source.next_frame().unwrap() {
            let OwnedFrame::Depth(depth) = frame else { panic!("depth") };
            frames.push((source.frame_name().unwrap(), depth.raw[0]));
        }
        frames
    };
    let of_file =
        |name: &str| (1..=PAGES).map(move |page| (format!("{name}_{page:04}"), value(page))).collect::<Vec<_>>();
    assert_eq!(played(&path), of_file("2"));
    let all = [of_file("1"), of_file("2"), vec![("3".to_owned(), 900)]].concat();
    assert_eq!(played(folder.path()), all);
}

#[test]
fn a_truncated_file_ends_with_an_error_and_is_not_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let whole = tiff();
    let options = SourceOptions::default().with_camera(Some(Camera::kinect_v1().with_shape((0, 0))));
    let mut found = Vec::new();
    for cut in [whole.len() - 10, whole.len() / 2] {
        let path = write(folder.path(), "cut.tiff", &whole[..cut]);
        let notes = io::read_file(&path, &ReadOptions::default()).unwrap().notes;
        assert!(notes.iter().any(|note| note.contains("truncated after image")), "{notes:?}");
        let mut source = source::open(path.to_str().unwrap(), &options).unwrap();
        let mut frames = 0;
        let error = loop {
            match source.next_frame() {
                Ok(Some(_)) => frames += 1,
                Ok(None) => panic!("no error after {frames} frames"),
                Err(error) => break error.to_string(),
            }
            assert!(frames < PAGES, "{frames}");
        };
        assert!(error.contains(&format!("truncated after image {frames}")), "{error}");
        assert!(source.next_frame().unwrap().is_none());
        found.push(frames);
    }
    assert_eq!(found, [2, 1]);
}

#[test]
fn directories_of_pages_that_overlap_are_refused_at_once() {
    // Each page's directory has 65,535 entries, and the next one begins one entry later.
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.resize(1 << 20, 0);
    for page in 0..2000u32 {
        let at = 8 + 12 * page as usize;
        bytes[at..at + 2].copy_from_slice(&u16::MAX.to_le_bytes());
        let end = at + 2 + 12 * usize::from(u16::MAX);
        bytes[end..end + 4].copy_from_slice(&(8 + 12 * (page + 1)).to_le_bytes());
    }
    let error = read_as("a.tiff", &bytes).unwrap_err();
    assert!(error.contains("overlap"), "{error}");
}

#[test]
fn pages_that_form_a_loop_are_read_once_and_too_many_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let whole = tiff();
    let number = |at: usize| u32::from_le_bytes(whole[at..at + 4].try_into().unwrap());
    let mut at = 4;
    while number(at) != 0 {
        let directory = number(at) as usize;
        at = directory + 2 + 12 * usize::from(u16::from_le_bytes([whole[directory], whole[directory + 1]]));
    }
    // The last page links to the first.
    let looped = [&whole[..at], &whole[4..8], &whole[at + 4..]].concat();
    let images = |name: &str, bytes: &[u8]| {
        Stack::open(&write(folder.path(), name, bytes), &ReadOptions::default()).unwrap().unwrap().images()
    };
    assert_eq!(images("looped.tif", &looped), images("whole.tif", &whole));

    // Directories without entries.
    let mut many = b"II*\0\x08\0\0\0".to_vec();
    for page in 0..70_000u32 {
        many.extend(0u16.to_le_bytes());
        many.extend((8 + 6 * (page + 1)).to_le_bytes());
    }
    many.extend([0; 6]);
    let error = read_as("a.tiff", &many).unwrap_err();
    assert!(error.contains("65535 pages"), "{error}");
}

#[test]
fn all_images_of_a_file_count_as_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = write(folder.path(), "a.npy", &npy(false, false));
    let read = |limit| io::read_with(&path, &ReadOptions::default().with_max_memory_bytes(limit));
    // Three images of 960 bytes each, one of which is decoded.
    assert!(read(3 * 960 + 4000).is_ok());
    let error = read(3 * 960 + 500).unwrap_err().to_string();
    assert!(error.contains("the limit is 3 KiB"), "{error}");
}
