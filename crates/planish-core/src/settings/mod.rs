//! The user's settings as data, and their resolution into parameters.
//!
//! Every front end (command line, Python, ROS node, browser, experiments) only fills in a [`Settings`], so the same
//! JSON or YAML works in each. Values by name are set only through [`Settings::set`], so a field has the same name,
//! range and error everywhere.

mod choices;
mod merge;
mod resolve;
#[cfg(feature = "serde")]
mod serialize;
mod suggest;
mod unused;
mod value;
mod video;

use std::str::FromStr;

use crate::cpu::CloudEstimate;
use crate::devices::GpuOptions;
use crate::engines::{Engine, SmootherOptions};
use crate::error::ParamError;
use crate::fill::check_width;
use crate::fleet::FleetDevice;
use crate::outputs::Outputs;
use crate::params::{CloudParams, Edges, Params, Project, Strength};
use crate::preparation::Preparation;
use crate::sensor::SensorModel;
use crate::threads::ONE_THREAD;

pub use choices::{GridChoice, Preset, RadiusChoice, SensorChoice, TemporalChoice};
pub use value::SettingValue;
use value::quoted;

/// The user's settings. A field that is `None` has the value of the preset, or its default.
///
/// ```
/// use planish::{Camera, DepthFrame, IntoFrame, Params, Settings};
///
/// let settings: Settings = "preset=strong edges=off".parse()?;
/// let frame = DepthFrame::new(Camera::kinect_v1(), vec![1500; 640 * 480]).unwrap();
/// let resolved = settings.resolve((&frame).into_frame().unwrap())?;
/// assert!(matches!(resolved.params, Params::Frame(_)));
///
/// let error = "strength=1.5".parse::<Settings>().unwrap_err();
/// assert_eq!(error.to_string(), "strength = 1.5 is not allowed: 0 (light) to 1 (strong)");
/// # Ok::<(), planish::ParamError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub struct Settings {
    /// A named set of parameters, which the other fields override.
    pub preset: Option<Preset>,
    /// Strength of smoothing, 0 (light) to 1 (strong), instead of a preset.
    pub strength: Option<f32>,
    /// The sensor that took the frames [default: Kinect v1] or the points of an unorganized cloud, which is in the
    /// sensor's frame or states its pose [default: none, or Kinect v1 if its depth steps are recognized].
    pub sensor: Option<SensorChoice>,
    /// Edge handling [default: robust for frames and for clouds of a known sensor; for other clouds chosen by their
    /// shape, or off if a radius or a number of neighbours is given].
    pub edges: Option<Edges>,
    /// Whether pixels that float between two surfaces become holes before smoothing [default: no].
    pub remove_floating: Option<bool>,
    /// Minimum range of a frame's pixels in metres; nearer pixels become holes before smoothing.
    pub min_range_m: Option<f32>,
    /// Maximum range of a frame's pixels in metres; farther pixels become holes before smoothing.
    pub max_range_m: Option<f32>,
    /// Side in pixels of the blocks that become one pixel each before smoothing, 2 to 8.
    pub decimate: Option<u32>,
    /// Maximum width in pixels, 1 to 64, of holes that are filled with the surface around them and flagged [default:
    /// none]. Only for frames of a camera.
    pub fill: Option<u32>,
    /// Whether isolated points of unorganized clouds become holes [default: no].
    pub remove_isolated: Option<bool>,
    /// Half-width of the window in samples, 1 to 7. If neither window nor stride is given, both follow the frame's
    /// resolution.
    pub window: Option<u32>,
    /// Distance between samples in pixels, 1 to 8.
    pub stride: Option<u32>,
    /// Whether samples are means of blocks of pixels.
    pub average_blocks: Option<bool>,
    /// The radius of a neighbourhood.
    pub radius: Option<RadiusChoice>,
    /// Number of neighbours of a point in an unorganized cloud, 6 to 1000, instead of a radius [default: chosen by
    /// the cloud's noise and shape, or by the range if the sensor is known].
    pub neighbours: Option<u32>,
    /// Number of passes over an unorganized cloud, 1 or 2. The first of two passes uses 20 neighbours, which helps if
    /// the noise exceeds half the spacing of the points [default: chosen from the noise; 1 if a radius or a number of
    /// neighbours is given or the sensor is known].
    pub passes: Option<u32>,
    /// Reconstruction of a frame's pixel grid from an unorganized cloud [default: auto].
    pub grid: Option<GridChoice>,
    /// Whether the points of an unorganized cloud move along the smoothed surface until they are evenly spaced, by up
    /// to 1.5 standard deviations of the noise [default: no]. Not for frames in flight, files smoothed in tiles, or
    /// WebAssembly. Normals and curvature are not recomputed.
    pub even: Option<bool>,
    /// Smoothing over time for the video of one camera, in the order in which the session receives the frames [default:
    /// off]. The camera must be stationary, or its motion tracked or given. Not for unorganized clouds, rigs or
    /// WebAssembly.
    pub temporal: Option<TemporalChoice>,
    /// Whether the motion of the camera is estimated from frame to frame and compensated [default: no]. Enables
    /// smoothing over time. Needs the camera's intrinsics, which must be given unless they follow from organized
    /// points.
    pub track: Option<bool>,
    /// Degree of the surface, 1 to 3.
    pub degree: Option<u32>,
    /// Bandwidth of the Gaussian weights in metres [default: the radius].
    pub bandwidth_m: Option<f32>,
    /// Ridge of the fit, 1e-3 to 100.
    pub ridge: Option<f32>,
    /// Direction in which points move. Only for frames.
    pub project: Option<Project>,
    /// The engine [default: auto].
    pub engine: Option<Engine>,
    /// The GPU, selected by its index or part of its name; requires the engine gpu [default: the first real GPU].
    pub adapter: Option<String>,
    /// The devices that share the frames, as a comma-separated list of `all` (every real GPU), `cpu`, and GPUs by
    /// index or part of their name.
    pub devices: Option<String>,
    /// Number of threads of the CPU engines [default: one per core].
    pub threads: Option<usize>,
    /// The results to compute [default: points].
    pub outputs: Option<Outputs>,
}

