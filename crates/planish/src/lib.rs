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

pub mod agreement;
mod camera;
mod cloud;
mod colour;
mod cpu;
mod devices;
mod error;
pub mod evaluate;
mod floating;
mod frame;
#[cfg(feature = "gpu")]
mod gpu;
pub mod io;
mod params;
mod radius;
mod reference;
pub mod render;
mod sensor;
pub mod simulate;
mod smoothed;
mod smoother;
pub mod source;
pub mod stream;
mod threads;
mod unorganized;
mod view;

pub use camera::{Camera, SATURATED_DEPTH};
pub use cloud::{
    Attribute, AttributeValues, IDENTITY_VIEWPOINT, MAX_PIXELS, OrganizedCloud, PointCloud, PositionColumns, Xyz,
};
pub use cpu::SimdLevel;
#[cfg(feature = "gpu")]
pub use devices::lose_gpu_devices;
pub use devices::{AdapterKind, FrameTimings, GpuAdapter, GpuOptions, Transfer, auto_choice, gpu_adapters};
pub use error::{DeviceError, EngineError, Error, FormatError, FrameError, IoError, ParamError};
pub use frame::{DepthFrame, DepthImage, Frame};
pub use params::{Edges, KINECT_V1_DEPTH_STEP_AT_1M, KINECT_V1_NOISE_AT_1M, Radius, Sensor, SmoothParams, Strength};
pub use smoothed::{Outputs, Smoothed, Status};
pub use smoother::{Engine, Smoother, SmootherOptions, smooth_points};
pub use unorganized::estimate_radius_m;
pub use view::SmoothedView;
