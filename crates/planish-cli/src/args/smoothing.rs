//! The arguments that select smoothing parameters, engines and devices.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use planish::rig::{merged_params, merged_params_in_voxels};
use planish::{CloudParams, Edges, Engine, FleetDevice, Outputs, ParamError, SettingValue, Settings, SmootherOptions};

use super::{ENGINE, TUNING};

#[derive(Clone, Copy, ValueEnum)]
pub enum PresetArg {
    /// Small objects: windows of 15x15 pixels for a Kinect v1, larger for noisier sensors
    Light,
    /// Recommended: windows of 25x25 pixels for a Kinect v1
    Default,
    /// Walls, floors and far ranges: windows of 29x29 pixels for a Kinect v1, with twice the samples
    Strong,
    /// The setting of the 2011 report: half-width 3, stride 1, radius 3 cm, degree 3
    Paper,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum SensorArg {
    /// Kinect v1, Xtion, PrimeSense (the default)
    Kinect1,
    /// RealSense D415
    D415,
    /// RealSense D435
    #[value(alias = "stereo")]
    D435,
    /// RealSense D455
    D455,
    /// Azure Kinect, Orbbec Femto Bolt
    #[value(alias = "femto")]
    AzureKinect,
    /// RealSense L515
    L515,
    /// iPhone and iPad lidar
    #[value(alias = "ipad")]
    Iphone,
    /// Depth without noise
    Exact,
    /// Estimated from the frame
    Auto,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum EdgesArg {
    /// All neighbours count: edges are rounded
    Off,
    /// Neighbours off the point's surface are ignored: edges stay sharp
    Robust,
}

impl EdgesArg {
    pub fn edges(self) -> Edges {
        match self {
            Self::Off => Edges::Off,
            Self::Robust => Edges::Robust,
        }
    }
}

#[derive(Clone, Copy, ValueEnum)]
pub enum GridArg {
    /// The grid is detected if the points lie on the pixels of a camera
    Auto,
    /// Unorganized clouds stay unorganized
    Off,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum TemporalArg {
    /// Every frame on its own
    Off,
    /// Up to 16 frames, fewer where the scene changes
    Steady,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum ProjectArg {
    /// Along its ray, the direction of depth noise
    Ray,
    /// Along the surface normal
    Normal,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum EngineArg {
    /// A hardware GPU if available, otherwise the CPU; also the CPU if it finishes a single file before a GPU opens
    Auto,
    /// CPU in f32, with SIMD and threads
    Cpu,
    /// GPU through Vulkan or Metal
    Gpu,
    /// CPU in f64: slow, the reference for accuracy
    Reference,
}

impl EngineArg {
    pub fn engine(self) -> Engine {
        match self {
            Self::Auto => Engine::Auto,
            Self::Cpu => Engine::Cpu,
            Self::Gpu => Engine::Gpu,
            Self::Reference => Engine::Reference,
        }
    }
}

/// How to smooth; values not given come from the preset.
#[derive(clap::Args)]
pub struct SmoothingArgs {
    /// Preset
    ///
    /// By default the recommended one. Other options override individual values.
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// Strength: 0 light, 0.5 default, 1 strong
    ///
    /// Replaces a preset; values between are interpolated.
    #[arg(long, value_name = "0..1", conflicts_with = "preset", allow_negative_numbers = true)]
    pub strength: Option<f32>,
    /// Sensor
    ///
    /// Its noise sets the radius and the width of edges. By default kinect1 for frames. For unorganized clouds, which
    /// must be in the sensor's frame or state its pose, by default none, or kinect1 if its depth steps are recognized.
    #[arg(long, value_enum)]
    pub sensor: Option<SensorArg>,
    /// Creases and steps
    ///
    /// By default robust for frames. For unorganized clouds, robust if the sensor is given or recognized, or if that
    /// reduces the error at held-out points, and off if a radius or a number of neighbours is given. Smoothing an
    /// unorganized cloud takes 1.5 to 3.6 times as long with robust edges.
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// Engine
    ///
    /// By default auto. An engine requested by name is not replaced by another, except in a stream that loses its GPU
    /// twice.
    #[arg(long, value_enum)]
    pub engine: Option<EngineArg>,
    /// Settings file (JSON or YAML) that options override
    ///
    /// Python (planish.Settings) and the browser page write the same format.
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    pub settings: Option<PathBuf>,
    /// Turn pixels that float between two surfaces into holes before smoothing [default: false]
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true", hide_short_help = true, help_heading = TUNING)]
    pub remove_floating: Option<bool>,
    /// Turn pixels of a frame that are nearer than this into holes before smoothing
    #[arg(long, value_name = "METRES", allow_negative_numbers = true, hide_short_help = true, help_heading = TUNING)]
    pub min_range: Option<f32>,
    /// Turn pixels of a frame that are farther than this into holes before smoothing
    #[arg(long, value_name = "METRES", allow_negative_numbers = true, hide_short_help = true, help_heading = TUNING)]
    pub max_range: Option<f32>,
    /// Reduce the resolution before smoothing: blocks of KxK pixels become one, 2 to 8
    ///
    /// Each block becomes the mean of those of its pixels that are on the same surface as its median, so surfaces are
    /// not mixed. The camera is scaled too.
    #[arg(long, value_name = "K", hide_short_help = true, help_heading = TUNING)]
    pub decimate: Option<u32>,
    /// Fill holes up to N pixels wide with the surface around them, 1 to 64 [default: none are filled]
    ///
    /// A hole is filled if its rim is one surface, or if it is the shadow that a near object casts for the named
    /// sensor. Filled pixels have the status 8. For depth images, NAME.origin.png shows them.
    #[arg(long, value_name = "N", hide_short_help = true, help_heading = TUNING)]
    pub fill: Option<u32>,
    /// Half-width of the window in samples, 1 to 7: (2K+1)² candidates
    #[arg(long, value_name = "K", hide_short_help = true, help_heading = TUNING)]
    pub window: Option<u32>,
    /// Distance between samples in pixels, 1 to 8
    ///
    /// With neither --stride nor --window, both adapt to the pixel pitch: pixels coarser than a Kinect v1's get a
    /// shorter stride and, if needed, a wider window.
    #[arg(long, value_name = "S", hide_short_help = true, help_heading = TUNING)]
    pub stride: Option<u32>,
    /// Average a block of pixels, as wide as the stride, into each sample
    #[arg(long, value_name = "true|false", action = clap::ArgAction::Set, hide_short_help = true, help_heading = TUNING)]
    pub average_blocks: Option<bool>,
    /// Radius of a neighbourhood in metres, or `sensor`: growing with range like the sensor's noise
    #[arg(long, value_name = "METRES|sensor", allow_negative_numbers = true, hide_short_help = true, help_heading = TUNING)]
    pub radius: Option<RadiusArg>,
    /// For unorganized clouds: number of neighbours, 6 to 1000, instead of a radius
    ///
    /// By default the noise and the shape of each cloud decide, or the range if the sensor is given or recognized; in
    /// streams it is 40.
    #[arg(long, value_name = "K", conflicts_with = "radius", hide_short_help = true, help_heading = TUNING)]
    pub neighbours: Option<u32>,
    /// For unorganized clouds: number of passes; 2 adds a first pass with 20 neighbours [default: depends on the noise]
    ///
    /// The first pass helps where the noise exceeds half the spacing of the points. With a given radius or number of
    /// neighbours, a known sensor, and in tiles, the default is 1.
    #[arg(long, value_name = "1|2", hide_short_help = true, help_heading = TUNING)]
    pub passes: Option<u32>,
    /// For unorganized clouds: turn isolated points into holes [default: false]
    ///
    /// Isolated points have fewer than 3 neighbours, or fewer than a quarter of --neighbours (fewer than 5 if the
    /// sensor is known).
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true", hide_short_help = true, help_heading = TUNING)]
    pub remove_isolated: Option<bool>,
    /// For unorganized clouds: whether to rebuild the grid of a frame that has lost it [default: auto]
    ///
    /// PCL and RealSense save frames as clouds without holes: at most one point per pixel of a camera without
    /// distortion. On the rebuilt grid, such a cloud is smoothed like any frame: faster, and with its edges kept.
    /// Streams are not examined.
    #[arg(long, value_enum, hide_short_help = true, help_heading = TUNING)]
    pub grid: Option<GridArg>,
    /// For unorganized clouds: space points evenly along the smoothed surface [default: false]
    ///
    /// Smoothing removes noise across the surface; noise along it leaves clumps and gaps. Points move by at most 1.5
    /// standard deviations of the noise along the surface. A lost grid is not rebuilt. Streams and tiles do not support
    /// this option.
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true", hide_short_help = true, help_heading = TUNING)]
    pub even: Option<bool>,
    /// Smooth video
    ///
    /// Off by default. Applies to the frames of one camera: streams, rigs, folders (in the order of their numbers) and
    /// recordings, but not to unorganized clouds. Without --track or --poses, the camera must be stationary.
    #[arg(long, value_enum)]
    pub temporal: Option<TemporalArg>,
    /// Smooth video from a moving camera over time: its motion is estimated from frame to frame
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true", hide_short_help = true, help_heading = TUNING)]
    pub track: Option<bool>,
    /// Degree of the surface: 1 plane, 2 or 3 polynomial
    #[arg(long, value_name = "D", hide_short_help = true, help_heading = TUNING)]
    pub degree: Option<u32>,
    /// Bandwidth of the Gaussian weights in metres [default: the radius]
    #[arg(long, value_name = "METRES", allow_negative_numbers = true, hide_short_help = true, help_heading = TUNING)]
    pub bandwidth: Option<f32>,
    /// Damping of slopes and curvatures, 1e-3 (weak) to 100 (a plane)
    #[arg(long, value_name = "LAMBDA", allow_negative_numbers = true, hide_short_help = true, help_heading = TUNING)]
    pub ridge: Option<f32>,
    /// Direction in which a point moves onto the surface
    ///
    /// Points move along the normal in clouds whose sensor position is unknown, and in unorganized clouds unless
    /// the sensor is given or recognized.
    #[arg(long, value_enum, hide_short_help = true, help_heading = TUNING)]
    pub project: Option<ProjectArg>,
    /// GPU for --engine gpu: index or part of the name (see `planish devices`) [default: the first hardware GPU]
    #[arg(long, value_name = "NAME|INDEX", hide_short_help = true, help_heading = ENGINE)]
    pub adapter: Option<String>,
    /// Threads of the CPU engines [default: one per core]
    #[arg(long, value_name = "N", hide_short_help = true, help_heading = ENGINE)]
    pub threads: Option<usize>,
}

/// Several devices at once.
#[derive(clap::Args)]
pub struct GpusArgs {
    /// Devices that share the frames: all (every GPU), or a list of indices, parts of names, and cpu
    #[arg(long, value_name = "all|LIST", conflicts_with = "adapter", hide_short_help = true, help_heading = ENGINE)]
    pub gpus: Option<String>,
}

impl GpusArgs {
    /// Returns the named devices; an empty list without --gpus.
    pub fn devices(&self, engine: Engine) -> Result<Vec<FleetDevice>> {
        let Some(list) = &self.gpus else { return Ok(Vec::new()) };
        if !matches!(engine, Engine::Auto | Engine::Gpu) {
            bail!("--gpus already selects the devices; remove --engine {}", engine.name());
        }
        FleetDevice::parse_list(list).with_context(|| format!("--gpus {list}"))
    }
}

/// Converts an error about a setting to one that names the command-line option instead.
pub fn by_option(error: ParamError) -> anyhow::Error {
    match error.field {
        field if Settings::NAMES.contains(&field) => {
            anyhow::anyhow!("{} = {} is not allowed: {}", option_of(field), error.value, error.allowed)
        }
        _ => error.into(),
    }
}

/// Converts an error; if it is about a setting, the result names the command-line option instead.
pub fn by_option_of_error(error: planish::Error) -> anyhow::Error {
    match error {
        planish::Error::Param(error) => by_option(error),
        error => error.into(),
    }
}

/// Returns the command-line option that corresponds to a setting, such as `--radius` for `radius_m`.
pub fn option_of(setting: &str) -> String {
    let name = match setting {
        "devices" => "gpus",
        "outputs" => "fields",
        setting => setting.trim_end_matches("_m"),
    };
    format!("--{}", name.replace('_', "-"))
}

/// Returns the name of an option's value as a setting value.
fn named<T: ValueEnum>(value: Option<&T>) -> SettingValue {
    value.and_then(ValueEnum::to_possible_value).map(|value| value.get_name().to_owned()).into()
}

impl SmoothingArgs {
    /// Returns the settings from the file, overridden by the options.
    pub fn settings(&self) -> Result<Settings> {
        self.settings_over_file(self.given()?)
    }

    /// Returns the same settings as [`settings`](Self::settings), plus the devices of `--gpus`.
    pub fn settings_with(&self, gpus: &GpusArgs) -> Result<Settings> {
        let mut given = self.given()?;
        if let Some(list) = &gpus.gpus {
            given.set("devices", list.as_str()).map_err(by_option)?;
            given.validate().map_err(by_option)?;
            FleetDevice::parse_list(list).with_context(|| format!("--gpus {list}"))?;
        }
        self.settings_over_file(given)
    }

    fn settings_over_file(&self, given: Settings) -> Result<Settings> {
        let Some(file) = &self.settings else { return Ok(given) };
        let mut settings = planish::io::read_settings(file)?;
        settings.override_with(given);
        settings.validate().with_context(|| file.display().to_string())?;
        Ok(settings)
    }

    /// Returns the settings given as options.
    fn given(&self) -> Result<Settings> {
        let mut settings = Settings::default();
        let radius = self.radius.map(|radius| match radius {
            RadiusArg::Sensor => SettingValue::from("sensor"),
            RadiusArg::Metres(radius_m) => radius_m.into(),
        });
        let given: [(&str, SettingValue); 26] = [
            ("preset", named(self.preset.as_ref())),
            ("strength", self.strength.into()),
            ("sensor", named(self.sensor.as_ref())),
            ("edges", named(self.edges.as_ref())),
            ("remove_floating", self.remove_floating.into()),
            ("min_range_m", self.min_range.into()),
            ("max_range_m", self.max_range.into()),
            ("decimate", self.decimate.into()),
            ("fill", self.fill.into()),
            ("remove_isolated", self.remove_isolated.into()),
            ("window", self.window.into()),
            ("stride", self.stride.into()),
            ("average_blocks", self.average_blocks.into()),
            ("radius_m", radius.into()),
            ("neighbours", self.neighbours.into()),
            ("passes", self.passes.into()),
            ("grid", named(self.grid.as_ref())),
            ("even", self.even.into()),
            ("temporal", named(self.temporal.as_ref())),
            ("track", self.track.into()),
            ("degree", self.degree.into()),
            ("bandwidth_m", self.bandwidth.into()),
            ("ridge", self.ridge.into()),
            ("project", named(self.project.as_ref())),
            ("engine", named(self.engine.as_ref())),
            ("adapter", self.adapter.clone().into()),
        ];
        for (name, value) in given {
            if value != SettingValue::None {
                settings.set(name, value).map_err(by_option)?;
            }
        }
        if let Some(threads) = self.threads {
            settings.set("threads", threads as f64).map_err(by_option)?;
        }
        settings.validate().map_err(by_option)?;
        Ok(settings)
    }

    /// Returns the parameters for smoothing the merged points of a rig's cameras.
    pub fn merged_params(&self, voxel_m: Option<f64>) -> Result<CloudParams> {
        self.settings()?.override_cloud(params_of_voxels(voxel_m)?).map_err(by_option)
    }

    /// Returns the options for opening a smoother that computes `outputs`.
    pub fn options(&self, outputs: Outputs) -> Result<SmootherOptions> {
        Ok(self.settings()?.options().with_outputs(outputs))
    }
}

#[derive(Clone, Copy)]
pub enum RadiusArg {
    Sensor,
    Metres(f32),
}

impl std::str::FromStr for RadiusArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "sensor" => Ok(Self::Sensor),
            number => number
                .parse()
                .map(Self::Metres)
                .map_err(|_| "expected metres, such as 0.03, or the word sensor".to_owned()),
        }
    }
}

/// Returns the parameters for a rig's merged points: for all points, or for one point per voxel if a voxel size is
/// given.
pub fn params_of_voxels(voxel_m: Option<f64>) -> Result<CloudParams> {
    let Some(size_m) = voxel_m else { return Ok(merged_params()) };
    if !(size_m > 0.0 && size_m.is_finite()) {
        bail!("--voxel {size_m}: expected a size in metres above 0, such as 0.005");
    }
    Ok(merged_params_in_voxels(size_m))
}
