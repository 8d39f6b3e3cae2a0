//! How to smooth, and with what.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use planish::rig::{merged_params, merged_params_in_voxels};
use planish::{CloudParams, Edges, Engine, FleetDevice, Outputs, ParamError, SettingValue, Settings, SmootherOptions};

#[derive(Clone, Copy, ValueEnum)]
pub enum PresetArg {
    /// Windows of 15x15 pixels of a Kinect v1, and as the noise of others demands: for small things
    Light,
    /// Windows of 25x25 pixels of a Kinect v1: recommended
    Default,
    /// Windows of 29x29 pixels of a Kinect v1 with twice the samples: for walls, floors and far ranges
    Strong,
    /// The setting of the 2011 report: window 3, stride 1, 3 cm, degree 3
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
    /// Every neighbour counts: edges are rounded off
    Off,
    /// Neighbours off the point's surface do not count
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
pub enum ProjectArg {
    /// Along its ray, as depth noise acts
    Ray,
    /// Along the normal of the surface
    Normal,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum EngineArg {
    Auto,
    Cpu,
    Gpu,
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
    /// Settings in JSON or YAML, as planish.Settings in Python and the browser's page write them; the options below
    /// override them
    #[arg(long, value_name = "FILE")]
    pub settings: Option<PathBuf>,
    /// A named setting; the options below override single values
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// How much to smooth, 0 to 1, instead of a preset: 0 is light, 0.5 default, 1 strong
    #[arg(long, value_name = "0..1", conflicts_with = "preset", allow_negative_numbers = true)]
    pub strength: Option<f32>,
    /// Which sensor took the frames: its depth steps set the radius, its noise what counts as an edge
    #[arg(long, value_enum)]
    pub sensor: Option<SensorArg>,
    /// Whether creases and steps are kept; by default they are in frames on a grid, and not in general clouds, which
    /// then take 1.5 to 3.6 times as long
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// First turn pixels that float between two surfaces into holes
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub remove_floating: Option<bool>,
    /// Half width of the window: (2K+1)² candidates, K from 1 to 7
    #[arg(long, value_name = "K")]
    pub window: Option<u32>,
    /// Distance between candidates in pixels, 1 to 8. With neither --stride nor --window, pixels coarser than a Kinect
    /// v1's get a shorter stride and, where needed, a larger K
    #[arg(long, value_name = "S")]
    pub stride: Option<u32>,
    /// Whether each candidate is the mean of its block of pixels, as wide as the stride, so that every pixel counts
    #[arg(long, value_name = "true|false", action = clap::ArgAction::Set)]
    pub average_blocks: Option<bool>,
    /// Radius of a neighbourhood in metres, or `sensor`: growing with distance as the sensor's noise does
    #[arg(long, value_name = "METRES|sensor", allow_negative_numbers = true)]
    pub radius: Option<RadiusArg>,
    /// Of general clouds instead of a radius: so many neighbours (6 to 1000, else 40), by the density around each point
    #[arg(long, value_name = "K", conflicts_with = "radius")]
    pub neighbours: Option<u32>,
    /// Of general clouds: turn isolated points into holes, those with fewer than 3 neighbours or a quarter of K; else
    /// they stay where they are
    #[arg(long, value_name = "true|false", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub remove_isolated: Option<bool>,
    /// Degree of the surface: 1 plane, 2 or 3 polynomial
    #[arg(long, value_name = "D")]
    pub degree: Option<u32>,
    /// Bandwidth of the Gaussian weights in metres; else the radius
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    pub bandwidth: Option<f32>,
    /// How much the surface's slopes and curvatures are damped, 1e-3 (little) to 100 (a plane)
    #[arg(long, value_name = "LAMBDA", allow_negative_numbers = true)]
    pub ridge: Option<f32>,
    /// Along which line a point is put onto the surface; general clouds, and clouds whose sensor's place is unknown,
    /// always along the normal
    #[arg(long, value_enum)]
    pub project: Option<ProjectArg>,
    /// Which engine to use; one requested by name is never replaced by another, except in a stream that loses its GPU
    /// twice [default: auto]
    #[arg(long, value_enum)]
    pub engine: Option<EngineArg>,
    /// Which GPU to use with --engine gpu: index or part of the name (see `planish devices`); by default the first real
    /// one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// Threads of the CPU engines; by default one per core
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
}

/// Several devices at once.
#[derive(clap::Args)]
pub struct GpusArgs {
    /// Deal frames to several devices: all for every GPU, or their indices or parts of their names, separated by
    /// commas; cpu is the CPU as one more
    #[arg(long, value_name = "all|LIST", conflicts_with = "adapter")]
    pub gpus: Option<String>,
}

impl GpusArgs {
    /// The devices named; none if none are.
    pub fn devices(&self, engine: Engine) -> Result<Vec<FleetDevice>> {
        let Some(list) = &self.gpus else { return Ok(Vec::new()) };
        if !matches!(engine, Engine::Auto | Engine::Gpu) {
            bail!("--gpus names the devices: leave --engine {} out", engine.name());
        }
        FleetDevice::parse_list(list).with_context(|| format!("--gpus {list}"))
    }
}

/// Names the option in place of the setting.
pub fn by_option(error: ParamError) -> anyhow::Error {
    match error.field {
        field if Settings::NAMES.contains(&field) => {
            anyhow::anyhow!("{} = {} is not allowed: {}", option_of(field), error.value, error.allowed)
        }
        _ => error.into(),
    }
}

/// Names the option in place of the setting, where the error is one of a setting.
pub fn by_option_of_error(error: planish::Error) -> anyhow::Error {
    match error {
        planish::Error::Param(error) => by_option(error),
        error => error.into(),
    }
}

/// Returns the option of a setting.
pub fn option_of(setting: &str) -> String {
    let name = match setting {
        "devices" => "gpus",
        setting => setting.trim_end_matches("_m"),
    };
    format!("--{}", name.replace('_', "-"))
}

/// Returns the name of an option's value.
fn named<T: ValueEnum>(value: Option<&T>) -> SettingValue {
    value.and_then(ValueEnum::to_possible_value).map(|value| value.get_name().to_owned()).into()
}

impl SmoothingArgs {
    /// Returns the settings from the file, overridden by the options.
    pub fn settings(&self) -> Result<Settings> {
        self.settings_over_file(self.given()?)
    }

