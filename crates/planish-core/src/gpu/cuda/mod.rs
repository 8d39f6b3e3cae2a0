//! Frames that never leave the GPU: depth in a CUDA program's memory is smoothed there, and the result is written to
//! the program's memory.
//!
//! The kernels are those of the GPU engine. They are translated to CUDA C++ ([`translate`]), compiled by NVRTC
//! ([`nvrtc`]) and launched in the device's primary context ([`driver`]), on the caller's stream. The GPU does not
//! switch contexts, the host does not wait, and neither Vulkan nor wgpu is involved.

mod driver;
mod functions;
mod nvrtc;
#[cfg(test)]
mod tests;
mod translate;

use std::ffi::c_void;
use std::sync::Arc;

use self::driver::{Cuda, DevicePointer, Event, Grid, Kernel, Memory};
use self::nvrtc::Nvrtc;
use self::translate::{ENTRY_POINT, translate};
use super::plan::{Plan, PlannedPass, WebGpuLimits};
use crate::camera::Camera;
use crate::engines::Engine;
use crate::error::{EngineError, Error, FrameError, ParamError};
use crate::frame::{DepthView, IntoFrame};
use crate::outputs::Outputs;
use crate::params::Params;
use crate::settings::Settings;

/// Maximum number of frames in flight.
const FRAMES: u64 = 16;

/// Maximum number of words in a buffer; kernels count them in 32 bits.
const MOST_WORDS: u64 = u32::MAX as u64;

/// Limits of every CUDA device: bytes of shared memory per block, bytes per buffer, and blocks across and down.
const LIMITS: WebGpuLimits = WebGpuLimits::new(48 << 10, WORD * MOST_WORDS, 65_535);

/// Number of bytes in a word.
const WORD: u64 = 4;

/// Smooths depth images of one camera in CUDA memory. Calls return at once; the GPU runs their work in stream order.
pub struct CudaSmoother {
    passes: Vec<Pass>,
    frame: FrameSizes,
    /// The kernels' uniform, binding 0.
    batch: [u32; 4],
    /// The bytes at the start of every frame's input: the header and the camera's rays.
    head: Vec<u8>,
    /// Buffers for `smooth`, which writes its output to the caller's memory.
    alone: Buffers,
    /// Buffers of the frames in flight, allocated by the first `submit`.
    ring: Option<Buffers>,
    /// Number of frames submitted so far.
    submitted: u64,
    /// Number of submitted frames whose kernels were launched.
    launched: u64,
    /// Number of submitted frames whose results were received.
    received: u64,
    /// Event at the end of the last call's work.
    last: Event,
    cuda: Arc<Cuda>,
}

/// GPU memory for one result. Dropping it frees the memory after the GPU has finished all work that uses it.
pub struct CudaMemory {
    memory: Memory,
    /// Event at the end of the work that writes the result.
    written: Event,
    cuda: Arc<Cuda>,
}

/// A kernel and its launch parameters for one frame.
struct Pass {
    kernel: Kernel,
    bindings: Vec<u32>,
    blocks: [u32; 2],
    threads: [u32; 2],
}

/// The shape of one frame, and the sizes of its buffers in bytes.
struct FrameSizes {
    width: usize,
    height: usize,
    row_bytes: usize,
    input: u64,
    output: u64,
    kept: [u64; 2],
}

/// Device memory for consecutive frames.
struct Buffers {
    input: Memory,
    output: Option<Memory>,
    kept: [Memory; 2],
}

