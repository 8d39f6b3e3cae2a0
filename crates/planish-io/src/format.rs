//! Detects file formats, and suggests programs that convert unsupported ones.

use std::path::Path;

use super::FormatResult;
use super::write::is_origin_mask;
use planish_core::FormatError;

/// The extensions of formats that can be written, for messages.
pub const WRITTEN: &str = ".pcd, .ply, .las, .laz, .e57, .xyz, .csv, .npz, .bin, .png, .tiff or .npy";

/// Extensions of unsupported formats, and advice on how to convert each.
const CONVERTIBLE: [(&[&str], &str); 7] = [
    (
        &["fls", "fws", "lsproj", "rcp", "rcs", "zfs", "dp", "imp"],
        "unsupported scanner format; export E57 or LAS with the manufacturer's software",
    ),
    (
        &["bag", "db3", "mcap"],
        "ROS recordings are not supported here; `planish smooth` and `planish stream` read MCAP; convert others with \
         `pip install rosbags` and \
         `rosbags-convert --src FILE --dst converted --dst-storage mcap`",
    ),
    (
        &["pcap", "pcapng"],
        "unsupported lidar packets; extract clouds with the lidar's driver (ouster-cli, VeloView, pcap tools)",
    ),
    (&["oni", "klg", "svo", "svo2"], "unsupported camera recording; export depth images with the camera's own tool"),
    (
        &["vtk", "vtp", "fbx", "3ds", "dae", "wrl", "x3d"],
        "unsupported mesh format; convert the mesh to PLY (MeshLab, or open3d.io)",
    ),
    (&["hdr", "dpt", "h5", "hdf5", "mat", "parquet"], "unsupported array format; save the array as .npy or .npz"),
    (&["ptg"], "unsupported scanner format; convert the scans to E57 (CloudCompare) to keep their poses"),
];

/// Returns advice on converting a file with an unsupported extension, if known.
pub(super) fn what_converts(path: &Path) -> Option<&'static str> {
    let extension = path.extension()?.to_str()?.to_ascii_lowercase();
    CONVERTIBLE.iter().find(|(endings, _)| endings.contains(&extension.as_str())).map(|(_, what)| *what)
}

/// The file formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Format {
    /// The Point Cloud Library's PCD v0.7.
    Pcd,
    /// Stanford's PLY.
    Ply,
    /// A depth image as 16-bit grayscale PNG.
    DepthPng,
    /// A depth image as grayscale TIFF.
    DepthTiff,
    /// A NumPy array of depth or points.
    Npy,
    /// ASPRS LAS 1.0 to 1.4. LAS 1.5 is read as LAS 1.4.
    Las,
    /// Compressed LAS, COPC included.
    Laz,
    /// Lines of numbers (XYZ, TXT, ASC, PTS): x, y, z and optional further columns.
    Text,
    /// Comma-separated values whose first line names the columns.
    Csv,
    /// A NumPy archive of points and their fields, or of depth.
    Npz,
    /// ASTM E57: scans with their poses.
    E57,
    /// Lidar scans as f32 without a header, such as KITTI's: x, y, z, intensity.
    KittiBin,
    /// nuScenes lidar scans as f32 without a header: x, y, z, intensity, ring.
    NuScenesBin,
    /// The vertices of a Wavefront OBJ; read-only.
    Obj,
    /// The vertices of an STL; read-only.
    Stl,
    /// The vertices of an OFF; read-only.
    Off,
    /// The vertices of a glTF or GLB; read-only.
    Gltf,
    /// Leica's PTX text scans; read-only.
    Ptx,
    /// A depth image as 16-bit grey Netpbm (PGM); read-only.
    Pgm,
    /// A depth image as Netpbm floats (PFM); read-only.
    Pfm,
    /// A depth image in OpenEXR; read-only.
    Exr,
}