/// Parameters to which the settings resolve for one kind of input.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Resolved {
    /// The parameters.
    pub params: Params,
    /// The sensor whose noise model is used by the steps before smoothing ([`Settings::preparation`]); `None` if no
    /// such step is set.
    pub preparation_sensor: Option<SensorModel>,
    /// The parameters of the first of two passes over an unorganized cloud; `None` for a single pass.
    pub first_pass: Option<CloudParams>,
    /// The sensor that was recognized by the depth steps of an unorganized cloud, and by whose noise the cloud is
    /// smoothed ([`SensorModel::recognize`]); `None` if the settings give a sensor, a radius or a number of neighbours.
    pub recognized_sensor: Option<SensorModel>,
    /// The estimate for an unorganized cloud; `None` if the number of neighbours does not follow from an estimate.
    pub cloud_estimate: Option<CloudEstimate>,
    /// Names of the given settings that have no effect on this kind of input.
    pub unused: Vec<&'static str>,
}

impl Resolved {
    fn of(params: Params) -> Self {
        let (preparation_sensor, first_pass, recognized_sensor, cloud_estimate, unused) = Default::default();
        Self { params, preparation_sensor, first_pass, recognized_sensor, cloud_estimate, unused }
    }
}

/// The allowed values of the setting `sensor`, for error messages.
const SENSORS: &str =
    "kinect1, d415, d435, d455, azure-kinect, l515, iphone, exact, auto or an object of step and sigma";
const OUTPUTS: &str = if ONE_THREAD {
    "a list of points, depth, depth_m, normals, curvature, status, neighbours"
} else {
    "a list of points, depth, depth_m, normals, curvature, status, neighbours, frames, sigma"
};
const PASSES: &str = "1 or 2";
/// The names of all settings, for error messages. WebAssembly builds support fewer settings.
const FIELDS: &str = if ONE_THREAD {
    "preset, strength, sensor, edges, remove_floating, remove_isolated, window, stride, average_blocks, radius_m, \
     neighbours, passes, grid, degree, bandwidth_m, ridge, project, engine, threads, outputs"
} else {
    "preset, strength, sensor, edges, remove_floating, min_range_m, max_range_m, decimate, fill, remove_isolated, \
     window, stride, average_blocks, radius_m, neighbours, passes, grid, even, temporal, track, degree, bandwidth_m, \
     ridge, project, engine, adapter, devices, threads, outputs"
};

impl Settings {
    /// The names of all fields in [`set`](Self::set) and in files.
    pub const NAMES: [&'static str; 29] = [
        "preset",
        "strength",
        "sensor",
        "edges",
        "remove_floating",
        "min_range_m",
        "max_range_m",
        "decimate",
        "fill",
        "remove_isolated",
        "window",
        "stride",
        "average_blocks",
        "radius_m",
        "neighbours",
        "passes",
        "grid",
        "even",
        "temporal",
        "track",
        "degree",
        "bandwidth_m",
        "ridge",
        "project",
        "engine",
        "adapter",
        "devices",
        "threads",
        "outputs",
    ];