impl CudaSmoother {
    /// Opens a GPU to smooth depth images of a camera without distortion: u16 in the camera's units, or f32 in
    /// metres. The settings may request points, normals, curvature and depth_m. Their `adapter` is the index of a
    /// CUDA device or a part of its name. If it is not set, the device of the calling thread's context is used, or
    /// the first device if there is no context.
    ///
    /// # Errors
    /// If CUDA's driver or compiler (NVRTC) is missing, or a setting is not supported.
    pub fn open(settings: &Settings, camera: &Camera, is_metres: bool) -> Result<Self, Error> {
        let unavailable = |reason: String| EngineError::Unavailable { engine: "gpu", reason };
        camera.validate()?;
        let outputs = settings.outputs.unwrap_or_default();
        check(settings, camera, outputs)?;
        let cuda = Arc::new(Cuda::open(settings.adapter.as_deref()).map_err(unavailable)?);
        let nvrtc = Nvrtc::load(cuda.driver_major, cuda.capability).map_err(unavailable)?;
        let settings = &Settings { engine: Some(Engine::Gpu), ..settings.clone() };

        // The header and rays depend on the camera only, so an empty frame provides them.
        let pixels = camera.width * camera.height;
        let (raw, metres) = (vec![0u16; pixels], vec![0f32; pixels]);
        let view = if is_metres { DepthView::from_metres(&metres, camera) } else { DepthView::new(&raw, camera) };
        let frame = view?.into_frame()?;
        let Params::Frame(params) = settings.resolve(frame)?.params else {
            return Err(FrameError::MissingCamera { what: "depth in CUDA memory" }.into());
        };
        let mut plan = Plan::new(params, outputs, frame, &LIMITS).map_err(|error| named(error, &cuda.name))?;
        let mut head = plan.upload(frame)?;
        let sizes = FrameSizes {
            width: camera.width,
            height: camera.height,
            row_bytes: camera.width * if is_metres { 4 } else { 2 },
            input: head.len() as u64,
            output: plan.output_bytes() as u64,
            kept: plan.kept_bytes().map(|bytes| bytes as u64),
        };
        head.truncate(plan.head_bytes());

        let pass = |planned: PlannedPass| -> Result<Pass, String> {
            let source = translate(&planned.wgsl)?;
            let kernel = cuda.load(&nvrtc.compile(&source.text, cuda.capability)?, ENTRY_POINT)?;
            Ok(Pass { kernel, bindings: source.bindings, blocks: planned.workgroups, threads: source.threads })
        };
        let passes = plan.passes().into_iter().map(pass).collect::<Result<_, _>>().map_err(unavailable)?;
        let alone = Buffers::new(&cuda, &sizes, &head, 1, false)?;
        let last = cuda.event().map_err(unavailable)?;
        Ok(Self {
            passes,
            frame: sizes,
            batch: plan.uniform(),
            head,
            alone,
            ring: None,
            submitted: 0,
            launched: 0,
            received: 0,
            last,
            cuda,
        })
    }

    /// Returns the name of the GPU.
    pub fn gpu_name(&self) -> &str {
        &self.cuda.name
    }

    /// Returns the number of channels of a result: three each for points and normals, one each for curvature and
    /// depth_m, in this order.
    pub fn channels(&self) -> usize {
        (self.frame.output / WORD) as usize / (self.frame.width * self.frame.height)
    }

    /// Smooths the image at `depth`, whose rows begin every `row_stride` bytes, into `result`: one plane of f32 per
    /// channel, row by row. Both are addresses in device memory. All work runs on the stream.
    ///
    /// # Safety
    /// `depth` and `result` must point to valid memory of this GPU, large enough for the image and the result, until
    /// the stream has run the work added by this call. `stream` must be a stream of the GPU's primary context; 0 is
    /// the default stream.
    ///
    /// # Errors
    /// If frames are in flight, the stride is too small, an address is not in this GPU's memory, or the GPU fails.
    pub unsafe fn smooth(&mut self, depth: u64, row_stride: usize, result: u64, stream: usize) -> Result<(), Error> {
        if self.in_flight() > 0 {
            return Err(EngineError::Full { in_flight: self.in_flight() }.into());
        }
        self.check_depth(depth, row_stride)?;
        self.check_memory("the result", result)?;
        let samples = self.alone.input.address + self.head.len() as u64;
        // SAFETY: the caller guarantees the addresses and the stream; the buffers live until the last call's work is
        // done.
        Ok(self.add_to(stream, || unsafe {
            self.copy_in((samples, depth), row_stride, stream)?;
            self.launch(self.alone.of_frame(0, &self.frame, result), 1, stream)
        })?)
    }

