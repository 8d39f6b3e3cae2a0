//! Fleets, which distribute frames over several devices and return the results in the order of submission.
//!
//! Each device has a [`Smoother`](crate::Smoother) and a thread ([`worker`]). A frame goes to the device that is
//! expected to finish it first ([`dealing`]). If a device is lost, the others smooth its frames.

mod dealing;
mod devices;
mod member;
mod worker;

use std::sync::Arc;
use std::thread;

use crate::engines::{Engine, SmootherOptions};
use crate::error::{EngineError, Error};
use crate::frame::{Frame, FrameGeometry, GeometryScratch};
use crate::params::{CloudParams, EngineParams, FrameParams, Params, Window, WindowSize};
use crate::smoothed::Smoothed;
use crate::smoother::{Smoother, check_grid, check_options, for_engine};
use crate::smoothing_engine::DeviceSteps;
use crate::threads::{ONE_THREAD, on_a_thread_each};
use crate::view::SmoothedView;
pub use devices::FleetDevice;
pub use member::{FleetMember, SharedFrame};
use worker::{Job, Shared, Worker};

/// Number of frames queued per device slot, in addition to the frame in the slot, so that the device's thread never
/// has to wait for the caller's.
const WAITING_PER_SLOT: usize = 1;

/// Number of CPU threads that a GPU occupies: one for submission, the others for copying results.
const THREADS_OF_A_GPU: usize = 4;

/// Returns the number of CPU engine threads that leaves enough cores for the GPUs' threads. Returns `None`, which
/// means one thread per core, if there are no GPUs.
fn threads_beside(devices: &[FleetDevice]) -> Option<usize> {
    let gpus = devices.iter().filter(|device| matches!(device, FleetDevice::Gpu(_))).count();
    let cores = thread::available_parallelism().map_or(1, usize::from);
    (gpus > 0).then(|| cores.saturating_sub(gpus * THREADS_OF_A_GPU).max(1))
}

/// Smoothers on several devices, for frames with the same grid or for unorganized clouds.
///
/// Use it like a [`Smoother`] with frames in flight: submit frames while there is room, and receive the results in
/// the same order.
///
/// ```
/// use std::sync::Arc;
/// use planish::{Fleet, FleetDevice, FrameParams, OrganizedCloud, Smoothed, SmootherOptions, Xyz};
///
/// # fn main() -> Result<(), planish::Error> {
/// # let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// # let frame = Arc::new(OrganizedCloud::from_positions(64, 48, plane)?);
/// # let frames = vec![frame; 5];
/// // Every GPU of this machine, or if it has none the CPU.
/// let devices = FleetDevice::parse_list("all").unwrap_or_else(|_| vec![FleetDevice::Cpu]);
/// let mut fleet = Fleet::open(FrameParams::paper(), &SmootherOptions::default(), &devices, (64, 48))?;
/// let mut received = 0;
/// for frame in &frames {
///     if fleet.in_flight() == fleet.max_in_flight() {
///         received += usize::from(fleet.receive()?.is_some());
///     }
///     fleet.submit(Arc::clone(frame), Smoothed::default())?;
/// }
/// while let Some(view) = fleet.receive()? {
///     assert_eq!(view.shape(), (64, 48));
///     received += 1;
/// }
/// assert_eq!(received, frames.len());
/// # Ok(())
/// # }
/// ```
pub struct Fleet {
    shared: Arc<Shared>,
    workers: Vec<Worker>,
    grid: Option<(usize, usize)>,
    /// Maximum number of frames in flight while at least one device works.
    room: usize,
    /// Whether the devices compute the steps after smoothing.
    takes_steps: bool,
    /// The window, if its size depends on the resolution and the resolution is not known yet.
    undecided: Option<Window>,
    /// The window size, if it depends on the resolution and a frame has determined it.
    size: Option<WindowSize>,
    scratch: GeometryScratch,
    /// Number of the next frame to be submitted.
    next_in: u64,
    /// Number of the next frame to be received.
    next_out: u64,
}

