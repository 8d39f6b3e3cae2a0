//! Options of a rig stream.

use std::time::Duration;

use super::{Rig, RigWay};
use planish_core::{
    CloudParams, CloudRadius, FleetDevice, FrameParams, ParamError, Preparation, SensorChoice, Settings,
    SmootherOptions, TemporalParams,
};

/// Minimum voxel size in metres, finer than any depth camera resolves.
const SMALLEST_VOXEL_M: f64 = 1e-4;

/// Minimum radius in voxels; with a smaller one, most points have no neighbours.
const LEAST_VOXELS_IN_RADIUS: f64 = 1.999;

/// Options of a rig stream.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct RigOptions {
    /// Method for smoothing the frames of a moment.
    pub way: RigWay,
    /// Parameters for each camera's frames, one set per camera.
    pub params: Vec<FrameParams>,
    /// Parameters for the points of all cameras as one cloud.
    pub general_params: CloudParams,
    /// For views: maximum distance between two cameras' surfaces due to pose errors, in metres, 0 to 0.1.
    pub registration_m: f64,
    /// For merged points: voxel size in metres for thinning; `None` keeps all points.
    pub voxel_m: Option<f64>,
    /// The engine and the outputs.
    pub smoother: SmootherOptions,
    /// The devices that share the cameras; if empty, the smoother options' device smooths all of them.
    pub devices: Vec<FleetDevice>,
    /// Preparation steps for each camera's frames before smoothing.
    pub preparation: Preparation,
    /// Parameters for smoothing each camera's results over time; `None` disables it.
    pub temporal: Option<TemporalParams>,
    /// Whether smoothing over time estimates the motion of each camera.
    pub tracks_cameras: bool,
    /// Maximum number of moments; `None` for no limit.
    pub max_moments: Option<u64>,
    /// Maximum duration; `None` for no limit.
    pub max_duration: Option<Duration>,
}

impl RigOptions {
    /// Creates options with default parameters for each camera's sensor and for merged points.
    pub fn new(rig: &Rig, way: RigWay, smoother: SmootherOptions) -> Self {
        let params = |camera: &super::RigCamera| {
            FrameParams::for_sensor(camera.sensor.unwrap_or_default(), planish_core::Strength::default())
        };
        Self {
            way,
            params: rig.cameras.iter().map(params).collect(),
            general_params: super::merged_params(),
            registration_m: super::DEFAULT_REGISTRATION_M,
            voxel_m: None,
            smoother,
            devices: Vec::new(),
            preparation: Preparation::default(),
            temporal: None,
            tracks_cameras: false,
            max_moments: None,
            max_duration: None,
        }
    }

    /// Creates options from settings. Each camera uses the sensor of the settings or, if they name none, its sensor
    /// in the rig. The merged cloud uses the parameters for merged points ([`merged_params`](super::merged_params),
    /// or [`merged_params_in_voxels`](super::merged_params_in_voxels) if `voxel_m` is given), overridden by the
    /// settings.
    ///
    /// # Errors
    /// If settings contradict each other or set `fill`, a sensor is to be estimated, or a device is missing.
    pub fn from_settings(
        rig: &Rig,
        way: RigWay,
        settings: &Settings,
        voxel_m: Option<f64>,
    ) -> Result<Self, planish_core::Error> {
        if let Some(width_px) = settings.fill {
            let allowed = "available only for single cameras";
            return Err(ParamError { field: "fill", value: width_px.to_string(), allowed }.into());
        }
        let of_camera = |camera: &super::RigCamera| {
            let mut settings = settings.clone();
            settings.sensor = settings.sensor.or(camera.sensor.map(SensorChoice::Known));
            settings.frame_params()
        };
        let params = rig.cameras.iter().map(of_camera).collect::<Result<Vec<_>, _>>()?;
        let merged = voxel_m.map_or_else(super::merged_params, super::merged_params_in_voxels);
        // Preparation applies to each camera's frames, not to the merged cloud.
        let mut of_points = settings.clone();
        (of_points.remove_floating, of_points.decimate) = (None, None);
        (of_points.min_range_m, of_points.max_range_m) = (None, None);
        let general_params = of_points.override_cloud(merged)?;
        let options = Self::new(rig, way, settings.options()).with_params(params, general_params);
        let options = options
            .with_preparation(settings.preparation())
            .with_temporal(settings.temporal_params(), settings.tracks_camera());
        Ok(options.with_devices(settings.devices()?).with_voxel_m(voxel_m))
    }