    /// Sets a field by its name; `radius` and `bandwidth` are accepted for `radius_m` and `bandwidth_m`. A value of
    /// [`SettingValue::None`] clears the field.
    ///
    /// # Errors
    /// If the name is unknown, or the value is invalid or outside its range.
    pub fn set(&mut self, name: &str, value: impl Into<SettingValue>) -> Result<(), ParamError> {
        let value = value.into();
        match name {
            "preset" => self.preset = value.named("preset", &Preset::NAMED, "light, default, strong or paper")?,
            "strength" => self.strength = value.number("strength", "0 (light) to 1 (strong)")?,
            "sensor" => self.sensor = sensor_of(value)?,
            "edges" => self.edges = edges_of(&value)?,
            "remove_floating" => self.remove_floating = value.truth("remove_floating")?,
            // WebAssembly builds omit these settings.
            "min_range_m" if !ONE_THREAD => {
                self.min_range_m = value.number("min_range_m", "a range in metres, 0 or more")?
            }
            "max_range_m" if !ONE_THREAD => {
                self.max_range_m = value.number("max_range_m", "a range in metres, 0 or more")?
            }
            "decimate" if !ONE_THREAD => self.decimate = value.whole("decimate", "2 to 8")?,
            "fill" if !ONE_THREAD => self.fill = value.whole("fill", "1 to 64 pixels")?,
            "remove_isolated" => self.remove_isolated = value.truth("remove_isolated")?,
            "window" => self.window = value.whole("window", "1 to 7")?,
            "stride" => self.stride = value.whole("stride", "1 to 8")?,
            "average_blocks" => self.average_blocks = value.truth("average_blocks")?,
            "radius_m" | "radius" => self.radius = radius_of(value)?,
            "neighbours" => self.neighbours = value.whole("neighbours", "6 to 1000")?,
            "passes" => self.passes = value.whole("passes", PASSES)?,
            "grid" => self.grid = value.named("grid", &GridChoice::NAMED, "auto or off")?,
            "even" => self.even = value.truth("even")?,
            "temporal" => self.temporal = value.named("temporal", &TemporalChoice::NAMED, "off or steady")?,
            "track" => self.track = value.truth("track")?,
            "degree" => self.degree = value.whole("degree", "1 to 3")?,
            "bandwidth_m" | "bandwidth" => {
                self.bandwidth_m = value.number("bandwidth_m", "1e-6 to 1000 metres")?;
            }
            "ridge" => self.ridge = value.number("ridge", "1e-3 to 100")?,
            "project" => self.project = value.named("project", &Project::NAMED, "ray or normal")?,
            "engine" => self.engine = value.named("engine", &Engine::NAMED, "auto, cpu, gpu or reference")?,
            "adapter" => self.adapter = value.text(),
            "devices" => self.devices = value.text(),
            "threads" => self.threads = value.whole("threads", "1 or more")?.map(|threads| threads as usize),
            "outputs" => self.outputs = outputs_of(value)?,
            _ => {
                let suggestion = suggest::closest(name, &Self::NAMES);
                let suggestion = suggestion.map_or(String::new(), |meant| format!(" (did you mean {meant}?)"));
                return Err(ParamError { field: "settings", value: quoted(name) + &suggestion, allowed: FIELDS });
            }
        }
        self.check_ranges()
    }

    /// Refuses values outside their ranges, and settings that contradict each other.
    pub fn validate(&self) -> Result<(), ParamError> {
        self.check_ranges()?;
        let contradiction = |field, value: &str, allowed| Err(ParamError { field, value: value.to_owned(), allowed });
        if self.preset.is_some() && self.strength.is_some() {
            return contradiction(
                "strength",
                &self.strength.map(|strength| strength.to_string()).unwrap_or_default(),
                "set either preset or strength",
            );
        }
        if self.radius.is_some() && self.neighbours.is_some() {
            return contradiction(
                "neighbours",
                &self.neighbours.map(|neighbours| neighbours.to_string()).unwrap_or_default(),
                "set either radius_m or neighbours",
            );
        }
        if ONE_THREAD && self.even == Some(true) {
            return contradiction("even", "true", "not available in the browser");
        }
        if !ONE_THREAD && self.tracks_camera() && self.temporal == Some(TemporalChoice::Off) {
            return contradiction("track", "true", "only with temporal=steady");
        }
        if ONE_THREAD && (self.temporal == Some(TemporalChoice::Steady) || self.tracks_camera()) {
            return contradiction("temporal", "steady", "not available in the browser");
        }
        let wants_frames = !ONE_THREAD && self.outputs.is_some_and(|outputs| outputs.frames);
        if wants_frames && self.temporal_params().is_none() {
            return contradiction("outputs", "frames", "only with temporal=steady");
        }
        if let Some(adapter) = &self.adapter {
            if self.engine() != Engine::Gpu {
                return contradiction("adapter", adapter, "only with the engine gpu");
            }
            if self.devices.is_some() {
                return contradiction("adapter", adapter, "set either devices or adapter");
            }
        }
        if let Some(devices) = &self.devices
            && !matches!(self.engine(), Engine::Auto | Engine::Gpu)
        {
            return contradiction(
                "devices",
                devices,
                "only with the engine auto or gpu, since the list chooses the engines",
            );
        }
        Ok(())
    }

