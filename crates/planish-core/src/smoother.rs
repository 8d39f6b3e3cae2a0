//! The smoother: opens an engine once for a grid or for unorganized clouds, then smooths any number of frames.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::engines::{self, Capabilities, ChoiceReason, Engine, SmootherOptions};
use crate::error::{Error, FrameError, ParamError};
use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::{CloudParams, Edges, EngineParams, FrameParams, Params, Radius, Window, WindowSize};
use crate::progress::Progress;
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, DeviceSteps, SmoothingEngine, Video};
use crate::threads::ONE_THREAD;
use crate::timings::FrameTimings;
use crate::view::SmoothedView;
use crate::xyz::validate_shape;

/// An open engine and its buffers, for frames on one grid or for unorganized clouds.
///
/// One frame at a time:
///
/// ```
/// use planish::{Engine, FrameParams, OrganizedCloud, Smoothed, Smoother, Xyz};
///
/// # fn main() -> Result<(), planish::Error> {
/// let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// let cloud = OrganizedCloud::from_positions(64, 48, plane)?;
/// let mut smoother = Smoother::open(FrameParams::paper(), Engine::Auto, (64, 48))?;
/// let mut smoothed = Smoothed::default();
/// smoother.smooth(&cloud, &mut smoothed)?;
/// assert!((smoothed.points.z()[1000] - 1.0).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
///
/// Several frames in flight: a GPU computes one frame while the next is uploaded and the previous one is read back.
/// Results are received in the order of submission:
///
/// ```
/// # use planish::{Engine, FrameParams, OrganizedCloud, Smoothed, Smoother, Xyz};
/// # fn main() -> Result<(), planish::Error> {
/// # let plane: Xyz = (0..64 * 48).map(|i| [0.002 * (i % 64) as f32, 0.002 * (i / 64) as f32, 1.0]).collect();
/// # let frames = vec![OrganizedCloud::from_positions(64, 48, plane)?; 5];
/// # let mut smoother = Smoother::open(FrameParams::paper(), Engine::Auto, (64, 48))?;
/// let mut spare = Vec::new();
/// let mut use_result = |smoothed: &Smoothed| assert_eq!(smoothed.points.len(), 64 * 48);
/// for frame in &frames {
///     if smoother.in_flight() == smoother.max_in_flight() {
///         if let Some(result) = smoother.receive()? {
///             let smoothed = result.into_smoothed();
///             use_result(&smoothed);
///             spare.push(smoothed);
///         }
///     }
///     smoother.submit(frame, spare.pop().unwrap_or_default())?;
/// }
/// while let Some(result) = smoother.receive()? {
///     use_result(&result.into_smoothed());
/// }
/// # Ok(())
/// # }
/// ```
pub struct Smoother {
    params: EngineParams,
    /// The automatic window, until a frame with a known resolution decides its size; `None` afterwards, or for a
    /// fixed window.
    undecided: Option<Window>,
    grid: Option<(usize, usize)>,
    outputs: Outputs,
    engine: Engine,
    opened: Box<dyn SmoothingEngine>,
    opener: Opener,
    chosen_because: Option<ChoiceReason>,
    scratch: GeometryScratch,
    /// Results of frames that were in flight when the engine was reopened for another window size.
    ready: VecDeque<Result<SmoothedView, Error>>,
    is_prepared: bool,
}

/// The arguments for reopening the engine with another window size.
enum Opener {
    Options(SmootherOptions),
    #[cfg(feature = "wgpu-interop")]
    Device {
        device: wgpu::Device,
        queue: wgpu::Queue,
        options: SmootherOptions,
        shape: (usize, usize),
    },
}

impl Opener {
    fn open(&self, params: EngineParams, grid: Option<(usize, usize)>) -> Result<engines::Opened, Error> {
        match self {
            Self::Options(options) => engines::open(params, options, grid),
            #[cfg(feature = "wgpu-interop")]
            Self::Device { device, queue, options, shape } => {
                let gpu = crate::gpu::Gpu::open_on(device, queue, params, options.outputs, &options.gpu, *shape)?;
                Ok((Box::new(gpu), Engine::Gpu, None))
            }
        }
    }
}

