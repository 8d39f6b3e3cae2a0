//! How to smooth, and with what.

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use planish::rig::{merged_params, merged_params_in_voxels};
use planish::{
    Edges, Engine, FleetDevice, Frame, GpuOptions, OrganizedCloud, Outputs, ParamError, Project, Radius, SensorModel,
    SmoothParams, SmootherOptions, Strength,
};

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
    /// A named setting; the options below override single values
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// How much to smooth, 0 to 1, instead of a preset: 0 is light, 0.5 default, 1 strong
    #[arg(long, value_name = "0..1", conflicts_with = "preset", allow_negative_numbers = true)]
    pub strength: Option<f32>,
    /// Which sensor took the frames: its depth steps set the radius, its noise what counts as an edge
    #[arg(long, value_enum)]
    pub sensor: Option<SensorArg>,
    /// Whether creases and steps are kept; by default they are in frames on a grid, and not in general clouds, which then take 1.5 to
    /// 3.6 times as long
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// First turn pixels that float between two surfaces into holes
    #[arg(long)]
    pub remove_floating: bool,
    /// Half width of the window: (2K+1)² candidates, K from 1 to 7
    #[arg(long, value_name = "K")]
    pub window: Option<u32>,
    /// Distance between candidates in pixels, 1 to 8. With neither --stride nor --window, pixels coarser than a Kinect v1's get a
    /// shorter stride and, where needed, a larger K
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
    /// Of general clouds: turn isolated points into holes, those with fewer than 3 neighbours or a quarter of K; else they stay where they are
    #[arg(long)]
    pub remove_isolated: bool,
    /// Degree of the surface: 1 plane, 2 or 3 polynomial
    #[arg(long, value_name = "D")]
    pub degree: Option<u32>,
    /// Bandwidth of the Gaussian weights in metres; else the radius
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    pub bandwidth: Option<f32>,
    /// How much the surface's slopes and curvatures are damped, 1e-3 (little) to 100 (a plane)
    #[arg(long, value_name = "LAMBDA", allow_negative_numbers = true)]
    pub ridge: Option<f32>,
    /// Along which line a point is put onto the surface; general clouds, and clouds whose sensor's place is unknown, always along the normal
    #[arg(long, value_enum)]
    pub project: Option<ProjectArg>,
    /// Which engine to use; one requested by name never falls back to another (except in a stream that loses its GPU twice)
    #[arg(long, value_enum, default_value = "auto")]
    pub engine: EngineArg,
    /// Which GPU to use with --engine gpu: index or part of the name (see `planish devices`); by default the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// Threads of the CPU engines; by default one per core
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
}

