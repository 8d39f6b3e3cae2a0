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

#[cfg(feature = "internal")]
#[doc(hidden)]
pub mod agreement;
#[cfg(feature = "mcap")]
pub mod bag;
mod camera;
pub mod clean;
mod cloud;
mod colour;
mod cpu;
mod devices;
mod eigen;
mod engine;
mod engines;
mod error;
#[cfg(feature = "evaluate")]
pub mod evaluate;
mod fleet;
mod floating;
mod frame;
#[cfg(any(feature = "gpu", feature = "webgpu"))]
mod gpu;
#[cfg(feature = "io")]
pub mod io;
mod method;
mod neighbours;
mod outputs;
mod params;
mod pose;
mod progress;
mod range;
#[cfg(feature = "reference")]
mod reference;
#[cfg(feature = "evaluate")]
pub mod render;
#[cfg(feature = "stream")]
pub mod rig;
#[cfg(feature = "ros")]
pub mod ros;
mod sensor;
mod simd_level;
#[cfg(feature = "simulate")]
pub mod simulate;
mod smoothed;
mod smoother;
#[cfg(feature = "stream")]
pub mod source;
mod status;
#[cfg(feature = "stream")]
pub mod stream;
mod threads;
#[cfg(feature = "scans")]
pub mod tiles;
mod timings;
mod view;
mod xyz;

/// The GPU engine as data, for hosts of WebGPU that are not wgpu.
#[cfg(feature = "webgpu")]
pub mod webgpu {
    pub use crate::gpu::plan::{Plan, PlannedPass, WebGpuLimits};
}

pub use camera::{Camera, Distortion, SATURATED_DEPTH};
pub use cloud::{Attribute, AttributeValues, OrganizedCloud, PointCloud, PositionColumns};
pub use devices::{AdapterKind, GpuAdapter, GpuOptions, Transfer};
pub use engines::{Capabilities, ChoiceReason, Engine, SmootherOptions, auto_choice, gpu_adapters};
pub use error::{DeviceError, EngineError, Error, FormatError, FrameError, IoError, ParamError};
pub use fleet::{Fleet, FleetDevice, FleetMember, SharedFrame};
pub use frame::{DepthFrame, DepthImage, DepthView, Frame, IntoFrame, PointLayout, PointsView, RangeRule, Scalar};
pub use outputs::{Outputs, SmoothedMut, VectorsMut};
pub use params::{Edges, Project, Radius, SmoothParams, Strength};
pub use pose::SensorPose;
pub use progress::Progress;
pub use sensor::SensorModel;
pub use simd_level::SimdLevel;
pub use smoothed::Smoothed;
pub use smoother::Smoother;
pub use status::Status;
pub use timings::FrameTimings;
pub use view::SmoothedView;
#[cfg(feature = "wgpu-interop")]
pub use wgpu;
pub use xyz::{MAX_PIXELS, Xyz};

/// What the project's own tests and experiments need and its users do not; it may change with every version.
#[doc(hidden)]
#[cfg(feature = "internal")]
pub mod internal {
    pub use crate::agreement;
    pub use crate::fleet::lose_device as lose_fleet_device;
    #[cfg(feature = "gpu")]
    pub use crate::gpu::lose_devices as lose_gpu_devices;
    #[cfg(feature = "io")]
    pub use crate::io::internal::*;
    #[cfg(feature = "stream")]
    pub use crate::source::internal::*;
}