impl std::fmt::Debug for Smoother {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { params, undecided, grid, outputs, engine, .. } = self;
        f.debug_struct("Smoother")
            .field("engine", engine)
            .field("device", &self.gpu_name())
            .field("grid", grid)
            .field("outputs", outputs)
            .field("params", params)
            .field("undecided", undecided)
            .field("in_flight", &self.in_flight())
            .finish()
    }
}

impl Smoother {
    /// Opens an engine for frames of one shape (width, height), with points as its only output.
    ///
    /// # Errors
    /// Same as [`open_with`](Self::open_with).
    pub fn open(params: FrameParams, engine: Engine, shape: (usize, usize)) -> Result<Self, Error> {
        Self::open_with(params, &SmootherOptions::new(engine, Outputs::POINTS), shape)
    }

    /// Opens an engine for frames of one shape (width, height).
    ///
    /// This call checks limits, compiles kernels and computes a first frame. `Auto` chooses the engine in this call,
    /// and uses the CPU if the GPU cannot be opened for these frames. The size of an automatic window
    /// ([`Window::Auto`]) is decided by the first frame with a known resolution. If the pixels of that frame are
    /// coarser than a Kinect v1's, the engine is then opened again, and `Auto` chooses again.
    ///
    /// # Errors
    /// If a parameter is outside its range, or the engine is not available.
    pub fn open_with(params: FrameParams, options: &SmootherOptions, shape: (usize, usize)) -> Result<Self, Error> {
        Self::open_any(params.into(), options, Some(shape))
    }

    /// Opens an engine for unorganized clouds of any size.
    ///
    /// # Errors
    /// If a parameter is outside its range, or the engine is not available.
    pub fn open_clouds(params: CloudParams, options: &SmootherOptions) -> Result<Self, Error> {
        Self::open_any(params.into(), options, None)
    }

    /// Opens an engine for frames on a grid, or for unorganized clouds if `grid` is `None`.
    pub(crate) fn open_any(
        params: Params,
        options: &SmootherOptions,
        grid: Option<(usize, usize)>,
    ) -> Result<Self, Error> {
        check_options(params, options, grid)?;
        let (params, undecided) = for_engine(params);
        Self::with_opener(params, undecided, Opener::Options(options.clone()), options.outputs, grid)
    }

    /// Opens an engine for a caller that decides the window size itself ([`set_size`](Self::set_size)).
    pub(crate) fn open_decided(
        params: EngineParams,
        options: &SmootherOptions,
        grid: Option<(usize, usize)>,
    ) -> Result<Self, Error> {
        Self::with_opener(params, None, Opener::Options(options.clone()), options.outputs, grid)
    }

    /// Opens the GPU engine on a device and a queue that belong to the host program.
    ///
    /// The device must not be polled by another thread while this smoother is in use. Its error callbacks are not
    /// replaced, so validation errors reach the host program. With [`wgpu::Features::MAPPABLE_PRIMARY_BUFFERS`], frames
    /// need no copies; with [`wgpu::Features::TIMESTAMP_QUERY`] and `TIMESTAMP_QUERY_INSIDE_ENCODERS`, they can be
    /// timed. The signature contains types of wgpu, so each new version of wgpu is a breaking change to this function.
    ///
    /// # Errors
    /// Same as [`open_with`](Self::open_with).
    #[cfg(feature = "wgpu-interop")]
    pub fn open_on(
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        params: FrameParams,
        options: &SmootherOptions,
        shape: (usize, usize),
    ) -> Result<Self, Error> {
        check_options(params.into(), options, Some(shape))?;
        let (params, undecided) = for_engine(params.into());
        let (device, queue) = (device.clone(), queue.clone());
        let opener = Opener::Device { device, queue, options: options.clone(), shape };
        Self::with_opener(params, undecided, opener, options.outputs, Some(shape))
    }