    /// Submits an image in the same form as for [`smooth`](Self::smooth). Results are received later, in the order of
    /// submission. Frames that are submitted before the first is received are smoothed together, which takes less
    /// time per frame.
    ///
    /// # Safety
    /// Same as [`smooth`](Self::smooth).
    ///
    /// # Errors
    /// If the maximum number of frames is in flight, the stride is too small, the address is not in this GPU's memory,
    /// or the GPU fails.
    pub unsafe fn submit(&mut self, depth: u64, row_stride: usize, stream: usize) -> Result<(), Error> {
        self.check_depth(depth, row_stride)?;
        if self.in_flight() == self.max_in_flight() {
            return Err(EngineError::Full { in_flight: self.in_flight() }.into());
        }
        if self.ring.is_none() {
            self.ring = Some(Buffers::new(&self.cuda, &self.frame, &self.head, FRAMES, true)?);
        }
        let Some(ring) = &self.ring else { return Ok(()) };
        let slot = self.submitted % FRAMES;
        let samples = ring.input.address + slot * self.frame.input + self.head.len() as u64;
        // The result of the slot's previous frame has been copied out by earlier work. SAFETY: the caller guarantees
        // the address and the stream; the buffers live until the last call's work is done.
        self.add_to(stream, || unsafe { self.copy_in((samples, depth), row_stride, stream) })?;
        self.submitted += 1;
        Ok(())
    }

    /// Smooths the submitted frames, and copies the oldest result to `result`. Returns false if no frame is in
    /// flight.
    ///
    /// # Safety
    /// Same as [`smooth`](Self::smooth).
    ///
    /// # Errors
    /// If the address is not in this GPU's memory, or the GPU fails.
    pub unsafe fn receive(&mut self, result: u64, stream: usize) -> Result<bool, Error> {
        if self.in_flight() == 0 {
            return Ok(false);
        }
        self.check_memory("the result", result)?;
        let Some((ring, output)) = self.ring.as_ref().and_then(|ring| Some((ring, ring.output.as_ref()?.address)))
        else {
            return Ok(false);
        };
        let (bytes, mut launched) = (self.frame.output, self.launched);
        let most = self.frame.most_together();
        // SAFETY: the caller guarantees the address and the stream; the buffers live until the last call's work is
        // done.
        let done = self.add_to(stream, || unsafe {
            while launched < self.submitted {
                // Launch frames with adjacent buffers together, up to the end of the ring.
                let slot = launched % FRAMES;
                let frames = (self.submitted - launched).min(FRAMES - slot).min(most);
                self.launch(ring.of_frame(slot, &self.frame, output + slot * bytes), frames as u32, stream)?;
                launched += frames;
            }
            let from = output + self.received % FRAMES * bytes;
            self.cuda.copy_rows((result, from), bytes as usize, (bytes as usize, 1), stream)
        });
        self.launched = launched;
        done?;
        self.received += 1;
        Ok(true)
    }

    /// Discards the frames in flight; their results cannot be received afterwards.
    pub fn forget(&mut self) {
        (self.launched, self.received) = (self.submitted, self.submitted);
    }

    /// Allocates memory for a result.
    ///
    /// # Errors
    /// If the GPU has too little free memory.
    pub fn new_result(&self) -> Result<CudaMemory, Error> {
        let memory = self.cuda.allocate(self.frame.output as usize, false)?;
        let written = self.cuda.event().map_err(|reason| self.cuda.failed(reason))?;
        Ok(CudaMemory { memory, written, cuda: Arc::clone(&self.cuda) })
    }

