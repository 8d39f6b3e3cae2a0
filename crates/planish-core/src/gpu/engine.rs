//! The GPU engine, which manages slots, frames in flight and batches.

use std::collections::{HashSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use super::copier::{Copied, Copier};
use super::device::{self, GpuDevice, OpenAdapter, Purpose, lock};
use super::fill_kernels;
use super::flight::{Flight, FreeSlots};
use super::kernel::{KernelKey, Pass};
use super::layout::{InputKind, Layout};
use super::over_time::OverTime;
use super::sigma_kernels::scratch_words;
use super::slot::{Dispatch, Kernels, Slot, SlotUse};
use super::steps::{compile_steps, step_kernels};
use super::upload::Uploader;
use super::view::MappedView;
use crate::devices::{GpuAdapter, GpuOptions, Transfer, choose};
use crate::error::{EngineError, Error, FrameError};
use crate::fill::MOST_PX;
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::{Edges, EngineParams};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, DeviceSteps, SmoothingEngine, Video, VideoStep};
use crate::threads::{Threads, on_a_thread_each};
use crate::timings::FrameTimings;
use crate::view::SmoothedView;

/// Lists the adapters of this machine.
pub(crate) fn adapters() -> Vec<GpuAdapter> {
    device::list()
}

/// Destroys the open devices, as a driver reset does, to test recovery.
pub fn lose_devices() {
    device::lose_open();
}

/// A submitted frame, whose result is either read in place or copied.
enum Pending {
    InPlace(Box<Flight>),
    Copied(Copied),
}

/// A function that opens an adapter with all its queues.
type OpenSeveral = Box<dyn FnOnce() -> Result<Arc<OpenAdapter>, EngineError> + Send>;

/// Maximum number of bytes per buffer in a submission of several frames.
const MAX_BATCH_BYTES: u64 = 256 << 20;
/// Maximum number of frames per submission.
const MAX_BATCH_FRAMES: u64 = 64;

/// The GPU engine with its buffers.
pub(crate) struct Gpu {
    /// The adapter, with the slots' devices: one until frames overlap, then one per queue.
    pub(super) adapter: Arc<OpenAdapter>,
    /// Opens the adapter with all its queues; `None` once it has been called, and for a device of the host program.
    pub(super) several: Option<OpenSeveral>,
    params: EngineParams,
    outputs: Outputs,
    options: GpuOptions,
    shape: (usize, usize),
    pub(super) free: FreeSlots,
    /// Number of slots allocated so far; they alternate between the queues.
    allocated: usize,
    uploader: Uploader,
    /// The temporal filter, if the frames are a video.
    over_time: Option<OverTime>,
    /// The steps after smoothing, if any.
    steps: Option<DeviceSteps>,
    pending: VecDeque<Pending>,
    /// The copying threads: at least one, and one per device if the system allows it.
    copiers: Vec<Copier>,
    timings: Option<FrameTimings>,
    /// Total size of all slots in bytes, whether free or in use.
    bytes: Arc<AtomicU64>,
}

impl Gpu {
    /// Opens the engine on the adapter that the options select.
    pub(crate) fn open(
        params: EngineParams,
        outputs: Outputs,
        options: &GpuOptions,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let adapters = adapters();
        let chosen = choose(&adapters, options.adapter.as_deref())?.clone();
        let adapter = OpenAdapter::open(&chosen, Purpose::OneAtATime)?;
        let mut engine = Self::open_in(adapter, params, outputs, options, shape)?;
        engine.several = Some(Box::new(move || OpenAdapter::open(&chosen, Purpose::InFlight)));
        Ok(engine)
    }

    /// Opens the engine on a device of the host program.
    #[cfg(feature = "wgpu-interop")]
    pub(crate) fn open_on(
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        params: EngineParams,
        outputs: Outputs,
        options: &GpuOptions,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let device = Arc::new(GpuDevice::of_host(device.clone(), queue.clone()));
        Self::open_in(Arc::new(OpenAdapter { devices: vec![device] }), params, outputs, options, shape)
    }