    fn with_opener(
        params: EngineParams,
        undecided: Option<Window>,
        opener: Opener,
        outputs: Outputs,
        grid: Option<(usize, usize)>,
    ) -> Result<Self, Error> {
        let (opened, engine, chosen_because) = opener.open(params, grid)?;
        Ok(Self {
            params,
            undecided,
            grid,
            outputs,
            engine,
            opened,
            opener,
            chosen_because,
            scratch: GeometryScratch::default(),
            ready: VecDeque::new(),
            is_prepared: false,
        })
    }

    /// Reopens the engine for another window size. Frames in flight are finished first.
    pub(crate) fn set_size(&mut self, size: WindowSize) -> Result<(), Error> {
        let params = self.params.with_size(size);
        if params == self.params {
            self.undecided = None;
            return Ok(());
        }
        while self.opened.in_flight() > 0 {
            let received = self.opened.receive();
            let is_over = received.is_err();
            self.ready.extend(received.transpose());
            if is_over {
                break;
            }
        }
        (self.opened, self.engine, self.chosen_because) = self.opener.open(params, self.grid)?;
        // Cleared only after a successful opening, so that the next frame tries again after a failure.
        self.undecided = None;
        if self.is_prepared {
            self.opened.prepare_in_flight();
        }
        self.params = params;
        Ok(())
    }

    /// Returns the open engine; for [`Engine::Auto`], the engine that it chose.
    pub fn engine(&self) -> Engine {
        self.engine
    }

    /// Returns the capabilities of the open engine.
    pub fn capabilities(&self) -> Capabilities {
        self.engine.capabilities()
    }

    /// Returns the name of the GPU; `None` for other engines.
    pub fn gpu_name(&self) -> Option<&str> {
        self.opened.device_name()
    }

    /// Returns the reason for the choice of `Auto`; `None` if the caller chose the engine by name.
    pub fn chosen_because(&self) -> Option<&ChoiceReason> {
        self.chosen_because.as_ref()
    }

