//! Reads files of any supported format.

use std::fs;
use std::io::Read;
use std::path::Path;

#[cfg(feature = "scans")]
use planish_core::PointCloud;
use planish_core::{Camera, DepthFrame, FormatError, IoError, OrganizedCloud};

use super::contents::{Contents, DepthSummary, organized_if_grid};
#[cfg(feature = "exr")]
use super::depth_exr;
#[cfg(feature = "tiff")]
use super::depth_tiff;
#[cfg(feature = "scans")]
use super::e57;
#[cfg(not(all(feature = "exr", feature = "more-formats", feature = "npz", feature = "scans", feature = "tiff")))]
use super::format::left_out;
use super::format::{self, Encoding, Format};
use super::input::{FormatResult, ReadOptions, read_bytes};
#[cfg(feature = "scans")]
use super::las::{self, LasReader};
#[cfg(feature = "npz")]
use super::npz;
use super::plain::plain;
#[cfg(feature = "scans")]
use super::ply::PlyReader;
#[cfg(feature = "scans")]
use super::records::RecordReader;
use super::{depth_png, meaning, mesh, npy, pcd, ply, xyz_text};
#[cfg(feature = "more-formats")]
use super::{gltf, kitti, netpbm, ptx};

/// Summarizes the 16-bit depth image in a PNG or TIFF file without storing its pixels in memory. Returns `None` for
/// other formats and other TIFF images.
pub fn summarize_depth(path: &Path, options: &ReadOptions) -> Result<Option<(Format, DepthSummary)>, IoError> {
    /// Number of leading bytes that suffice to recognize PNG and TIFF.
    const MAGIC_BYTES: u64 = 8;
    let summarize = || {
        if !fs::metadata(path)?.is_file() {
            return Ok(None);
        }
        let mut start = Vec::new();
        fs::File::open(path)?.take(MAGIC_BYTES).read_to_end(&mut start)?;
        let format = Format::of_contents(&start);
        let summary = match format {
            Some(Format::DepthPng) => Some(depth_png::summarize(&read_bytes(path, options)?, options)?),
            #[cfg(feature = "tiff")]
            Some(Format::DepthTiff) => depth_tiff::summarize(&read_bytes(path, options)?, options)?,
            _ => None,
        };
        Ok(format.zip(summary))
    };
    summarize().map_err(IoError::at(path))
}

/// Reads a file of any supported format; the path `-` means standard input. Pipes, sockets and devices are errors.
pub fn read(path: &Path) -> Result<(Format, Contents), IoError> {
    read_with(path, &ReadOptions::default())
}

/// Same as [`read`], with options.
pub fn read_with(path: &Path, options: &ReadOptions) -> Result<(Format, Contents), IoError> {
    read_file(path, options).map(|file| (file.format, file.contents))
}

/// Reads a LAS, LAZ or PLY file in parts of at most `points_at_once` points, and calls `visit` for each. A part is a
/// cloud with all fields and its own origin; a file without points yields one empty cloud. Returns the file's format
/// and [`FileRead::notes`].
#[cfg(feature = "scans")]
pub fn read_in_parts(
    path: &Path,
    points_at_once: usize,
    mut visit: impl FnMut(&PointCloud),
) -> Result<(Format, Vec<String>), IoError> {
    fn read<R: RecordReader>(
        path: &Path,
        at_once: usize,
        visit: &mut dyn FnMut(&PointCloud),
    ) -> FormatResult<(R::Header, Vec<String>)> {
        let mut reader = R::open(path)?;
        let header = reader.header().clone();
        let is_empty = reader.points() == 0;
        loop {
            let records = reader.next_records(at_once.max(1))?;
            let is_last = records.is_empty();
            if !is_last || is_empty {
                visit(&R::cloud_of(&header, records)?);
            }
            if is_last {
                return Ok((header, reader.notes()));
            }
        }
    }
    let read = match Format::of_extension(path) {
        Some(Format::Ply) => read::<PlyReader>(path, points_at_once, &mut visit).map(|(_, notes)| (Format::Ply, notes)),
        _ => read::<LasReader>(path, points_at_once, &mut visit).map(|(header, notes)| {
            let is_compressed = header.header.point_format().is_compressed;
            (if is_compressed { Format::Laz } else { Format::Las }, notes)
        }),
    };
    read.map_err(IoError::at(path))
}

