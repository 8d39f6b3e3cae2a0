//! Standard errors on the device (docs/method.md, section 17): four passes after those of a frame. They read its input
//! and its result, and add a channel to the result.

use bytemuck::{Pod, Zeroable, bytes_of};

use super::device::GpuDevice;
use super::layout::{InputKind, Layout, constants as layout_constants, write_constant};
use super::shader::shader;
use crate::outputs::Outputs;
use crate::params::EngineParams;
use crate::sigma::{ErrorScale, constants};

/// Columns and rows of pixels per workgroup.
const TILE: [usize; 2] = [32, 8];
/// Kept for each pixel: the residual, the smoothed range, and whether there is a step.
const PIXEL_WORDS: usize = 3;
/// Kept for each row that counts: products and mean squares along rows and columns, for each lag.
const SUMS: usize = 4 * constants::MOST_LAG_PX;

/// The uniform of a slot, as `errors/buffers.wgsl` has it.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Uniform {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    sigma: [f32; 3],
    memory_words: u32,
    gain: f32,
    least_area: f32,
    least_variance: f32,
    sigma_at: u32,
    status_at: u32,
    neighbours_at: u32,
    padding: [u32; 2],
}

const _: () = assert!(size_of::<Uniform>() == 64);

/// A pass over pixels, rows or frames. Its kernel depends on the kind of input only if it reads the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum ErrorPass {
    SetResiduals(InputKind),
    CorrelateRows,
    MeasureArea,
    EstimateErrors,
}

impl ErrorPass {
    /// Returns the passes for a kind of input, in order.
    pub(super) fn of(kind: InputKind) -> [Self; 4] {
        [Self::SetResiduals(kind), Self::CorrelateRows, Self::MeasureArea, Self::EstimateErrors]
    }

    pub(super) fn entry_point(self) -> &'static str {
        match self {
            Self::SetResiduals(_) => "set_residuals",
            Self::CorrelateRows => "correlate_rows",
            Self::MeasureArea => "measure_area",
            Self::EstimateErrors => "estimate_errors",
        }
    }

    /// Returns workgroups for a frame of this many pixels, across and down.
    pub(super) fn workgroups(self, (width, height): (usize, usize)) -> [usize; 2] {
        match self {
            Self::SetResiduals(_) | Self::EstimateErrors => [width.div_ceil(TILE[0]), height.div_ceil(TILE[1])],
            Self::CorrelateRows => [rows(height), 1],
            Self::MeasureArea => [1, 1],
        }
    }

    /// Returns the WGSL of its kernel.
    pub(super) fn wgsl(self) -> String {
        let kind = if let Self::SetResiduals(kind) = self { kind } else { InputKind::Depth };
        let mut text = layout_constants(kind, Outputs::POINTS, 1);
        text += &error_constants();
        text += shader!("shaders/errors/buffers.wgsl");
        text += shader!("shaders/words.wgsl");
        match self {
            Self::SetResiduals(_) => {
                text += shader!("shaders/input.wgsl");
                text += shader!("shaders/sensor.wgsl");
                text += shader!("shaders/errors/set_residuals.wgsl");
            }
            Self::CorrelateRows => text += shader!("shaders/errors/correlate_rows.wgsl"),
            Self::MeasureArea => text += shader!("shaders/errors/measure_area.wgsl"),
            Self::EstimateErrors => {
                text += shader!("shaders/pixel_result.wgsl");
                text += shader!("shaders/errors/estimate_errors.wgsl");
            }
        }
        text
    }
}

/// Returns the constants of the passes in WGSL.
fn error_constants() -> String {
    let mut text = String::new();
    let words = [
        ("TILE_WIDTH", TILE[0]),
        ("TILE_HEIGHT", TILE[1]),
        ("HALF", constants::HALF_PX),
        ("BIAS_HALF", constants::BIAS_HALF_PX),
        ("NEAR_STEP", constants::NEAR_STEP_PX),
        ("MOST_LAG", constants::MOST_LAG_PX),
        ("ROW_STEP", constants::STEP_PX),
    ];
    for (name, value) in words {
        write_constant(&mut text, name, "u32", format_args!("{value}u"));
    }
    let numbers = [
        ("CLIP", constants::CLIP),
        ("LEAST_DEVIATION_M", constants::LEAST_DEVIATION_M),
        ("STEP_DEVIATIONS", constants::STEP_DEVIATIONS),
        ("STEP_SHARE", constants::STEP_SHARE),
        ("LEAST_CORRELATION", constants::LEAST_CORRELATION as f32),
        ("EXPONENT", constants::EXPONENT as f32),
        ("NEAR_STEP_FACTOR", constants::NEAR_STEP_FACTOR),
        ("MOST_SHARE", constants::MOST_SHARE),
        ("BIAS_DEVIATIONS", constants::BIAS_DEVIATIONS),
        ("BIAS_WEIGHT", constants::BIAS_WEIGHT),
    ];
    for (name, value) in numbers {
        write_constant(&mut text, name, "f32", format_args!("{value:?}"));
    }
    text
}

/// Returns the number of rows from which the correlation is measured.
fn rows(height: usize) -> usize {
    height.div_ceil(constants::STEP_PX)
}

/// Returns the words that are kept for each frame of a layout.
pub(super) fn kept_words(layout: &Layout) -> usize {
    PIXEL_WORDS * layout.pixels() + SUMS * rows(layout.height) + 1
}

/// The buffers of a slot for the passes.
pub(super) struct SlotErrors {
    pub(super) bind_group: wgpu::BindGroup,
    _memory: wgpu::Buffer,
}

impl SlotErrors {
    /// Creates them for this many frames of a layout with the output `sigma`; `None` for other layouts. `bound` are the
    /// input, the result, and a buffer for the place of one that is not used.
    pub(super) fn new(
        gpu: &GpuDevice,
        layout: &Layout,
        frames: usize,
        params: &EngineParams,
        bound: [&wgpu::Buffer; 3],
    ) -> Option<Self> {
        use wgpu::BufferUsages as Usage;
        let at = |range: Option<std::ops::Range<usize>>| range.map(|range| range.start as u32);
        let ErrorScale { gain, least_area, least_variance } = ErrorScale::of(params);
        let contents = Uniform {
            width: layout.width as u32,
            height: layout.height as u32,
            input_words: layout.input_words() as u32,
            output_words: layout.output_words() as u32,
            sigma: params.sensor.sigma,
            memory_words: kept_words(layout) as u32,
            gain: gain as f32,
            least_area: least_area as f32,
            least_variance,
            sigma_at: at(layout.sigma())?,
            status_at: at(layout.status())?,
            neighbours_at: at(layout.neighbours())?,
            padding: [0; 2],
        };
        let buffer = |label, size, usage, mapped_at_creation| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation })
        };
        let uniform = buffer("errors", size_of::<Uniform>() as u64, Usage::UNIFORM, true);
        if let Ok(mut range) = uniform.get_mapped_range_mut(..) {
            range.copy_from_slice(bytes_of(&contents));
        }
        uniform.unmap();
        let memory = buffer("residuals", 4 * (kept_words(layout) * frames) as u64, Usage::STORAGE, false);
        let [input, output, unused] = bound;
        let entries: Vec<_> = [&uniform, input, output, &memory, unused]
            .into_iter()
            .zip(0..)
            .map(|(buffer, binding)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let bind_group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &gpu.bind_group_layout,
            entries: &entries,
        });
        Some(Self { bind_group, _memory: memory })
    }
}

#[cfg(test)]
mod tests;
