//! Smoothing of depth-camera point clouds by moving least squares, fast enough for every frame of a camera.
//!
//! [`Smoother`] is the front door: open it once with [`SmoothParams`] for an [`Engine`] and a grid, or for general clouds, then
//! give it frames. [`DepthView`] and [`PointsView`] borrow what other programs hold, [`DepthFrame`], [`OrganizedCloud`] and
//! [`PointCloud`] own it; results go into a [`Smoothed`] or into buffers of the caller's ([`SmoothedMut`]).
//!
//! Depth to interleaved points and normals:
//!
//! ```
//! use planish::{Camera, DepthView, Engine, Outputs, SmoothParams, SmoothedMut, Smoother, SmootherOptions};
//!
//! # fn main() -> Result<(), planish::Error> {
//! let (raw, camera) = (vec![1500u16; 640 * 480], Camera::kinect_v1());
//! let options = SmootherOptions::new(Engine::Auto, Outputs::POINTS.with_normals(true));
//! let mut smoother = Smoother::open_with(SmoothParams::default(), &options, (640, 480))?;
//! let (mut points, mut normals) = (vec![[0f32; 3]; raw.len()], vec![[0f32; 3]; raw.len()]);
//! let out = SmoothedMut::new().with_points(&mut points).with_normals(&mut normals);
//! smoother.smooth_into(DepthView::new(&raw, &camera)?, out)?;
//! # assert!((points[1000][2] - 1.5).abs() < 1e-6 && normals[1000][2] < -0.99);
//! # Ok(())
//! # }
//! ```
//!
//! A general cloud:
//!
//! ```
//! use planish::{Engine, PointsView, SmoothParams, Smoothed, Smoother};
//!
//! # fn main() -> Result<(), planish::Error> {
//! # let points: Vec<[f32; 3]> = (0..900).map(|i| [0.01 * (i % 30) as f32, 0.01 * (i / 30) as f32, 2.0]).collect();
//! // let points: Vec<[f32; 3]> = ...
//! let mut smoother = Smoother::open(SmoothParams::general(), Engine::Auto, None)?;
//! let mut smoothed = Smoothed::default();
//! smoother.smooth(PointsView::from_rows(&points)?, &mut smoothed)?;
//! println!("{} points, the first at {:?}", smoothed.points.len(), smoothed.points.get(0));
//! # assert!((smoothed.points.z[0] - 2.0).abs() < 1e-6);
//! # Ok(())
//! # }
//! ```
//!
//! With the feature `io`, the module `io` reads and writes files; with `stream`, `source` and `stream` smooth frames as they
//! come; with `simulate`, `simulate` makes frames with known truth; with `evaluate`, `evaluate` measures how good a surface is.
//! What is computed is in the project's `docs/method.md`; comments that name a section mean that page.

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
pub use planish_eval::{evaluate, render};
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

/// What the project's own tests and experiments need and its users do not; it may change with every version.
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
