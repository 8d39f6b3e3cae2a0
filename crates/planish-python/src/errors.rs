//! Conversion of the library's errors to Python exceptions.

use planish::{EngineError, Error, FormatError, FrameError, IoError, ParamError};
use std::ffi::CString;
use std::path::Path;

use pyo3::exceptions::{PyFileNotFoundError, PyMemoryError, PyOSError, PyRuntimeError, PyRuntimeWarning, PyValueError};
use pyo3::prelude::*;

/// Maps errors to `ValueError` for invalid input, `OSError` and its subclasses for files, `MemoryError`, and
/// `RuntimeError` for engines.
pub fn to_py(error: impl Into<Error>) -> PyErr {
    let error = error.into();
    let text = error.to_string();
    match error {
        Error::Param(_) | Error::Frame(_) => PyValueError::new_err(text),
        Error::Engine(EngineError::OutOfMemory { .. }) => PyMemoryError::new_err(text),
        Error::Io(IoError { path, problem: FormatError::Os(os) }) => match (os.kind(), os.raw_os_error()) {
            (std::io::ErrorKind::NotFound, None) => PyFileNotFoundError::new_err(text),
            // Python derives the subclass from the number: FileNotFoundError, PermissionError, ...
            (_, Some(number)) => PyOSError::new_err((number, os.to_string(), path.display().to_string())),
            _ => PyOSError::new_err(text),
        },
        Error::Io(IoError { problem: FormatError::TooLarge { .. }, .. }) => PyMemoryError::new_err(text),
        Error::Io(_) => PyValueError::new_err(text),
        _ => PyRuntimeError::new_err(text),
    }
}

pub fn param(error: ParamError) -> PyErr {
    to_py(error)
}

pub fn frame(error: FrameError) -> PyErr {
    to_py(error)
}

/// Raises warnings about dropped data and guesses in a file, attributed to the Python caller at stack level `level`.
pub fn warn(py: Python<'_>, path: &Path, notes: &[String], level: i32) -> PyResult<()> {
    for note in notes {
        // C strings cannot contain NUL.
        let text = format!("{}: {note}", path.display()).replace('\0', " ");
        let text = CString::new(text).unwrap_or_default();
        PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, level)?;
    }
    Ok(())
}