/// The contents and format of a file, with notes on reading it.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct FileRead {
    /// The format of the file.
    pub format: Format,
    /// The encoding of a PCD or PLY file; `None` for other formats.
    pub encoding: Option<Encoding>,
    /// The contents of the file.
    pub contents: Contents,
    /// The camera of a depth image, if the file states one.
    pub camera: Option<Camera>,
    /// Notes for users on dropped data and guesses, one clause each.
    pub notes: Vec<String>,
}

/// Same as [`read_with`], but also returns the encoding, the camera and notes.
pub fn read_file(path: &Path, options: &ReadOptions) -> Result<FileRead, IoError> {
    let read = || {
        let bytes = read_bytes(path, options)?;
        let (bytes, announced) = (plain(&bytes, options)?, Format::of_input(path));
        if let (None, None, Some(what)) = (Format::of_contents(&bytes), announced, format::what_converts(path)) {
            return Err(FormatError::Unsupported(what.into()));
        }
        let mut beside = Beside { folder: path.parent(), ..Beside::default() };
        let (format, contents) = decode_plain(&bytes, announced, options, &mut beside)?;
        let Beside { camera, notes, .. } = beside;
        let encoding = match format {
            Format::Pcd => pcd::encoding(&bytes),
            Format::Ply => ply::encoding(&bytes),
            _ => None,
        };
        Ok(FileRead { format, encoding, contents, camera, notes })
    };
    read().map_err(IoError::at(path))
}

/// Decodes a file's contents. `announced` is the format that the file's extension names, for contents that do not
/// identify their format.
pub fn decode(bytes: &[u8], announced: Option<Format>) -> FormatResult<(Format, Contents)> {
    decode_with(bytes, announced, &ReadOptions::default())
}

/// Same as [`decode`], with options.
pub fn decode_with(bytes: &[u8], announced: Option<Format>, options: &ReadOptions) -> FormatResult<(Format, Contents)> {
    decode_plain(&plain(bytes, options)?, announced, options, &mut Beside::default())
}

/// Additional inputs and outputs of the decoders.
#[derive(Default)]
struct Beside<'a> {
    /// The folder that contains the file, for formats that consist of several files.
    #[cfg_attr(not(feature = "more-formats"), allow(dead_code))]
    folder: Option<&'a Path>,
    camera: Option<Camera>,
    notes: Vec<String>,
}

