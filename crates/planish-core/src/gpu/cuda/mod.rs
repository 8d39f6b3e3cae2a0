//! Frames that never leave the GPU: depth in a CUDA program's memory is smoothed by the Vulkan kernels, and the result
//! is in that program's memory again.
//!
//! Vulkan exports the buffers of 16 frames, a timeline semaphore `copied`, and one `done` per queue; CUDA imports them.
//! On the caller's stream, a frame is: copy the depth into a buffer, signal `copied`, wait for `done`, copy the result
//! out. A queue of Vulkan waits for `copied`, runs the kernels, and signals its `done`. The host does not wait.
//!
//! A GPU works for one of CUDA and Vulkan at a time, and needs about 0.17 ms to change (H200, driver 580): frame by
//! frame that is most of the time, for 16 frames in flight little of it.

mod driver;
mod shared;

use std::collections::VecDeque;
use std::sync::Arc;

use ash::vk;
use bytemuck::bytes_of;

use self::driver::{Cuda, ImportedMemory, ImportedSemaphore};
use self::shared::{ExportedBuffer, SharingDevice};
use super::device::{GpuDevice, OpenAdapter, adapters, list};
use super::engine::Gpu;
use super::layout::{InputKind, Layout};
use super::upload::Uploader;
use crate::camera::Camera;
use crate::devices::{GpuOptions, choose};
use crate::error::{EngineError, Error, FrameError, ParamError};
use crate::frame::{DepthView, FrameGeometry, GeometryScratch, IntoFrame};
use crate::outputs::Outputs;
use crate::params::{EngineParams, FrameParams, Params};
use crate::settings::Settings;
use crate::smoothing_engine::AdmittedFrame;

/// Frames whose buffers exist at once, which may be in flight.
const FRAMES: usize = 16;

/// Submissions that wgpu may have unfinished before the host waits for the oldest.
const MOST_UNFINISHED: usize = 64;

/// Bytes of a word.
const WORD: u64 = 4;

/// Smooths depth images in CUDA's memory, for one camera. Calls return at once; the work is done in the order of the
/// stream.
pub struct CudaSmoother {
    slots: Vec<CudaSlot>,
    /// One list per queue.
    kernels: Vec<Vec<(wgpu::ComputePipeline, [usize; 2])>>,
    layout: Layout,
    /// Frames handed over, and received.
    submitted: u64,
    received: u64,
    stream: Option<usize>,
    /// Submissions with their queues.
    unfinished: VecDeque<(usize, wgpu::SubmissionIndex)>,
    /// Counts frames, in the order of the stream.
    copied: (vk::Semaphore, ImportedSemaphore),
    /// One per queue; its value is the number of the last finished frame.
    done: Vec<(vk::Semaphore, ImportedSemaphore)>,
    cuda: Cuda,
    engine: Gpu,
    sharing: SharingDevice,
}

/// The buffers of a frame.
struct CudaSlot {
    input: ImportedMemory,
    output: ImportedMemory,
    bind_group: wgpu::BindGroup,
}

