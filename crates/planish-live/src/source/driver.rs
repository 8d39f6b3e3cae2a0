//! Camera drivers: C libraries, loaded at run time and never linked.

use std::error::Error;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use libloading::Library;

use planish_core::DeviceError;

/// Declares a struct of functions from a C library, which are valid as long as the struct lives. `find` looks them up
/// by their names, to which it adds the common prefix.
macro_rules! c_functions {
    ($(#[$about:meta])* $visible:vis struct $name:ident($prefix:literal) {
        $($(#[$note:meta])* $function:ident($($argument:ty),* $(,)?) $(-> $result:ty)?;)*
    }) => {
        $(#[$about])*
        $visible struct $name {
            $($(#[$note])* $visible $function: unsafe extern "C" fn($($argument),*) $(-> $result)?,)*
            _library: libloading::Library,
        }

        impl $name {
            /// # Safety
            /// The library's functions with these names must have these signatures.
            unsafe fn find(library: libloading::Library) -> Result<Self, libloading::Error> {
                // SAFETY: as above; the functions are stored together with their library.
                unsafe {
                    Ok(Self {
                        $($function: *library.get(concat!($prefix, stringify!($function), "\0").as_bytes())?,)*
                        _library: library,
                    })
                }
            }
        }
    };
}
pub(super) use c_functions;

/// Loads a library once per process. It is never unloaded, since its threads keep running.
pub(super) fn load_once<T>(
    loaded: &Mutex<Option<&'static T>>,
    load: impl FnOnce() -> Result<T, DeviceError>,
) -> Result<&'static T, DeviceError> {
    let mut loaded = loaded.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(functions) = *loaded {
        return Ok(functions);
    }
    let functions: &'static T = Box::leak(Box::new(load()?));
    *loaded = Some(functions);
    Ok(functions)
}

/// Loads the file named by the environment variable, otherwise the first of the usual names that can be loaded.
pub(super) fn load(
    variable: &str,
    usual: impl IntoIterator<Item = String>,
    help: &'static str,
) -> Result<Library, DeviceError> {
    let named = std::env::var_os(variable).filter(|name| !name.is_empty());
    let names: Vec<_> = match named {
        Some(name) => vec![name],
        None => usual.into_iter().map(Into::into).collect(),
    };
    let mut first_error = None;
    for name in names {
        // SAFETY: loading a camera driver runs no code with preconditions.
        match unsafe { Library::new(&name) } {
            Ok(library) => return Ok(library),
            Err(error) => {
                // The underlying system error states the reason.
                let reason = error.source().map_or_else(|| error.to_string(), ToString::to_string);
                first_error.get_or_insert_with(|| format!("{} cannot be loaded: {reason}", Path::new(&name).display()));
            }
        }
    }
    Err(DeviceError::Driver { what: first_error.unwrap_or_else(|| "no driver file name is known".into()), help })
}