    /// Returns the number of frames submitted and not yet received.
    pub fn in_flight(&self) -> usize {
        (self.submitted - self.received) as usize
    }

    /// Returns the maximum number of frames in flight.
    pub const fn max_in_flight(&self) -> usize {
        FRAMES as usize
    }

    fn check_depth(&self, depth: u64, row_stride: usize) -> Result<(), Error> {
        let least = self.frame.row_bytes;
        if row_stride < least {
            return Err(FrameError::BadStride { what: "row stride", stride: row_stride, least }.into());
        }
        self.check_memory("the depth", depth)
    }

    /// Rejects host memory and memory of other GPUs.
    fn check_memory(&self, what: &'static str, address: u64) -> Result<(), Error> {
        if self.cuda.has(address) {
            return Ok(());
        }
        let gpu = self.cuda.name.clone();
        Err(FrameError::NotOnGpu { what, gpu, device: self.cuda.device }.into())
    }

    /// Adds work to a stream. It runs after the last call's work, even if that was added to another stream.
    fn add_to(&self, stream: usize, work: impl FnOnce() -> Result<(), String>) -> Result<(), EngineError> {
        let added = self.cuda.within(|| {
            self.last.wait_on(stream)?;
            let added = work();
            self.last.record(stream)?;
            added
        });
        added.map_err(|reason| self.cuda.failed(reason))
    }

    /// Copies an image into its frame's input, after the header and rays.
    ///
    /// # Safety
    /// Same as [`Cuda::copy_rows`].
    unsafe fn copy_in(&self, pointers: (u64, u64), row_stride: usize, stream: usize) -> Result<(), String> {
        let size = (self.frame.row_bytes, self.frame.height);
        // SAFETY: the caller guarantees the same.
        unsafe { self.cuda.copy_rows(pointers, row_stride, size, stream) }
    }

    /// Launches the kernels for frames whose buffers are adjacent.
    ///
    /// # Safety
    /// The buffers must be valid until the stream has run the kernels.
    unsafe fn launch(&self, mut buffers: [DevicePointer; 4], frames: u32, stream: usize) -> Result<(), String> {
        let mut batch = self.batch;
        for Pass { kernel, bindings, blocks: [across, down], threads } in &self.passes {
            let argument = |&binding: &u32| match binding {
                0 => (&raw mut batch).cast::<c_void>(),
                binding => (&raw mut buffers[binding as usize - 1]).cast(),
            };
            let mut arguments: Vec<*mut c_void> = bindings.iter().map(argument).collect();
            let grid = Grid { blocks: [*across, *down, frames], threads: *threads };
            // SAFETY: each argument has the type of the kernel's parameter; the caller guarantees that the buffers are
            // valid until the stream has run the kernel.
            unsafe { self.cuda.launch(kernel, grid, &mut arguments, stream)? };
        }
        Ok(())
    }
}

impl FrameSizes {
    /// Returns the maximum number of frames per launch, which is limited because the kernels count words in 32 bits.
    fn most_together(&self) -> u64 {
        let [points, planes] = self.kept;
        let most = self.input.max(self.output).max(points).max(planes);
        (WORD * MOST_WORDS / most).max(1)
    }
}

impl CudaMemory {
    /// Returns the address of the memory.
    pub fn address(&self) -> u64 {
        self.memory.address
    }

    /// Returns the CUDA device number of the GPU.
    pub fn device(&self) -> i32 {
        self.cuda.device
    }

    /// Declares that the work added to the stream so far writes the memory.
    ///
    /// # Errors
    /// If the GPU fails.
    ///
    /// # Safety
    /// `stream` must be a stream of the GPU's primary context.
    pub unsafe fn written_by(&self, stream: usize) -> Result<(), Error> {
        Ok(self.written.record(stream).map_err(|reason| self.cuda.failed(reason))?)
    }

