//! Smooths frames of any shape: opens and reopens engines, and recovers when a GPU is lost or too small.

mod build;
mod clock;
mod evenly;
mod event;
mod filtering;
mod finish;
mod first_pass;
mod flights;
mod inspect;
mod lost_grid;
mod open;
mod over_time;
mod pending;
mod recovery;
mod resolve;
mod results;
mod sight;
mod watch;

use std::collections::VecDeque;

use crate::camera::Camera;
use crate::cpu::CloudEstimate;
use crate::doubts::Doubt;
use crate::engines::{Engine, SmootherOptions};
use crate::error::{EngineError, Error};
use crate::fleet::FleetDevice;
use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame, Lattice, RangeRule};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::{CloudParams, FrameParams, WindowSize};
use crate::sensor::SensorModel;
use crate::settings::Settings;
use crate::smoothed::Smoothed;
use crate::smoother::{check_frame, check_no_frames, check_options, for_engine, needs_range};
use crate::smoothing_engine::AdmittedFrame;
use crate::threads::ONE_THREAD;

pub use event::{CloudChoice, SessionEvent};
use finish::Finishing;
pub use open::LIVE_IN_FLIGHT;
use open::{Open, OpenFor, process_id};
use over_time::OverTime;
use pending::Pending;
pub use recovery::{GpuLosses, Recovery};
pub use results::{ResultFilter, ResultSight};
use sight::Sight;
pub use watch::ProgressWatch;

/// Smooths frames and clouds of any shape, one after another or several in flight.
///
/// A session opens the engine with the first frame, and again when the grid, the outputs or the settings change. A
/// cloud that does not fit the GPU that [`Engine::Auto`] chose is smoothed on the CPU. A lost GPU is reopened once;
/// if it is lost again, [`Engine::Auto`] and streams continue on the CPU. [`take_events`](Self::take_events) reports
/// each of these steps. [`Smoother`](crate::Smoother) is the lower-level interface: it smooths one kind of frame and
/// does none of the above.
///
/// ```
/// use planish::{OrganizedCloud, Session, Settings, Smoothed, Xyz};
///
/// # fn main() -> Result<(), planish::Error> {
/// # let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// let cloud = OrganizedCloud::from_positions(64, 48, plane)?;
/// let mut session = Session::new("preset=light".parse::<Settings>()?)?;
/// let mut smoothed = Smoothed::default();
/// session.smooth(&cloud, &mut smoothed)?;
/// session.smooth(&cloud.points, &mut smoothed)?;
/// for event in session.take_events() {
///     println!("{event}");
/// }
/// # Ok(())
/// # }
/// ```
pub struct Session {
    chosen: Chosen,
    options: SmootherOptions,
    devices: Vec<FleetDevice>,
    /// Index of the device that smooths frames one at a time.
    device: usize,
    /// The last estimated sensor; `None` if no sensor was estimated.
    estimated: Option<SensorModel>,
    /// The parameters for the last unorganized cloud, if it was examined.
    cloud_params: Option<CloudParams>,
    /// The estimate for the last unorganized cloud.
    cloud_estimate: Option<CloudEstimate>,
    /// The rebuilt pixel grid of the last unorganized cloud; `None` if the cloud is not a frame without its grid.
    lattice: Option<Lattice>,
    /// Whether the current frame is a cloud on its rebuilt grid, and so not part of a video.
    is_on_lattice: bool,
    /// The number of points of the last unorganized cloud.
    known_points: usize,
    /// The parameters that were chosen for the last unorganized cloud.
    cloud_choice: Option<CloudChoice>,
    /// Whether `cloud_params`, `cloud_estimate`, `lattice`, `known_points` and `cloud_choice` belong to the current or
    /// prepared frame.
    is_prepared: bool,
    /// Buffer for the result of smoothing a cloud on its rebuilt grid.
    on_grid: Smoothed,
    /// Buffer for the points after the first of two passes.
    first_pass: Smoothed,
    /// The open engine for first passes.
    open_for_first: Option<Open>,
    /// Buffer for the result before its points are spaced evenly.
    before_even: Smoothed,
    /// The parameters of the first of two passes while it runs; otherwise `None`.
    is_first: Option<CloudParams>,
    /// The state of smoothing over time, with its buffers.
    video: OverTime,
    /// Camera, sensor and geometry of the frame that an engine was last opened for; `None` if the frame is not part
    /// of a video.
    sight: Option<Sight>,
    /// Doubts that were already reported.
    doubts: Vec<Doubt>,
    /// The camera whose lens was last checked.
    doubted_camera: Option<Camera>,
    /// Buffers and threads for the steps after the engine: estimating standard errors and filling holes.
    finish: Option<Box<dyn Finishing>>,
    is_live: bool,
    is_single: bool,
    /// Whether the window of the first frame with a known resolution is kept for all frames of its shape.
    keeps_window: bool,
    keeps_sensor: bool,
    estimates_clouds: bool,
    kept_window: Option<((usize, usize), WindowSize)>,
    open: Option<Open>,
    /// The engine that replaces the GPU for clouds, once a cloud was too large for the GPU.
    instead_for_clouds: Option<Engine>,
    /// The GPU failures so far, and whether the CPU engine has taken over for all frames.
    losses: GpuLosses,
    pending: VecDeque<Pending>,
    ready: VecDeque<Result<crate::SmoothedView, Error>>,
    events: Vec<SessionEvent>,
    scratch: GeometryScratch,
    /// The rule by which ranges were measured in the last frame; `None` before the first frame.
    rule: Option<RangeRule>,
    watch: ProgressWatch,
    /// ID of the process that opened the engine. It is compared because threads do not survive a fork.
    process: u32,
}