    pub(super) fn open_in(
        adapter: Arc<OpenAdapter>,
        params: EngineParams,
        outputs: Outputs,
        options: &GpuOptions,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let mut options = options.clone();
        let gpu = &adapter.devices[0];
        let lacks = |reason: &str| EngineError::Unavailable {
            engine: "gpu",
            reason: format!("the adapter {} {reason}", gpu.name),
        };
        gpu.check_timestamps(&options)?;
        let direct = gpu.features.contains(wgpu::Features::MAPPABLE_PRIMARY_BUFFERS);
        options.transfer = match options.transfer {
            Transfer::Direct if !direct => return Err(lacks("does not support computing in host memory")),
            Transfer::Auto if direct => Transfer::Direct,
            Transfer::Auto => Transfer::Staged,
            chosen => chosen,
        };
        let mut engine = Self {
            adapter,
            several: None,
            params,
            outputs,
            options,
            shape,
            free: Arc::default(),
            allocated: 0,
            uploader: Uploader::new(params),
            over_time: None,
            steps: None,
            pending: VecDeque::new(),
            copiers: Vec::new(),
            timings: None,
            bytes: Arc::default(),
        };
        // Check limits, compile and warm up here, so that errors and delays do not occur with the first frame.
        for kind in InputKind::ALL {
            engine.check_limits(engine.layout(kind), 1)?;
        }
        engine.compile(&engine.adapter)?;
        engine.warm_up()?;
        Ok(engine)
    }

    /// Distributes later frames over several queues, if the adapter supports it. This is tried only once; if it
    /// fails, frames in flight share the open queue.
    fn open_several(&mut self) {
        let Some(open) = self.several.take().filter(|_| self.options.slots > 1) else { return };
        let Ok(several) = open() else { return };
        if self.compile(&several).is_ok() {
            self.adapter = several;
            lock(&self.free).clear();
            // Errors are ignored here; the next frame reports them.
            let _ = self.warm_up();
        }
    }

    /// Returns the first device, for limits, features and faults, which all devices share.
    fn gpu(&self) -> &GpuDevice {
        &self.adapter.devices[0]
    }

    /// Compiles the kernels of all kinds of input in parallel, because drivers compile on the calling thread.
    fn compile(&self, adapter: &OpenAdapter) -> Result<(), EngineError> {
        let keys: HashSet<KernelKey> = InputKind::ALL.into_iter().flat_map(|kind| self.kernel_keys(kind)).collect();
        let all = adapter.devices.iter().flat_map(|gpu| keys.iter().map(move |&key| (gpu, key)));
        let compiled = on_a_thread_each(all, |(gpu, key)| gpu.kernel(key).map(drop));
        let failed = || Err(self.gpu().failed("a kernel could not be compiled"));
        compiled.into_iter().try_for_each(|result| result.unwrap_or_else(|_| failed()))?;
        let checks = self.options.bounds_checks;
        let compile = |gpu: &Arc<GpuDevice>| match &self.steps {
            Some(steps) => compile_steps(gpu, steps, self.outputs, checks),
            None => Ok(()),
        };
        adapter.devices.iter().try_for_each(compile)
    }

    /// Computes a frame of holes in every slot and starts the copiers, so that the driver's one-time work per buffer
    /// and kernel does not delay the first frames of a camera.
    fn warm_up(&mut self) -> Result<(), EngineError> {
        while self.copiers.len() < self.adapter.devices.len() {
            self.copiers.push(Copier::start()?);
        }
        let used_for = self.slot_use(InputKind::Depth, true);
        let mut landed = Vec::new();
        for _ in 0..self.options.slots {
            let slot = self.slot(used_for, 1)?;
            let step = VideoStep { starts: true, motion: None };
            landed.push(MappedView::of(self.submit_slot(slot, &step)?)?);
        }
        Ok(())
    }

    pub(super) fn layout(&self, kind: InputKind) -> Layout {
        let (width, height) = self.shape;
        let keeps_planes = self.params.edges != Edges::Off;
        let keeps_points = keeps_planes || self.params.averages_blocks();
        Layout { width, height, kind, outputs: self.outputs, keeps_points, keeps_planes, cell: self.params.cell_px() }
    }