    /// Refuses options that contradict each other. [`RigStream::run`](super::RigStream::run) calls this first.
    ///
    /// # Errors
    /// If `registration_m` is outside 0 to 0.1, `temporal` is invalid or used with voxels, or the outputs include
    /// sigma; or if `voxel_m` is below 0.1 mm, above half a fixed radius, or set for a method other than
    /// [`RigWay::Merged`].
    pub fn validate(&self) -> Result<(), ParamError> {
        if !(0.0..=0.1).contains(&self.registration_m) {
            let value = self.registration_m.to_string();
            return Err(ParamError { field: "registration_m", value, allowed: "0 to 0.1 m" });
        }
        if let Some(temporal) = &self.temporal {
            temporal.validate()?;
        }
        if self.smoother.outputs.sigma {
            return Err(ParamError {
                field: "outputs",
                value: "sigma".into(),
                allowed: "available only for single cameras",
            });
        }
        let Some(size_m) = self.voxel_m else { return Ok(()) };
        if self.temporal.is_some() {
            let allowed = "must be off with voxels, which differ from moment to moment";
            return Err(ParamError { field: "temporal", value: "steady".to_owned(), allowed });
        }
        if self.way != RigWay::Merged {
            let (value, allowed) = (self.way.name().to_owned(), "voxels apply only to merged");
            return Err(ParamError { field: "way", value, allowed });
        }
        if !(size_m >= SMALLEST_VOXEL_M && size_m.is_finite()) {
            let (value, allowed) = (format!("{size_m:?}"), "a size in metres, at least 0.0001");
            return Err(ParamError { field: "voxel", value, allowed });
        }
        if let CloudRadius::Fixed { radius_m } = self.general_params.radius
            && f64::from(radius_m) < LEAST_VOXELS_IN_RADIUS * size_m
        {
            let (value, allowed) = (radius_m.to_string(), "at least two voxels, so that points have neighbours");
            return Err(ParamError { field: "radius", value, allowed });
        }
        Ok(())
    }

    /// Sets the parameters: one set per camera, and one for the merged cloud.
    pub fn with_params(self, params: Vec<FrameParams>, general_params: CloudParams) -> Self {
        Self { params, general_params, ..self }
    }

    /// Sets the preparation steps before smoothing.
    pub fn with_preparation(self, preparation: Preparation) -> Self {
        Self { preparation, ..self }
    }

    /// Sets how each camera's results are smoothed over time, and whether each camera's motion is estimated
    /// ([`RigSmoother::with_temporal`](super::RigSmoother::with_temporal)).
    pub fn with_temporal(self, temporal: Option<TemporalParams>, tracks_cameras: bool) -> Self {
        Self { temporal, tracks_cameras, ..self }
    }

    /// Sets the maximum distance between two cameras' surfaces due to pose errors, in metres.
    pub fn with_registration_m(self, registration_m: f64) -> Self {
        Self { registration_m, ..self }
    }

    /// Sets the voxel size in metres for thinning merged points
    /// ([`RigSmoother::with_voxel_m`](super::RigSmoother::with_voxel_m)); `None` keeps all points. The parameters
    /// should match the size ([`merged_params_in_voxels`](super::merged_params_in_voxels)).
    pub fn with_voxel_m(self, voxel_m: Option<f64>) -> Self {
        Self { voxel_m, ..self }
    }

    /// Distributes cameras over these devices; if the list is empty, the options' device smooths all cameras.
    pub fn with_devices(self, devices: Vec<FleetDevice>) -> Self {
        Self { devices, ..self }
    }

    /// Sets the maximum number of moments.
    pub fn with_max_moments(self, max_moments: Option<u64>) -> Self {
        Self { max_moments, ..self }
    }

    /// Sets the maximum duration.
    pub fn with_max_duration(self, max_duration: Option<Duration>) -> Self {
        Self { max_duration, ..self }
    }
}