impl CudaSmoother {
    /// Opens the GPU for depth of a camera without distortion: u16 in its units, or f32 in metres. The outputs of the
    /// settings may be points, normals, curvature and depth_m.
    ///
    /// # Errors
    /// If Vulkan or CUDA is missing, the Vulkan driver cannot export memory, or a setting does not apply.
    pub fn open(settings: &Settings, camera: &Camera, is_metres: bool) -> Result<Self, Error> {
        let unavailable = |reason: String| EngineError::Unavailable { engine: "gpu", reason };
        camera.validate()?;
        let outputs = settings.outputs.unwrap_or_default();
        check(settings, camera, outputs)?;
        let listed = list();
        let chosen = choose(&listed, settings.adapter.as_deref())?;
        let adapter = adapters().get(chosen.index).ok_or_else(|| unavailable("the adapter is gone".into()))?;
        let sharing = SharingDevice::open(adapter, chosen).map_err(unavailable)?;
        let cuda = Cuda::open(sharing.uuid).map_err(unavailable)?;
        let shape = (camera.width, camera.height);

        // The header and rays depend on the camera only, so an empty frame provides them.
        let (raw, metres) = (vec![0u16; camera.width * camera.height], vec![0f32; camera.width * camera.height]);
        let view = if is_metres { DepthView::from_metres(&metres, camera) } else { DepthView::new(&raw, camera) };
        let frame = view?.into_frame()?;
        let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
        let Params::Frame(params @ FrameParams { window, .. }) = settings.resolve(frame)?.params else {
            return Err(FrameError::MissingCamera { what: "depth in CUDA's memory" }.into());
        };
        let pitch = geometry.rule.known_pitch_at_1m().filter(|_| window.is_auto());
        let params = EngineParams::from(params).with_size(pitch.map_or(window.nominal(), |at| window.at_pitch(at)));
        let adapter = Arc::new(OpenAdapter::new(adapter, &chosen.name, sharing.devices.clone()));
        let options = GpuOptions::default();
        let engine = Gpu::open_in(adapter, params, outputs, &options, shape)?;
        let queues = engine.adapter.devices.len();
        let kind = if is_metres { InputKind::DepthMetres } else { InputKind::Depth };
        let layout = engine.layout(kind);
        let kernels = engine.adapter.devices.iter().map(|gpu| engine.kernels(gpu, kind));
        let kernels = kernels.collect::<Result<Vec<_>, _>>()?;
        let mut words = vec![0u32; layout.input_words()];
        let words_of: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        Uploader::new(params).write(&layout, &AdmittedFrame::new(frame, geometry), &mut |word, bytes| {
            words_of[4 * word..4 * word + bytes.len()].copy_from_slice(bytes);
        });
        let slot = |i: usize| {
            CudaSlot::new((&sharing, i % queues), &engine.adapter.devices[i % queues], &cuda, &layout, &words)
        };
        let slots = (0..FRAMES).map(slot).collect::<Result<Vec<_>, _>>().map_err(unavailable)?;
        let semaphore = || -> Result<_, String> {
            let (semaphore, fd) = sharing.exporter.semaphore()?;
            Ok((semaphore, cuda.import_semaphore(fd)?))
        };
        let copied = semaphore().map_err(unavailable)?;
        let done = (0..queues).map(|_| semaphore()).collect::<Result<Vec<_>, _>>().map_err(unavailable)?;
        Ok(Self {
            slots,
            kernels,
            layout,
            submitted: 0,
            received: 0,
            stream: None,
            unfinished: VecDeque::new(),
            copied,
            done,
            cuda,
            engine,
            sharing,
        })
    }

    /// The name of the GPU.
    pub fn gpu_name(&self) -> &str {
        &self.engine.adapter.devices[0].name
    }

    /// Channels of a result: three for points and normals each, one for curvature and depth_m each, in this order.
    pub fn channels(&self) -> usize {
        self.layout.output_words() / self.layout.pixels()
    }

    /// Smooths an image at `depth`, whose rows begin every `row_stride` bytes, into `result`: a plane of f32 for each
    /// channel, row by row. Both are addresses in device memory; everything happens on the stream.
    ///
    /// # Safety
    /// `depth` and `result` must be valid memory of this GPU, of that size, until the stream has run what this call
    /// adds to it, and `stream` a stream of its primary context; 0 is the default one.
    ///
    /// # Errors
    /// If frames are in flight, the stride is too small, or the GPU fails.
    pub unsafe fn smooth(&mut self, depth: u64, row_stride: usize, result: u64, stream: usize) -> Result<(), Error> {
        if self.in_flight() > 0 {
            return Err(EngineError::Full { in_flight: self.in_flight() }.into());
        }
        // SAFETY: as the caller promises.
        unsafe {
            self.submit(depth, row_stride, stream)?;
            self.receive(result, stream).map(drop)
        }
    }

