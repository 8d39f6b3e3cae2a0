//! Checks of the fuzz targets. The workspace's tests run them on the inputs in `corpus/`.

use std::fs;
use std::path::PathBuf;

use planish::Camera;
use planish::bag::{BagSource, recover};
use planish::internal::lzf::{compress, decompress};
use planish::io::{Contents, Format, ReadOptions, decode_with, parse_camera};
use planish::rig::{Rig, calibration};
use planish::source::{SourceOptions, open};

/// Decodes bytes as a file with the extension of a format.
///
/// # Panics
/// If the decoded contents are not valid.
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

/// Reads bytes as an MCAP recording.
///
/// # Panics
/// If the temporary file cannot be written.
pub fn check_bag(bytes: &[u8]) {
    let path = own_path().with_extension("mcap");
    fs::write(&path, bytes).expect("a folder for temporary files");
    let camera = Camera::kinect_v1().with_shape((0, 0));
    if let Ok(mut source) = BagSource::open(&path, None, None, Some(camera)) {
        // An unreadable frame is an error, but the next frame may be readable.
        while !matches!(source.next_frame(), Ok(None)) {}
    }
}

/// Recovers bytes as a truncated recording.
///
/// # Panics
/// If a rejected file was changed, or a recovered file is not complete.
pub fn check_recover(bytes: &[u8]) {
    let path = own_path().with_extension("recovered.mcap");
    fs::write(&path, bytes).expect("a folder for temporary files");
    let options = ReadOptions::default().with_max_memory_bytes(256 << 20);
    match recover(&path, &options) {
        Ok(_) => assert!(recover(&path, &options).expect("a recording that can be read").was_whole),
        Err(_) => assert!(fs::read(&path).expect("the file") == bytes, "a refused file has changed"),
    }
}

/// Reads text as a rig.json and as a calibration of several cameras.
///
/// # Panics
/// If the temporary file cannot be written.
pub fn check_rig(bytes: &[u8]) {
    let path = own_path().with_extension("rig");
    fs::write(&path, bytes).expect("a folder for temporary files");
    let _ = Rig::read(&path);
    let _ = calibration::read(&path, &calibration::CalibrationOptions::default());
}

/// Reads a valid LAZ file with a replaced chunk table; if the first byte is odd, the table's offset is replaced too.
///
/// # Panics
/// If the cloud is not valid.
pub fn check_laz_chunks(bytes: &[u8]) {
    let mut file = include_bytes!("../corpus/las/s.laz").to_vec();
    let field = |at: usize| file.get(at..at + 4).and_then(|field| field.try_into().ok()).map(u32::from_le_bytes);
    // The header contains the offset of the points, which begin with the offset of the table.
    let points = field(96).expect("a header") as usize;
    let table = field(points).expect("a table") as usize;
    let Some((first, rest)) = bytes.split_first() else { return };
    let rest = match rest.split_at_checked(8).filter(|_| first % 2 == 1) {
        Some((place, rest)) => {
            file[points..points + 8].copy_from_slice(place);
            rest
        }
        None => rest,
    };
    file.truncate(table);
    file.extend_from_slice(rest);
    check_decoder(&file, Format::Laz);
}

/// Reads text as a camera file, for an image of unknown size and for one of known size.
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

/// Decompresses bytes as LZF to several sizes, and checks that compression and decompression restore the bytes.
///
/// # Panics
/// If a size or the restored bytes differ.
pub fn check_lzf(bytes: &[u8]) {
    for size in [0, bytes.len(), 4 * bytes.len(), 1 << 20] {
        if let Ok(data) = decompress(bytes, size) {
            assert_eq!(data.len(), size);
        }
    }
    assert_eq!(decompress(&compress(bytes), bytes.len()).as_deref(), Ok(bytes));
}

/// Reads bytes as the file list of a data set in TUM layout.
///
/// # Panics
/// If the temporary files cannot be written.
pub fn check_tum(bytes: &[u8]) {
    let folder = own_path();
    fs::create_dir_all(&folder).expect("a folder for the list");
    let options = SourceOptions::default().with_camera(Some(Camera::kinect_v1()));
    for list in ["depth.txt", "associations.txt"] {
        fs::write(folder.join(list), bytes).expect("a list");
        if let Ok(mut source) = open(folder.to_str().expect("a name in UTF-8"), &options) {
            // A listed image may be missing, or may be a file of another kind.
            for _ in 0..4 {
                let _ = source.next_frame();
            }
        }
        fs::remove_file(folder.join(list)).expect("the list");
    }
}

/// Returns a temporary path for this process.
fn own_path() -> PathBuf {
    std::env::temp_dir().join(format!("planish-fuzz-{}", std::process::id()))
}
