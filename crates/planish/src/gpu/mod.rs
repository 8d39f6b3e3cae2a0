//! The GPU engine: docs/method.md in f32, one pixel a thread, through wgpu: Vulkan, Metal or DirectX 12.
//!
//! One kernel a setting ([`kernel`], shaders/*.wgsl, with the reference's stage names) goes from depth or points to the
//! outputs that are wanted; where edges are kept, one before it fits the planes of all pixels; [`layout`] is the one description of what goes up and comes back. A [`slot::Slot`] has the buffers
//! of one frame or batch in flight. Results are read where the device put them ([`view`]) or copied out, for frames in flight
//! by a thread of its own ([`copier`]).

mod copier;
mod device;
mod kernel;
mod layout;
mod slot;
#[cfg(test)]
mod tests;
mod view;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;

use rayon::prelude::*;

use crate::camera::Rays;
use crate::devices::{FrameTimings, GpuAdapter, GpuOptions, Transfer, choose};
use crate::error::{EngineError, Error, FrameError};
use crate::frame::Frame;
use crate::params::{Edges, SmoothParams};
use crate::smoothed::{Outputs, Smoothed};
use crate::view::SmoothedView;
use copier::{Copied, Copier};
use device::{GpuDevice, lock};
use kernel::{KernelKey, Pass};
use layout::{InputKind, Layout};
use slot::Slot;
pub(crate) use view::MappedView;

/// The adapters of this machine.
pub(crate) fn adapters() -> Vec<GpuAdapter> {
    device::list()
}

/// Destroys the open devices, for tests.
pub(crate) fn lose_devices() {
    device::lose_open();
}

/// Slots that wait for their next frames; views give theirs back from any thread.
type FreeSlots = Arc<Mutex<Vec<Slot>>>;

/// A submission on its way through the device.
struct Flight {
    gpu: Arc<GpuDevice>,
    slot: Slot,
    submission: wgpu::SubmissionIndex,
    free: FreeSlots,
}

impl Flight {
    /// Waits for the result.
    fn land(self) -> Result<MappedView, EngineError> {
        self.gpu.wait(self.submission.clone())?;
        self.slot.wait_mapped(&self.gpu)?;
        MappedView::new(self)
    }
}

/// A frame that was submitted, by how its result is wanted.
enum Pending {
    InPlace(Box<Flight>),
    Copied(Copied),
}

/// A submission of several frames has no more bytes than this in a buffer, and no more frames.
const MAX_BATCH_BYTES: u64 = 256 << 20;
const MAX_BATCH_FRAMES: u64 = 64;

/// The GPU engine with its buffers.
pub(crate) struct Gpu {
    gpu: Arc<GpuDevice>,
    params: SmoothParams,
    outputs: Outputs,
    options: GpuOptions,
    shape: (usize, usize),
    free: FreeSlots,
    rays: Rays,
    pitches: Vec<f64>,
    pending: VecDeque<Pending>,
    copier: Option<Copier>,
    timings: Option<FrameTimings>,
    /// Bytes of all slots, wherever they are.
    bytes: Arc<AtomicU64>,
}

impl Gpu {
    pub(crate) fn open(
        params: SmoothParams,
        outputs: Outputs,
        options: &GpuOptions,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let adapters = adapters();
        let gpu = GpuDevice::open(choose(&adapters, options.adapter.as_deref())?)?;
        let mut options = options.clone();
        let lacks = |reason: &str| EngineError::Unavailable {
            engine: "gpu",
            reason: format!("the adapter {} {reason}", gpu.name),
        };
        let needed = wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS;
        if options.timestamps && !gpu.features.contains(needed) {
            return Err(lacks("takes no time stamps"));
        }
        let direct = gpu.features.contains(wgpu::Features::MAPPABLE_PRIMARY_BUFFERS);
        options.transfer = match options.transfer {
            Transfer::Direct if !direct => return Err(lacks("cannot compute in the host's memory")),
            Transfer::Auto if direct => Transfer::Direct,
            Transfer::Auto => Transfer::Staged,
            chosen => chosen,
        };
        let engine = Self {
            gpu,
            params,
            outputs,
            options,
            shape,
            free: Arc::default(),
            rays: Rays::default(),
            pitches: Vec::new(),
            pending: VecDeque::new(),
            copier: None,
            timings: None,
            bytes: Arc::default(),
        };
        // What can be refused is refused now, and what takes long is done now.
        let [depth, points] = [InputKind::Depth, InputKind::Points].map(|kind| engine.layout(kind));
        engine.check_limits(depth, 1)?;
        engine.check_limits(points, 1)?;
        let slot = engine.slot(depth, 1)?;
        lock(&engine.free).push(slot);
        let gpu = &engine.gpu;
        let [depth, points] = [depth, points].map(|layout| {
            let keys: Vec<_> = engine.kernel_keys(layout.kind).collect();
            move || keys.into_iter().try_for_each(|key| gpu.kernel(key).map(drop))
        });
        // Drivers compile on the calling thread: two at once take as long as one.
        let (depth, points) = thread::scope(|scope| {
            let depth = scope.spawn(depth);
            let points = points();
            (depth.join().unwrap_or_else(|_| Err(gpu.failed("a kernel was not compiled"))), points)
        });
        depth.and(points)?;
        Ok(engine)
    }