    /// Returns what a slot is used for. `finishes` states whether the steps after smoothing finish the frames.
    fn slot_use(&self, kind: InputKind, finishes: bool) -> SlotUse {
        let layout = self.layout(kind);
        let results = match (&self.over_time, self.steps) {
            (Some(over_time), _) => over_time.results(layout),
            (None, Some(steps)) if finishes => Layout { outputs: steps.outputs, ..layout },
            _ => layout,
        };
        SlotUse { layout, results, fill_px: self.steps.and_then(|steps| steps.fill_px).filter(|_| finishes) }
    }

    /// Returns true if the steps after smoothing, if any, finish a frame.
    fn finishes(&self, frame: &AdmittedFrame<'_>) -> bool {
        self.steps.is_none_or(|steps| steps.finish(&frame.frame))
    }

    /// Returns the keys of the kernels of a frame's passes, in order.
    fn kernel_keys(&self, kind: InputKind) -> impl Iterator<Item = KernelKey> {
        let workgroup_bytes = self.gpu().limits.max_compute_workgroup_storage_size as usize;
        let key = move |&pass| {
            KernelKey::new(&self.params, pass, kind, self.outputs, self.options.bounds_checks, workgroup_bytes)
        };
        Pass::of(&self.params).iter().map(key)
    }

    /// Returns the compiled kernels of a frame's passes, in order, with their numbers of workgroups.
    pub(super) fn kernels(&self, gpu: &GpuDevice, kind: InputKind) -> Result<Vec<Dispatch>, EngineError> {
        self.kernel_keys(kind).map(|key| Ok((gpu.kernel(key)?, key.workgroups(self.shape)))).collect()
    }

    /// Returns the largest number of workgroups, across or down, among a frame's kernels.
    fn most_workgroups(&self, kind: InputKind) -> usize {
        self.kernel_keys(kind).flat_map(|key| key.workgroups(self.shape)).max().unwrap_or(0)
    }

    /// Returns the device's maximum number of bytes per buffer.
    fn buffer_limit(&self) -> u64 {
        let limits = &self.gpu().limits;
        limits.max_buffer_size.min(limits.max_storage_buffer_binding_size)
    }

    /// Returns the size of a frame's largest buffer in bytes.
    fn frame_bytes(&self, layout: Layout) -> u64 {
        let [points, planes] = layout.kept_words();
        let of_sigma = layout.sigma().map_or(0, |_| scratch_words(&layout));
        let fill_px = self.steps.and_then(|steps| steps.fill_px);
        let of_fill = fill_px.map_or(0, |_| fill_kernels::scratch_words(&layout));
        let all = [layout.input_words(), layout.output_words(), points, planes, of_sigma, of_fill];
        4 * all.into_iter().max().unwrap_or(0) as u64
    }

    /// Returns the maximum number of a batch's frames per submission. It keeps submissions within the device's
    /// limits, and short enough not to block other users of the device or trigger a desktop watchdog.
    fn frames_at_once(&self, layout: Layout) -> usize {
        let bytes = self.buffer_limit().min(MAX_BATCH_BYTES);
        (bytes / self.frame_bytes(layout)).clamp(1, MAX_BATCH_FRAMES) as usize
    }

    /// Returns an error if `frames` frames of a layout exceed the device's limits.
    fn check_limits(&self, layout: Layout, frames: usize) -> Result<(), EngineError> {
        let limits = [
            ("bytes in a buffer", self.buffer_limit(), self.frame_bytes(layout) * frames as u64),
            (
                "workgroups across or down",
                u64::from(self.gpu().limits.max_compute_workgroups_per_dimension),
                self.most_workgroups(layout.kind) as u64,
            ),
        ];
        match limits.into_iter().find(|(_, allowed, needed)| needed > allowed) {
            None => Ok(()),
            Some((what, allowed, needed)) => {
                Err(EngineError::Limit { device: self.gpu().name.clone(), what, allowed, needed })
            }
        }
    }