/// The source of the parameters.
#[derive(Debug, Clone)]
enum Chosen {
    Settings(Box<Settings>),
    Params(FrameParams, CloudParams),
}

impl Session {
    /// Creates a session; the engine is opened with the first frame.
    ///
    /// # Errors
    /// If settings are outside their ranges or contradict each other, or a device is missing.
    pub fn new(settings: Settings) -> Result<Self, Error> {
        let (options, devices) = (settings.options(), settings.devices()?);
        Self::of(Chosen::Settings(Box::new(settings)), options, devices)
    }

    /// Creates a session with explicit parameters for frames and for clouds. Frames in flight are distributed among
    /// `devices`, if any are given.
    ///
    /// # Errors
    /// If a parameter is outside its range.
    pub fn with_params(
        frame: FrameParams,
        cloud: CloudParams,
        options: SmootherOptions,
        devices: Vec<FleetDevice>,
    ) -> Result<Self, Error> {
        Self::of(Chosen::Params(frame, cloud), options, devices)
    }

    fn of(chosen: Chosen, options: SmootherOptions, devices: Vec<FleetDevice>) -> Result<Self, Error> {
        let mut session = Self {
            chosen,
            options,
            devices,
            device: 0,
            estimated: None,
            cloud_params: None,
            cloud_estimate: None,
            lattice: None,
            is_on_lattice: false,
            known_points: 0,
            cloud_choice: None,
            is_prepared: false,
            on_grid: Smoothed::default(),
            first_pass: Smoothed::default(),
            open_for_first: None,
            before_even: Smoothed::default(),
            is_first: None,
            video: OverTime::default(),
            sight: None,
            doubts: Vec::new(),
            doubted_camera: None,
            finish: None,
            is_live: false,
            is_single: false,
            keeps_window: false,
            keeps_sensor: false,
            estimates_clouds: true,
            kept_window: None,
            open: None,
            instead_for_clouds: None,
            losses: GpuLosses::default(),
            pending: VecDeque::new(),
            ready: VecDeque::new(),
            events: Vec::new(),
            scratch: GeometryScratch::default(),
            rule: None,
            watch: ProgressWatch::default(),
            process: process_id(),
        };
        session.validate()?;
        Ok(session)
    }