/// Decodes uncompressed bytes, as returned by [`plain`].
fn decode_plain(
    bytes: &[u8],
    announced: Option<Format>,
    options: &ReadOptions,
    beside: &mut Beside<'_>,
) -> FormatResult<(Format, Contents)> {
    let notes = &mut beside.notes;
    if bytes.is_empty() {
        return Err(FormatError::Malformed("the file is empty".into()));
    }
    let likely = || xyz_text::is_likely(bytes).then_some(Format::Text);
    let format = Format::of_contents(bytes).or(announced).or_else(likely).ok_or_else(|| {
        FormatError::Unsupported(
            "not a point cloud or depth image; expected PCD, PLY, LAS, LAZ, E57, PTX, XYZ text, CSV, NPY, NPZ, \
             lidar .bin, OBJ, OFF, STL, glTF, 16-bit PNG or PGM, TIFF, EXR or PFM"
                .into(),
        )
    })?;
    #[cfg(any(feature = "more-formats", feature = "tiff"))]
    if !matches!(format, Format::DepthTiff | Format::Npy) {
        options.image_of(1, notes)?;
    }
    // The decoders of these formats check only the memory that they allocate, so the file's bytes are counted here.
    let counts_file = matches!(
        format,
        Format::Pcd
            | Format::Ply
            | Format::Text
            | Format::Csv
            | Format::Npz
            | Format::Obj
            | Format::Off
            | Format::Gltf
            | Format::DepthTiff
    );
    let used = if crate::HAS_ROOM && counts_file { bytes.len() } else { 0 };
    let mut decode = |options: &ReadOptions| match format {
        Format::Pcd => organized_if_grid(pcd::decode(bytes, options)?),
        Format::Ply => organized_if_grid(ply::decode(bytes, options, notes)?),
        Format::DepthPng => Ok(Contents::Depth(depth_png::decode(bytes, options)?)),
        #[cfg(feature = "tiff")]
        Format::DepthTiff => depth_tiff::decode(bytes, options, notes),
        Format::Npy => npy::decode(bytes, options, notes),
        #[cfg(feature = "scans")]
        Format::Las | Format::Laz => Ok(Contents::General(las::decode(bytes, options, notes)?)),
        Format::Text | Format::Csv => Ok(Contents::General(xyz_text::decode(bytes, options, notes)?)),
        #[cfg(feature = "npz")]
        Format::Npz => npz::decode(bytes, options, notes).map(|(contents, own)| {
            beside.camera = own;
            contents
        }),
        #[cfg(feature = "scans")]
        Format::E57 => Ok(Contents::General(e57::decode(bytes, options, notes)?)),
        #[cfg(feature = "more-formats")]
        Format::KittiBin => Ok(Contents::General(kitti::decode(bytes, false, options, notes)?)),
        #[cfg(feature = "more-formats")]
        Format::NuScenesBin => Ok(Contents::General(kitti::decode(bytes, true, options, notes)?)),
        Format::Obj => Ok(Contents::General(mesh::decode_obj(bytes, options, notes)?)),
        Format::Stl => Ok(Contents::General(mesh::decode_stl(bytes, options)?)),
        #[cfg(feature = "more-formats")]
        Format::Off => Ok(Contents::General(mesh::decode_off(bytes, options, notes)?)),
        #[cfg(feature = "more-formats")]
        Format::Ptx => Ok(Contents::General(ptx::decode(bytes, options, notes)?)),
        #[cfg(feature = "more-formats")]
        Format::Pgm => netpbm::decode_pgm(bytes, options),
        #[cfg(feature = "more-formats")]
        Format::Pfm => netpbm::decode_pfm(bytes, options),
        #[cfg(feature = "more-formats")]
        Format::Gltf => Ok(Contents::General(gltf::decode(bytes, beside.folder, options, notes)?)),
        #[cfg(feature = "exr")]
        Format::Exr => depth_exr::decode(bytes, options, notes),
        #[cfg(not(all(
            feature = "exr",
            feature = "more-formats",
            feature = "npz",
            feature = "scans",
            feature = "tiff"
        )))]
        _ => Err(left_out(format)),
    };
    let mut contents = if crate::HAS_ROOM { options.beside(used, decode)? } else { decode(options)? };
    if let Contents::Organized(cloud) = &mut contents {
        meaning::holes_at_sensor(cloud, notes);
    }
    meaning::to_metres(&mut contents, options, notes)?;
    Ok((format, contents))
}

/// Reads a 16-bit depth image (PNG, TIFF, NPY or another format), and combines it with its camera.
pub fn read_depth_frame(path: &Path, camera: Camera) -> Result<DepthFrame, IoError> {
    match read(path)?.1 {
        Contents::Depth(image) => DepthFrame::from_image(camera, image).map_err(FormatError::from),
        _ => Err(FormatError::Unsupported("the file is not a 16-bit depth image".into())),
    }
    .map_err(IoError::at(path))
}

/// Reads an organized cloud (PCD, PLY, NPY or NPZ).
pub fn read_organized(path: &Path) -> Result<OrganizedCloud, IoError> {
    match read(path)?.1 {
        Contents::Organized(cloud) => Ok(cloud),
        _ => Err(FormatError::Unsupported("the file is not an organized cloud".into())),
    }
    .map_err(IoError::at(path))
}
