//! planish in a browser: everything but the interface and the calls of WebGPU, which are TypeScript (`web/`).
//!
//! A [`Page`] holds frames and results. A page sends it requests in JSON, each with bytes where it has some, and gets a
//! reply in JSON with bytes ([`Page::handle`]); in WebAssembly through the exports of `abi`. Where the page has WebGPU,
//! it asks for a plan of a frame, runs the plan's kernels, and hands in what they wrote; else the CPU engine smooths
//! the frame here, in vectors of 128 bits. Nothing is written twice: kernels, parameters, file formats and pictures are
//! the library's.

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