    fn validate(&mut self) -> Result<(), Error> {
        match &self.chosen {
            Chosen::Settings(settings) => settings.validate()?,
            Chosen::Params(frame, cloud) => {
                frame.validate()?;
                cloud.validate()?;
            }
        }
        Ok(())
    }

    /// Changes the settings from the next frame on. Frames in flight keep the old settings.
    ///
    /// # Errors
    /// Same as [`new`](Self::new); the session then keeps its settings.
    pub fn set_settings(&mut self, settings: Settings) -> Result<(), Error> {
        let devices = settings.devices()?;
        self.options = settings.override_options(self.options.clone());
        if devices != self.devices {
            (self.devices, self.device) = (devices, 0);
        }
        self.chosen = Chosen::Settings(Box::new(settings));
        (self.kept_window, self.estimated, self.instead_for_clouds) = (None, None, None);
        (self.cloud_params, self.cloud_estimate, self.lattice, self.known_points) = (None, None, None, 0);
        self.restart_video();
        if self.pending.is_empty() {
            self.video.close();
        }
        Ok(())
    }

    /// Sets the results to compute from the next frame on.
    pub fn set_outputs(&mut self, outputs: Outputs) {
        self.options.outputs = outputs;
    }

    /// Returns the results to compute.
    pub fn outputs(&self) -> Outputs {
        self.options.outputs
    }

    /// Returns the settings; `None` if the session was created with explicit parameters.
    pub fn settings(&self) -> Option<&Settings> {
        match &self.chosen {
            Chosen::Settings(settings) => Some(settings),
            Chosen::Params(..) => None,
        }
    }

