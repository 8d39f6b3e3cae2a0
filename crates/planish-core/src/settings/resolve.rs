//! Resolution of settings into parameters, for a frame, for a sensor, or for clouds.

use super::{Preset, RadiusChoice, Resolved, SensorChoice, Settings};
use crate::cpu::{CloudEstimate, Decided};
use crate::error::ParamError;
use crate::frame::Frame;
use crate::params::{CloudParams, CloudRadius, Fit, FrameParams, FrameRadius, Strength};
use crate::preparation::Preparation;
use crate::sensor::SensorModel;
use crate::threads::{ONE_THREAD, Threads};

impl Settings {
    /// Resolves the settings into parameters for a frame on a grid or for an unorganized cloud. The sensor is
    /// estimated from the frame if requested. If the settings give no number of neighbours, it is estimated from the
    /// cloud, together with the edge handling and the need for a first pass.
    ///
    /// # Errors
    /// If settings contradict each other or the input, or the sensor cannot be estimated from this frame.
    pub fn resolve(&self, frame: Frame<'_>) -> Result<Resolved, ParamError> {
        self.resolve_on(frame, self.threads)
    }

    /// Same as [`resolve`](Self::resolve), but does not recognize the sensor of an unorganized cloud, whose
    /// neighbourhoods may be too wide for tiles.
    ///
    /// # Errors
    /// Same as [`resolve`](Self::resolve).
    pub fn resolve_by_density(&self, frame: Frame<'_>) -> Result<Resolved, ParamError> {
        self.resolve_frame(frame, self.threads, false)
    }

    /// Same as [`resolve`](Self::resolve), but estimates with `threads` threads.
    pub(crate) fn resolve_on(&self, frame: Frame<'_>, threads: Option<usize>) -> Result<Resolved, ParamError> {
        // WebAssembly builds recognize no sensor, to stay small.
        self.resolve_frame(frame, threads, !ONE_THREAD)
    }

    fn resolve_frame(
        &self,
        frame: Frame<'_>,
        threads: Option<usize>,
        recognizes: bool,
    ) -> Result<Resolved, ParamError> {
        self.validate()?;
        if frame.grid().is_none() {
            if let (Frame::Points(cloud), Some(_)) = (frame, self.sensor_of_clouds()) {
                self.check_sensor_position(cloud.assumed_sensor_m())?;
            }
            let to_estimate = match frame {
                Frame::Points(cloud) if self.chooses_neighbours() => Some(cloud),
                _ => None,
            };
            let unused = self.unused_by_clouds();
            let recognized_sensor = to_estimate.as_ref().filter(|_| recognizes).and_then(SensorModel::recognize);
            if let Some(sensor) = recognized_sensor {
                let settings = Self { sensor: Some(SensorChoice::Known(sensor)), ..self.clone() };
                let (params, first_pass) = (settings.cloud_params()?.into(), settings.first_pass(None));
                return Ok(Resolved { first_pass, recognized_sensor, unused, ..Resolved::of(params) });
            }
            let cloud_estimate = match to_estimate {
                Some(cloud) => {
                    let refused = |_| {
                        let value = threads.map_or(String::new(), |threads| threads.to_string());
                        ParamError { field: "threads", value, allowed: "a number of threads that the system can start" }
                    };
                    let decided = Decided { edges: self.edges, passes: self.passes };
                    // Shared threads do not survive a fork.
                    Threads::open(threads).map_err(refused)?.install(|| CloudEstimate::with(&cloud, decided))
                }
                None => None,
            };
            let params = self.cloud_params_by(cloud_estimate)?.into();
            let first_pass = self.first_pass(cloud_estimate);
            return Ok(Resolved { first_pass, cloud_estimate, unused, ..Resolved::of(params) });
        }
        let sensor = self.known_sensor().or_else(|| SensorModel::estimate_from(frame)).ok_or_else(|| {
            let allowed = "a named sensor such as kinect1, since this frame has too few depths for an estimate";
            ParamError { field: "sensor", value: "auto".into(), allowed }
        })?;
        let params = self.checked_frame_params(sensor)?.into();
        let preparation_sensor = Some(sensor).filter(|_| !self.preparation().is_empty());
        let unused = self.unused_by_frames();
        Ok(Resolved { preparation_sensor, unused, ..Resolved::of(params) })
    }

