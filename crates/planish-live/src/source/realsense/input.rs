//! The choice of a RealSense camera or recording.

use std::path::{Path, PathBuf};

/// A RealSense camera or recording.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RealSenseInput {
    /// The first camera found.
    Any,
    /// The camera with this serial number.
    Serial(String),
    /// A recording made by librealsense: .bag, or .db3 since version 2.58.
    Recording(PathBuf),
}

impl RealSenseInput {
    /// Parses the text after the colon of a source's name: empty, a file, or a serial number.
    pub(in crate::source) fn parse(name: &str) -> Self {
        let path = Path::new(name);
        let extension = path.extension().and_then(|extension| extension.to_str()).map(str::to_ascii_lowercase);
        let is_recording = matches!(extension.as_deref(), Some("bag" | "db3")) || path.is_file();
        match name {
            "" => Self::Any,
            _ if is_recording => Self::Recording(path.to_path_buf()),
            serial => Self::Serial(serial.to_owned()),
        }
    }
}
