//! Output folders for live frames, which are often the only copy of a measurement.

use std::path::Path;

use planish_core::{FormatError, IoError};

/// Refuses a folder that is not empty: its files could be overwritten or mixed with the new ones, and links in it may
/// point elsewhere. Hidden files are ignored.
pub(crate) fn refuse_used(folder: &Path) -> Result<(), IoError> {
    let at = |error: std::io::Error| IoError { path: folder.to_path_buf(), problem: error.into() };
    let entries = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(at)?,
    };
    for entry in entries {
        let name = entry.map_err(at)?.file_name();
        if !name.as_encoded_bytes().starts_with(b".") {
            let problem = FormatError::Unsupported("the folder is not empty; choose a new or an empty one".into());
            return Err(IoError { path: folder.to_path_buf(), problem });
        }
    }
    Ok(())
}