    /// Returns a slot for `frames` frames: the matching slot that has been free longest, or a new slot.
    fn slot(&mut self, used_for: SlotUse, frames: usize) -> Result<Slot, EngineError> {
        {
            let mut free = lock(&self.free);
            // Slots that views returned may belong to a device that is no longer used.
            free.retain(|slot| self.adapter.devices.iter().any(|gpu| Arc::ptr_eq(gpu, &slot.gpu)));
            if let Some(at) = free.iter().position(|slot| slot.used_for == used_for && slot.frames == frames) {
                return Ok(free.remove(at));
            }
            // Only one batch is processed at a time, so slots for other batch sizes are dropped.
            free.retain(|slot| slot.frames == 1);
        }
        let devices = &self.adapter.devices;
        let gpu = Arc::clone(&devices[self.allocated % devices.len()]);
        let Self { params, options, over_time, bytes, .. } = self;
        let slot = Slot::new(gpu, used_for, frames, params, options, over_time.as_ref(), bytes)?;
        self.allocated += 1;
        Ok(slot)
    }

    /// Writes frames of one kind into a slot and submits it.
    fn launch(&mut self, frames: &[AdmittedFrame<'_>]) -> Result<Flight, Error> {
        let Some(first) = frames.first() else {
            return Err(FrameError::LengthMismatch { what: "a batch".into(), len: 0, expected: 1 }.into());
        };
        self.gpu().check()?;
        let used_for = self.slot_use(InputKind::of(&first.frame), self.finishes(first));
        self.check_limits(used_for.layout, frames.len())?;
        let mut slot = self.slot(used_for, frames.len())?;
        slot.write(frames, &mut self.uploader)?;
        Ok(self.submit_slot(slot, &first.step)?)
    }

    /// Submits a slot whose frames have been written.
    fn submit_slot(&mut self, mut slot: Slot, step: &VideoStep) -> Result<Flight, EngineError> {
        let smooth = self.kernels(&slot.gpu, slot.used_for.layout.kind)?;
        let [sigma, fill] = step_kernels(&slot.gpu, &slot.used_for, self.options.bounds_checks)?;
        let kernels = Kernels { smooth, sigma, fill };
        let submission = slot.submit(&kernels, self.over_time.as_mut().map(|over_time| (over_time, step)));
        self.gpu().check()?;
        Ok(Flight { slot, submission, free: Arc::clone(&self.free) })
    }
}

impl SmoothingEngine for Gpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let view = MappedView::of(self.launch(std::slice::from_ref(frame))?)?;
        self.timings = view.timings();
        view.copy_into(out);
        Ok(())
    }

    /// Smooths a batch, with as many frames per submission as the device allows.
    fn smooth_batch(&mut self, frames: &[AdmittedFrame<'_>], out: &mut [Smoothed]) -> Result<(), Error> {
        let (mut done, mut timings) = (0, None::<FrameTimings>);
        while let Some(first) = frames.get(done) {
            let use_of = |frame: &AdmittedFrame<'_>| (InputKind::of(&frame.frame), self.finishes(frame));
            let used_for = use_of(first);
            let most = self.frames_at_once(self.layout(used_for.0));
            let alike = frames[done..].iter().take_while(|frame| use_of(frame) == used_for).count();
            // Divide the frames evenly, because submissions of the same size use the same slot.
            let count = alike.div_ceil(alike.div_ceil(most));
            let view = MappedView::of(self.launch(&frames[done..done + count])?)?;
            let out = out[done..done + count].par_iter_mut().enumerate();
            out.for_each(|(i, out)| view.copy_frame_to(i, out, &Threads::default()));
            if let Some(more) = view.timings() {
                *timings.get_or_insert_default() += more;
            }
            done += count;
        }
        self.timings = timings;
        Ok(())
    }

    /// Submits a frame. If `buffer` is given, another thread copies the result to it once ready; otherwise the result
    /// stays in mapped memory.
    fn submit(&mut self, frame: &AdmittedFrame<'_>, buffer: Option<Smoothed>) -> Result<(), Error> {
        let in_flight = self.pending.len();
        if in_flight >= self.options.slots {
            return Err(EngineError::Full { in_flight }.into());
        }
        if in_flight > 0 {
            self.open_several();
        }
        let flight = self.launch(std::slice::from_ref(frame))?;
        self.pending.push_back(match buffer {
            None => Pending::InPlace(Box::new(flight)),
            Some(buffer) => {
                let queue = self.adapter.devices.iter().position(|gpu| Arc::ptr_eq(gpu, &flight.slot.gpu)).unwrap_or(0);
                // There are fewer copiers than devices if the system allowed no more threads.
                let copier = &self.copiers[queue.min(self.copiers.len() - 1)];
                Pending::Copied(copier.copy(flight, buffer))
            }
        });
        Ok(())
    }

    fn prepare_in_flight(&mut self) {
        self.open_several();
    }

    /// Sets up the temporal filter on the device. Returns false if the filter would keep the last values of holes, or
    /// if its state does not fit on the device; the session then filters the results.
    fn smooth_over_time(&mut self, video: &Video) -> Result<bool, Error> {
        let layout = self.layout(InputKind::Depth);
        if video.params.hold_frames > 0 || OverTime::largest_buffer(video, layout) > self.buffer_limit() {
            return Ok(false);
        }
        // The temporal state is not shared between queues, so only one queue is used.
        let several = self.several.take();
        let gpu = Arc::clone(&self.adapter.devices[0]);
        let opened = OverTime::new(&gpu, *video, layout, self.options.bounds_checks).and_then(|over_time| {
            self.over_time = Some(over_time);
            lock(&self.free).clear();
            self.warm_up()
        });
        match opened {
            Ok(()) => Ok(true),
            Err(lost @ EngineError::Lost { .. }) => Err(lost.into()),
            // For example, out of memory.
            Err(_) => {
                (self.over_time, self.several) = (None, several);
                lock(&self.free).clear();
                Ok(false)
            }
        }
    }

    /// Returns false if the steps need outputs that the engine was not opened for, if frames are smoothed over time, if
    /// rows are too long, or if the device has too few workgroups or too little memory.
    fn take_steps(&mut self, steps: &DeviceSteps) -> Result<bool, Error> {
        let Outputs { points, status, neighbours, .. } = self.outputs;
        let (width, height) = self.shape;
        let fits = height <= self.gpu().limits.max_compute_workgroups_per_dimension as usize;
        let fits = fits && (steps.fill_px.is_none() || width <= fill_kernels::WIDEST_PX);
        debug_assert!(steps.fill_px.is_none_or(|width_px| width_px <= MOST_PX), "{:?}", steps.fill_px);
        if !(points && status && (neighbours || !steps.sigma) && fits) || self.over_time.is_some() {
            return Ok(false);
        }
        self.outputs.sigma = steps.sigma;
        self.steps = Some(*steps);
        lock(&self.free).clear();
        let adapter = Arc::clone(&self.adapter);
        let opened = self.check_limits(self.layout(InputKind::Points), 1).and_then(|()| self.compile(&adapter));
        match opened.and_then(|()| self.warm_up()) {
            Ok(()) => Ok(true),
            Err(lost @ EngineError::Lost { .. }) => Err(lost.into()),
            // For example, out of memory.
            Err(_) => {
                (self.outputs.sigma, self.steps) = (false, None);
                lock(&self.free).clear();
                Ok(false)
            }
        }
    }

    fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match self.pending.pop_front() {
            None => Ok(None),
            Some(Pending::InPlace(flight)) => {
                let view = MappedView::of(*flight)?;
                let timings = view.timings();
                Ok(Some(SmoothedView::in_place(Box::new(view), timings)))
            }
            Some(Pending::Copied(copied)) => {
                let (smoothed, timings) = copied.wait(self.gpu())?;
                Ok(Some(SmoothedView::owned(smoothed, timings)))
            }
        }
    }

    fn in_flight(&self) -> usize {
        self.pending.len()
    }

    fn max_in_flight(&self) -> usize {
        self.options.slots
    }

    /// Returns the times measured on the device.
    fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Returns the size in bytes of all slots and of the temporal state.
    fn buffer_bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed) + self.over_time.as_ref().map_or(0, OverTime::bytes)
    }

    fn device_name(&self) -> Option<&str> {
        Some(&self.gpu().name)
    }
}
