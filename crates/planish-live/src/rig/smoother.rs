//! Smooths the frames of a moment.

use std::collections::VecDeque;
use std::sync::Arc;

use rayon::prelude::*;

use super::flight::Flight;
use super::general::{General, Stopper};
use super::views::{Measured, View};
use super::{DEFAULT_REGISTRATION_M, Rig, RigCamera};
use planish_core::{
    Camera, CloudParams, Engine, EngineError, Error, FleetDevice, Frame, FrameError, FrameParams, Outputs, ParamError,
    Smoothed, SmoothedView, Smoother, SmootherOptions,
    internal::{Rays, ResultFilter, RigidTransform, Threads},
};

/// Method for smoothing the frames of a moment. Every method returns each camera's points on that camera's grid and
/// in its coordinate frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum RigWay {
    /// Each camera's frame is smoothed separately, with the noise of the camera's sensor.
    #[default]
    Each,
    /// All points are smoothed as one unorganized cloud, so that each surface is fitted to the points of all cameras
    /// that see it.
    Merged,
    /// The points of all cameras are projected into range images from each camera's position. Each range image is
    /// smoothed as a frame of its camera, and every point becomes the mean of its estimates in these views. The
    /// cameras' intrinsics must be known.
    Views,
}

impl RigWay {
    /// All methods.
    pub const ALL: [Self; 3] = [Self::Each, Self::Merged, Self::Views];

    /// Returns the name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Each => "each",
            Self::Merged => "merged",
            Self::Views => "views",
        }
    }
}

/// A smoother for the frames of a rig's cameras. It smooths one moment at a time, or keeps several in flight, as a
/// [`Smoother`] does with frames.
pub struct RigSmoother {
    pub(super) way: RigWay,
    pub(super) options: SmootherOptions,
    /// Devices that share the cameras; if empty, the options' device smooths all of them.
    pub(super) devices: Vec<FleetDevice>,
    /// The device that failed last.
    pub(super) failed: Option<FleetDevice>,
    registration_m: f64,
    pub(super) threads: Threads,
    /// The rig's cameras, followed by one per added viewpoint.
    pub(super) cameras: Vec<CameraSmoother>,
    /// Number of cameras in the rig.
    pub(super) of_rig: usize,
    /// Whether smoothing over time estimates each camera's motion.
    pub(super) tracks_cameras: bool,
    /// The smoother for all cameras' points as one cloud.
    pub(super) general: General,
    pub(super) engine: Engine,
    /// Moments submitted and not yet received.
    pub(super) flights: VecDeque<Flight>,
    /// Timestamp of the next moment, in seconds.
    pub(super) time_s: Option<f64>,
}

/// The smoother of one camera, opened for the shape of the camera's frames.
pub(super) struct CameraSmoother {
    pub(super) rig_from_camera: RigidTransform,
    /// The assigned device, if there are several.
    pub(super) device: Option<FleetDevice>,
    /// Camera for frames without their own.
    camera: Option<Camera>,
    /// Viewing rays of the camera's depth images, if these are merged into one cloud.
    pub(super) rays: Arc<Rays>,
    pub(super) params: FrameParams,
    smoother: Option<Smoother>,
    shape: (usize, usize),
    /// The filter that smooths the camera's results over time, if any.
    pub(super) video: Option<ResultFilter>,
}

/// The result of each camera; `None` for a camera without a frame. A frame that cannot be smoothed yields an error
/// for its camera only.
pub type RigResults = Vec<Option<Result<Smoothed, FrameError>>>;

