//! planish in a browser: everything but the interface and the calls of WebGPU, which are TypeScript (`web/`).
//!
//! A [`Page`] holds frames and results. A page sends requests as JSON, some with bytes, and receives replies as JSON
//! with bytes ([`Page::handle`]); in WebAssembly through the exports of `abi`. With WebGPU, the page requests a plan
//! for a frame, runs the plan's kernels, and passes back their output; otherwise the CPU engine smooths the frame here,
//! in vectors of 128 bits. Kernels, parameters, file formats and pictures are the library's.

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[cfg(target_family = "wasm")]
mod abi;
mod camera;
mod frame;
mod page;
mod picture;
mod plans;
mod request;

pub use camera::CameraGiven;
pub use frame::PageFrame;
pub use page::Page;
pub use plans::usual_plans;
pub use request::{PictureKind, Reply, Request, Side};
