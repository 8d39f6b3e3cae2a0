//! A slot holds the buffers of one frame, or one batch of frames, in flight, from upload through the kernel to
//! readback.
//!
//! There are two kinds of transfer. *Staged*: the host writes an upload buffer, the device copies it, the kernel runs
//! on device memory, and the result is copied to a buffer that the host reads. *Direct*: the kernel reads and writes
//! the host's buffers, so transfers overlap with arithmetic.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::bytes_of;

use super::device::GpuDevice;
use super::fill::SlotFill;
use super::layout::Layout;
use super::mapped::Mapped;
use super::over_time::{OverTime, SlotOverTime};
use super::sigma::SlotSigma;
use super::sigma_kernels::scratch_words;
use super::stamps::Stamps;
use super::upload::Uploader;
use crate::devices::{GpuOptions, Transfer};
use crate::error::EngineError;
use crate::params::EngineParams;
use crate::smoothing_engine::{AdmittedFrame, VideoStep};
use crate::timings::FrameTimings;

/// Number of bytes in a word.
const WORD: u64 = 4;

/// A kernel and its number of workgroups for a frame, across and down.
pub(super) type Dispatch = (wgpu::ComputePipeline, [usize; 2]);

/// The kernels of a frame, in order.
#[derive(Default)]
pub(super) struct Kernels {
    pub(super) smooth: Vec<Dispatch>,
    pub(super) sigma: Vec<Dispatch>,
    pub(super) fill: Vec<Dispatch>,
}

/// The frames that a slot is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SlotUse {
    /// The layout on the device.
    pub(super) layout: Layout,
    /// The layout of the results to read back. Without a temporal filter, it has a part of the outputs of `layout`.
    pub(super) results: Layout,
    /// Maximum width of the holes to fill, in pixels.
    pub(super) fill_px: Option<u32>,
}

impl SlotUse {
    /// Returns true if steps after smoothing read the result, which then stays in the device's memory until they are
    /// done.
    fn has_steps(&self) -> bool {
        self.layout.outputs.sigma || self.fill_px.is_some()
    }

    /// Returns the number of bytes of the buffers for these steps.
    fn step_bytes(&self, frames: usize) -> u64 {
        let of_sigma = self.layout.sigma().map_or(0, |_| (scratch_words(&self.layout) * frames) as u64 * WORD);
        of_sigma + self.fill_px.map_or(0, |_| SlotFill::bytes(&self.layout, frames))
    }
}

pub(super) struct Slot {
    /// The device that the slot is submitted to.
    pub(super) gpu: Arc<GpuDevice>,
    pub(super) used_for: SlotUse,
    pub(super) frames: usize,
    /// Buffer that the host writes. It is mapped whenever the slot is free.
    upload: wgpu::Buffer,
    /// Input buffer of the kernel; `None` if the kernel reads `upload`.
    input: Option<wgpu::Buffer>,
    /// Output buffer of the kernel; `None` if the kernel writes `readback`.
    output: Option<wgpu::Buffer>,
    /// Buffer that the host reads. It is mapped once the slot's submission has run.
    pub(super) readback: wgpu::Buffer,
    /// Points and planes that passes keep for later passes.
    _kept: [wgpu::Buffer; 2],
    bind_group: wgpu::BindGroup,
    over_time: Option<SlotOverTime>,
    sigma: Option<SlotSigma>,
    fill: Option<SlotFill>,
    stamps: Option<Stamps>,
    mapped: Mapped,
    /// The commands of the next frames.
    encoded: Option<wgpu::CommandBuffer>,
    _counted: Counted,
}

/// Counts the bytes of buffers in a shared total for as long as the buffers live.
pub(super) struct Counted {
    bytes: u64,
    all: Arc<AtomicU64>,
}