    /// The adapter's name.
    pub(crate) fn device_name(&self) -> &str {
        &self.gpu.name
    }

    pub(crate) fn smooth(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        let view = self.launch(&[frame])?.land()?;
        self.timings = view.timings();
        view.copy_to(0, out);
        Ok(())
    }

    /// The times on the device of the last call of `smooth` or `smooth_batch`.
    pub(crate) fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Smooths many frames, as many in one submission as the device takes.
    pub(crate) fn smooth_batch(&mut self, frames: &[Frame<'_>], out: &mut [Smoothed]) -> Result<(), Error> {
        let (mut done, mut timings) = (0, None::<FrameTimings>);
        while let Some(&first) = frames.get(done) {
            let kind = kind_of(first);
            let most = self.frames_at_once(self.layout(kind));
            let alike = frames[done..].iter().take_while(|&&frame| kind_of(frame) == kind).count();
            // Submissions of one size use one slot.
            let count = alike.div_ceil(alike.div_ceil(most));
            let view = self.launch(&frames[done..done + count])?.land()?;
            out[done..done + count].par_iter_mut().enumerate().for_each(|(i, out)| view.copy_to(i, out));
            if let Some(more) = view.timings() {
                *timings.get_or_insert_default() += more;
            }
            done += count;
        }
        self.timings = timings;
        Ok(())
    }

    /// Sends a frame on its way; its result is received in the order of submission. With a buffer the result is copied there
    /// by another thread as soon as it is there, without one it stays where it is.
    pub(crate) fn submit(&mut self, frame: Frame<'_>, buffer: Option<Smoothed>) -> Result<(), Error> {
        let in_flight = self.pending.len();
        if in_flight >= self.options.slots {
            return Err(EngineError::Full { in_flight }.into());
        }
        let flight = self.launch(&[frame])?;
        self.pending.push_back(match buffer {
            None => Pending::InPlace(Box::new(flight)),
            Some(buffer) => {
                let copier = match &self.copier {
                    Some(copier) => copier,
                    None => self.copier.insert(Copier::start()?),
                };
                Pending::Copied(copier.copy(flight, buffer))
            }
        });
        Ok(())
    }

    /// The result of the oldest frame in flight; `None` if there is none.
    pub(crate) fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match self.pending.pop_front() {
            None => Ok(None),
            Some(Pending::InPlace(flight)) => Ok(Some(SmoothedView::mapped(flight.land()?))),
            Some(Pending::Copied(copied)) => {
                let (smoothed, timings) = copied.wait(&self.gpu)?;
                Ok(Some(SmoothedView::owned(smoothed, timings)))
            }
        }
    }

    /// Bytes of the buffers of all slots.
    pub(crate) fn buffer_bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    pub(crate) fn in_flight(&self) -> usize {
        self.pending.len()
    }

    pub(crate) fn max_in_flight(&self) -> usize {
        self.options.slots
    }

    fn layout(&self, kind: InputKind) -> Layout {
        let (width, height) = self.shape;
        Layout { width, height, kind, outputs: self.outputs, keeps_edges: self.params.edges != Edges::Off }
    }