impl Fleet {
    /// Opens a smoother on each device, as [`Smoother::open_with`] does. Each device overrides the engine and adapter
    /// in the options.
    ///
    /// # Errors
    /// If there are no devices, a device cannot be opened, or the parameters are invalid.
    pub fn open(
        params: FrameParams,
        options: &SmootherOptions,
        devices: &[FleetDevice],
        shape: (usize, usize),
    ) -> Result<Self, Error> {
        Self::open_any(params.into(), options, devices, Some(shape))
    }

    /// Opens a smoother for unorganized clouds on each device.
    ///
    /// # Errors
    /// Same as [`open`](Self::open).
    pub fn open_clouds(params: CloudParams, options: &SmootherOptions, devices: &[FleetDevice]) -> Result<Self, Error> {
        Self::open_any(params.into(), options, devices, None)
    }

    pub(crate) fn open_any(
        params: Params,
        options: &SmootherOptions,
        devices: &[FleetDevice],
        grid: Option<(usize, usize)>,
    ) -> Result<Self, Error> {
        check_options(params, options, grid)?;
        let (params, undecided) = for_engine(params);
        let mut fleet = Self::open_decided(params, options, devices, grid, None)?;
        fleet.undecided = undecided;
        Ok(fleet)
    }

    /// Opens a fleet whose window is already decided. The devices compute `steps` after smoothing if all of them
    /// support it ([`takes_steps`](Self::takes_steps)).
    pub(crate) fn open_decided(
        params: EngineParams,
        options: &SmootherOptions,
        devices: &[FleetDevice],
        grid: Option<(usize, usize)>,
        steps: Option<&DeviceSteps>,
    ) -> Result<Self, Error> {
        if devices.is_empty() {
            let reason = "a fleet needs at least one device".to_owned();
            return Err(EngineError::Unavailable { engine: "fleet", reason }.into());
        }
        if ONE_THREAD {
            let reason = "it needs a thread per device, but this build has only one".to_owned();
            return Err(EngineError::Unavailable { engine: "fleet", reason }.into());
        }
        let cpu = options.clone().with_threads(options.threads.or_else(|| threads_beside(devices)));
        let options_of = |device: &FleetDevice| match device {
            FleetDevice::Cpu => device.options(&cpu),
            FleetDevice::Gpu(_) => device.options(options),
        };
        // All results of a fleet must need the same steps, and the CPU engine does not compute any.
        let steps = steps.filter(|_| !devices.contains(&FleetDevice::Cpu));
        let open = |device: &FleetDevice| {
            let mut smoother = Smoother::open_decided(params, &options_of(device), grid)?;
            let takes_steps = steps.map_or(Ok(false), |steps| smoother.take_steps(steps))?;
            smoother.prepare_in_flight();
            Ok((smoother, takes_steps))
        };
        let panicked = || EngineError::Unavailable {
            engine: "fleet",
            reason: "the thread that opens a device panicked".to_owned(),
        };
        let opened = on_a_thread_each(devices, open).into_iter();
        let opened: Result<Vec<(Smoother, bool)>, Error> =
            opened.map(|result| result.unwrap_or_else(|_| Err(panicked().into()))).collect();
        let (smoothers, take_steps): (Vec<Smoother>, Vec<bool>) = opened?.into_iter().unzip();
        let takes_steps = take_steps.iter().all(|takes_steps| *takes_steps);
        if !takes_steps && take_steps.contains(&true) {
            // The devices are opened again without the steps.
            drop(smoothers);
            return Self::open_decided(params, options, devices, grid, None);
        }
        let window = smoothers.len() * options.gpu.slots * (1 + WAITING_PER_SLOT);
        let shared = Arc::new(Shared::new(&smoothers, window));
        let start = |(device, smoother)| Worker::start(Arc::clone(&shared), device, smoother);
        let workers = smoothers.into_iter().enumerate().map(start).collect::<Result<_, _>>();
        // If a worker fails to start, stop the threads that have started, which would otherwise wait forever.
        let workers = workers.inspect_err(|_| shared.close())?;
        let scratch = GeometryScratch::default();
        let (undecided, size, next_in, next_out) = (None, None, 0, 0);
        Ok(Self { shared, workers, grid, room: window, takes_steps, undecided, size, scratch, next_in, next_out })
    }