    /// Returns the parameters for frames of the named sensor without examining a frame.
    ///
    /// # Errors
    /// If settings contradict each other, or the sensor is to be estimated.
    pub fn frame_params(&self) -> Result<FrameParams, ParamError> {
        self.validate()?;
        let sensor = self.known_sensor().ok_or_else(|| {
            let allowed = "a named sensor, since no frame is available for an estimate (`planish info` reports the \
                           nearest sensor of a frame)";
            ParamError { field: "sensor", value: "auto".into(), allowed }
        })?;
        self.checked_frame_params(sensor)
    }

    /// Refuses a sensor for an unorganized cloud whose sensor position is `assumed_m` because it is unknown: noise
    /// grows with the distance from the sensor.
    pub fn check_sensor_position(&self, assumed_m: Option<[f64; 3]>) -> Result<(), ParamError> {
        let (Some(sensor), Some(_)) = (self.sensor_of_clouds(), assumed_m) else { return Ok(()) };
        let value = sensor.name().map_or_else(|| format!("{sensor:?}"), str::to_owned);
        let allowed = "only for clouds that state the sensor's pose or have it at the origin, since noise grows with \
                       the range";
        Err(ParamError { field: "sensor", value, allowed })
    }

    /// Returns the parameters for unorganized clouds, which have no pixels, without examining a cloud.
    ///
    /// # Errors
    /// If settings contradict each other, or apply only to frames on a grid.
    pub fn cloud_params(&self) -> Result<CloudParams, ParamError> {
        self.cloud_params_by(None)
    }

    /// Returns the parameters for a cloud with this estimate. The preset `light` halves the estimated number of
    /// neighbours, and `strong` doubles it.
    ///
    /// # Errors
    /// Same as [`cloud_params`](Self::cloud_params).
    pub fn cloud_params_by(&self, estimate: Option<CloudEstimate>) -> Result<CloudParams, ParamError> {
        self.validate()?;
        self.check_for_clouds()?;
        let params = self.cloud_params_unchecked();
        let CloudRadius::Neighbours { count } = params.radius else { return Ok(params) };
        if !self.chooses_neighbours() {
            return Ok(params);
        }
        let strength = self.any_strength()?.unwrap_or(Strength::DEFAULT);
        let edges = self.edges.or(estimate.map(|estimate| estimate.edges)).unwrap_or(params.fit.edges);
        let params = params.with_edges(edges);
        let count = estimate.map_or(count, |estimate| estimate.neighbours) as f32 * (2.0 * strength.get() - 1.0).exp2();
        Ok(params.with_neighbours((count.round() as u32).clamp(6, 1000)))
    }

    /// Returns the parameters of the first pass over a cloud with this estimate; `None` for a single pass.
    pub fn first_pass(&self, estimate: Option<CloudEstimate>) -> Option<CloudParams> {
        let estimated = estimate.and_then(|estimate| estimate.first_neighbours);
        let neighbours = match self.passes {
            None => estimated,
            Some(passes) => Some(CloudEstimate::FIRST_NEIGHBOURS).filter(|_| passes > 1),
        };
        neighbours.map(|count| CloudParams::default().with_neighbours(count))
    }

    /// Returns `preset`, overridden by these settings.
    ///
    /// # Errors
    /// Same as [`cloud_params`](Self::cloud_params).
    pub fn override_cloud(&self, preset: CloudParams) -> Result<CloudParams, ParamError> {
        Self { sensor: None, ..self.clone() }.cloud_params()?;
        Ok(self.overridden_cloud(preset))
    }

