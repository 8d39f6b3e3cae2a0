//! Lists and opens adapters, caches compiled kernels, and detects device loss.
//!
//! An adapter is opened once for frames smoothed one at a time, which is fast, and a second time for overlapping
//! frames, with one wgpu device per queue. All of the process's smoothers on that adapter share these devices, which
//! are closed with the last smoother. After a device is lost, every call returns the loss as an error, and the next
//! smoother opens a new device.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};

use super::kernel::KernelKey;
use super::queues;
use super::step_kernels::StepPass;
use crate::devices::{AdapterKind, GpuAdapter, GpuOptions};
use crate::error::EngineError;

/// Time without a response after which a device is considered hung.
pub(super) const TIMEOUT: Duration = Duration::from_secs(60);

/// Maximum time for which a waiting thread polls before it releases the lock to other threads.
const STEP: Duration = Duration::from_millis(1);

/// Time for which a failing device is polled to find out whether it is lost.
const LOSS_TIMEOUT: Duration = Duration::from_millis(100);

/// Time for which a waiting thread spins before it blocks. Most frames finish sooner, and waking up takes 30 to 60
/// µs. Threads do not spin on software adapters, which need the CPU.
const SPIN: Duration = Duration::from_millis(1);

/// Locks a mutex, ignoring poisoning: the state behind this engine's locks is always consistent.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The purpose for which an adapter is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    /// One submission at a time, on one queue.
    OneAtATime,
    /// Frames in flight, on several queues, which not every adapter has.
    InFlight,
}

/// An open adapter.
pub(super) struct OpenAdapter {
    /// The devices, one per queue; there is at least one. They share one fault record.
    pub(super) devices: Vec<Arc<GpuDevice>>,
}

pub(super) struct GpuDevice {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) name: String,
    pub(super) limits: wgpu::Limits,
    pub(super) features: wgpu::Features,
    pub(super) bind_group_layout: wgpu::BindGroupLayout,
    pub(super) pipeline_layout: wgpu::PipelineLayout,
    kernels: Mutex<HashMap<KernelKey, wgpu::ComputePipeline>>,
    /// Kernels for standard errors, by pass and whether bounds are checked.
    step_kernels: Mutex<HashMap<(StepPass, bool), wgpu::ComputePipeline>>,
    fault: Arc<Mutex<Option<EngineError>>>,
    /// Serializes polling. If two threads poll at once, wgpu 30 may panic: one thread can see an empty queue before
    /// the other records the last submission as done.
    turn: Mutex<()>,
    /// Number of threads waiting to submit; polling threads yield to them.
    submitting: AtomicUsize,
    /// Time for which waiting threads spin; zero for software adapters.
    pub(super) spin: Duration,
}

/// Returns the adapters of this machine, in order of their indices. They are enumerated once, since that takes longer
/// than opening a device.
pub(super) fn adapters() -> &'static [wgpu::Adapter] {
    static ADAPTERS: OnceLock<Vec<wgpu::Adapter>> = OnceLock::new();
    ADAPTERS.get_or_init(|| {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            flags: wgpu::InstanceFlags::empty(),
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()))
    })
}