    /// Returns the settings as [`settings`](Self::settings), with the devices of `--gpus`.
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
        let given: [(&str, SettingValue); 17] = [
            ("preset", named(self.preset.as_ref())),
            ("strength", self.strength.into()),
            ("sensor", named(self.sensor.as_ref())),
            ("edges", named(self.edges.as_ref())),
            ("remove_floating", self.remove_floating.into()),
            ("remove_isolated", self.remove_isolated.into()),
            ("window", self.window.into()),
            ("stride", self.stride.into()),
            ("average_blocks", self.average_blocks.into()),
            ("radius_m", radius.into()),
            ("neighbours", self.neighbours.into()),
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

    /// Returns the parameters for the points of a rig's cameras as one cloud.
    pub fn merged_params(&self, voxel_m: Option<f64>) -> Result<CloudParams> {
        self.settings()?.override_cloud(params_of_voxels(voxel_m)?).map_err(by_option)
    }

    /// Returns how a smoother is opened.
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
            number => number.parse().map(Self::Metres).map_err(|_| "metres, as 0.03, or the word sensor".to_owned()),
        }
    }
}

/// The parameters of a rig's merged points: all of them, or one for each voxel of this size in metres.
pub fn params_of_voxels(voxel_m: Option<f64>) -> Result<CloudParams> {
    let Some(size_m) = voxel_m else { return Ok(merged_params()) };
    if !(size_m > 0.0 && size_m.is_finite()) {
        bail!("--voxel {size_m}: a size in metres above 0, as 0.005");
    }
    Ok(merged_params_in_voxels(size_m))
}
