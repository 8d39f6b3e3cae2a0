//! planish in a browser: everything except the user interface and the WebGPU calls, which are in TypeScript (`web/`).
//!
//! A [`Page`] holds frames and results. The web page sends requests as JSON, some with bytes, and receives replies as
//! JSON with bytes ([`Page::handle`]); in WebAssembly, this uses the exports of `abi`. With WebGPU, the web page
//! requests a plan for a frame, runs its kernels, and passes back their output. Otherwise the CPU engine smooths the
//! frame here, with 128-bit vectors. Kernels, parameters, file formats and pictures come from the library.

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