impl Format {
    /// Returns the format's common name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pcd => "PCD",
            Self::Ply => "PLY",
            Self::DepthPng => "PNG",
            Self::DepthTiff => "TIFF",
            Self::Npy => "NPY",
            Self::Las => "LAS",
            Self::Laz => "LAZ",
            Self::Text => "text",
            Self::Csv => "CSV",
            Self::Npz => "NPZ",
            Self::E57 => "E57",
            Self::KittiBin => "lidar .bin",
            Self::NuScenesBin => "nuScenes .pcd.bin",
            Self::Obj => "OBJ",
            Self::Stl => "STL",
            Self::Off => "OFF",
            Self::Gltf => "glTF",
            Self::Ptx => "PTX",
            Self::Pgm => "PGM",
            Self::Pfm => "PFM",
            Self::Exr => "EXR",
        }
    }

    /// Returns true if the format can be written, not only read.
    pub fn is_written(self) -> bool {
        !matches!(self, Self::Obj | Self::Stl | Self::Off | Self::Gltf | Self::Ptx | Self::Pgm | Self::Pfm | Self::Exr)
    }

    /// Returns the format that a path's extension names.
    pub fn of_extension(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "pcd" => Some(Self::Pcd),
            "ply" => Some(Self::Ply),
            "png" => Some(Self::DepthPng),
            "tif" | "tiff" => Some(Self::DepthTiff),
            "npy" => Some(Self::Npy),
            "las" => Some(Self::Las),
            "laz" => Some(Self::Laz),
            "xyz" | "txt" | "asc" | "pts" => Some(Self::Text),
            "csv" => Some(Self::Csv),
            "npz" => Some(Self::Npz),
            "e57" => Some(Self::E57),
            "bin" if path.file_stem()?.to_str()?.to_ascii_lowercase().ends_with(".pcd") => Some(Self::NuScenesBin),
            "bin" => Some(Self::KittiBin),
            "obj" => Some(Self::Obj),
            "stl" => Some(Self::Stl),
            "off" => Some(Self::Off),
            "gltf" | "glb" => Some(Self::Gltf),
            "ptx" => Some(Self::Ptx),
            "pgm" => Some(Self::Pgm),
            "pfm" => Some(Self::Pfm),
            "exr" => Some(Self::Exr),
            _ => None,
        }
    }

    /// Returns the format that an input's extension names, ignoring a final `.gz`.
    pub(super) fn of_input(path: &Path) -> Option<Self> {
        let is_gzip = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gz"));
        Self::of_extension(path).or_else(|| if is_gzip { Self::of_extension(&path.with_extension("")) } else { None })
    }

    /// Returns true if a file in a folder counts as a frame, judging by its extension. The ambiguous extensions .txt,
    /// .csv, .obj, .off, .stl, .gltf and .glb are excluded, and so are origin masks.
    pub fn is_of_frames(path: &Path) -> bool {
        let may_be_anything = |extension: &std::ffi::OsStr| {
            ["txt", "csv", "obj", "off", "stl", "gltf", "glb"].iter().any(|name| extension.eq_ignore_ascii_case(name))
        };
        let is_frame = Self::of_extension(path).is_some() && !is_origin_mask(path);
        is_frame && !path.extension().is_some_and(may_be_anything)
    }

    /// Returns the format that a file's first bytes identify.
    pub(super) fn of_contents(bytes: &[u8]) -> Option<Self> {
        let starts = |magic: &[u8]| bytes.starts_with(magic);
        if starts(b"ply\n") || starts(b"ply\r") {
            Some(Self::Ply)
        } else if starts(b"\x89PNG\r\n\x1a\n") {
            Some(Self::DepthPng)
        } else if starts(b"II*\0") || starts(b"MM\0*") {
            Some(Self::DepthTiff)
        } else if starts(b"\x93NUMPY") {
            Some(Self::Npy)
        } else if starts(b"PK\x03\x04") {
            Some(Self::Npz)
        } else if starts(b"ASTM-E57") {
            Some(Self::E57)
        } else if starts(b"glTF") {
            Some(Self::Gltf)
        } else if starts(b"\x76\x2f\x31\x01") {
            Some(Self::Exr)
        } else if starts(b"LASF") {
            Some(las_or_laz(bytes))
        } else if starts(b"# .PCD") || starts(b"VERSION") || starts(b"FIELDS") {
            Some(Self::Pcd)
        } else {
            None
        }
    }

    pub(super) fn of_output(path: &Path) -> FormatResult<Self> {
        Self::of_extension(path)
            .ok_or_else(|| FormatError::Unsupported(format!("unknown file extension; expected {WRITTEN}")))
    }
}

/// Distinguishes LAS and LAZ by the compression bit in the header's point format.
pub(super) fn las_or_laz(bytes: &[u8]) -> Format {
    const POINT_FORMAT_AT: usize = 104;
    match bytes.get(POINT_FORMAT_AT) {
        Some(number) if number & 0x80 != 0 => Format::Laz,
        _ => Format::Las,
    }
}

/// The encoding of the points in a PCD or PLY file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Encoding {
    /// Text.
    Ascii,
    /// Little-endian binary.
    #[default]
    Binary,
    /// Binary compressed with LZF (PCD only; PLY is written as plain binary).
    BinaryCompressed,
}

/// Returns the error for a format that is disabled in this build.
#[cfg(not(all(feature = "exr", feature = "more-formats", feature = "npz", feature = "scans", feature = "tiff")))]
pub(crate) fn left_out(format: Format) -> FormatError {
    let feature = match format {
        Format::Npz => "npz",
        Format::DepthTiff => "tiff",
        Format::Exr => "exr",
        Format::Las | Format::Laz | Format::E57 => "scans",
        _ => "more-formats",
    };
    FormatError::Unsupported(format!(
        "{} is not supported by this build; enable planish's feature `{feature}`",
        format.name()
    ))
}
