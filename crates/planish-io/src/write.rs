//! Writes clouds and depth images to files, and encodes them as bytes.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::atomic_write::check_target;
use super::depth_png::encode_png;
#[cfg(feature = "tiff")]
use super::depth_tiff;
#[cfg(feature = "more-formats")]
use super::kitti;
#[cfg(not(all(feature = "exr", feature = "more-formats", feature = "npz", feature = "scans", feature = "tiff")))]
use super::left_out;
#[cfg(feature = "npz")]
use super::npz;
use super::xyz_text::Heading;
use super::{CloudRef, Encoding, Format, depth_png, npy, pcd, ply, write_whole, xyz_text};
#[cfg(feature = "scans")]
use super::{e57, las};
use planish_core::{DepthImage, FormatError, IoError, Outputs, Smoothed};

/// Returns true if two paths refer to the same file, including through symbolic links and, on Unix, hard links.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let identity = |path: &Path| std::fs::metadata(path).map(|metadata| (metadata.dev(), metadata.ino())).ok();
        identity(a).is_some_and(|a| identity(b) == Some(a))
    }
    #[cfg(not(unix))]
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
}

/// Returns an error if f32 would round coordinates by more than a tenth of a millimetre. Use it for formats that store
/// coordinates only as f32.
pub(crate) fn check_f32(origin_m: [f64; 3], mut positions: impl Iterator<Item = [f32; 3]>) -> Result<(), FormatError> {
    const FINE_M: f64 = 1e-4;
    let rounding_m = |axis: usize, value: f32| {
        let exact = origin_m[axis] + f64::from(value);
        (f64::from(exact as f32) - exact).abs()
    };
    let is_coarse = |p: [f32; 3]| (0..3).any(|axis| rounding_m(axis, p[axis]) > FINE_M);
    if origin_m != [0.0; 3] && positions.any(is_coarse) {
        let text = "the format stores coordinates as f32, which would round them by more than 0.1 mm; write .ply or \
                    another format, or subtract an offset";
        return Err(FormatError::Unsupported(text.into()));
    }
    Ok(())
}

/// Encodes a cloud as the bytes of a file. Text files name their columns in a comment, CSV files in the first line.
/// LAS and LAZ drop holes, and NPY stores positions only.
///
/// # Errors
/// If the format cannot represent the cloud, or fields differ in length.
pub fn encode_cloud<'a>(
    format: Format,
    cloud: impl Into<CloudRef<'a>>,
    encoding: Encoding,
) -> Result<Vec<u8>, FormatError> {
    let cloud = cloud.into();
    cloud.points().validate()?;
    match format {
        Format::Pcd => pcd::encode(cloud, encoding),
        Format::Ply => ply::encode(cloud, encoding),
        Format::Npy => Ok(npy::encode_points(cloud)),
        #[cfg(feature = "scans")]
        Format::Las | Format::Laz => las::encode(cloud.points(), format == Format::Laz),
        Format::Text => xyz_text::encode(cloud, Heading::Comment),
        Format::Csv => xyz_text::encode(cloud, Heading::Names),
        #[cfg(feature = "npz")]
        Format::Npz => npz::encode(cloud),
        #[cfg(feature = "scans")]
        Format::E57 => e57::encode(cloud.points()),
        #[cfg(feature = "more-formats")]
        Format::KittiBin => kitti::encode(cloud, false),
        #[cfg(feature = "more-formats")]
        Format::NuScenesBin => kitti::encode(cloud, true),
        Format::Obj | Format::Stl | Format::Off | Format::Gltf => Err(FormatError::Unsupported(
            "a mesh format cannot store points without faces; write .ply, which meshing programs read".into(),
        )),
        Format::Ptx => Err(FormatError::Unsupported("PTX can be read but not written; write .e57".into())),
        Format::DepthPng | Format::DepthTiff | Format::Pgm | Format::Pfm | Format::Exr => {
            Err(FormatError::Unsupported(
                "an image cannot store points; write .pcd, .ply, .las, .laz, .xyz, .csv or .npy".into(),
            ))
        }
        #[cfg(not(all(
            feature = "exr",
            feature = "more-formats",
            feature = "npz",
            feature = "scans",
            feature = "tiff"
        )))]
        _ => Err(left_out(format)),
    }
}

/// Checks in advance that an output can be written: its folder exists and is writable, and its format can represent the
/// cloud's fields and the `added` outputs.
///
/// # Errors
/// If [`write_cloud`] would fail, except because of individual values.
pub fn check_writable<'a>(path: &Path, cloud: impl Into<CloudRef<'a>>, added: Outputs) -> Result<(), IoError> {
    let mut none = cloud.into().points().select(&[]);
    let mut result = Smoothed::default();
    result.prepare(0, 1, added);
    for (name, values) in result.fields(added) {
        none.set_attribute(name, values);
    }
    let encode = || encode_cloud(Format::of_output(path)?, &none, Encoding::Binary);
    encode().and_then(|_| check_target(path)).map_err(IoError::at(path))
}

