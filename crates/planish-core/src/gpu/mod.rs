//! The GPU engine: docs/method.md in f32, with one thread per pixel, on Vulkan, Metal or DirectX 12 through wgpu.
//!
//! For each combination of settings, a kernel ([`kernel`], shaders/*.wgsl, with the reference's stage names) computes
//! the requested outputs from depth or points. If blocks are averaged or edges kept, earlier kernels compute the points
//! and planes that it reads. [`layout`] describes uploads ([`upload`]) and results ([`results`]). These modules are
//! independent of wgpu: [`plan`] exports them to other WebGPU hosts, and [`cuda`] runs them in the memory of CUDA
//! programs.
//!
//! The other modules are the host side on wgpu: the engine, slots with the buffers of one frame or batch in flight, and
//! results, which are read in mapped memory or, for frames in flight, copied out by a separate thread.

#[cfg(feature = "gpu")]
mod copier;
#[cfg(feature = "cuda")]
mod cuda;
#[cfg(feature = "gpu")]
mod device;
#[cfg(feature = "gpu")]
mod engine;
#[cfg(feature = "gpu")]
mod fill;
#[cfg(feature = "gpu")]
mod fill_kernels;
#[cfg(feature = "gpu")]
mod flight;
#[cfg(feature = "gpu")]
mod general;
mod kernel;
mod layout;
#[cfg(feature = "gpu")]
mod mapped;
#[cfg(feature = "gpu")]
mod over_time;
#[cfg(feature = "webgpu")]
pub(crate) mod plan;
#[cfg(feature = "gpu")]
mod queues;
mod results;
mod shader;
#[cfg(feature = "gpu")]
mod sigma;
#[cfg(feature = "gpu")]
mod sigma_kernels;
#[cfg(feature = "gpu")]
mod slot;
#[cfg(feature = "gpu")]
mod stamps;
#[cfg(feature = "gpu")]
mod step_kernels;
#[cfg(feature = "gpu")]
mod steps;
#[cfg(feature = "gpu")]
#[cfg(test)]
mod tests;
mod upload;
#[cfg(feature = "gpu")]
mod view;

#[cfg(feature = "cuda")]
pub use cuda::{CudaMemory, CudaSmoother};
#[cfg(feature = "gpu")]
pub use engine::lose_devices;
#[cfg(feature = "gpu")]
pub(crate) use engine::{Gpu, adapters};
#[cfg(feature = "gpu")]
pub(crate) use general::GeneralGpu;