    /// Hands an image over, as [`smooth`](Self::smooth) does; its result is received later, in the same order. The GPU
    /// changes from CUDA to Vulkan and back once for all frames that were handed over before the first is received,
    /// which takes longer than a frame.
    ///
    /// # Safety
    /// As of [`smooth`](Self::smooth).
    ///
    /// # Errors
    /// If as many are in flight as can be, the stride is too small, or the GPU fails.
    pub unsafe fn submit(&mut self, depth: u64, row_stride: usize, stream: usize) -> Result<(), Error> {
        let layout = self.layout;
        let row_bytes = layout.width * if layout.kind == InputKind::DepthMetres { 4 } else { 2 };
        if row_stride < row_bytes {
            return Err(FrameError::BadStride { what: "row stride", stride: row_stride, least: row_bytes }.into());
        }
        if self.in_flight() == FRAMES {
            return Err(EngineError::Full { in_flight: FRAMES }.into());
        }
        self.change_to(stream)?;
        let queue = self.queue_of(self.submitted);
        let gpu = Arc::clone(&self.engine.adapter.devices[queue]);
        gpu.check()?;
        let failed = |what: String| EngineError::Device { device: gpu.name.clone(), reason: what };
        let (slot, number) = (&self.slots[self.submitted as usize % FRAMES], self.submitted + 1);
        let samples = slot.input.address + WORD * layout.rays().end as u64;
        // The stream has waited for the kernels that read this slot before, to copy their result out.
        // SAFETY: as the caller promises; the slot's buffers live as long as this.
        unsafe {
            let pointers = (samples, depth);
            self.cuda.copy_rows(pointers, row_stride, (row_bytes, layout.height), stream).map_err(failed)?;
        }
        self.cuda.signal(&self.copied.1, number, stream).map_err(failed)?;
        self.launch(&gpu, queue, number)?;
        self.submitted = number;
        Ok(())
    }

    /// Has the stream wait for the oldest frame in flight and copy its result; false if none is in flight.
    ///
    /// # Safety
    /// As of [`smooth`](Self::smooth).
    ///
    /// # Errors
    /// If the GPU fails.
    pub unsafe fn receive(&mut self, result: u64, stream: usize) -> Result<bool, Error> {
        if self.in_flight() == 0 {
            return Ok(false);
        }
        self.change_to(stream)?;
        let name = || self.gpu_name().to_owned();
        let failed = |what: String| EngineError::Device { device: name(), reason: what };
        let (slot, number) = (&self.slots[self.received as usize % FRAMES], self.received + 1);
        let queue = self.queue_of(self.received);
        self.cuda.wait(&self.done[queue].1, number, stream).map_err(failed)?;
        let bytes = WORD as usize * self.layout.output_words();
        // SAFETY: as the caller promises.
        unsafe { self.cuda.copy_rows((result, slot.output.address), bytes, (bytes, 1), stream).map_err(failed)? };
        self.received = number;
        Ok(true)
    }

    /// Frames handed over and not yet received.
    pub fn in_flight(&self) -> usize {
        (self.submitted - self.received) as usize
    }

    /// How many may be.
    pub const fn max_in_flight(&self) -> usize {
        FRAMES
    }

    /// Returns the queue of a frame, counted from 0.
    fn queue_of(&self, frame: u64) -> usize {
        frame as usize % FRAMES % self.engine.adapter.devices.len()
    }

    /// Waits for what another stream does with the buffers.
    fn change_to(&mut self, stream: usize) -> Result<(), EngineError> {
        if let Some(before) = self.stream.filter(|before| *before != stream) {
            let device = self.gpu_name().to_owned();
            self.cuda.synchronize(before).map_err(|reason| EngineError::Device { device, reason })?;
        }
        self.stream = Some(stream);
        Ok(())
    }

    /// Submits the kernels of the next frame.
    fn launch(&mut self, gpu: &GpuDevice, queue: usize, number: u64) -> Result<(), EngineError> {
        let failed = |what: String| EngineError::Device { device: gpu.name.clone(), reason: what };
        let slot = &self.slots[self.submitted as usize % FRAMES];
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_bind_group(0, &slot.bind_group, &[]);
            for (kernel, [across, down]) in &self.kernels[queue] {
                pass.set_pipeline(kernel);
                pass.dispatch_workgroups(*across as u32, *down as u32, 1);
            }
        }
        let commands = encoder.finish();
        self.sharing.stage(queue, (self.copied.0, number), (self.done[queue].0, number)).map_err(failed)?;
        self.unfinished.push_back((queue, gpu.submit(commands)));
        if self.unfinished.len() > MOST_UNFINISHED
            && let Some((queue, oldest)) = self.unfinished.pop_front()
        {
            self.engine.adapter.devices[queue].wait(oldest)?;
        }
        gpu.check()
    }
}

