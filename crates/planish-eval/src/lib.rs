//! Simulated depth frames with known ground truth, scores of surface quality, and pictures of surfaces.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

#[cfg(feature = "evaluate")]
pub mod compare;
#[cfg(feature = "evaluate")]
pub mod evaluate;
#[cfg(feature = "evaluate")]
pub mod mesh;
#[cfg(feature = "evaluate")]
pub mod render;
pub mod simulate;
