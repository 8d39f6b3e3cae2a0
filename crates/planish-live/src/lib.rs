//! Live smoothing: frame sources, the loop that smooths their frames, and rigs of several cameras.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

mod new_folder;
pub mod rig;
pub mod source;
pub mod stream;

/// Items for planish's own tests and its other crates.
#[doc(hidden)]
pub mod internal {
    #[cfg(feature = "internal")]
    pub use crate::source::internal::*;
}