    /// Smooths one frame or cloud into `out`, whose buffers are reused.
    ///
    /// # Errors
    /// If the frame is malformed, settings do not fit it, or the engine fails and no other may take over.
    pub fn smooth<'a>(&mut self, frame: impl IntoFrame<'a>, out: &mut Smoothed) -> Result<(), Error> {
        let frame = frame.into_frame()?;
        match self.finishes() {
            true => self.smooth_and_finish(frame, out),
            false => self.smooth_unfinished(frame, out),
        }
    }

    /// Smooths a frame in space and, if requested, over time, without the steps after the engine.
    fn smooth_unfinished(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        if !ONE_THREAD && self.over_time(frame).is_some() {
            let result = self.smooth_over_time(frame, out);
            self.is_prepared = false;
            return result;
        }
        let (width, height) = frame.shape();
        out.prepare(width, height, self.options.outputs);
        self.smooth_frame(frame, out.as_mut())
    }

    /// Smooths one frame or cloud into the caller's buffers.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth). Also if a buffer's length differs from the frame's, if a buffer is for an
    /// output that was not requested, or if holes are to be filled but the status is not among the outputs.
    pub fn smooth_into<'a>(&mut self, frame: impl IntoFrame<'a>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let frame = frame.into_frame()?;
        let (width, height) = frame.shape();
        out.check(width * height, self.options.outputs)?;
        self.check_flags()?;
        match self.finishes() {
            true => self.smooth_and_finish_into(frame, out),
            false => self.smooth_frame(frame, out),
        }
    }

    fn smooth_frame(&mut self, frame: Frame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        if !ONE_THREAD && frame.grid().is_none() {
            check_no_frames(self.options.outputs)?;
        }
        let result = match (self.take_lattice(frame), self.to_space_evenly(frame)) {
            _ if self.over_time(frame).is_some() => self.smooth_over_time_into(frame, out),
            (Some((lattice, points)), _) => self.smooth_on_lattice(lattice, &points, out),
            (None, Some(points)) => self.smooth_evenly(&points, out),
            (None, None) => self.smooth_in_passes(frame, out),
        };
        self.is_prepared = false;
        result
    }

    /// Smooths a frame with the engine alone, and tries again if another engine takes over.
    fn one_at_a_time(&mut self, frame: Frame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        self.check_idle()?;
        loop {
            let result = self
                .open_for(frame, false)
                .and_then(|admitted| self.smoother()?.smooth_admitted(&admitted, out.reborrow()));
            match result {
                Err(error) => self.recover(error, frame.grid().is_none(), false)?,
                Ok(()) => return Ok(()),
            }
        }
    }

    /// Opens the engine for frames like this one, unless it is already open. The next cloud of the same size reuses
    /// the chosen neighbours, edges and passes; the same cloud reuses its rebuilt grid. Calling this function is
    /// optional, because [`smooth`](Self::smooth) also opens the engine.
    ///
    /// # Errors
    /// Same as [`smooth`](Self::smooth).
    pub fn prepare<'a>(&mut self, frame: impl IntoFrame<'a>) -> Result<(), Error> {
        let frame = frame.into_frame()?;
        let outputs = self.options.outputs;
        self.options.outputs = self.outputs_of_engine(frame);
        let result = self.on_its_grid(frame, |session, frame| session.open_for(frame, false).map(drop));
        self.options.outputs = outputs;
        self.is_prepared |= result.is_ok();
        result
    }

    /// Opens the smoother or fleet for this frame, unless it is already open, and returns the frame with its
    /// geometry. `in_flight` states whether a fleet may be used.
    fn open_for<'a>(&mut self, frame: Frame<'a>, in_flight: bool) -> Result<AdmittedFrame<'a>, Error> {
        self.forget_other_process();
        check_frame(frame, self.options.outputs, frame.grid())?;
        let (params, _) = self.resolve(frame)?;
        let (engine_params, window) = for_engine(params);
        let needs_range = needs_range(&engine_params) || window.is_some();
        let geometry = FrameGeometry::of(frame, needs_range, &mut self.scratch);
        self.rule = Some(geometry.rule);
        self.look_at(frame, geometry, params);
        let engine_params = self.with_window(engine_params, params, frame, &geometry);
        let mut options = self.options.clone();
        options.outputs = self.outputs_before_time(frame);
        let sigma = !ONE_THREAD && std::mem::take(&mut options.outputs.sigma);
        options.engine = self.engine_for(frame.grid().is_none());
        options.only_points = self.is_single.then(|| frame.shape().0 * frame.shape().1);
        let uses_fleet = !ONE_THREAD && in_flight && !self.devices.is_empty() && !self.losses.uses_cpu();
        if let (false, Some(device)) = (uses_fleet, self.devices.get(self.device)) {
            options = device.options(&options);
        }
        let video = self.video_of_engine(&options, uses_fleet);
        let is_possible = !ONE_THREAD && (uses_fleet || matches!(options.engine, Engine::Auto | Engine::Gpu));
        let steps = if is_possible { self.steps_of_engine(frame, sigma) } else { None };
        let wanted = OpenFor { grid: frame.grid(), params: engine_params, options, uses_fleet, video, steps };
        if self.open.as_ref().is_none_or(|open| !open.fits(&wanted)) {
            check_options(params, &wanted.options, frame.grid())?;
            self.finish_flights()?;
            self.open = None;
            let devices: &[FleetDevice] = if uses_fleet { &self.devices } else { &[] };
            let open = Open::new(wanted, devices)?;
            self.open = Some(open);
            self.video.leave_device();
            // Finishing the frames in flight may have opened the engine for other frames, and so overwritten this
            // state.
            if !ONE_THREAD {
                self.doubt(frame);
                self.rule = Some(geometry.rule);
                self.look_at(frame, geometry, params);
            }
        }
        self.watch.set(self.open.as_ref().and_then(Open::progress));
        Ok(AdmittedFrame::new(frame, geometry))
    }

    fn engine_for(&self, is_cloud: bool) -> Engine {
        if self.losses.uses_cpu() {
            return Engine::Cpu;
        }
        self.instead_for_clouds.filter(|_| is_cloud).unwrap_or(self.options.engine)
    }

    /// Decides how to continue after an error. Returns `Ok` if smoothing should be tried again, otherwise the error.
    fn recover(&mut self, error: Error, is_cloud: bool, is_stream: bool) -> Result<(), Error> {
        let Error::Engine(engine_error) = &error else { return Err(error) };
        if matches!(engine_error, EngineError::Stopped | EngineError::Full { .. }) {
            return Err(error);
        }
        let was_open = self.open.is_some();
        let was_gpu = self.open.as_ref().is_some_and(|open| open.engine() == Engine::Gpu);
        (self.open, self.open_for_first) = (None, None);
        if engine_error.is_too_large() && is_cloud && was_gpu && self.options.engine == Engine::Auto {
            self.instead_for_clouds = Some(Engine::Cpu);
            self.events.push(SessionEvent::TooLargeForGpu { error: engine_error.clone() });
            return Ok(());
        }
        let leaves = self.devices.len() > 1 && !is_stream && !engine_error.is_too_large();
        if leaves {
            let device = self.devices.remove(self.device);
            self.device = 0;
            self.events.push(SessionEvent::DeviceLeft { device, error: engine_error.clone() });
            return Ok(());
        }
        let may_use_cpu = is_stream || self.options.engine == Engine::Auto;
        match self.losses.next(&error, was_gpu, was_open, may_use_cpu) {
            Recovery::Reopen => self.events.push(SessionEvent::Reopening { error: engine_error.clone() }),
            Recovery::UseCpu => {
                self.devices.clear();
                self.events.push(SessionEvent::UsingCpu { error: engine_error.clone() });
            }
            Recovery::Fail => return Err(error),
        }
        Ok(())
    }

    /// Forgets the engine if another process opened it: after a fork, the engine's threads do not exist in the new
    /// process, so they cannot be joined.
    fn forget_other_process(&mut self) {
        let process = process_id();
        if self.process != process {
            let finish = self.finish.take();
            std::mem::forget((self.open.take(), self.open_for_first.take(), std::mem::take(&mut self.video), finish));
            self.sight = None;
            self.pending.clear();
            self.ready.clear();
            self.process = process;
        }
    }

    /// Returns an error if frames are in flight.
    fn check_idle(&self) -> Result<(), EngineError> {
        match self.in_flight() {
            0 => Ok(()),
            in_flight => Err(EngineError::Full { in_flight }),
        }
    }

    fn smoother(&mut self) -> Result<&mut crate::Smoother, Error> {
        let closed = || EngineError::Unavailable { engine: "session", reason: "no engine is open".to_owned() };
        self.open.as_mut().and_then(Open::smoother).ok_or_else(|| closed().into())
    }

    /// Closes the engine and frees its memory; the next frame opens it again. Frames in flight are discarded.
    pub fn close(&mut self) {
        self.forget_other_process();
        (self.open, self.open_for_first) = (None, None);
        (self.cloud_params, self.lattice) = (None, None);
        (self.on_grid, self.first_pass, self.before_even) = Default::default();
        self.finish = None;
        self.restart_video();
        self.video.close();
        self.pending.clear();
        self.ready.clear();
        self.watch.set(None);
    }
}

/// Smooths one frame or cloud with an engine opened for this call. To smooth several frames, use a [`Session`].
///
/// ```
/// use planish::{Camera, DepthView, Settings};
///
/// # fn main() -> Result<(), planish::Error> {
/// let (raw, camera) = (vec![1500u16; 640 * 480], Camera::kinect_v1());
/// let smoothed = planish::smooth(DepthView::new(&raw, &camera)?, &Settings::default())?;
/// assert!((smoothed.points.z()[1000] - 1.5).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Same as [`Session::new`] and [`Session::smooth`].
pub fn smooth<'a>(frame: impl IntoFrame<'a>, settings: &Settings) -> Result<Smoothed, Error> {
    let mut smoothed = Smoothed::default();
    Session::new(settings.clone())?.with_single_frame(true).smooth(frame, &mut smoothed)?;
    Ok(smoothed)
}

#[cfg(test)]
mod tests;
