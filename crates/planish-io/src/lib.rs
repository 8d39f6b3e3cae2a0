//! Reading and writing files, without losing fields and without leaving half-written files.
//!
//! A format is detected from the contents first, then from the file's extension. Every reader checks what a header
//! claims against the bytes that are there before it allocates. One kind of damage ends the process: GPS times of LAZ
//! (point formats 6 to 10) that send the decoder, laz 0.13, into a recursion that overflows the stack. Read files of
//! strangers in a process of their own.

#![cfg_attr(docsrs, feature(doc_cfg))]
#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

mod atomic_write;
mod camera_file;
mod columns;
mod depth_png;
#[cfg(feature = "tiff")]
mod depth_tiff;
#[cfg(feature = "scans")]
mod e57;
mod format;
mod kitti;
#[cfg(feature = "scans")]
mod las;
mod little_endian;
mod mesh;
mod npy;
#[cfg(feature = "npz")]
mod npz;
mod pcd;
mod ply;
#[cfg(feature = "scans")]
mod records;
mod rgb_png;
mod settings_file;
mod text;
#[cfg(feature = "scans")]
pub mod tiles;
mod write;
mod xyz_text;

use std::fs;
use std::io::Read;
use std::path::Path;

use planish_core::{Camera, DepthFrame, DepthImage, FormatError, IoError, OrganizedCloud, PointCloud};

pub use self::format::{Format, WRITTEN};
#[cfg(feature = "scans")]
use atomic_write::{AtomicFile, Temporary, folder_of};
pub use atomic_write::{remove_temporaries, write_whole};
pub use camera_file::{camera_to_json, parse_camera, read_camera, unknown_camera_key};
#[cfg(feature = "scans")]
use las::LasReader;
pub use pcd::Encoding;
#[cfg(feature = "scans")]
use ply::PlyReader;
#[cfg(feature = "scans")]
use records::{RecordEncoder, RecordReader};
pub use settings_file::{parse_settings, read_settings, settings_to_json};
pub use write::{CloudRef, check_writable, encode_cloud, encode_depth, write_cloud, write_depth, write_depth_metres};

/// For planish's other crates and its own tests; it may change with every version.
#[doc(hidden)]
pub mod internal {
    pub use crate::atomic_write::AtomicFile;
    pub use crate::camera_file::{colmap_camera, read_text as camera_text, states_depth_scale};
    pub use crate::columns::{cloud_from_columns, columns_from_cloud, with_values};
    pub use crate::depth_png::{decode as decode_depth_png, encode as encode_depth_png};
    pub use crate::pcd::lzf;
    pub use crate::rgb_png::{read_rgb_png, write_rgb_png};
    pub use crate::{brief, quoted};
    pub use planish_core::AttributeValues;
}

/// The name that stands for standard input.
const STANDARD_INPUT: &str = "-";

pub(crate) type FormatResult<T> = Result<T, FormatError>;

/// The beginning of a text from a file, for error messages.
pub fn quoted(text: &str) -> String {
    const MOST: usize = 80;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{:?}...", &text[..end]),
        None => format!("{text:?}"),
    }
}

/// The beginning of a message that may quote a file, on one line.
pub fn brief(message: &str) -> String {
    const MOST: usize = 160;
    let message = message.split_whitespace().collect::<Vec<_>>().join(" ");
    match message.char_indices().nth(MOST) {
        Some((end, _)) => format!("{}...", &message[..end]),
        None => message,
    }
}

/// A picture, 3 bytes (red, green, blue) a pixel, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// 3 * width * height bytes.
    pub rgb: Vec<u8>,
}

/// How to read files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct ReadOptions {
    /// Files are refused before they are read if they are larger than this many bytes, and before they are decoded if
    /// what they decompress to and its columns or pixels need more. 2 GiB by default.
    pub max_memory_bytes: u64,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { max_memory_bytes: 2 << 30 }
    }
}

