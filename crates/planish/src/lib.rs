//! Smoothing of depth-camera point clouds by moving least squares, fast enough for every frame of a camera.
//!
//! [`Smoother`] is the front door: open it once with [`SmoothParams`] for an [`Engine`] and a frame shape, then give it
//! [`DepthFrame`]s or [`OrganizedCloud`]s. [`smooth_points`] smooths clouds without a pixel grid. [`io`] reads and writes
//! files, [`simulate`] makes frames with known truth. What is computed is in the project's `docs/method.md`; comments that
//! name a section mean that page.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

mod camera;
mod cloud;
mod colour;
mod cpu;
mod error;
pub mod evaluate;
mod frame;
pub mod io;
mod params;
mod reference;
pub mod render;
pub mod simulate;
mod smoothed;
mod smoother;
mod threads;
mod unorganized;

pub use camera::{Camera, SATURATED_DEPTH};
pub use cloud::{
    Attribute, AttributeValues, IDENTITY_VIEWPOINT, MAX_PIXELS, OrganizedCloud, PointCloud, PositionColumns, Xyz,
};
pub use cpu::SimdLevel;
pub use error::{EngineError, Error, FormatError, FrameError, IoError, ParamError};
pub use frame::{DepthFrame, DepthImage, Frame};
pub use params::{KINECT_V1_DEPTH_STEP_AT_1M, Radius, SmoothParams};
pub use smoothed::{Outputs, Smoothed, Status};
pub use smoother::{Engine, Smoother, SmootherOptions, smooth_points};
pub use unorganized::estimate_radius_m;