impl Counted {
    pub(super) fn new(bytes: u64, all: &Arc<AtomicU64>) -> Self {
        all.fetch_add(bytes, Ordering::Relaxed);
        Self { bytes, all: Arc::clone(all) }
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.all.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl Slot {
    /// Allocates the buffers for `frames` frames, and adds their sizes to `all_bytes`.
    pub(super) fn new(
        gpu: Arc<GpuDevice>,
        used_for: SlotUse,
        frames: usize,
        params: &EngineParams,
        options: &GpuOptions,
        over_time: Option<&OverTime>,
        all_bytes: &Arc<AtomicU64>,
    ) -> Result<Self, EngineError> {
        use wgpu::BufferUsages as Usage;
        let SlotUse { layout, results, fill_px } = used_for;
        let input_bytes = (layout.input_words() * frames) as u64 * WORD;
        let result_bytes = (results.output_words() * frames) as u64 * WORD;
        let in_space_bytes = over_time.map_or(0, |_| layout.output_words() as u64 * WORD);
        let direct = options.transfer == Transfer::Direct;
        // Reading the host's memory would slow down steps after smoothing.
        let is_copied = !direct || used_for.has_steps();
        let output_bytes = match used_for.has_steps() {
            true => (layout.output_words() * frames) as u64 * WORD,
            false => result_bytes,
        };
        // Every kernel binds both buffers, even if it uses neither, so they must not be empty.
        let kept_bytes = layout.kept_words().map(|words| (words * frames).max(4) as u64 * WORD);
        let total = kept_bytes.iter().sum::<u64>()
            + in_space_bytes
            + used_for.step_bytes(frames)
            + if direct { 1 } else { 2 } * input_bytes
            + result_bytes
            + if is_copied { output_bytes } else { 0 };
        let owner = Arc::clone(&gpu);
        gpu.allocate(total, || {
            let device = &gpu.device;
            let buffer = |label, size, usage, mapped_at_creation| {
                device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation })
            };
            let upload_as = if direct { Usage::STORAGE } else { Usage::COPY_SRC };
            let readback_as = if is_copied { Usage::COPY_DST } else { Usage::STORAGE };
            let upload = buffer("upload", input_bytes, Usage::MAP_WRITE | upload_as, true);
            let readback = buffer("readback", result_bytes, Usage::MAP_READ | readback_as, false);
            let input = (!direct).then(|| buffer("input", input_bytes, Usage::STORAGE | Usage::COPY_DST, false));
            let output = is_copied.then(|| buffer("output", output_bytes, Usage::STORAGE | Usage::COPY_SRC, false));
            let uniform = gpu.uniform("batch", bytes_of(&layout.batch()));
            let kept = kept_bytes.map(|bytes| buffer("kept", bytes, Usage::STORAGE, false));
            let (read, written) = (input.as_ref().unwrap_or(&upload), output.as_ref().unwrap_or(&readback));
            let over_time = over_time.map(|over_time| over_time.slot(&gpu, &layout, [read, written]));
            let written = over_time.as_ref().map_or(written, |over_time| &over_time.in_space);
            let sigma = SlotSigma::new(&gpu, &layout, frames, params, [read, written, &kept[0]]);
            let new_fill = |width_px| SlotFill::new(&gpu, &layout, frames, params, width_px, [read, written]);
            let fill = fill_px.map(new_fill);
            let bind_group = gpu.bind([&uniform, read, written, &kept[0], &kept[1]]);
            let stamps = options.timestamps.then(|| Stamps::new(&gpu));
            Self {
                gpu: owner,
                used_for,
                frames,
                upload,
                input,
                output,
                readback,
                _kept: kept,
                bind_group,
                over_time,
                sigma,
                fill,
                stamps,
                mapped: Mapped::default(),
                encoded: None,
                _counted: Counted::new(total, all_bytes),
            }
        })
    }