/// Encodes a depth image as the bytes of a file: 16-bit PNG, TIFF or NPY.
///
/// # Errors
/// If the format cannot store depth, or the image is too large for it.
pub fn encode_depth(format: Format, image: &DepthImage) -> Result<Vec<u8>, FormatError> {
    match format {
        Format::DepthPng => depth_png::encode(image),
        #[cfg(feature = "tiff")]
        Format::DepthTiff => depth_tiff::encode(image),
        #[cfg(not(feature = "tiff"))]
        Format::DepthTiff => Err(left_out(format)),
        Format::Npy => Ok(npy::encode_depth(image)),
        _ => Err(FormatError::Unsupported("this format cannot store depth; write .png, .tiff or .npy".into())),
    }
}

/// Writes a cloud in the format given by the path's extension: PCD, PLY, LAS, LAZ (without holes), E57, lines of text,
/// CSV, NPZ, a lidar's `.bin`, or NPY (positions only).
pub fn write_cloud<'a>(path: &Path, cloud: impl Into<CloudRef<'a>>, encoding: Encoding) -> Result<(), IoError> {
    let cloud = cloud.into();
    let encode = || match Format::of_output(path)? {
        Format::Text if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("pts")) => {
            cloud.points().validate()?;
            xyz_text::encode(cloud, Heading::Count)
        }
        Format::Text | Format::KittiBin if cloud.points().is_empty() => {
            let reason = "no points are left, and this format cannot store an empty cloud; write .csv, .pcd or .ply";
            Err(FormatError::Unsupported(reason.into()))
        }
        format => encode_cloud(format, cloud, encoding),
    };
    encode().and_then(|bytes| write_whole(path, &bytes)).map_err(IoError::at(path))
}

/// Writes a depth image in the format given by the path's extension: 16-bit PNG, TIFF or NPY.
pub fn write_depth(path: &Path, image: &DepthImage) -> Result<(), IoError> {
    let encode = || encode_depth(Format::of_output(path)?, image);
    encode().and_then(|bytes| write_whole(path, &bytes)).map_err(IoError::at(path))
}

/// Returns the path of a depth file's origin mask, NAME.origin.png in the same folder.
pub fn origin_mask_of(depth: &Path) -> PathBuf {
    depth.with_extension(ORIGIN)
}

/// Returns true for an origin mask: a file whose name ends in .origin.png and that is an 8-bit PNG, which no depth
/// image is.
pub(crate) fn is_origin_mask(path: &Path) -> bool {
    let has_name = path.file_name().is_some_and(|name| name.to_string_lossy().ends_with(&format!(".{ORIGIN}")));
    has_name && is_8_bit(path)
}

/// Returns true for a PNG with 8 bits per channel.
fn is_8_bit(path: &Path) -> bool {
    let mut start = [0; PNG_BIT_DEPTH + 1];
    let read = std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut start));
    read.is_ok() && start[PNG_BIT_DEPTH] == 8
}

/// Byte offset of the bit depth in a PNG: it follows the signature, and the header's length, type, width and height.
const PNG_BIT_DEPTH: usize = 24;

/// The extension of origin masks, which replaces the depth file's extension.
const ORIGIN: &str = "origin.png";

/// Writes the origin mask of a depth file, an 8-bit PNG in the same folder. Values are 0 for holes, 85 for filled
/// pixels, 170 for pixels carried over from the previous frame, and 255 for measured pixels. Write the mask before the
/// depth file, so that an interruption leaves no depth file without a mask.
///
/// # Errors
/// If the result has no status, the mask cannot be written, or a file that is not an 8-bit PNG has the mask's name.
pub fn write_origin_mask(depth: &Path, smoothed: &Smoothed) -> Result<(), IoError> {
    let path = origin_mask_of(depth);
    if path.exists() && !is_8_bit(&path) {
        let text = "the mask of filled pixels would replace this file; rename the file, or choose another output";
        return Err(IoError { path, problem: FormatError::Unsupported(text.to_owned()) });
    }
    let no_status = || FormatError::Unsupported("the mask of filled pixels needs the status of each pixel".to_owned());
    let encode = || {
        let mask = smoothed.origin_mask().ok_or_else(no_status)?;
        encode_png(smoothed.width, smoothed.height, png::ColorType::Grayscale, png::BitDepth::Eight, &mask)
    };
    encode().and_then(|bytes| write_whole(&path, &bytes)).map_err(IoError::at(&path))
}

/// Writes depth in metres as a NumPy array of f32, [height, width].
pub fn write_depth_metres(path: &Path, width: usize, depth_m: &[f32]) -> Result<(), IoError> {
    write_whole(path, &npy::encode_depth_metres(width, depth_m)).map_err(IoError::at(path))
}