impl RigSmoother {
    /// Creates a smoother for a rig; engines are opened for the first frames. `params` are the parameters for each
    /// camera's frames, adapted to the camera's sensor ([`FrameParams::for_sensor`]); `general_params` are those for
    /// the points of all cameras as one cloud ([`CloudParams`]).
    pub fn new(
        rig: &Rig,
        way: RigWay,
        params: &[FrameParams],
        general_params: CloudParams,
        options: &SmootherOptions,
    ) -> Result<Self, Error> {
        rig.validate()?;
        if params.len() != rig.cameras.len() {
            let value = params.len().to_string();
            return Err(ParamError { field: "params", value, allowed: "one per camera of the rig" }.into());
        }
        if way == RigWay::Merged && options.outputs.needs_camera() {
            let value = "depth".to_owned();
            return Err(ParamError { field: "outputs", value, allowed: "merged clouds have no depth" }.into());
        }
        if options.threads == Some(0) {
            return Err(ParamError { field: "threads", value: "0".into(), allowed: "1 or more" }.into());
        }
        let camera = |(camera, &params): (&RigCamera, &FrameParams)| {
            params.validate()?;
            Ok(CameraSmoother::new(camera.pose.transform()?, camera.camera, params))
        };
        let mut cameras: Vec<CameraSmoother> =
            rig.cameras.iter().zip(params).map(camera).collect::<Result<_, Error>>()?;
        let of_rig = cameras.len();
        for viewpoint in rig.viewpoints.iter().filter(|_| way == RigWay::Views) {
            let rig_from_camera = viewpoint.pose.transform()?;
            let from = |camera: &&CameraSmoother| {
                camera.rig_from_camera.translation.distance_squared(rig_from_camera.translation)
            };
            let nearest = cameras[..of_rig].iter().min_by(|a, b| from(a).total_cmp(&from(b)));
            let params = nearest.map(|camera| camera.params).unwrap_or_default();
            cameras.push(CameraSmoother::new(rig_from_camera, Some(viewpoint.camera), params));
        }
        general_params.validate()?;
        Ok(Self {
            way,
            options: options.clone(),
            devices: Vec::new(),
            failed: None,
            registration_m: DEFAULT_REGISTRATION_M,
            threads: Threads::open(options.threads)?,
            cameras,
            of_rig,
            tracks_cameras: false,
            general: General::new(general_params),
            engine: options.engine,
            flights: VecDeque::new(),
            time_s: None,
        })
    }

    /// Distributes the cameras over these devices: each camera goes to the device with the fewest pixels so far. With
    /// an empty list, the options' device smooths all cameras. The first device smooths merged clouds. If a device
    /// fails, smoothing returns an error; a [`RigStream`](super::RigStream) then continues without the device.
    pub fn with_devices(self, devices: Vec<FleetDevice>) -> Self {
        Self { devices, ..self }
    }

    /// Sets the maximum distance between two cameras' surfaces due to pose errors, in metres, for smoothing by views.
    pub fn with_registration_m(self, registration_m: f64) -> Self {
        Self { registration_m, ..self }
    }

    /// Thins merged points to one per voxel of this size in metres; `None` keeps all.
    ///
    /// A fused cloud ([`receive_fused`](Self::receive_fused)) then has one point per voxel: the centroid of the
    /// voxel's points, smoothed together with the other centroids, and the camera of the point nearest to the
    /// centroid. Each camera's points are moved onto the surface of the centroids (docs/method.md, section 13).
    pub fn with_voxel_m(self, voxel_m: Option<f64>) -> Self {
        Self { general: self.general.with_voxel_m(voxel_m), ..self }
    }

    /// Returns a handle that cancels the smoothing of all points as one cloud.
    pub(super) fn stopper(&self) -> Stopper {
        self.general.stopper()
    }

    /// Returns the engine in use.
    pub fn engine(&self) -> Engine {
        self.engine
    }

    /// Closes the engines and discards moments in flight. The next frames reopen the engines, or open `engine` if
    /// given.
    pub(super) fn close(&mut self, engine: Option<Engine>) {
        self.flights.clear();
        // Moments in flight are submitted again, but the filters over time may already include them.
        self.restart_videos();
        self.general.close();
        self.cameras.iter_mut().for_each(|camera| (camera.smoother, camera.device) = (None, None));
        if let Some(engine) = engine {
            self.options.engine = engine;
            self.devices.clear();
        }
    }

    /// Removes the failed device and moves its cameras to the other devices. Returns false if no device has failed or
    /// no other is left.
    pub(super) fn leave_failed_device(&mut self) -> bool {
        let Some(failed) = self.failed.take().filter(|_| self.devices.len() > 1) else { return false };
        self.devices.retain(|device| *device != failed);
        true
    }

