//! Options of a stream, and the session that it opens.

use std::time::Duration;

use planish_core::{
    CloudParams, Error, FleetDevice, FrameParams, Preparation, SensorChoice, SensorModel, Session, Settings,
    SmootherOptions,
};
use planish_io::Trajectory;

/// Options of a stream.
#[derive(Debug, Clone, Default)]
#[non_exhaustive]
pub struct StreamOptions {
    /// The parameters of the smoothing method.
    pub params: StreamParams,
    /// The engine and the outputs.
    pub smoother: SmootherOptions,
    /// The devices over which frames are distributed; if empty, the smoother options' device smooths all of them.
    pub devices: Vec<FleetDevice>,
    /// Maximum number of frames; `None` for no limit.
    pub max_frames: Option<u64>,
    /// Maximum duration; `None` for no limit.
    pub max_duration: Option<Duration>,
    /// Poses of the camera, by timestamp or frame number.
    pub poses: Option<Trajectory>,
}

/// The origin of a stream's parameters.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum StreamParams {
    /// User settings, resolved when the first frame arrives.
    Settings(Settings),
    /// Explicit parameters.
    Params(FrameParams),
}

impl Default for StreamParams {
    fn default() -> Self {
        Self::Settings(Settings::default())
    }
}

impl StreamOptions {
    /// Creates options with explicit parameters and no limits.
    pub fn new(params: FrameParams, smoother: SmootherOptions) -> Self {
        Self { params: StreamParams::Params(params), smoother, ..Self::default() }
    }

    /// Creates options from settings, without limits.
    ///
    /// # Errors
    /// If settings contradict each other or do not apply to frames on a grid, or if a device is missing.
    pub fn from_settings(settings: Settings) -> Result<Self, Error> {
        // Checked before anything is opened or written. The errors are the same for known and estimated sensors.
        let mut of_known_sensor = settings.clone();
        of_known_sensor.sensor = settings.known_sensor().map(SensorChoice::Known);
        of_known_sensor.frame_params()?;
        // These steps need the sensor's noise before there is a frame from which to estimate it.
        if settings.remove_floating == Some(true) || settings.decimate.is_some() {
            settings.frame_params()?;
        }
        let (smoother, devices) = (settings.options(), settings.devices()?);
        Ok(Self { params: StreamParams::Settings(settings), smoother, devices, ..Self::default() })
    }

    /// Sets the engine and the outputs.
    pub fn with_smoother(self, smoother: SmootherOptions) -> Self {
        Self { smoother, ..self }
    }

    /// Returns the steps before smoothing and the sensor whose noise they need; `None` if there are no steps.
    pub(super) fn preparation(&self) -> Option<(Preparation, SensorModel)> {
        match &self.params {
            StreamParams::Settings(settings) => {
                let steps = Some(settings.preparation()).filter(|steps| !steps.is_empty())?;
                Some((steps, settings.known_sensor().unwrap_or_default()))
            }
            StreamParams::Params(_) => None,
        }
    }

    pub(super) fn is_over_time(&self) -> bool {
        matches!(&self.params, StreamParams::Settings(settings) if settings.temporal_params().is_some())
    }

    pub(super) fn session(&self, is_live: bool) -> Result<Session, Error> {
        let session = match &self.params {
            StreamParams::Settings(settings) => Session::new(settings.clone())?.with_devices(self.devices.clone()),
            StreamParams::Params(params) => {
                Session::with_params(*params, CloudParams::default(), self.smoother.clone(), self.devices.clone())?
            }
        };
        let mut session = session.with_options(self.smoother.clone());
        // Flags pixels that were filled or, in depth images, carried over time.
        let outputs = session.outputs();
        let flags = session
            .settings()
            .is_some_and(|settings| settings.fill.is_some() || (settings.flags_origins() && outputs.needs_camera()));
        session.set_outputs(outputs.with_status(outputs.status || flags));
        let session = session.with_live(is_live).with_kept_window(true).with_kept_sensor(true);
        Ok(session.with_cloud_estimates(false))
    }

    /// Distributes frames over these devices; if the list is empty, the options' device smooths all frames.
    pub fn with_devices(self, devices: Vec<FleetDevice>) -> Self {
        Self { devices, ..self }
    }

    /// Sets the maximum number of frames.
    pub fn with_max_frames(self, max_frames: Option<u64>) -> Self {
        Self { max_frames, ..self }
    }

    /// Sets the camera's poses, with which frames of a moving camera can be smoothed over time.
    pub fn with_poses(self, poses: Option<Trajectory>) -> Self {
        Self { poses, ..self }
    }

    /// Sets the maximum duration.
    pub fn with_max_duration(self, max_duration: Option<Duration>) -> Self {
        Self { max_duration, ..self }
    }
}