    /// Returns true if the devices compute the steps after smoothing.
    pub(crate) fn takes_steps(&self) -> bool {
        self.takes_steps
    }

    /// Submits a frame, and a buffer for its result. Returns at once; another thread smooths the frame.
    ///
    /// # Errors
    /// If the maximum number of frames is in flight, the frame is invalid or has another grid, or every device is
    /// lost. If smoothing the frame fails, `receive` returns the error instead of the result.
    pub fn submit<F: SharedFrame>(&mut self, frame: Arc<F>, buffer: Smoothed) -> Result<(), Error> {
        self.deal(frame, Some(buffer))
    }

    /// Submits a frame whose result is read in place, without a copy.
    pub fn submit_in_place<F: SharedFrame>(&mut self, frame: Arc<F>) -> Result<(), Error> {
        self.deal(frame, None)
    }

    pub(crate) fn deal(&mut self, frame: Arc<dyn SharedFrame>, buffer: Option<Smoothed>) -> Result<(), Error> {
        let in_flight = self.in_flight();
        if in_flight >= self.max_in_flight() {
            return match self.shared.last_loss() {
                Some(lost) if self.max_in_flight() == 0 => Err(lost.into()),
                _ => Err(EngineError::Full { in_flight }.into()),
            };
        }
        let view = frame.frame()?;
        check_grid(view.grid(), self.grid)?;
        self.decide_window(view);
        self.shared.deal(Job::new(self.next_in, frame, buffer, self.size))?;
        self.next_in += 1;
        Ok(())
    }

    /// Derives the window size for all devices from the first frame whose resolution is known.
    fn decide_window(&mut self, frame: Frame<'_>) {
        let Some(window) = self.undecided else { return };
        let geometry = FrameGeometry::of(frame, true, &mut self.scratch);
        if let Some(pitch_at_1m) = geometry.rule.known_pitch_at_1m() {
            (self.undecided, self.size) = (None, Some(window.at_pitch(pitch_at_1m)));
        }
    }

    /// Waits for the oldest frame in flight and returns its result; `None` if no frame is in flight.
    ///
    /// # Errors
    /// If that frame cannot be smoothed, or every device is lost.
    pub fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        if self.in_flight() == 0 {
            return Ok(None);
        }
        let result = self.shared.wait_for(self.next_out);
        self.next_out += 1;
        result.map(Some)
    }

    /// Returns the number of frames submitted and not yet received.
    pub fn in_flight(&self) -> usize {
        (self.next_in - self.next_out) as usize
    }

    /// Returns the maximum number of frames in flight; submitting more fails with [`EngineError::Full`]. 0 once every
    /// device is lost.
    pub fn max_in_flight(&self) -> usize {
        // Lost devices still count while another works: the maximum must not shrink while the caller relies on it.
        if self.shared.works() { self.room } else { 0 }
    }

    /// Returns the fleet's devices, in the order in which they were given.
    pub fn members(&self) -> Vec<FleetMember> {
        self.shared.members()
    }

    /// Returns [`Engine::Gpu`] while a GPU works, otherwise the engine of the first working device.
    pub fn engine(&self) -> Engine {
        let members = self.members();
        let mut working = members.iter().filter(|member| member.lost.is_none()).map(|member| member.engine);
        let first = working.clone().next().or(members.first().map(|member| member.engine)).unwrap_or_default();
        working.find(|&engine| engine == Engine::Gpu).unwrap_or(first)
    }
}

impl std::fmt::Debug for Fleet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (members, in_flight) = (self.members(), self.in_flight());
        f.debug_struct("Fleet")
            .field("grid", &self.grid)
            .field("members", &members)
            .field("in_flight", &in_flight)
            .finish()
    }
}

impl Drop for Fleet {
    fn drop(&mut self) {
        self.shared.close();
        self.workers.iter_mut().for_each(Worker::join);
    }
}

/// Marks a device of a fleet as lost.
pub fn lose_device(fleet: &Fleet, device: usize, error: &EngineError) {
    fleet.shared.lose(device, error);
}