    /// Smooths the frames of a moment, at most one per camera. Each result is in the coordinate frame of its camera's
    /// input points.
    ///
    /// # Errors
    /// If the engine fails; moments in flight are then lost, and the next frames reopen the engines. A frame that
    /// cannot be smoothed yields an error in its camera's result.
    pub fn smooth(&mut self, frames: &[Option<Frame<'_>>]) -> Result<RigResults, Error> {
        self.check_count(frames)?;
        let result = self.land_all().and_then(|()| self.smooth_now(frames));
        self.closed_by_error(result)
    }

    pub(super) fn smooth_now(&mut self, frames: &[Option<Frame<'_>>]) -> Result<RigResults, Error> {
        let results = match self.way {
            RigWay::Each => self.smooth_each(frames, self.outputs_in_space()),
            RigWay::Merged => self.smooth_merged(frames),
            RigWay::Views => self.smooth_views(frames),
        }?;
        self.over_time(frames, results)
    }

    pub(super) fn check_count(&self, frames: &[Option<Frame<'_>>]) -> Result<(), FrameError> {
        let (len, expected) = (frames.len(), self.of_rig);
        if len == expected {
            return Ok(());
        }
        Err(FrameError::LengthMismatch { what: "the frames of a rig".into(), len, expected })
    }

    /// Closes the engines after an error, since only some cameras' frames may be in flight.
    pub(super) fn closed_by_error<T>(&mut self, result: Result<T, Error>) -> Result<T, Error> {
        if result.is_err() {
            self.close(None);
        }
        result
    }

    /// Opens an engine for each camera with a frame, unless one is open for the frame's shape.
    pub(super) fn open_each(&mut self, frames: &[Option<Frame<'_>>], outputs: Outputs) -> Result<(), Error> {
        let is_open = |(camera, frame): (&CameraSmoother, &Option<Frame<'_>>)| {
            frame.is_none_or(|frame| camera.smoother.is_some() && camera.shape == frame.shape())
        };
        if self.cameras.iter().zip(frames).all(is_open) {
            return Ok(());
        }
        // Opening an engine closes the camera's previous engine, whose frames in flight would be lost.
        self.land_all()?;
        // All cameras share one thread pool.
        let options = self.options.clone().with_threads(None).with_outputs(outputs);
        for (i, frame) in frames.iter().enumerate() {
            let Some(frame) = *frame else { continue };
            if self.cameras[i].device.is_none() {
                self.cameras[i].device = self.least_loaded_device();
            }
            let opened = self.cameras[i].open(frame, &options);
            if opened.is_err() {
                self.failed = self.cameras[i].device.clone();
            }
            opened?;
        }
        // Engines differ only if the CPU is one of several devices.
        let mut engines = self.cameras.iter().filter_map(|camera| Some(camera.smoother.as_ref()?.engine()));
        let first = engines.clone().next().unwrap_or(self.engine);
        self.engine = engines.find(|&engine| engine == Engine::Gpu).unwrap_or(first);
        Ok(())
    }

    /// Returns the device whose cameras have the fewest pixels, if there are several.
    fn least_loaded_device(&self) -> Option<FleetDevice> {
        let pixels = |device: &FleetDevice| -> usize {
            let its = self.cameras.iter().filter(|camera| camera.device.as_ref() == Some(device));
            its.map(|camera| (camera.shape.0 * camera.shape.1).max(1)).sum()
        };
        self.devices.iter().min_by_key(|device| pixels(device)).cloned()
    }

    fn smooth_each(&mut self, frames: &[Option<Frame<'_>>], outputs: Outputs) -> Result<RigResults, Error> {
        self.open_each(frames, outputs)?;
        let Self { threads, cameras, engine, .. } = self;
        let results: Vec<Option<Result<Smoothed, Error>>> = if engine.capabilities().pipelined {
            let submit = |(camera, frame): (&mut CameraSmoother, &Option<Frame<'_>>)| {
                frame.map(|frame| camera.submit(frame, true))
            };
            let submitted: Vec<_> = cameras.iter_mut().zip(frames).map(submit).collect();
            let receive = |(camera, submitted): (&mut CameraSmoother, Option<Result<(), Error>>)| {
                submitted.map(|submitted| submitted.and_then(|()| camera.receive()).map(SmoothedView::into_smoothed))
            };
            cameras.iter_mut().zip(submitted).map(receive).collect()
        } else {
            let smooth =
                |(camera, frame): (&mut CameraSmoother, &Option<Frame<'_>>)| frame.map(|frame| camera.smooth(frame));
            threads.install(|| cameras.par_iter_mut().zip(frames).map(smooth).collect())
        };
        let failed = cameras
            .iter()
            .zip(&results)
            .find(|(_, result)| matches!(result, Some(Err(error)) if !matches!(error, Error::Frame(_))));
        self.failed = failed.and_then(|(camera, _)| camera.device.clone());
        results.into_iter().map(|result| result.map(by_fault).transpose()).collect()
    }

    fn smooth_views(&mut self, frames: &[Option<Frame<'_>>]) -> Result<RigResults, Error> {
        let outputs = self.outputs_in_space();
        let measured = self.cameras.par_iter_mut().zip(frames).map(|(camera, frame)| {
            let of =
                |frame: Frame<'_>| Measured::of(frame, camera.camera, camera.params.sensor, camera.rig_from_camera);
            frame.map(of)
        });
        let measured: Vec<Option<Result<Measured, FrameError>>> = self.threads.install(|| measured.collect());
        let (mut measured, mut refused): (Vec<Option<Measured>>, Vec<Option<FrameError>>) = measured
            .into_iter()
            .map(|result| match result {
                Some(Ok(measured)) => (Some(measured), None),
                Some(Err(error)) => (None, Some(error)),
                None => (None, None),
            })
            .unzip();
        if measured.iter().any(Option::is_some) {
            let added = self.cameras[self.of_rig..].iter().filter_map(CameraSmoother::measures_nothing);
            measured.extend(added.map(Some));
            refused.resize(measured.len(), None);
        }
        let view = |(i, of): (usize, &Option<Measured>)| Some(of.as_ref()?.view(i, &measured, self.registration_m));
        let views: Vec<Option<View>> = self.threads.install(|| measured.par_iter().enumerate().map(view).collect());
        let frames: Vec<Option<Frame<'_>>> = views
            .iter()
            .zip(&measured)
            .map(|(view, of)| view.as_ref().zip(of.as_ref()).map(|(view, of)| view.frame(of)).transpose())
            .collect::<Result<_, _>>()?;
        // Moving points onto tangent planes needs points and normals.
        let of_views = outputs.with_depth(false).with_depth_m(false).with_points(true).with_normals(true);
        let results = self.smooth_each(&frames, of_views)?;
        drop(frames);
        let mut smoothed = Vec::with_capacity(views.len());
        for ((view, result), refused) in views.into_iter().zip(results).zip(&mut refused) {
            smoothed.push(match (view, result) {
                (Some(view), Some(Ok(result))) => Some((view, result)),
                (_, Some(Err(error))) => {
                    *refused = Some(error);
                    None
                }
                _ => None,
            });
        }
        let back = |(i, of): (usize, &Option<Measured>)| of.as_ref()?.carried_back(i, &measured, &smoothed, outputs);
        let of_rig = measured[..self.of_rig].par_iter().enumerate();
        let back: Vec<Option<Smoothed>> = self.threads.install(|| of_rig.map(back).collect());
        Ok(back.into_iter().zip(refused).map(|(back, refused)| back.map(Ok).or(refused.map(Err))).collect())
    }
}

/// Returns an error of the engine as the outer result, and an error of the frame as the inner one.
fn by_fault(result: Result<Smoothed, Error>) -> Result<Result<Smoothed, FrameError>, Error> {
    match result {
        Ok(smoothed) => Ok(Ok(smoothed)),
        Err(Error::Frame(error)) => Ok(Err(error)),
        Err(error) => Err(error),
    }
}

impl CameraSmoother {
    fn new(rig_from_camera: RigidTransform, camera: Option<Camera>, params: FrameParams) -> Self {
        let (device, rays) = (None, Arc::default());
        Self { rig_from_camera, device, camera, rays, params, smoother: None, shape: (0, 0), video: None }
    }

    /// Creates the empty measurements of an added viewpoint.
    fn measures_nothing(&self) -> Option<Measured> {
        Some(Measured::nothing(self.camera?, self.params.sensor, self.rig_from_camera))
    }

    /// Opens the engine for the shape of this frame, unless it is already open for that shape.
    fn open(&mut self, frame: Frame<'_>, options: &SmootherOptions) -> Result<(), Error> {
        let shape = frame.shape();
        if self.smoother.is_some() && shape == self.shape {
            return Ok(());
        }
        let options = self.device.as_ref().map_or_else(|| options.clone(), |device| device.options(options));
        let mut smoother = Smoother::open_with(self.params.at_resolution_of(frame), &options, shape)?;
        smoother.prepare_in_flight();
        (self.shape, self.smoother) = (shape, Some(smoother));
        Ok(())
    }

    fn smooth(&mut self, frame: Frame<'_>) -> Result<Smoothed, Error> {
        let mut smoothed = Smoothed::default();
        self.opened()?.smooth(frame, &mut smoothed)?;
        Ok(smoothed)
    }

    pub(super) fn submit(&mut self, frame: Frame<'_>, is_copied: bool) -> Result<(), Error> {
        let smoother = self.opened()?;
        if is_copied { smoother.submit(frame, Smoothed::default()) } else { smoother.submit_in_place(frame) }
    }

    pub(super) fn receive(&mut self) -> Result<SmoothedView, Error> {
        self.opened()?.receive()?.ok_or_else(|| Self::not_open().into())
    }

    fn opened(&mut self) -> Result<&mut Smoother, Error> {
        self.smoother.as_mut().ok_or_else(|| Self::not_open().into())
    }

    /// Returns an error that cannot occur: every frame's smoother is opened before it is used.
    fn not_open() -> EngineError {
        EngineError::Unavailable { engine: "auto", reason: "the camera's smoother is not open".into() }
    }
}