    /// Writes the frames into the upload buffer, which must be mapped.
    pub(super) fn write(&mut self, frames: &[AdmittedFrame<'_>], uploader: &mut Uploader) -> Result<(), EngineError> {
        let mut range = self.upload.get_mapped_range_mut(..).map_err(|error| self.gpu.failed(error))?;
        for (i, frame) in frames.iter().enumerate() {
            let layout = &self.used_for.layout;
            let first = i * layout.input_words();
            uploader.write(layout, frame, &mut |word: usize, bytes: &[u8]| {
                let at = (first + word) * WORD as usize;
                range.slice(at..at + bytes.len()).copy_from_slice(bytes);
            });
        }
        Ok(())
    }

    /// Submits the frames, and requests that the buffers be mapped once the kernels have run.
    ///
    /// Encoding takes longer than submitting, so the commands of the slot's next frames are encoded here, while the
    /// device works. In videos, the commands depend on the frame.
    pub(super) fn submit(
        &mut self,
        kernels: &Kernels,
        over_time: Option<(&mut OverTime, &VideoStep)>,
    ) -> wgpu::SubmissionIndex {
        let is_video = over_time.is_some();
        let commands = self.encoded.take().unwrap_or_else(|| self.encode(kernels, over_time));
        self.upload.unmap();
        let submission = self.gpu.submit(commands);

        let stamps = self.stamps.as_ref().map(|stamps| (&stamps.readback, wgpu::MapMode::Read));
        let buffers = [(&self.upload, wgpu::MapMode::Write), (&self.readback, wgpu::MapMode::Read)];
        self.mapped.ask_for(buffers.into_iter().chain(stamps));
        self.encoded = (!is_video).then(|| self.encode(kernels, None));
        submission
    }

    /// Encodes the kernels of the frames, then those for standard errors and holes, or for the temporal filter.
    fn encode(&self, kernels: &Kernels, over_time: Option<(&mut OverTime, &VideoStep)>) -> wgpu::CommandBuffer {
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        if let Some(stamps) = &self.stamps {
            stamps.write(&mut encoder, 0);
        }
        if let Some(input) = &self.input {
            encoder.copy_buffer_to_buffer(&self.upload, 0, input, 0, None);
        }
        let begun = over_time.zip(self.over_time.as_ref()).map(|((over_time, step), slot)| {
            let moves = over_time.begin(&self.gpu, slot, &self.used_for.layout, step);
            (over_time, slot, moves)
        });
        if let Some(fill) = &self.fill {
            fill.begin(&mut encoder);
        }
        {
            let timestamp_writes = self.stamps.as_ref().map(Stamps::around_kernels);
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes });
            pass.set_bind_group(0, &self.bind_group, &[]);
            // Each dispatch waits for the previous one: wgpu detects that they share buffers.
            self.dispatch(&mut pass, &kernels.smooth);
            if let Some(sigma) = &self.sigma {
                pass.set_bind_group(0, &sigma.bind_group, &[]);
                self.dispatch(&mut pass, &kernels.sigma);
            }
            if let Some(fill) = &self.fill {
                pass.set_bind_group(0, &fill.bind_group, &[]);
                self.dispatch(&mut pass, &kernels.fill);
            }
            if let Some((over_time, slot, moves)) = begun {
                over_time.encode(&mut pass, slot, moves);
            }
        }
        if let Some(output) = &self.output {
            self.copy_results(&mut encoder, output);
        }
        if let Some(stamps) = &self.stamps {
            stamps.write(&mut encoder, 3);
            stamps.resolve(&mut encoder);
        }
        encoder.finish()
    }

    /// Copies the requested outputs to the buffer that the host reads.
    fn copy_results(&self, encoder: &mut wgpu::CommandEncoder, output: &wgpu::Buffer) {
        let SlotUse { layout, results, .. } = &self.used_for;
        if !self.used_for.has_steps() || layout == results {
            encoder.copy_buffer_to_buffer(output, 0, &self.readback, 0, None);
            return;
        }
        for frame in 0..self.frames {
            let bytes = |layout: &Layout, word: usize| (frame * layout.output_words() + word) as u64 * WORD;
            for (from, to) in layout.parts().into_iter().zip(results.parts()) {
                if let (Some(from), Some(to)) = (from, to) {
                    let (at, size) = (bytes(results, to.start), Some(to.len() as u64 * WORD));
                    encoder.copy_buffer_to_buffer(output, bytes(layout, from.start), &self.readback, at, size);
                }
            }
        }
    }

    fn dispatch(&self, pass: &mut wgpu::ComputePass<'_>, kernels: &[Dispatch]) {
        for (kernel, [across, down]) in kernels {
            pass.set_pipeline(kernel);
            pass.dispatch_workgroups(*across as u32, *down as u32, self.frames as u32);
        }
    }

    /// Waits until all buffers of a finished submission are mapped for the host.
    pub(super) fn wait_mapped(&self) -> Result<(), EngineError> {
        self.mapped.wait(&self.gpu)
    }

    /// Returns the times of the last submission and unmaps its timestamps, which must be mapped. `None` unless
    /// timestamps were requested.
    pub(super) fn timings(&self) -> Option<FrameTimings> {
        self.stamps.as_ref()?.timings()
    }
}