    /// Smooths one frame into `out`, whose buffers are reused. Refuses a frame whose grid differs from the smoother's.
    pub fn smooth<'a>(&mut self, frame: impl IntoFrame<'a>, out: &mut Smoothed) -> Result<(), Error> {
        let frame = self.admit(frame.into_frame()?)?;
        let (width, height) = frame.frame.shape();
        out.prepare(width, height, self.outputs);
        self.opened.smooth(&frame, out.as_mut())
    }

    /// Smooths one frame into the caller's buffers. Refuses buffers whose length differs from the frame's, and buffers
    /// for outputs that the smoother was not opened for.
    pub fn smooth_into<'a>(&mut self, frame: impl IntoFrame<'a>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let frame = self.admit(frame.into_frame()?)?;
        let (width, height) = frame.frame.shape();
        out.check(width * height, self.outputs)?;
        self.opened.smooth(&frame, out)
    }

    /// Smooths a frame whose shape and buffers were already checked.
    pub(crate) fn smooth_admitted(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        self.opened.smooth(frame, out)
    }

    /// Enables smoothing over time for all later frames; returns false if the engine does not support it. Only for
    /// sessions, which mark the first frame of a video and check buffers.
    pub(crate) fn smooth_over_time(&mut self, video: &Video) -> Result<bool, Error> {
        self.opened.smooth_over_time(video)
    }

    /// Adds steps to all later frames; returns false if the engine does not support them. Only for sessions, which
    /// check buffers.
    pub(crate) fn take_steps(&mut self, steps: &DeviceSteps) -> Result<bool, Error> {
        self.opened.take_steps(steps)
    }

    /// Submits a frame whose shape was already checked.
    pub(crate) fn submit_admitted(&mut self, frame: &AdmittedFrame<'_>, buffer: Option<Smoothed>) -> Result<(), Error> {
        self.opened.submit(frame, buffer)
    }

    /// Smooths several frames of the same shape, from one camera or several. A GPU computes up to 64 frames per
    /// submission.
    ///
    /// `out` must have one result per frame, whose buffers are reused.
    pub fn smooth_batch(&mut self, frames: &[Frame<'_>], out: &mut [Smoothed]) -> Result<(), Error> {
        if frames.len() != out.len() {
            let (len, expected) = (out.len(), frames.len());
            return Err(FrameError::LengthMismatch { what: "the results of a batch".into(), len, expected }.into());
        }
        let frames = frames.iter().map(|&frame| self.admit(frame)).collect::<Result<Vec<_>, _>>()?;
        self.opened.smooth_batch(&frames, out)
    }

    /// Returns the time spent in each stage of the last [`smooth`](Self::smooth) or
    /// [`smooth_batch`](Self::smooth_batch), on a GPU or in the CPU engine; `None` unless
    /// [`GpuOptions::timestamps`](crate::GpuOptions::timestamps) is set.
    pub fn timings(&self) -> Option<FrameTimings> {
        self.opened.timings()
    }

    /// Returns the progress of the frame being smoothed, for use by another thread; `None` for the CPU and GPU engines
    /// for frames on a grid, which are always fast. The engines for unorganized clouds, and the reference, can take a
    /// long time.
    pub fn progress(&self) -> Option<Arc<Progress>> {
        self.opened.progress()
    }

    /// Makes the engine store the density-based radii of later clouds, for [`own_radius_m`](Self::own_radius_m).
    pub fn keep_radii(&mut self) {
        self.opened.keep_radii();
    }

    /// Returns the density-based radius of point `i` of the last cloud in metres, before it was limited; `None` if
    /// the point has no such radius, or radii were not stored.
    pub fn own_radius_m(&self, i: usize) -> Option<f32> {
        self.opened.own_radius_m(i)
    }

    /// Returns the size in bytes of the buffers kept between frames, excluding the caller's frames and results. The
    /// CPU engine keeps padded frames, the GPU engine keeps slots in device memory and shared memory, and the
    /// reference keeps no buffers.
    pub fn buffer_bytes(&self) -> u64 {
        self.opened.buffer_bytes()
    }

    /// Submits a frame and a buffer for its result; [`receive`](Self::receive) returns the filled buffer.
    ///
    /// On a GPU, the frame has been copied when this function returns, and another thread copies the result into the
    /// buffer. The CPU engines, and all engines for unorganized clouds, compute the frame during this call.
    pub fn submit<'a>(&mut self, frame: impl IntoFrame<'a>, buffer: Smoothed) -> Result<(), Error> {
        let frame = self.admit(frame.into_frame()?)?;
        self.opened.submit(&frame, Some(buffer))
    }

    /// Submits a frame whose result is not copied: [`receive`](Self::receive) returns a view of the memory that the
    /// device wrote.
    pub fn submit_in_place<'a>(&mut self, frame: impl IntoFrame<'a>) -> Result<(), Error> {
        let frame = self.admit(frame.into_frame()?)?;
        self.opened.submit(&frame, None)
    }

    /// Waits for the oldest frame in flight and returns its result; `None` if no frame is in flight.
    pub fn receive(&mut self) -> Result<Option<SmoothedView>, Error> {
        match self.ready.pop_front() {
            Some(result) => result.map(Some),
            None => self.opened.receive(),
        }
    }

    /// Prepares for several frames in flight. Without this call, the second frame in flight waits for the preparation:
    /// about 0.1 s on a GPU with several queues, where frames overlap. Not needed when smoothing one frame at a time.
    pub fn prepare_in_flight(&mut self) {
        self.is_prepared = true;
        self.opened.prepare_in_flight();
    }

    /// Returns the number of frames that were submitted but not yet received.
    pub fn in_flight(&self) -> usize {
        self.ready.len() + self.opened.in_flight()
    }

    /// Returns the maximum number of frames in flight. Submitting one more fails with
    /// [`EngineError::Full`](crate::EngineError::Full).
    pub fn max_in_flight(&self) -> usize {
        self.opened.max_in_flight()
    }

    /// Refuses a frame whose grid differs from the smoother's, and determines how its ranges are measured.
    fn admit<'a>(&mut self, frame: Frame<'a>) -> Result<AdmittedFrame<'a>, Error> {
        check_frame(frame, self.outputs, self.grid)?;
        let needs_range = needs_range(&self.params) || self.undecided.is_some();
        let geometry = FrameGeometry::of(frame, needs_range, &mut self.scratch);
        self.admit_with(frame, geometry)
    }

    /// Admits a checked frame with its geometry. Decides the window size if it is undecided and the frame's
    /// resolution is known.
    fn admit_with<'a>(&mut self, frame: Frame<'a>, geometry: FrameGeometry) -> Result<AdmittedFrame<'a>, Error> {
        if let (Some(window), Some(pitch_at_1m)) = (self.undecided, geometry.rule.known_pitch_at_1m()) {
            self.set_size(window.at_pitch(pitch_at_1m))?;
        }
        Ok(AdmittedFrame::new(frame, geometry))
    }
}