impl ReadOptions {
    /// The same with another limit in bytes.
    pub const fn with_max_memory_bytes(self, max_memory_bytes: u64) -> Self {
        Self { max_memory_bytes }
    }

    /// Refuses what needs more: a number of things of so many bytes each.
    pub fn check(&self, count: usize, bytes_each: usize) -> FormatResult<()> {
        let (needed, allowed) = (count as u64 as u128 * bytes_each as u128, self.max_memory_bytes);
        if needed <= u128::from(allowed) {
            return Ok(());
        }
        Err(FormatError::TooLarge { needed: u64::try_from(needed).unwrap_or(u64::MAX), allowed })
    }
}

/// The contents of a file.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Contents {
    /// A 16-bit depth image; it needs a camera to become points.
    Depth(DepthImage),
    /// Depth in metres; it needs a camera to become points.
    DepthMetres {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Depth in metres, row by row; holes are not finite, 0 or negative.
        depth_m: Vec<f32>,
    },
    /// Points on a pixel grid.
    Organized(OrganizedCloud),
    /// A general cloud: points in any order.
    General(PointCloud),
}

impl Contents {
    /// Width and height in pixels; the number of points and 1 for a general cloud.
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::Depth(image) => (image.width, image.height),
            Self::DepthMetres { width, height, .. } => (*width, *height),
            Self::Organized(cloud) => (cloud.width(), cloud.height()),
            Self::General(cloud) => (cloud.len(), 1),
        }
    }

    /// Whether it is depth and needs a camera.
    pub fn is_depth(&self) -> bool {
        matches!(self, Self::Depth(_) | Self::DepthMetres { .. })
    }
}

/// What a depth image of 16 bits holds, in brief.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct DepthSummary {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Pixels with a depth: neither 0 nor [`SATURATED_DEPTH`](planish_core::SATURATED_DEPTH).
    pub valid: usize,
    /// The smallest and largest of their raw values.
    pub raw: Option<[u16; 2]>,
}

impl DepthSummary {
    /// Adds pixels.
    pub(crate) fn add(&mut self, raw: impl Iterator<Item = u16>) {
        for raw in raw.filter(|&raw| raw != 0 && raw != planish_core::SATURATED_DEPTH) {
            self.valid += 1;
            let [low, high] = self.raw.unwrap_or([raw; 2]);
            self.raw = Some([low.min(raw), high.max(raw)]);
        }
    }
}

impl From<&DepthImage> for DepthSummary {
    fn from(image: &DepthImage) -> Self {
        let mut summary = Self { width: image.width, height: image.height, ..Self::default() };
        summary.add(image.raw.iter().copied());
        summary
    }
}

/// Summarizes a depth image in a PNG or TIFF file without holding it in memory; `None` for files of other formats.
pub fn summarize_depth(path: &Path, options: &ReadOptions) -> Result<Option<(Format, DepthSummary)>, IoError> {
    /// A file of these formats begins with no more.
    const MAGIC_BYTES: u64 = 8;
    let summarize = || {
        if !fs::metadata(path)?.is_file() {
            return Ok(None);
        }
        let mut start = Vec::new();
        fs::File::open(path)?.take(MAGIC_BYTES).read_to_end(&mut start)?;
        let format = Format::of_contents(&start);
        let summarize = match format {
            Some(Format::DepthPng) => depth_png::summarize,
            #[cfg(feature = "tiff")]
            Some(Format::DepthTiff) => depth_tiff::summarize,
            _ => return Ok(None),
        };
        let summary = summarize(&read_bytes(path, options)?, options)?;
        Ok(format.map(|format| (format, summary)))
    };
    summarize().map_err(IoError::at(path))
}

/// Reads a file of any format; `-` is standard input. Refuses what is no regular file, such as pipes, sockets and
/// devices.
pub fn read(path: &Path) -> Result<(Format, Contents), IoError> {
    read_with(path, &ReadOptions::default())
}

