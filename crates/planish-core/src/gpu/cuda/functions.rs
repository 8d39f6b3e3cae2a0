//! Functions of libraries that are loaded at run time.

/// Defines `Functions`, the functions of one library, from their names and parameters. All return an int.
macro_rules! functions {
    ($($name:ident = $symbol:literal ( $($argument:ty),* );)*) => {
        /// The functions of the library.
        struct Functions {
            $($name: unsafe extern "C" fn($($argument),*) -> std::ffi::c_int,)*
        }

        impl Functions {
            /// Loads the functions. The library stays loaded, since it may run threads of its own.
            fn load(library: libloading::Library, name: &str) -> Result<Self, String> {
                let library = std::mem::ManuallyDrop::new(library);
                // SAFETY: the signatures match the library's header.
                unsafe {
                    Ok(Self {
                        $($name: *library
                            .get(concat!($symbol, "\0").as_bytes())
                            .map_err(|_| format!("{name} is too old: it lacks {}", $symbol))?,)*
                    })
                }
            }
        }
    };
}
pub(super) use functions;
