//! ROS 2 recordings in MCAP: copied with their depth smoothed, read as a source of frames, or written from frames.
//!
//! Recordings are read and written record by record, so memory holds one chunk and one message, whatever the length
//! of the recording. Messages are types of [`ros`](crate::ros).

mod decompress;
mod foxglove;
mod parts;
mod poses;
mod records;
mod recover;
mod schemas;
mod smooth;
mod source;
mod survey;
mod wire;
mod writer;

use std::path::{Path, PathBuf};

use planish_core::{FormatError, IoError};
use planish_io::internal::brief;

pub use poses::{CameraPoses, PoseTopic, camera_trajectory};
pub use recover::{Recovered, part_of, recover};
pub use smooth::{SmoothBagOptions, SmoothBagReport, TopicReport, smooth_bag};
pub use source::BagSource;
pub use survey::{MessageKind, OtherTopic, Survey, Topic};
pub use writer::{BagWriter, finish_recordings, refuse_cut_off};

/// The magic bytes at the beginning of an MCAP recording.
const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// Returns true if a path is an MCAP recording: a file that begins with the magic bytes of MCAP, or a rosbag2 folder
/// with .mcap files.
pub fn is_bag(path: &Path) -> bool {
    let has_parts = || match parts::parts_of(path) {
        Ok(parts) => parts.iter().any(|part| is_named_mcap(part)),
        Err(_) => true,
    };
    is_recording(path) || path.join("metadata.yaml").is_file() && has_parts()
}

/// Returns true if a file begins with the magic bytes of MCAP.
fn is_recording(path: &Path) -> bool {
    use std::io::Read;
    let mut first = [0; 8];
    path.is_file()
        && std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut first)).is_ok()
        && first == MAGIC
}

/// Returns the path to read for a recording: `path` itself, or the only .mcap file of a rosbag2 folder. A folder with
/// several files is returned unchanged; its files are read one after another.
///
/// # Errors
/// If a rosbag2 folder contains recordings in another format, or lacks a file that it lists.
pub fn file_of(path: &Path) -> Result<PathBuf, IoError> {
    if !path.join("metadata.yaml").is_file() {
        return Ok(path.to_path_buf());
    }
    let parts = parts::parts_of(path).map_err(IoError::at(path))?;
    let other = parts.iter().find_map(|part| refuse_other_bags(part).err());
    match (&parts[..], other) {
        (_, Some(other)) => Err(other),
        ([], None) => {
            let files = std::fs::read_dir(path).map_err(|error| IoError::at(path)(error.into()))?;
            let mut files = files.flatten().map(|entry| entry.path());
            files.find_map(|file| refuse_other_bags(&file).err()).map_or_else(|| Ok(path.to_path_buf()), Err)
        }
        ([only], None) => Ok(only.clone()),
        (_, None) => Ok(path.to_path_buf()),
    }
}

/// Refuses recordings in other formats by name (ROS 1, ROS 2 in SQLite, compressed files) and states the command that
/// converts them.
pub fn refuse_other_bags(path: &Path) -> Result<(), IoError> {
    let name = path.display();
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default().to_ascii_lowercase();
    let is_compressed = extension == "zstd" && path.file_stem().is_some_and(|stem| is_named_mcap(Path::new(stem)));
    let kind = match extension.as_str() {
        "bag" => "ROS 1 recordings",
        "db3" => "ROS 2 recordings in SQLite",
        _ if is_compressed => {
            let problem = format!("compressed files are not supported; decompress the recording with `zstd -d {name}`");
            return Err(IoError { path: path.to_path_buf(), problem: FormatError::Unsupported(problem) });
        }
        _ => return Ok(()),
    };
    Err(IoError {
        path: path.to_path_buf(),
        problem: FormatError::Unsupported(format!(
            "{kind} are not supported; convert the file to MCAP with `pip install rosbags`, then `rosbags-convert \
             --src {name} --dst converted --dst-storage mcap`; for a RealSense recording use the source \
             realsense:{name}"
        )),
    })
}

/// Returns true if a file name has the extension of an MCAP recording.
pub fn is_named_mcap(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Converts an error of the MCAP reader or writer.
fn of_mcap(error: mcap::McapError) -> FormatError {
    match error {
        mcap::McapError::Io(error) => FormatError::Os(error),
        mcap::McapError::RecordTooLarge { len, .. } | mcap::McapError::ChunkTooLarge(len) => {
            FormatError::Malformed(format!("a record of {len} bytes exceeds the memory limit or the size of the file"))
        }
        error => FormatError::Malformed(brief(&format!("damaged: {error}"))),
    }
}