    fn check_ranges(&self) -> Result<(), ParamError> {
        self.given_strength()?;
        self.frame_params_for(SensorModel::KINECT_V1)?.validate()?;
        self.cloud_params_unchecked().validate()?;
        if !ONE_THREAD {
            self.preparation().validate()?;
            check_width(self.fill)?;
        }
        if self.threads == Some(0) {
            return Err(ParamError { field: "threads", value: "0".into(), allowed: "1 or more" });
        }
        if let Some(passes) = self.passes.filter(|passes| !(1..=2).contains(passes)) {
            return Err(ParamError { field: "passes", value: passes.to_string(), allowed: PASSES });
        }
        match self.sensor {
            Some(SensorChoice::Known(sensor)) => sensor.validate(),
            _ => Ok(()),
        }
    }

    /// Returns true if planish, not the user or the paper preset, chooses the number of neighbours in unorganized
    /// clouds.
    pub fn chooses_neighbours(&self) -> bool {
        self.radius.is_none() && self.leaves_neighbours_open() && self.sensor_of_clouds().is_none()
    }

    /// Returns the sensor by whose noise unorganized clouds are smoothed; `None` if no named sensor is given, or if the
    /// settings give a number of neighbours or a radius, or are those of the paper.
    pub fn sensor_of_clouds(&self) -> Option<SensorModel> {
        let has_radius = matches!(self.radius, Some(RadiusChoice::Metres(_)));
        match self.sensor {
            Some(SensorChoice::Known(sensor)) if !has_radius && self.leaves_neighbours_open() => Some(sensor),
            _ => None,
        }
    }

    fn leaves_neighbours_open(&self) -> bool {
        self.neighbours.is_none() && self.preset != Some(Preset::Paper)
    }

    /// Returns true if a frame's pixel grid is reconstructed from an unorganized cloud. It is not reconstructed with
    /// `grid=off`, a radius, a number of neighbours or passes, the paper preset or `fill`, or if points are to be
    /// removed or spaced evenly.
    pub fn rebuilds_grid(&self) -> bool {
        let removes_points = self.remove_isolated == Some(true) || self.remove_floating == Some(true);
        let is_for_clouds = removes_points || self.passes.is_some() || self.spaces_evenly() || self.fill.is_some();
        let gives_neither = self.radius.is_none() && self.leaves_neighbours_open();
        self.grid != Some(GridChoice::Off) && gives_neither && !is_for_clouds
    }

    /// Returns true if the points of unorganized clouds are spaced evenly.
    pub fn spaces_evenly(&self) -> bool {
        // WebAssembly builds omit even spacing, and `validate` refuses it there.
        self.even == Some(true) && !ONE_THREAD
    }

    /// Returns true if the sensor model is estimated from frames.
    pub fn estimates_sensor(&self) -> bool {
        self.sensor == Some(SensorChoice::Auto)
    }

    /// Returns the steps before smoothing, which a front end applies to frames on a grid ([`Preparation`]).
    pub fn preparation(&self) -> Preparation {
        Preparation {
            min_range_m: self.min_range_m,
            max_range_m: self.max_range_m,
            remove_floating: self.remove_floating == Some(true),
            decimate: self.decimate,
        }
    }

    /// Returns true if results may contain values that were not measured in their frame, because holes are filled or
    /// values are carried over time.
    pub fn flags_origins(&self) -> bool {
        !ONE_THREAD && (self.fill.is_some() || self.temporal_params().is_some())
    }

