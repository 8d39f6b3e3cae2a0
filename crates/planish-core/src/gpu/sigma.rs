//! Estimates standard errors on the device (docs/method.md, section 17), in four passes after those of a frame. They
//! read the frame's input and result, and add a channel to the result.

use bytemuck::{Pod, Zeroable, bytes_of};

use super::device::GpuDevice;
use super::layout::Layout;
use super::sigma_kernels::scratch_words;
use crate::params::EngineParams;
use crate::sigma::ErrorScale;

/// A slot's uniform, as declared in `sigma/buffers.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Uniform {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    sensor_sigma: [f32; 3],
    scratch_words: u32,
    gain: f32,
    least_area: f32,
    least_variance: f32,
    sigma_at: u32,
    status_at: u32,
    neighbours_at: u32,
    padding: [u32; 2],
}

const _: () = assert!(size_of::<Uniform>() == 64);

/// A slot's buffers for the passes that estimate standard errors.
pub(super) struct SlotSigma {
    pub(super) bind_group: wgpu::BindGroup,
    _scratch: wgpu::Buffer,
}

impl SlotSigma {
    /// Creates the buffers for `frames` frames; `None` if the layout has no `sigma`. `bound` contains the input, the
    /// result, and a placeholder for the unused fifth binding.
    pub(super) fn new(
        gpu: &GpuDevice,
        layout: &Layout,
        frames: usize,
        params: &EngineParams,
        bound: [&wgpu::Buffer; 3],
    ) -> Option<Self> {
        let at = |range: Option<std::ops::Range<usize>>| range.map(|range| range.start as u32);
        let ErrorScale { gain, least_area, least_variance } = ErrorScale::of(params);
        let contents = Uniform {
            width: layout.width as u32,
            height: layout.height as u32,
            input_words: layout.input_words() as u32,
            output_words: layout.output_words() as u32,
            sensor_sigma: params.sensor.sigma,
            scratch_words: scratch_words(layout) as u32,
            gain: gain as f32,
            least_area: least_area as f32,
            least_variance,
            sigma_at: at(layout.sigma())?,
            status_at: at(layout.status())?,
            neighbours_at: at(layout.neighbours())?,
            padding: [0; 2],
        };
        let uniform = gpu.uniform("sigma", bytes_of(&contents));
        let scratch_bytes = 4 * (scratch_words(layout) * frames) as u64;
        let scratch = gpu.buffer("scratch", scratch_bytes, wgpu::BufferUsages::STORAGE);
        let [input, output, unused] = bound;
        let bind_group = gpu.bind([&uniform, input, output, &scratch, unused]);
        Some(Self { bind_group, _scratch: scratch })
    }
}

#[cfg(test)]
mod tests;
