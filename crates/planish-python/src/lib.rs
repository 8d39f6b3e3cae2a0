//! The extension module `planish._planish`: the library's types for Python. The public package is in `python/planish`.

mod arrays;
mod camera;
mod cuda;
mod dlpack;
mod errors;
mod files;
mod settings;
mod smoother;
mod stream;
mod tools;

use std::ffi::OsString;

use pyo3::prelude::*;

/// Runs the command `planish` with its arguments, the program's name first, and returns its exit code.
#[pyfunction]
fn command(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| planish_cli::run(arguments))
}

/// planish for Python.
#[pyo3::pymodule(gil_used = false)]
mod _planish {
    #[pymodule_export]
    use super::camera::PyCamera;
    #[pymodule_export]
    use super::command;
    #[pymodule_export]
    use super::cuda::PyCudaSmoother;
    #[pymodule_export]
    use super::dlpack::PyCudaArray;
    #[pymodule_export]
    use super::files::{
        devices, evaluate, origin_values, read, read_settings, settings_to_json, simulate, write_depth, write_points,
    };
    #[pymodule_export]
    use super::smoother::PySmoother;
    #[pymodule_export]
    use super::stream::PyStream;
    #[pymodule_export]
    use super::tools::{clean, compare_files, convert, draw, merge, mesh, prepare};

    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");
}
