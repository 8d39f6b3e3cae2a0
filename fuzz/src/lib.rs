//! Checks of the fuzz targets. The workspace's tests run them on the inputs in `corpus`.

use std::fs;
use std::path::PathBuf;

use planish::Camera;
use planish::bag::BagSource;
use planish::internal::lzf::{compress, decompress};
use planish::io::{Contents, Format, ReadOptions, decode_with, parse_camera};
use planish::source::{SourceOptions, open};

/// Decodes bytes as a file with the extension of a format.
///
/// # Panics
/// If contents are not valid.
pub fn check_decoder(bytes: &[u8], announced: Format) {
    let options = ReadOptions::default().with_max_memory_bytes(256 << 20);
    match decode_with(bytes, Some(announced), &options).map(|(_, contents)| contents) {
        Ok(Contents::Organized(cloud)) => cloud.points.validate().expect("fields of one length"),
        Ok(Contents::General(cloud)) => cloud.validate().expect("fields of one length"),
        Ok(Contents::Depth(image)) => assert_eq!(image.raw.len(), image.width * image.height),
        Ok(Contents::DepthMetres { width, height, depth_m }) => assert_eq!(depth_m.len(), width * height),
        _ => {}
    }
}

/// Reads bytes as a recording in MCAP.
///
/// # Panics
/// If there is nowhere to write them.
pub fn check_bag(bytes: &[u8]) {
    let path = own_path().with_extension("mcap");
    fs::write(&path, bytes).expect("a folder for temporary files");
    let camera = Camera::kinect_v1().with_shape((0, 0));
    if let Ok(mut source) = BagSource::open(&path, None, None, Some(camera)) {
        // Frames that cannot be read are errors, and the next may be fine.
        while !matches!(source.next_frame(), Ok(None)) {}
    }
}

/// Reads text as a camera file, of an image of unknown size and of a known one.
///
/// # Panics
/// If a camera is not valid.
pub fn check_camera(text: &str) {
    for shape in [None, Some((640, 480))] {
        if let Ok(camera) = parse_camera(text, shape) {
            let (width, height) = (camera.width.max(1), camera.height.max(1));
            camera.with_shape((width, height)).validate().expect("a valid camera");
        }
    }
}

/// Decompresses bytes as LZF to several sizes, and checks that compressing and decompressing returns the same bytes.
///
/// # Panics
/// If the size or the bytes differ.
pub fn check_lzf(bytes: &[u8]) {
    for size in [0, bytes.len(), 4 * bytes.len(), 1 << 20] {
        if let Ok(data) = decompress(bytes, size) {
            assert_eq!(data.len(), size);
        }
    }
    assert_eq!(decompress(&compress(bytes), bytes.len()).as_deref(), Ok(bytes));
}

/// Reads bytes as the list of a data set in TUM layout.
///
/// # Panics
/// If there is nowhere to write them.
pub fn check_tum(bytes: &[u8]) {
    let folder = own_path();
    fs::create_dir_all(&folder).expect("a folder for the list");
    let options = SourceOptions::default().with_camera(Some(Camera::kinect_v1()));
    for list in ["depth.txt", "associations.txt"] {
        fs::write(folder.join(list), bytes).expect("a list");
        if let Ok(mut source) = open(folder.to_str().expect("a name in UTF-8"), &options) {
            // The images that it names are not there, or another file is.
            for _ in 0..4 {
                let _ = source.next_frame();
            }
        }
        fs::remove_file(folder.join(list)).expect("the list");
    }
}

/// Returns where this process may write.
fn own_path() -> PathBuf {
    std::env::temp_dir().join(format!("planish-fuzz-{}", std::process::id()))
}
