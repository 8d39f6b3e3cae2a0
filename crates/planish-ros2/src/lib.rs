//! ROS 2 messages, their conversion, and MCAP recordings of them.

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