    /// Makes a stream wait until the memory is written.
    ///
    /// # Errors
    /// If the GPU fails.
    ///
    /// # Safety
    /// Same as [`written_by`](Self::written_by).
    pub unsafe fn wait_on(&self, stream: usize) -> Result<(), Error> {
        Ok(self.written.wait_on(stream).map_err(|reason| self.cuda.failed(reason))?)
    }
}

impl Drop for CudaSmoother {
    fn drop(&mut self) {
        // Kernels must not be unloaded while a stream runs them. The error of a lost device is ignored: no stream
        // runs on it.
        let _ = self.last.synchronize();
    }
}

impl Buffers {
    /// Allocates buffers for `frames` frames and uploads the head of each. There is no output buffer unless
    /// `has_output` is true.
    fn new(
        cuda: &Arc<Cuda>,
        sizes: &FrameSizes,
        head: &[u8],
        frames: u64,
        has_output: bool,
    ) -> Result<Self, EngineError> {
        let allocate = |bytes: u64| cuda.allocate((frames * bytes) as usize, true);
        let [points, planes] = sizes.kept;
        let buffers = Self {
            input: allocate(sizes.input)?,
            output: has_output.then(|| allocate(sizes.output)).transpose()?,
            kept: [allocate(points)?, allocate(planes)?],
        };
        let heads = (0..frames).map(|frame| (buffers.input.address + frame * sizes.input, head));
        // SAFETY: each head fits at the start of its frame's input.
        unsafe { cuda.upload(heads) }.map_err(|reason| cuda.failed(reason))?;
        Ok(buffers)
    }

    /// Returns the addresses of the buffers of the frame in `slot`, in binding order from binding 1.
    fn of_frame(&self, slot: u64, sizes: &FrameSizes, output: DevicePointer) -> [DevicePointer; 4] {
        let [points, planes] = &self.kept;
        let kept = [points.address + slot * sizes.kept[0], planes.address + slot * sizes.kept[1]];
        [self.input.address + slot * sizes.input, output, kept[0], kept[1]]
    }
}

/// Adds the device's name to an error about its limits.
fn named(error: Error, name: &str) -> Error {
    match error {
        Error::Engine(EngineError::Limit { what, allowed, needed, .. }) => {
            EngineError::Limit { device: name.to_owned(), what, allowed, needed }.into()
        }
        error => error,
    }
}

/// Rejects settings that the kernels do not cover.
fn check(settings: &Settings, camera: &Camera, outputs: Outputs) -> Result<(), Error> {
    let refuse = |field, value: String, allowed| Err(ParamError { field, value, allowed }.into());
    let numbers = Outputs { points: false, normals: false, curvature: false, depth_m: false, ..outputs };
    if numbers != Outputs::NONE {
        return refuse(
            "outputs",
            numbers.names().join(", "),
            "points, normals, curvature and depth_m for frames in CUDA memory",
        );
    }
    if let Some(engine) = settings.engine.filter(|engine| !matches!(engine, Engine::Auto | Engine::Gpu)) {
        return refuse("engine", engine.name().to_owned(), "gpu or auto for frames in CUDA memory");
    }
    if !settings.preparation().is_empty() {
        return refuse(
            "remove_floating",
            "a step before smoothing".into(),
            "no preparation (remove_floating, min_range_m, max_range_m, decimate) for frames in CUDA memory",
        );
    }
    if let Some(width_px) = settings.fill {
        return refuse("fill", width_px.to_string(), "no filling for frames in CUDA memory");
    }
    if settings.temporal_params().is_some() {
        return refuse("temporal", "steady".into(), "off for frames in CUDA memory");
    }
    if settings.estimates_sensor() {
        return refuse("sensor", "auto".into(), "a named sensor, such as kinect1, for frames in CUDA memory");
    }
    if !camera.distortion.is_none() {
        let value = format!("{:?}", camera.distortion.coefficients());
        return refuse("distortion", value, "no distortion for frames in CUDA memory; rectify the images first");
    }
    Ok(())
}
