//! Smooths depth-camera frames and point clouds by Moving Least Squares, fast enough to process every frame of a live
//! camera.
//!
//! This example smooths one frame with settings from a user:
//!
//! ```
//! use planish::{Camera, DepthView, Settings};
//!
//! # fn main() -> Result<(), planish::Error> {
//! let (raw, camera) = (vec![1500u16; 640 * 480], Camera::kinect_v1());
//! let settings: Settings = "preset=light edges=robust".parse()?;
//! let smoothed = planish::smooth(DepthView::new(&raw, &camera)?, &settings)?;
//! # assert!((smoothed.points.z()[1000] - 1.5).abs() < 1e-6);
//! # Ok(())
//! # }
//! ```
//!
//! For many frames of any shape, use a [`Session`]: it keeps the engine open, reopens it when needed, and recovers when
//! a GPU is lost. For frames of one shape with explicit parameters, use a [`Smoother`], which does none of this. In
//! this example, a smoother writes into the caller's interleaved buffers:
//!
//! ```
//! use planish::{Camera, DepthView, Engine, FrameParams, Outputs, SmoothedMut, Smoother, SmootherOptions};
//!
//! # fn main() -> Result<(), planish::Error> {
//! let (raw, camera) = (vec![1500u16; 640 * 480], Camera::kinect_v1());
//! let options = SmootherOptions::new(Engine::Auto, Outputs::POINTS.with_normals(true));
//! let mut smoother = Smoother::open_with(FrameParams::default(), &options, (640, 480))?;
//! let (mut points, mut normals) = (vec![[0f32; 3]; raw.len()], vec![[0f32; 3]; raw.len()]);
//! let out = SmoothedMut::new().with_points(&mut points).with_normals(&mut normals);
//! smoother.smooth_into(DepthView::new(&raw, &camera)?, out)?;
//! # assert!((points[1000][2] - 1.5).abs() < 1e-6 && normals[1000][2] < -0.99);
//! # Ok(())
//! # }
//! ```
//!
//! [`DepthView`] and [`PointsView`] borrow the caller's data; [`DepthFrame`], [`OrganizedCloud`] and [`PointCloud`] own
//! their data.
//!
//! # Features
//! | feature | default | adds |
//! |---|---|---|
//! | `gpu` | yes | the GPU engine, through wgpu |
//! | `reference` | yes | the f64 engine that defines the results of the others |
//! | `io` | yes | `io`: point clouds, depth images, cameras, settings files |
//! | `exr`, `npz`, `tiff` | yes | OpenEXR; NumPy archives; TIFF |
//! | `scans`, `more-formats` | yes | LAS, LAZ, E57, clouds larger than memory; gzip, glTF, PTX and others |
//! | `stream` | yes | `source`, `stream`, `rig`: cameras, recordings, the live loop, several cameras |
//! | `simulate`, `evaluate` | yes | simulated frames with known ground truth; scores and pictures of surfaces |
//! | `ros`, `mcap` | no | ROS 2 messages; MCAP recordings |
//! | `mcap-compression` | no | compression of written MCAP recordings (zstd and LZ4 in C) |
//! | `rerun` | no | a sink for the Rerun viewer; about 400 crates |
//! | `webgpu`, `wgpu-interop` | no | kernels as data; the GPU engine on the caller's `wgpu::Device` |
//! | `cuda` | no | depth and results in CUDA memory |
//! | `serde` | with `io` | [`Settings`] and GPU adapters as JSON or YAML |
//!
//! The method is defined in the project's `docs/method.md`; comments that name a section refer to that page.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]
#![cfg_attr(docsrs, feature(doc_cfg))]

pub use planish_core::*;
#[cfg(feature = "simulate")]
pub use planish_eval::simulate;
#[cfg(feature = "evaluate")]
pub use planish_eval::{compare, evaluate, mesh, render};
#[cfg(feature = "io")]
pub use planish_io as io;
#[cfg(feature = "scans")]
pub use planish_io::tiles;
#[cfg(feature = "stream")]
pub use planish_live::{rig, source, stream};
#[cfg(feature = "ros")]
pub use planish_ros2::ros;

/// ROS 2 recordings in MCAP.
#[cfg(feature = "mcap")]
pub mod bag {
    pub use planish_live::stream::BagSink;
    pub use planish_ros2::bag::*;
}

/// Items for the project's tests and experiments, not for users; they may change with every version.
#[doc(hidden)]
#[cfg(feature = "internal")]
pub mod internal {
    pub use planish_core::agreement;
    pub use planish_core::internal::*;
    #[cfg(feature = "io")]
    pub use planish_io::internal::*;
    #[cfg(feature = "stream")]
    pub use planish_live::internal::*;
}