    /// The kernels of a frame's passes, in order.
    fn kernel_keys(&self, kind: InputKind) -> impl Iterator<Item = KernelKey> {
        let workgroup_bytes = self.gpu.limits.max_compute_workgroup_storage_size as usize;
        let key = move |&pass| {
            KernelKey::new(&self.params, pass, kind, self.outputs, self.options.bounds_checks, workgroup_bytes)
        };
        Pass::of(self.params.edges).iter().map(key)
    }

    fn kernels(&self, kind: InputKind) -> Result<Vec<wgpu::ComputePipeline>, EngineError> {
        self.kernel_keys(kind).map(|key| self.gpu.kernel(key)).collect()
    }

    /// Workgroups for a frame, across and down; the same for every pass.
    fn workgroups(&self, kind: InputKind) -> [usize; 2] {
        self.kernel_keys(kind).next().map_or([0; 2], |key| key.workgroups(self.shape))
    }

    /// Bytes that one buffer of the device may have.
    fn buffer_limit(&self) -> u64 {
        let limits = &self.gpu.limits;
        limits.max_buffer_size.min(limits.max_storage_buffer_binding_size)
    }

    /// Bytes of the largest buffer of a frame.
    fn frame_bytes(layout: Layout) -> u64 {
        4 * layout.input_words().max(layout.output_words()).max(layout.first_words()) as u64
    }

    /// How many frames of a batch a submission has: within the limits of the device, and of what others that use it, and the
    /// watchdogs of desktops, bear.
    fn frames_at_once(&self, layout: Layout) -> usize {
        let bytes = self.buffer_limit().min(MAX_BATCH_BYTES);
        (bytes / Self::frame_bytes(layout)).clamp(1, MAX_BATCH_FRAMES) as usize
    }

    /// Refuses frames of a layout that the device cannot take.
    fn check_limits(&self, layout: Layout, frames: usize) -> Result<(), EngineError> {
        let limits = [
            ("bytes in a buffer", self.buffer_limit(), Self::frame_bytes(layout) * frames as u64),
            (
                "workgroups across or down",
                u64::from(self.gpu.limits.max_compute_workgroups_per_dimension),
                self.workgroups(layout.kind).into_iter().max().unwrap_or(0) as u64,
            ),
        ];
        match limits.into_iter().find(|(_, allowed, needed)| needed > allowed) {
            None => Ok(()),
            Some((what, allowed, needed)) => {
                Err(EngineError::Limit { device: self.gpu.name.clone(), what, allowed, needed })
            }
        }
    }

    /// A free slot for so many frames of a layout, or a new one.
    fn slot(&self, layout: Layout, frames: usize) -> Result<Slot, EngineError> {
        let mut free = lock(&self.free);
        match free.iter().position(|slot| slot.layout == layout && slot.frames == frames) {
            Some(at) => Ok(free.swap_remove(at)),
            None => {
                // One batch at a time: slots of other sizes are not kept.
                free.retain(|slot| slot.frames == 1);
                Slot::new(&self.gpu, layout, frames, self.options.transfer, self.options.timestamps, &self.bytes)
            }
        }
    }

    /// Writes frames of one kind into a slot and submits it.
    fn launch(&mut self, frames: &[Frame<'_>]) -> Result<Flight, Error> {
        let Some(&first) = frames.first() else {
            return Err(FrameError::LengthMismatch { what: "a batch".into(), len: 0, expected: 1 }.into());
        };
        if self.outputs.depth && frames.iter().any(|frame| frame.camera().is_none()) {
            return Err(FrameError::MissingCamera { what: "depth as an output" }.into());
        }
        self.gpu.check()?;
        let kind = kind_of(first);
        let layout = self.layout(kind);
        self.check_limits(layout, frames.len())?;
        let kernels = self.kernels(kind)?;
        let mut slot = self.slot(layout, frames.len())?;
        slot.write(&self.gpu, frames, &self.params, &mut self.rays, &mut self.pitches)?;
        let submission = slot.submit(&self.gpu, &kernels, self.workgroups(kind));
        self.gpu.check()?;
        Ok(Flight { gpu: Arc::clone(&self.gpu), slot, submission, free: Arc::clone(&self.free) })
    }
}

fn kind_of(frame: Frame<'_>) -> InputKind {
    match frame {
        Frame::Depth(_) => InputKind::Depth,
        Frame::Cloud(_) => InputKind::Points,
    }
}