/// [`read`] with other options than the default.
pub fn read_with(path: &Path, options: &ReadOptions) -> Result<(Format, Contents), IoError> {
    read_file(path, options).map(|file| (file.format, file.contents))
}

/// Reads a LAS, LAZ or PLY file some points at a time, each part a cloud with all fields and an origin of its own; of a
/// file without points one empty cloud.
#[cfg(feature = "scans")]
pub fn read_in_parts(
    path: &Path,
    points_at_once: usize,
    mut visit: impl FnMut(&PointCloud),
) -> Result<Format, IoError> {
    fn read<R: RecordReader>(
        path: &Path,
        at_once: usize,
        visit: &mut dyn FnMut(&PointCloud),
    ) -> FormatResult<R::Header> {
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
                return Ok(header);
            }
        }
    }
    let read = match Format::of_extension(path) {
        Some(Format::Ply) => read::<PlyReader>(path, points_at_once, &mut visit).map(|_| Format::Ply),
        _ => read::<LasReader>(path, points_at_once, &mut visit)
            .map(|header| if header.point_format().is_compressed { Format::Laz } else { Format::Las }),
    };
    read.map_err(IoError::at(path))
}

/// A file that was read.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct FileRead {
    /// Its format.
    pub format: Format,
    /// How a PCD or PLY file stores its points; `None` for other formats.
    pub encoding: Option<Encoding>,
    /// What it holds.
    pub contents: Contents,
    /// What of it was left out, or taken for something that its name does not say: one clause each, for a user to read.
    pub notes: Vec<String>,
}

/// [`read_with`], with how the file stores its points.
pub fn read_file(path: &Path, options: &ReadOptions) -> Result<FileRead, IoError> {
    let read = || {
        let bytes = read_bytes(path, options)?;
        if let (None, None, Some(what)) =
            (Format::of_contents(&bytes), Format::of_extension(path), self::format::what_converts(path))
        {
            return Err(FormatError::Unsupported(what.into()));
        }
        let mut notes = Vec::new();
        let (format, contents) = decode_noting(&bytes, Format::of_extension(path), options, &mut notes)?;
        let encoding = match format {
            Format::Pcd => pcd::encoding(&bytes),
            Format::Ply => ply::encoding(&bytes),
            _ => None,
        };
        Ok(FileRead { format, encoding, contents, notes })
    };
    read().map_err(IoError::at(path))
}