/// Several devices at once.
#[derive(clap::Args)]
pub struct GpusArgs {
    /// Deal frames to several devices: all for every GPU, or their indices or parts of their names, separated by commas; cpu is the CPU as
    /// one more
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

/// Names the option in place of the parameter's field.
fn by_option(error: ParamError) -> ParamError {
    const OPTIONS: [(&str, &str); 7] = [
        ("window", "--window"),
        ("stride", "--stride"),
        ("degree", "--degree"),
        ("radius_m", "--radius"),
        ("neighbours", "--neighbours"),
        ("ridge", "--ridge"),
        ("bandwidth_m", "--bandwidth"),
    ];
    let option = OPTIONS.iter().find(|(field, _)| *field == error.field);
    option.map_or(error.clone(), |(_, field)| ParamError { field, ..error })
}

impl SmoothingArgs {
    /// The options given that change nothing for a general cloud: it has no pixels, and no sensor.
    pub fn unused_by_general_clouds(&self) -> Vec<&'static str> {
        let given = [
            ("--window", self.window.is_some()),
            ("--stride", self.stride.is_some()),
            ("--average-blocks", self.average_blocks.is_some()),
            ("--project", matches!(self.project, Some(ProjectArg::Ray))),
            ("--sensor", self.sensor.is_some()),
            ("--preset", !matches!(self.preset, None | Some(PresetArg::Paper))),
            ("--strength", self.strength.is_some()),
        ];
        given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name).collect()
    }

    /// Whether the sensor is to be estimated from a frame.
    pub fn estimates_sensor(&self) -> bool {
        matches!(self.sensor, Some(SensorArg::Auto))
    }

    /// The parameters, where a frame that a sensor could be estimated from is not at hand.
    pub fn params(&self) -> Result<SmoothParams> {
        if self.estimates_sensor() {
            bail!(
                "--sensor auto needs a frame to estimate from, and a stream has none yet: run `planish info` on one, then name the nearest sensor"
            );
        }
        self.params_for(None)
    }

    /// The parameters for a frame. General clouds are smoothed without a sensor.
    pub fn params_for(&self, cloud: Option<&OrganizedCloud>) -> Result<SmoothParams> {
        self.params_of(self.sensor_of(cloud)?)
    }

    /// The parameters for frames of a sensor.
    pub fn params_of(&self, sensor: SensorModel) -> Result<SmoothParams> {
        let mut params = match (self.strength, self.preset) {
            (Some(strength), _) => SmoothParams::for_sensor(sensor, Strength::new(strength)?),
            (None, Some(PresetArg::Light)) => SmoothParams::for_sensor(sensor, Strength::LIGHT),
            (None, None | Some(PresetArg::Default)) => SmoothParams::for_sensor(sensor, Strength::DEFAULT),
            (None, Some(PresetArg::Strong)) => SmoothParams::for_sensor(sensor, Strength::STRONG),
            (None, Some(PresetArg::Paper)) => SmoothParams::paper(),
        };
        params.sensor = sensor;
        params.window = self.window.unwrap_or(params.window);
        params.stride = self.stride.unwrap_or(params.stride);
        params.average_blocks = self.average_blocks.unwrap_or(params.average_blocks);
        self.override_fit(&mut params);
        params.edges = self.edges.map_or(params.edges, EdgesArg::edges);
        match self.project {
            None => {}
            Some(ProjectArg::Ray) => params.project = Project::Ray,
            Some(ProjectArg::Normal) => params.project = Project::Normal,
        }
        params.validate().map_err(by_option)?;
        Ok(params)
    }

    /// The parameters for general clouds, which have neither pixels nor a sensor.
    pub fn general_params(&self) -> Result<SmoothParams> {
        let mut params = match self.preset {
            Some(PresetArg::Paper) => SmoothParams::paper(),
            _ => SmoothParams::general(),
        };
        self.override_fit(&mut params);
        if params.radius == Radius::Sensor {
            bail!(
                "--radius sensor is for frames on a grid: a general cloud takes --neighbours or a --radius in metres"
            );
        }
        params.edges = self.edges.map_or(params.edges, EdgesArg::edges);
        params.remove_isolated = self.remove_isolated;
        params.validate().map_err(by_option)?;
        Ok(params)
    }

    /// The parameters for the points of a rig's cameras as one cloud.
    pub fn merged_params(&self, voxel_m: Option<f64>) -> Result<SmoothParams> {
        let mut params = params_of_voxels(voxel_m)?;
        self.override_fit(&mut params);
        params.edges = self.edges.map_or(params.edges, EdgesArg::edges);
        params.validate().map_err(by_option)?;
        Ok(params)
    }

    /// Sets what was given of the neighbourhood and the surface.
    fn override_fit(&self, params: &mut SmoothParams) {
        params.degree = self.degree.unwrap_or(params.degree);
        params.bandwidth_m = self.bandwidth.or(params.bandwidth_m);
        match self.radius {
            None => {}
            Some(RadiusArg::Sensor) => {
                params.radius = Radius::Sensor;
            }
            Some(RadiusArg::Metres(radius_m)) => params.radius = Radius::Fixed { radius_m },
        }
        if let Some(count) = self.neighbours {
            params.radius = Radius::Neighbours { count };
        }
        params.ridge = self.ridge.unwrap_or(params.ridge);
    }

    /// Whether window and stride are left to the frame's resolution: neither given nor the report's.
    pub fn adapts_window(&self) -> bool {
        self.window.is_none() && self.stride.is_none() && !matches!(self.preset, Some(PresetArg::Paper))
    }

    /// The parameters for a frame's resolution.
    pub fn at_resolution_of(&self, params: SmoothParams, frame: Frame<'_>) -> SmoothParams {
        if self.adapts_window() { params.at_resolution_of(frame) } else { params }
    }

    /// Whose noise it is; of a frame, where it is to be estimated.
    fn sensor_of(&self, cloud: Option<&OrganizedCloud>) -> Result<SensorModel> {
        Ok(match (self.sensor, cloud) {
            (None | Some(SensorArg::Kinect1), _) | (Some(SensorArg::Auto), None) => SensorModel::KINECT_V1,
            (Some(SensorArg::D415), _) => SensorModel::REALSENSE_D415,
            (Some(SensorArg::D435), _) => SensorModel::REALSENSE_D435,
            (Some(SensorArg::D455), _) => SensorModel::REALSENSE_D455,
            (Some(SensorArg::AzureKinect), _) => SensorModel::AZURE_KINECT,
            (Some(SensorArg::L515), _) => SensorModel::REALSENSE_L515,
            (Some(SensorArg::Iphone), _) => SensorModel::APPLE_LIDAR,
            (Some(SensorArg::Exact), _) => SensorModel::EXACT,
            (Some(SensorArg::Auto), Some(cloud)) => SensorModel::estimate(cloud)
                .context("--sensor auto: too few depths to estimate a sensor from; name one, as --sensor kinect1")?,
        })
    }

    /// The sensor whose noise decides which pixels float, if those are to be removed.
    pub fn floating_sensor(&self, cloud: Option<&OrganizedCloud>) -> Result<Option<SensorModel>> {
        if self.remove_floating { self.sensor_of(cloud).map(Some) } else { Ok(None) }
    }

    pub fn engine(&self) -> Engine {
        self.engine.engine()
    }

    /// What a smoother is opened with.
    pub fn options(&self, outputs: Outputs) -> Result<SmootherOptions> {
        if self.adapter.is_some() && self.engine() != Engine::Gpu {
            bail!("--adapter chooses among GPUs: it needs --engine gpu");
        }
        let gpu = GpuOptions::default().with_adapter(self.adapter.clone());
        Ok(SmootherOptions::default()
            .with_engine(self.engine())
            .with_outputs(outputs)
            .with_threads(self.threads)
            .with_gpu(gpu))
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
pub fn params_of_voxels(voxel_m: Option<f64>) -> Result<SmoothParams> {
    let Some(size_m) = voxel_m else { return Ok(merged_params()) };
    if !(size_m > 0.0 && size_m.is_finite()) {
        bail!("--voxel {size_m}: a size in metres above 0, as 0.005");
    }
    Ok(merged_params_in_voxels(size_m))
}