    /// Returns the sensor model; `None` if it is to be estimated.
    pub fn known_sensor(&self) -> Option<SensorModel> {
        match self.sensor {
            Some(SensorChoice::Auto) => None,
            Some(SensorChoice::Known(sensor)) => Some(sensor),
            None => Some(SensorModel::KINECT_V1),
        }
    }

    /// Returns the chosen engine; [`Engine::Auto`] by default.
    pub fn engine(&self) -> Engine {
        self.engine.unwrap_or_default()
    }

    /// Returns the options of a smoother with these settings.
    pub fn options(&self) -> SmootherOptions {
        self.override_options(SmootherOptions::default())
    }

    /// Returns `options`, overridden by these settings.
    pub fn override_options(&self, options: SmootherOptions) -> SmootherOptions {
        let gpu = match &self.adapter {
            Some(adapter) => GpuOptions { adapter: Some(adapter.clone()), ..options.gpu.clone() },
            None => options.gpu.clone(),
        };
        SmootherOptions {
            engine: self.engine.unwrap_or(options.engine),
            outputs: self.outputs.unwrap_or(options.outputs),
            threads: self.threads.or(options.threads),
            gpu,
            ..options
        }
    }

    /// Returns the devices that share the frames; empty if the setting `devices` is not given. A single device is then
    /// used.
    ///
    /// # Errors
    /// If settings contradict each other, or a device is missing or named twice.
    pub fn devices(&self) -> Result<Vec<FleetDevice>, crate::Error> {
        self.validate()?;
        match &self.devices {
            Some(list) if !ONE_THREAD => Ok(FleetDevice::parse_list(list)?),
            _ => Ok(Vec::new()),
        }
    }

    fn given_strength(&self) -> Result<Option<Strength>, ParamError> {
        self.strength.map(Strength::new).transpose()
    }
}

impl FromStr for Settings {
    type Err = ParamError;

    /// Reads `name=value` pairs separated by spaces, commas or line ends, as in `preset=strong edges=off`. The items
    /// of a list are separated by `+`: `outputs=points+normals`.
    fn from_str(text: &str) -> Result<Self, ParamError> {
        let mut settings = Self::default();
        for pair in text.split([' ', ',', '\n', '\t', '\r']).filter(|pair| !pair.is_empty()) {
            let Some((name, value)) = pair.split_once('=') else {
                return Err(ParamError { field: "settings", value: quoted(pair), allowed: "name=value pairs" });
            };
            settings.set(name, SettingValue::Text(value.to_owned()))?;
        }
        settings.validate()?;
        Ok(settings)
    }
}

fn sensor_of(value: SettingValue) -> Result<Option<SensorChoice>, ParamError> {
    if let SettingValue::Sensor(sensor) = value {
        return Ok(Some(SensorChoice::Known(sensor)));
    }
    let Some(name) = value.text() else { return Ok(None) };
    match name.as_str() {
        "auto" => Ok(Some(SensorChoice::Auto)),
        name => match name.parse() {
            Ok(sensor) => Ok(Some(SensorChoice::Known(sensor))),
            Err(_) => Err(ParamError { field: "sensor", value: quoted(name), allowed: SENSORS }),
        },
    }
}

/// Reads the edge handling. Booleans are accepted, since YAML and ROS read the word `off` as false.
fn edges_of(value: &SettingValue) -> Result<Option<Edges>, ParamError> {
    match value {
        SettingValue::Bool(true) => Ok(Some(Edges::Robust)),
        SettingValue::Bool(false) => Ok(Some(Edges::Off)),
        value => value.named("edges", &Edges::NAMED, "robust or off"),
    }
}

fn radius_of(value: SettingValue) -> Result<Option<RadiusChoice>, ParamError> {
    match value.text().as_deref() {
        Some("sensor") => Ok(Some(RadiusChoice::Sensor)),
        _ => Ok(value.number("radius_m", "metres, such as 0.03, or sensor")?.map(RadiusChoice::Metres)),
    }
}

fn outputs_of(value: SettingValue) -> Result<Option<Outputs>, ParamError> {
    let names = match value {
        SettingValue::None => return Ok(None),
        SettingValue::List(names) => names,
        other => other.text().unwrap_or_default().split('+').map(|name| name.trim().to_owned()).collect(),
    };
    let mut outputs = Outputs::NONE;
    for name in &names {
        outputs = outputs.with_named(name).ok_or_else(|| ParamError {
            field: "outputs",
            value: quoted(name),
            allowed: OUTPUTS,
        })?;
    }
    outputs.validate()?;
    Ok(Some(outputs))
}

#[cfg(test)]
mod tests;