fn describe(index: usize, info: &wgpu::AdapterInfo) -> GpuAdapter {
    let kind = match info.device_type {
        wgpu::DeviceType::DiscreteGpu => AdapterKind::Discrete,
        wgpu::DeviceType::IntegratedGpu => AdapterKind::Integrated,
        wgpu::DeviceType::VirtualGpu => AdapterKind::Virtual,
        wgpu::DeviceType::Cpu => AdapterKind::Software,
        wgpu::DeviceType::Other => AdapterKind::Other,
    };
    GpuAdapter {
        index,
        name: info.name.clone(),
        kind,
        backend: info.backend.to_str().to_owned(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
    }
}

/// Returns the adapters that [`crate::gpu_adapters`] lists.
pub(crate) fn list() -> Vec<GpuAdapter> {
    adapters().iter().enumerate().map(|(index, adapter)| describe(index, &adapter.get_info())).collect()
}

/// The open adapters, by index and purpose.
static OPEN: Mutex<Vec<(usize, Purpose, Weak<OpenAdapter>)>> = Mutex::new(Vec::new());

/// Destroys the open devices.
pub(super) fn lose_open() {
    for adapter in lock(&OPEN).iter().filter_map(|(.., adapter)| adapter.upgrade()) {
        adapter.devices.iter().for_each(|device| device.device.destroy());
    }
}

/// Opens an adapter as if it had `queues` queues, with unshared devices, for tests that lose devices.
#[cfg(test)]
pub(super) fn open_alone(chosen: &GpuAdapter, queues: usize) -> OpenAdapter {
    let adapter = &adapters()[chosen.index];
    let opened = (0..queues).map(|_| queues::open_one(adapter).unwrap());
    OpenAdapter::new(adapter, &chosen.name, opened.collect())
}

impl OpenAdapter {
    /// Opens an adapter, or shares it if it is already open for this purpose and has no fault.
    pub(super) fn open(chosen: &GpuAdapter, purpose: Purpose) -> Result<Arc<Self>, EngineError> {
        let mut open = lock(&OPEN);
        open.retain(|(.., adapter)| adapter.strong_count() > 0);
        let alike = open.iter().filter(|(index, other, _)| (*index, *other) == (chosen.index, purpose));
        let shared = alike.filter_map(|(.., adapter)| adapter.upgrade());
        if let Some(adapter) = shared.into_iter().find(|adapter| adapter.devices.iter().all(|gpu| gpu.check().is_ok()))
        {
            return Ok(adapter);
        }
        let unavailable = |reason| EngineError::Unavailable { engine: "gpu", reason };
        let adapter = adapters()
            .get(chosen.index)
            .ok_or_else(|| unavailable(format!("the adapter {} is no longer available", chosen.name)))?;
        let opened =
            match purpose {
                Purpose::OneAtATime => vec![queues::open_one(adapter).map_err(|error| {
                    unavailable(format!("the adapter {} could not be opened: {error}", chosen.name))
                })?],
                Purpose::InFlight => queues::open_several(adapter)
                    .ok_or_else(|| unavailable(format!("the adapter {} cannot open several queues", chosen.name)))?,
            };
        let opened = Arc::new(Self::new(adapter, &chosen.name, opened));
        open.push((chosen.index, purpose, Arc::downgrade(&opened)));
        Ok(opened)
    }

    /// Wraps opened devices, which share one fault record.
    pub(super) fn new(adapter: &wgpu::Adapter, name: &str, opened: Vec<(wgpu::Device, wgpu::Queue)>) -> Self {
        let is_software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
        let spin = if is_software { Duration::ZERO } else { SPIN };
        let fault = Arc::<Mutex<Option<EngineError>>>::default();
        let record_faults = |(device, queue): (wgpu::Device, wgpu::Queue)| {
            let (lost, lost_name) = (Arc::clone(&fault), name.to_owned());
            device.set_device_lost_callback(move |reason, message| {
                // The loss explains all other errors.
                let mut fault = lock(&lost);
                if !matches!(*fault, Some(EngineError::Lost { .. })) {
                    let reason = format!("{message} ({reason:?})");
                    *fault = Some(EngineError::Lost { device: lost_name.clone(), reason });
                }
            });
            let (failed, failed_name) = (Arc::clone(&fault), name.to_owned());
            device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
                // The first error explains later ones.
                let first = || EngineError::Device { device: failed_name.clone(), reason: error.to_string() };
                lock(&failed).get_or_insert_with(first);
            }));
            Arc::new(GpuDevice::new(device, queue, name.to_owned(), Arc::clone(&fault), spin))
        };
        Self { devices: opened.into_iter().map(record_faults).collect() }
    }
}

impl GpuDevice {
    /// Wraps a device of the host program without setting callbacks; loss and errors are detected when waiting.
    #[cfg(feature = "wgpu-interop")]
    pub(super) fn of_host(device: wgpu::Device, queue: wgpu::Queue) -> Self {
        let info = device.adapter_info();
        let spin = if info.device_type == wgpu::DeviceType::Cpu { Duration::ZERO } else { SPIN };
        Self::new(device, queue, info.name, Arc::default(), spin)
    }

