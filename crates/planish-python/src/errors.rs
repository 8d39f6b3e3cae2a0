//! Errors of the library as Python's own.

use planish::{EngineError, Error, FormatError, FrameError, IoError, ParamError};
use pyo3::PyErr;
use pyo3::exceptions::{PyFileNotFoundError, PyMemoryError, PyOSError, PyRuntimeError, PyValueError};

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
            // Python makes of the number the right kind: FileNotFoundError, PermissionError, ...
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