    fn check_for_clouds(&self) -> Result<(), ParamError> {
        if self.radius == Some(RadiusChoice::Sensor) && self.sensor_of_clouds().is_none() {
            let allowed = "neighbours, a radius in metres or a named sensor for unorganized clouds";
            return Err(ParamError { field: "radius_m", value: "sensor".into(), allowed });
        }
        let allowed = "only for frames on a grid, since it needs the pixels around each point";
        if self.remove_floating == Some(true) {
            return Err(ParamError { field: "remove_floating", value: "true".into(), allowed });
        }
        if ONE_THREAD {
            return Ok(());
        }
        let Preparation { min_range_m, max_range_m, decimate, .. } = self.preparation();
        let given = [
            ("min_range_m", min_range_m.map(|range_m| range_m.to_string())),
            ("max_range_m", max_range_m.map(|range_m| range_m.to_string())),
            ("decimate", decimate.map(|k| k.to_string())),
            ("fill", self.fill.map(|width_px| width_px.to_string())),
        ];
        match given.into_iter().find_map(|(field, value)| Some((field, value?))) {
            Some((field, value)) => Err(ParamError { field, value, allowed }),
            None => Ok(()),
        }
    }

    fn checked_frame_params(&self, sensor: SensorModel) -> Result<FrameParams, ParamError> {
        if let Some(count) = self.neighbours {
            let allowed = "a radius for frames on a grid; neighbours apply to unorganized clouds";
            return Err(ParamError { field: "neighbours", value: count.to_string(), allowed });
        }
        self.frame_params_for(sensor)
    }

    pub(super) fn frame_params_for(&self, sensor: SensorModel) -> Result<FrameParams, ParamError> {
        let mut params = match self.any_strength()? {
            Some(strength) => FrameParams::for_sensor(sensor, strength),
            None => FrameParams::paper().with_sensor(sensor),
        };
        if let Some(window) = self.window {
            params = params.with_window(window);
        }
        if let Some(stride) = self.stride {
            params = params.with_stride(stride);
        }
        params.average_blocks = self.average_blocks.unwrap_or(params.average_blocks);
        params.radius = match self.radius {
            None => params.radius,
            Some(RadiusChoice::Sensor) => FrameRadius::Sensor,
            Some(RadiusChoice::Metres(radius_m)) => FrameRadius::Fixed { radius_m },
        };
        params.fit = self.override_fit(params.fit);
        params.project = self.project.unwrap_or(params.project);
        Ok(params)
    }

    /// Returns the given strength, or the preset's; `None` for the paper preset.
    fn any_strength(&self) -> Result<Option<Strength>, ParamError> {
        Ok(match (self.given_strength()?, self.preset) {
            (Some(strength), _) => Some(strength),
            (None, None | Some(Preset::Default)) => Some(Strength::DEFAULT),
            (None, Some(Preset::Light)) => Some(Strength::LIGHT),
            (None, Some(Preset::Strong)) => Some(Strength::STRONG),
            (None, Some(Preset::Paper)) => None,
        })
    }

    pub(super) fn cloud_params_unchecked(&self) -> CloudParams {
        let strength = self.any_strength().ok().flatten().unwrap_or_default();
        self.overridden_cloud(match (self.preset, self.sensor_of_clouds()) {
            (Some(Preset::Paper), _) => CloudParams::paper(),
            (_, Some(sensor)) => CloudParams::for_sensor(sensor, strength),
            _ => CloudParams::default(),
        })
    }

    fn overridden_cloud(&self, mut params: CloudParams) -> CloudParams {
        params.fit = self.override_fit(params.fit);
        if let Some(RadiusChoice::Metres(radius_m)) = self.radius {
            params.radius = CloudRadius::Fixed { radius_m };
        }
        if let Some(count) = self.neighbours {
            params.radius = CloudRadius::Neighbours { count };
        }
        params.remove_isolated = self.remove_isolated.unwrap_or(params.remove_isolated);
        params
    }

    fn override_fit(&self, fit: Fit) -> Fit {
        Fit {
            degree: self.degree.unwrap_or(fit.degree),
            bandwidth_m: self.bandwidth_m.or(fit.bandwidth_m),
            ridge: self.ridge.unwrap_or(fit.ridge),
            edges: self.edges.unwrap_or(fit.edges),
        }
    }
}