/// Refuses settings that need more than the kernels.
fn check(settings: &Settings, camera: &Camera, outputs: Outputs) -> Result<(), Error> {
    let refuse = |field, value: String, allowed| Err(ParamError { field, value, allowed }.into());
    let numbers = Outputs { points: false, normals: false, curvature: false, depth_m: false, ..outputs };
    if numbers != Outputs::NONE {
        return refuse(
            "outputs",
            numbers.names().join(", "),
            "points, normals, curvature and depth_m in CUDA's memory",
        );
    }
    if !settings.preparation().is_empty() {
        return refuse(
            "remove_floating",
            "a step before smoothing".into(),
            "no step before smoothing in CUDA's memory",
        );
    }
    if let Some(width_px) = settings.fill {
        return refuse("fill", width_px.to_string(), "no filling in CUDA's memory");
    }
    if settings.temporal_params().is_some() {
        return refuse("temporal", "steady".into(), "off in CUDA's memory");
    }
    if settings.estimates_sensor() {
        return refuse("sensor", "auto".into(), "a sensor by its name in CUDA's memory");
    }
    if !camera.distortion.is_none() {
        let value = format!("{:?}", camera.distortion.coefficients());
        return refuse("distortion", value, "none for depth in CUDA's memory: rectify the images first");
    }
    Ok(())
}

impl CudaSlot {
    fn new(
        (sharing, queue): (&SharingDevice, usize),
        gpu: &GpuDevice,
        cuda: &Cuda,
        layout: &Layout,
        words: &[u32],
    ) -> Result<Self, String> {
        let shared = |label, words: usize| -> Result<_, String> {
            let bytes = words as u64 * WORD;
            let ExportedBuffer { buffer, fd, allocated } = sharing.buffer(queue, label, bytes)?;
            Ok((buffer, cuda.import_memory(fd, allocated, bytes)?))
        };
        let (input, imported_input) = shared("input", layout.input_words())?;
        let (output, imported_output) = shared("output", layout.output_words())?;
        // Header and rays are the same for every frame.
        gpu.queue.write_buffer(&input, 0, bytemuck::cast_slice(words));
        let own = |label, size, usage| {
            let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
            gpu.device.create_buffer(&descriptor)
        };
        let batch = layout.batch();
        let uniform =
            own("batch", size_of_val(&batch) as u64, wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST);
        gpu.queue.write_buffer(&uniform, 0, bytes_of(&batch));
        let kept =
            layout.kept_words().map(|words| own("kept", words.max(4) as u64 * WORD, wgpu::BufferUsages::STORAGE));
        let entries: Vec<_> = [&uniform, &input, &output, &kept[0], &kept[1]]
            .into_iter()
            .zip(0..)
            .map(|(buffer, binding)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let bind_group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &gpu.bind_group_layout,
            entries: &entries,
        });
        // The writes are done before CUDA copies anything.
        let submission = gpu.submit(gpu.device.create_command_encoder(&Default::default()).finish());
        gpu.wait(submission).map_err(|error| error.to_string())?;
        Ok(Self { input: imported_input, output: imported_output, bind_group })
    }
}

impl Drop for CudaSmoother {
    fn drop(&mut self) {
        // Nothing may use the buffers any more; of a device that is lost, nothing does.
        if let Some(stream) = self.stream {
            let _ = self.cuda.synchronize(stream);
        }
        for (queue, submission) in self.unfinished.drain(..) {
            let _ = self.engine.adapter.devices[queue].wait(submission);
        }
        for slot in &self.slots {
            self.cuda.free_memory(&slot.input);
            self.cuda.free_memory(&slot.output);
        }
        for (semaphore, imported) in self.done.iter().chain([&self.copied]) {
            self.cuda.free_semaphore(imported);
            self.sharing.exporter.destroy(*semaphore);
        }
    }
}