    fn new(
        device: wgpu::Device,
        queue: wgpu::Queue,
        name: String,
        fault: Arc<Mutex<Option<EngineError>>>,
        spin: Duration,
    ) -> Self {
        let (limits, features) = (device.limits(), device.features());
        let storage = |read_only| wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Storage { read_only },
            has_dynamic_offset: false,
            min_binding_size: None,
        };
        let uniform = wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Uniform,
            has_dynamic_offset: false,
            min_binding_size: None,
        };
        let entries: Vec<_> = [uniform, storage(true), storage(false), storage(false), storage(false)]
            .into_iter()
            .zip(0..)
            .map(|(ty, binding)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty,
                count: None,
            })
            .collect();
        let bind_group_layout =
            device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(&bind_group_layout)],
            immediate_size: 0,
        });
        Self {
            device,
            queue,
            name,
            limits,
            features,
            bind_group_layout,
            pipeline_layout,
            kernels: Mutex::default(),
            step_kernels: Mutex::default(),
            fault,
            turn: Mutex::default(),
            submitting: AtomicUsize::new(0),
            spin,
        }
    }

    /// Returns an error if timestamps are requested but the device does not support them.
    pub(super) fn check_timestamps(&self, options: &GpuOptions) -> Result<(), EngineError> {
        let needed = wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS;
        if options.timestamps && !self.features.contains(needed) {
            let reason = format!("the adapter {} does not support timestamps", self.name);
            return Err(EngineError::Unavailable { engine: "gpu", reason });
        }
        Ok(())
    }

    /// Returns an error if this device has a fault.
    pub(super) fn check(&self) -> Result<(), EngineError> {
        let fault = lock(&self.fault).clone();
        match fault {
            None => Ok(()),
            Some(lost @ EngineError::Lost { .. }) => Err(lost),
            Some(error) => Err(self.loss().unwrap_or(error)),
        }
    }

    /// Returns the cause of a failure: the device's fault if it has one, otherwise the failure.
    pub(super) fn failed(&self, what: impl ToString) -> EngineError {
        let failure = || EngineError::Device { device: self.name.clone(), reason: what.to_string() };
        self.loss().or_else(|| self.check().err()).unwrap_or_else(failure)
    }

    /// Returns an error if the device is lost, otherwise `None`. wgpu reports a loss only when polled on an idle
    /// queue, and even later if another thread polls at the same time.
    fn loss(&self) -> Option<EngineError> {
        let until = Instant::now() + LOSS_TIMEOUT;
        loop {
            let idle = self.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(LOSS_TIMEOUT) });
            match idle {
                Err(lost) => return Some(lost),
                Ok(_) if Instant::now() > until => return None,
                Ok(_) => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Polls the device. Returns `Ok(false)` if the work is not finished.
    ///
    /// Never polls a lost device: wgpu would free its buffers, including those still being read, and panic on the
    /// driver's error.
    fn poll(&self, how: wgpu::PollType) -> Result<bool, EngineError> {
        if let Some(lost @ EngineError::Lost { .. }) = &*lock(&self.fault) {
            return Err(lost.clone());
        }
        let _alone = lock(&self.turn);
        // Another thread may have found the loss in the meantime.
        if let Some(lost @ EngineError::Lost { .. }) = &*lock(&self.fault) {
            return Err(lost.clone());
        }
        match catch_unwind(AssertUnwindSafe(|| self.device.poll(how))) {
            Ok(Ok(_)) => Ok(true),
            Ok(Err(wgpu::PollError::Timeout)) => Ok(false),
            Ok(Err(error)) => Err(self.lose(error)),
            Err(_) => Err(self.lose("wgpu panicked while waiting for the GPU")),
        }
    }

    /// Records the loss of the device, unless a loss is already recorded. Returns the recorded loss.
    fn lose(&self, reason: impl ToString) -> EngineError {
        let mut fault = lock(&self.fault);
        match &*fault {
            Some(lost @ EngineError::Lost { .. }) => lost.clone(),
            _ => {
                let lost = EngineError::Lost { device: self.name.clone(), reason: reason.to_string() };
                fault.insert(lost).clone()
            }
        }
    }

    /// Runs `work`, which allocates `bytes` on the device. Its errors are returned rather than recorded.
    pub(super) fn allocate<T>(&self, bytes: u64, work: impl FnOnce() -> T) -> Result<T, EngineError> {
        self.check()?;
        let internal = self.device.push_error_scope(wgpu::ErrorFilter::Internal);
        let invalid = self.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let memory = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let result = work();
        let memory = pollster::block_on(memory.pop());
        let other = pollster::block_on(invalid.pop()).or(pollster::block_on(internal.pop()));
        // Error scopes report nothing on a lost device.
        self.check()?;
        match (memory, other) {
            (Some(error), _) => {
                let reason = error.to_string();
                Err(EngineError::OutOfMemory { device: self.name.clone(), bytes, reason })
            }
            (None, Some(error)) => Err(self.failed(error)),
            (None, None) => Ok(result),
        }
    }

    /// Returns a compiled kernel, from the cache if present.
    pub(super) fn kernel(&self, key: KernelKey) -> Result<wgpu::ComputePipeline, EngineError> {
        cached(&self.kernels, key, || {
            self.compile(key.pass.entry_point(), key.wgsl(), &self.pipeline_layout, key.bounds_checks)
        })
    }

    /// Same as [`kernel`](Self::kernel), for the kernels of the steps after smoothing.
    pub(super) fn step_kernel(&self, pass: StepPass, checks: bool) -> Result<wgpu::ComputePipeline, EngineError> {
        cached(&self.step_kernels, (pass, checks), || {
            self.compile(pass.entry_point(), pass.wgsl(), &self.pipeline_layout, checks)
        })
    }

    /// Creates a buffer.
    pub(super) fn buffer(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let mapped_at_creation = false;
        self.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation })
    }

    /// Creates a uniform buffer with these contents.
    pub(super) fn uniform(&self, label: &str, contents: &[u8]) -> wgpu::Buffer {
        let uniform = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: contents.len() as u64,
            usage: wgpu::BufferUsages::UNIFORM,
            mapped_at_creation: true,
        });
        if let Ok(mut range) = uniform.get_mapped_range_mut(..) {
            range.copy_from_slice(contents);
        }
        uniform.unmap();
        uniform
    }

    /// Creates the bind group of a frame's kernel: the uniform, the input, and three writable buffers.
    pub(super) fn bind(&self, buffers: [&wgpu::Buffer; 5]) -> wgpu::BindGroup {
        let entries: Vec<_> = buffers
            .into_iter()
            .zip(0..)
            .map(|(buffer, binding)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let layout = &self.bind_group_layout;
        self.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
    }

    /// Compiles one of this project's own kernels.
    pub(super) fn compile(
        &self,
        entry_point: &str,
        wgsl: String,
        layout: &wgpu::PipelineLayout,
        bounds_checks: bool,
    ) -> Result<wgpu::ComputePipeline, EngineError> {
        self.allocate(0, || {
            let source = wgpu::ShaderModuleDescriptor {
                label: Some(entry_point),
                source: wgpu::ShaderSource::Wgsl(wgsl.into()),
            };
            let checks = if bounds_checks {
                wgpu::ShaderRuntimeChecks::checked()
            } else {
                wgpu::ShaderRuntimeChecks::unchecked()
            };
            // SAFETY: every index into a buffer is in range, for one of two reasons. Either it is derived from the
            // layout, which also determines the buffer sizes, and compared with the frame's width and height or with
            // the number of points; pixels of holes are listed from the bits of the frame's pixels. Workgroup memory is
            // sized for the largest tile and the widest hole that is allowed. Or an earlier pass over the same cloud
            // computed it, and it is below the number of points: positions in the sorted cloud are a permutation, and
            // the others are indices of positions, nodes and leaves. Loops end after a constant number of rounds, tree
            // walks because the node index only increases, radius searches because trial radii grow up to a limit, and
            // loops over the labels of holes and over words of a row because indices only decrease. No integer divisor
            // is zero. The tests also run every kernel with bounds checks and compare the results.
            let module = unsafe { self.device.create_shader_module_trusted(source, checks) };
            self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry_point),
                layout: Some(layout),
                module: &module,
                entry_point: Some(entry_point),
                compilation_options: wgpu::PipelineCompilationOptions {
                    // Workgroup memory is fully written before it is read.
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            })
        })
    }

    /// Submits commands while holding the polling lock, since wgpu polls while submitting.
    pub(super) fn submit(&self, commands: wgpu::CommandBuffer) -> wgpu::SubmissionIndex {
        self.submitting.fetch_add(1, Ordering::Relaxed);
        let _alone = lock(&self.turn);
        self.submitting.fetch_sub(1, Ordering::Relaxed);
        self.queue.submit([commands])
    }

    /// Waits until a submission is done. Its buffers may become mapped slightly later.
    pub(super) fn wait(&self, submission: wgpu::SubmissionIndex) -> Result<(), EngineError> {
        let spin_until = Instant::now() + self.spin;
        let look =
            |timeout| wgpu::PollType::Wait { submission_index: Some(submission.clone()), timeout: Some(timeout) };
        while Instant::now() < spin_until {
            if self.submitting.load(Ordering::Relaxed) > 0 {
                std::hint::spin_loop();
                continue;
            }
            if self.poll(look(Duration::ZERO))? {
                return self.check();
            }
            std::hint::spin_loop();
        }
        // Poll in small steps, since submitting threads wait for the lock.
        let until = Instant::now() + TIMEOUT;
        while Instant::now() < until {
            if self.submitting.load(Ordering::Relaxed) > 0 {
                // The lock is not fair: leave it free for a moment.
                std::thread::sleep(Duration::from_micros(50));
                continue;
            }
            if self.poll(look(STEP))? {
                return self.check();
            }
        }
        Err(self.lose(format!("no response for {} s", TIMEOUT.as_secs())))
    }
}

/// Returns a kernel from a cache; compiles and adds it if it is missing.
fn cached<K: Eq + std::hash::Hash>(
    cache: &Mutex<HashMap<K, wgpu::ComputePipeline>>,
    key: K,
    compile: impl FnOnce() -> Result<wgpu::ComputePipeline, EngineError>,
) -> Result<wgpu::ComputePipeline, EngineError> {
    // The cache is not locked while compiling, so that other smoothers continue; two may then compile the same
    // kernel.
    let known = lock(cache).get(&key).cloned();
    if let Some(kernel) = known {
        return Ok(kernel);
    }
    let kernel = compile()?;
    lock(cache).insert(key, kernel.clone());
    Ok(kernel)
}
