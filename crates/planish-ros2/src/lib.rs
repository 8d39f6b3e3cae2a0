//! ROS 2 messages and their conversion, and recordings of them in MCAP.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

#[cfg(feature = "mcap")]
pub mod bag;
pub mod ros;