/// The bytes of a regular file, or of standard input.
pub fn read_bytes(path: &Path, options: &ReadOptions) -> FormatResult<Vec<u8>> {
    let most = options.max_memory_bytes;
    let mut bytes = Vec::new();
    if path == Path::new(STANDARD_INPUT) {
        std::io::stdin().lock().take(most.saturating_add(1)).read_to_end(&mut bytes)?;
        options.check(bytes.len(), 1)?;
        return Ok(bytes);
    }
    // Asked before it is opened: opening a pipe waits for its other end.
    let metadata = fs::metadata(path)?;
    if metadata.is_dir() {
        return Err(FormatError::Unsupported("a folder, not a file".into()));
    }
    if !metadata.is_file() {
        return Err(FormatError::Unsupported(
            "a pipe or a device, not a regular file; standard input is read with the name -".into(),
        ));
    }
    options.check(usize::try_from(metadata.len()).unwrap_or(usize::MAX), 1)?;
    fs::File::open(path)?.take(most).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Decodes a file's contents; `announced` is the format of its extension, used where the contents are ambiguous.
pub fn decode(bytes: &[u8], announced: Option<Format>) -> FormatResult<(Format, Contents)> {
    decode_with(bytes, announced, &ReadOptions::default())
}

/// [`decode`] with other options than the default.
pub fn decode_with(bytes: &[u8], announced: Option<Format>, options: &ReadOptions) -> FormatResult<(Format, Contents)> {
    decode_noting(bytes, announced, options, &mut Vec::new())
}

/// The same, with [`FileRead::notes`].
fn decode_noting(
    bytes: &[u8],
    announced: Option<Format>,
    options: &ReadOptions,
    notes: &mut Vec<String>,
) -> FormatResult<(Format, Contents)> {
    if bytes.is_empty() {
        return Err(FormatError::Malformed("the file is empty".into()));
    }
    let likely = || xyz_text::is_likely(bytes).then_some(Format::Text);
    let format = Format::of_contents(bytes).or(announced).or_else(likely).ok_or_else(|| {
        FormatError::Unsupported(
            "not a point cloud or depth image: it is none of PCD, PLY, LAS, LAZ, E57, XYZ text, CSV, NPY, NPZ, lidar .bin, OBJ, STL, 16-bit PNG or TIFF".into(),
        )
    })?;
    let contents = match format {
        Format::Pcd => organized_if_grid(pcd::decode(bytes, options)?),
        Format::Ply => organized_if_grid(ply::decode(bytes, options, notes)?),
        Format::DepthPng => Ok(Contents::Depth(depth_png::decode(bytes, options)?)),
        #[cfg(feature = "tiff")]
        Format::DepthTiff => Ok(Contents::Depth(depth_tiff::decode(bytes, options)?)),
        Format::Npy => npy::decode(bytes, options),
        #[cfg(feature = "scans")]
        Format::Las | Format::Laz => Ok(Contents::General(las::decode(bytes, options)?)),
        Format::Text | Format::Csv => Ok(Contents::General(xyz_text::decode(bytes, options, notes)?)),
        #[cfg(feature = "npz")]
        Format::Npz => npz::decode(bytes, options, notes),
        #[cfg(feature = "scans")]
        Format::E57 => Ok(Contents::General(self::e57::decode(bytes, options, notes)?)),
        Format::KittiBin => Ok(Contents::General(kitti::decode(bytes, false, options)?)),
        Format::NuScenesBin => Ok(Contents::General(kitti::decode(bytes, true, options)?)),
        Format::Obj => Ok(Contents::General(mesh::decode_obj(bytes, options)?)),
        Format::Stl => Ok(Contents::General(mesh::decode_stl(bytes, options)?)),
        #[cfg(not(all(feature = "npz", feature = "scans", feature = "tiff")))]
        _ => Err(left_out(format)),
    }?;
    Ok((format, contents))
}

/// A cloud with the grid its file states; a height of 1 means none.
pub(crate) struct Gridded {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) points: PointCloud,
}

fn organized_if_grid(gridded: Gridded) -> FormatResult<Contents> {
    let Gridded { width, height, points } = gridded;
    if height > 1 {
        Ok(Contents::Organized(OrganizedCloud::new(width, height, points)?))
    } else {
        Ok(Contents::General(points))
    }
}

/// Of a format that this build was made without.
#[cfg(not(all(feature = "npz", feature = "scans", feature = "tiff")))]
fn left_out(format: Format) -> FormatError {
    let feature = match format {
        Format::Npz => "npz",
        Format::DepthTiff => "tiff",
        _ => "scans",
    };
    FormatError::Unsupported(format!("{}, which this build leaves out (planish's feature `{feature}`)", format.name()))
}

/// Reads a 16-bit depth image (PNG, TIFF or NPY) and combines it with its camera.
pub fn read_depth_frame(path: &Path, camera: Camera) -> Result<DepthFrame, IoError> {
    match read(path)?.1 {
        Contents::Depth(image) => DepthFrame::from_image(camera, image).map_err(FormatError::from),
        _ => Err(FormatError::Unsupported("not a 16-bit depth image".into())),
    }
    .map_err(IoError::at(path))
}

/// Reads an organized cloud (PCD, PLY or NPY).
pub fn read_organized(path: &Path) -> Result<OrganizedCloud, IoError> {
    match read(path)?.1 {
        Contents::Organized(cloud) => Ok(cloud),
        _ => Err(FormatError::Unsupported("not an organized cloud".into())),
    }
    .map_err(IoError::at(path))
}
