//! The types and engines of planish: everything from depth or points in memory to smoothed points in memory.
//!
//! Most programs should depend on the crate `planish`, which re-exports this one and adds support for files, cameras
//! and ROS 2. The method is defined in the project's `docs/method.md`; comments that name a section refer to that page.

#![cfg_attr(docsrs, feature(doc_cfg))]
#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::todo,
    clippy::print_stdout,
    clippy::print_stderr
)]

#[doc(hidden)]
pub mod agreement;
mod camera;
pub mod clean;
mod cloud;
mod colour;
mod constants;
mod cpu;
mod devices;
mod doubts;
mod eigen;
mod engines;
mod error;
mod even;
mod fill;
mod fleet;
mod floating;
mod frame;
#[cfg(any(feature = "gpu", feature = "webgpu"))]
mod gpu;
mod neighbours;
mod outputs;
mod params;
mod pose;
mod preparation;
mod progress;
mod provenance;
mod range;
#[cfg(feature = "reference")]
mod reference;
mod scanners;
mod sensor;
mod session;
mod settings;
mod sigma;
mod simd_level;
mod smoothed;
mod smoother;
mod smoothing_engine;
mod status;
mod strided;
mod temporal;
#[cfg(test)]
mod testing;
mod threads;
mod timings;
mod view;
mod xyz;

/// The GPU engine as data, for WebGPU hosts other than wgpu.
#[cfg(feature = "webgpu")]
pub mod webgpu {
    pub use crate::gpu::plan::{Plan, PlannedPass, WebGpuLimits};
}

pub use camera::{Camera, Distortion, SATURATED_DEPTH};
pub use cloud::{Attribute, AttributeValues, CoordinateSteps, OrganizedCloud, PointCloud, PositionColumns, Precision};
pub use cpu::CloudEstimate;
pub use devices::{AdapterKind, GpuAdapter, GpuOptions, Transfer};
pub use doubts::{Doubt, doubt_about_lens, doubts};
pub use engines::{
    Capabilities, ChoiceReason, Engine, SmootherOptions, auto_choice, gpu_adapters, silence_vulkan_drivers,
};
pub use error::{DeviceError, EngineError, Error, FormatError, FrameError, IoError, ParamError};
pub use fleet::{Fleet, FleetDevice, FleetMember, SharedFrame};
pub use frame::{
    DepthFrame, DepthImage, DepthView, Frame, IntoFrame, OwnedFrame, PointLayout, PointsView, RangeRule, Scalar,
};
#[cfg(feature = "cuda")]
pub use gpu::{CudaMemory, CudaSmoother};
pub use outputs::{Outputs, SmoothedMut, VectorsMut};
pub use params::{
    CloudParams, CloudRadius, Edges, Fit, FrameParams, FrameRadius, Params, Project, Strength, Window, WindowSize,
};
pub use pose::SensorPose;
pub use preparation::{Preparation, Prepared};
pub use progress::Progress;
pub use provenance::Provenance;
pub use sensor::SensorModel;
pub use session::{CloudChoice, ProgressWatch, Session, SessionEvent, smooth};
pub use settings::{GridChoice, Preset, RadiusChoice, Resolved, SensorChoice, SettingValue, Settings, TemporalChoice};
pub use simd_level::SimdLevel;
pub use smoothed::Smoothed;
pub use smoother::Smoother;
pub use status::{Origin, Status};
pub use strided::StridedMut;
pub use temporal::{CameraMotion, TemporalFilter, TemporalParams};
pub use threads::start_shared_threads;
pub use timings::FrameTimings;
pub use view::{Rows, SmoothedView};
#[cfg(feature = "wgpu-interop")]
pub use wgpu;
pub use xyz::{MAX_PIXELS, Xyz, validate_shape};

/// Items for planish's other crates, not for users. They may change with every version.
#[doc(hidden)]
pub mod internal {
    pub use crate::camera::Rays;
    pub use crate::clean::voxel_grid::{VoxelMap, Voxels};
    pub use crate::clean::voxels::downsample;
    pub use crate::constants::GRAZING_COSINE;
    pub use crate::eigen::symmetric_eigen;
    pub use crate::error::{KIB, memory};
    pub use crate::fleet::lose_device as lose_fleet_device;
    pub use crate::frame::{assumed_sensor_of_sample, sampling_step};
    #[cfg(feature = "gpu")]
    pub use crate::gpu::lose_devices as lose_gpu_devices;
    #[cfg(feature = "kd-tree")]
    pub use crate::neighbours::NeighbourSearch;
    pub use crate::neighbours::halo::{self, NeededHalo, OWN_SHARE};
    pub use crate::neighbours::middle;
    pub use crate::pose::{LONGEST_POSE_GAP_S, RigidTransform};
    #[cfg(feature = "reference")]
    pub use crate::reference::temporal::TemporalReference;
    pub use crate::session::{GpuLosses, LIVE_IN_FLIGHT, Recovery, ResultFilter, ResultSight};
    pub use crate::smoothed::named_fields;
    pub use crate::threads::Threads;
}