/// Converts parameters to those of an engine. Also returns the window if its size depends on the frame's resolution.
pub(crate) fn for_engine(params: Params) -> (EngineParams, Option<Window>) {
    match params {
        Params::Frame(params) => (params.into(), Some(params.window).filter(|window| window.is_auto())),
        Params::Cloud(params) => (params.into(), None),
    }
}

/// Returns true if, with these parameters, engines need the ranges of a frame's points.
pub(crate) fn needs_range(params: &EngineParams) -> bool {
    params.radius == Radius::Sensor || params.edges != Edges::Off || params.averages_blocks()
}

/// Refuses a frame whose grid differs from `grid`, or that lacks the camera that an output requires.
pub(crate) fn check_frame(frame: Frame<'_>, outputs: Outputs, grid: Option<(usize, usize)>) -> Result<(), FrameError> {
    check_grid(frame.grid(), grid)?;
    if outputs.needs_camera() && frame.camera().is_none() {
        return Err(FrameError::MissingCamera { what: "the output depth" });
    }
    Ok(())
}

/// Refuses a grid other than the expected one.
pub(crate) fn check_grid(found: Option<(usize, usize)>, expected: Option<(usize, usize)>) -> Result<(), FrameError> {
    match (found, expected) {
        (found, expected) if found == expected => Ok(()),
        (Some((frame_width, frame_height)), Some((width, height))) => {
            Err(FrameError::ShapeMismatch { frame_width, frame_height, width, height })
        }
        (found, expected) => {
            let describe = |grid: Option<(usize, usize)>| match grid {
                Some((width, height)) => format!("a grid of {width}x{height}"),
                None => "unorganized clouds (no grid)".to_owned(),
            };
            let found = match found {
                Some(_) => format!("has {}", describe(found)),
                None => "is an unorganized cloud".to_owned(),
            };
            Err(FrameError::GridMismatch { found, expected: describe(expected) })
        }
    }
}

/// Refuses the outputs `frames`, which needs a video, and `sigma`, which needs a session.
pub(crate) fn check_no_frames(outputs: Outputs) -> Result<(), ParamError> {
    let refused = |value: &str, allowed| Err(ParamError { field: "outputs", value: value.to_owned(), allowed });
    if outputs.frames && !ONE_THREAD {
        return refused("frames", "only for frames on a grid in a session with temporal=steady");
    }
    match outputs.sigma && !ONE_THREAD {
        true => refused("sigma", "only for frames on a grid in a session"),
        false => Ok(()),
    }
}

pub(crate) fn check_options(
    params: Params,
    options: &SmootherOptions,
    grid: Option<(usize, usize)>,
) -> Result<(), Error> {
    params.validate()?;
    options.outputs.validate()?;
    check_no_frames(options.outputs)?;
    match grid {
        Some((width, height)) => validate_shape(width, height)?,
        None if options.outputs.needs_camera() => {
            return Err(FrameError::MissingCamera { what: "the output depth" }.into());
        }
        None => {}
    }
    let positive = |field, value| match value {
        0 => Err(ParamError { field, value: "0".into(), allowed: "1 or more" }),
        _ => Ok(()),
    };
    positive("threads", options.threads.unwrap_or(1))?;
    positive("slots", options.gpu.slots)?;
    Ok(())
}
