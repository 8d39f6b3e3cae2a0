//! Reads and writes files, without losing fields and without leaving half-written files.
//!
//! A file's format is detected from its contents first, then from its extension. Before allocating memory, every reader
//! checks the sizes that a header claims against the file's size. In programs built from crates.io, one kind of damage
//! aborts the process: certain GPS times in LAZ files (point formats 6 to 10) make the decoder, laz 0.13, recurse until
//! the stack overflows. In such programs, read untrusted files in a separate process.

#![cfg_attr(docsrs, feature(doc_cfg))]
#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

/// False in WebAssembly, because the size of the web page is limited. That build omits some memory checks and checks
/// for rare contradictions.
pub(crate) const HAS_ROOM: bool = cfg!(not(target_family = "wasm"));

mod adapt;
mod atomic_write;
mod camera_file;
mod columns;
mod contents;
mod convert;
#[cfg(feature = "exr")]
mod depth_exr;
mod depth_png;
#[cfg(feature = "tiff")]
mod depth_tiff;
#[cfg(feature = "scans")]
mod e57;
mod error_text;
mod format;
mod frame_files;
#[cfg(feature = "more-formats")]
mod gltf;
mod guarded;
mod input;
#[cfg(feature = "more-formats")]
mod kitti;
#[cfg(feature = "scans")]
mod las;
mod length_unit;
mod little_endian;
mod meaning;
mod mesh;
#[cfg(feature = "more-formats")]
mod netpbm;
mod npy;
#[cfg(feature = "npz")]
mod npz;
mod pcd;
mod plain;
mod ply;
#[cfg(feature = "more-formats")]
mod ptx;
mod read;
#[cfg(feature = "scans")]
mod records;
mod rgb_png;
mod settings_file;
mod stack;
mod text;
#[cfg(feature = "scans")]
pub mod tiles;
mod trajectory;
mod triangle_files;
mod triangles;
mod write;
mod xyz_text;
mod yaml;

pub use adapt::{adapt_fields, losses};
pub use atomic_write::{is_read_only, remove_temporaries, replace_read_only_files, write_whole};
pub use camera_file::{
    CameraFile, camera_to_json, parse_camera, parse_camera_file, read_camera, read_camera_file, unknown_camera_key,
};
pub use contents::{CloudRef, Contents, DepthSummary, RgbImage};
pub(crate) use contents::{Gridded, depth_of_integers, organized_if_grid};
pub use convert::{ConvertOptions, ConvertReport, convert, write_merged};
pub(crate) use error_text::{brief, quoted, text_of};
pub use error_text::{printable, printable_line};
#[cfg(not(all(feature = "exr", feature = "more-formats", feature = "npz", feature = "scans", feature = "tiff")))]
pub(crate) use format::left_out;
pub use format::{Encoding, Format, WRITTEN};
pub use frame_files::frame_files;
pub(crate) use input::FormatResult;
#[cfg(feature = "scans")]
pub(crate) use {
    atomic_write::{AtomicFile, Temporary, folder_of},
    las::LasReader,
    ply::PlyReader,
    records::{RecordEncoder, RecordReader},
};

pub use input::{ReadOptions, Work, read_bytes};
pub use length_unit::LengthUnit;
pub use meaning::convert_to_metres;
#[cfg(feature = "scans")]
pub use read::read_in_parts;
pub use read::{
    FileRead, decode, decode_with, read, read_depth_frame, read_file, read_organized, read_with, summarize_depth,
};
pub use rgb_png::{read_rgb_png, write_animated_png, write_rgb_png};
pub use settings_file::{parse_settings, read_settings, settings_to_json};
pub use stack::Stack;
pub use trajectory::{Trajectory, read_trajectory, read_trajectory_with};
pub use triangle_files::{WRITTEN_MESHES, write_mesh};
pub use triangles::TriangleMesh;
pub use write::{
    check_writable, encode_cloud, encode_depth, is_same_file, origin_mask_of, write_cloud, write_depth,
    write_depth_metres, write_origin_mask,
};

/// Items for planish's other crates and tests; they may change with every version.
#[doc(hidden)]
pub mod internal {
    pub use crate::atomic_write::{AtomicFile, append_to, check_target, create_output_folder};
    pub use crate::camera_file::{colmap_camera, read_text as camera_text};
    pub use crate::columns::{cloud_from_columns, columns_from_cloud, with_values};
    pub use crate::depth_png::{decode as decode_depth_png, encode as encode_depth_png};
    pub use crate::error_text::{brief, quoted};
    pub use crate::guarded::{catches_panics, guarded};
    pub use crate::pcd::lzf;
    pub use crate::rgb_png::read_rgb_png_with;
    pub use crate::yaml::parse_yaml;
    pub use planish_core::AttributeValues;
}
