//! Fills holes on the device (docs/method.md, section 18), in seven passes after those of a frame and of its standard
//! errors. They read the frame's input and change its result.

use bytemuck::{Pod, Zeroable, bytes_of};

use super::device::GpuDevice;
use super::fill_kernels::{hole_words, scratch_words};
use super::layout::Layout;
use crate::params::EngineParams;

/// A slot's uniform, as declared in `fill/buffers.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Uniform {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    sensor_sigma: [f32; 3],
    most_px: u32,
    baseline_m: f32,
    frames: u32,
    scratch_words: u32,
    padding: u32,
}

const _: () = assert!(size_of::<Uniform>() == 48);

/// A slot's buffers for the passes that fill holes.
pub(super) struct SlotFill {
    pub(super) bind_group: wgpu::BindGroup,
    holes: wgpu::Buffer,
    /// Number of bytes at the beginning of `holes` that must be 0 before the first pass.
    cleared_bytes: u64,
    _scratch: wgpu::Buffer,
}

impl SlotFill {
    /// Creates the buffers for `frames` frames whose holes are up to `width_px` wide. `bound` contains the input and
    /// the result.
    pub(super) fn new(
        gpu: &GpuDevice,
        layout: &Layout,
        frames: usize,
        params: &EngineParams,
        width_px: u32,
        bound: [&wgpu::Buffer; 2],
    ) -> Self {
        let contents = Uniform {
            width: layout.width as u32,
            height: layout.height as u32,
            input_words: layout.input_words() as u32,
            output_words: layout.output_words() as u32,
            sensor_sigma: params.sensor.sigma,
            most_px: width_px,
            baseline_m: params.sensor.baseline_m().unwrap_or(0.0) as f32,
            frames: frames as u32,
            scratch_words: scratch_words(layout) as u32,
            padding: 0,
        };
        let uniform = gpu.uniform("fill", bytes_of(&contents));
        let [hole_bytes, cleared_bytes] = hole_words(layout, frames).map(|words| 4 * words as u64);
        let scratch_bytes = 4 * (scratch_words(layout) * frames) as u64;
        let scratch = gpu.buffer("fill", scratch_bytes, wgpu::BufferUsages::STORAGE);
        let holes = gpu.buffer("holes", hole_bytes, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST);
        let [input, output] = bound;
        let bind_group = gpu.bind([&uniform, input, output, &scratch, &holes]);
        Self { bind_group, holes, cleared_bytes, _scratch: scratch }
    }

    /// Returns the number of bytes of the buffers for `frames` frames.
    pub(super) fn bytes(layout: &Layout, frames: usize) -> u64 {
        4 * (scratch_words(layout) * frames + hole_words(layout, frames)[0]) as u64
    }

    /// Prepares the buffers for the passes.
    pub(super) fn begin(&self, encoder: &mut wgpu::CommandEncoder) {
        encoder.clear_buffer(&self.holes, 0, Some(self.cleared_bytes));
    }
}

#[cfg(test)]
mod tests;
