//! How to smooth, and with what.

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use planish::{
    Edges, Engine, Frame, GpuOptions, OrganizedCloud, Outputs, Radius, Sensor, SmoothParams, SmootherOptions, Strength,
};

#[derive(Clone, Copy, ValueEnum)]
pub enum PresetArg {
    /// 49 candidates over 13x13 pixels (without noise 5x5): for small things
    Light,
    /// 121 candidates over 31x31 pixels (without noise 11x11): what the library recommends
    Default,
    /// 225 candidates over 43x43 pixels (without noise 15x15): for walls, floors and far ranges
    Strong,
    /// The setting of the 2011 report: window 3, stride 1, 3 cm, degree 3
    Paper,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum SensorArg {
    /// Kinect v1, Xtion, PrimeSense (the default)
    Kinect1,
    /// Stereo as a RealSense D400
    Stereo,
    /// Depth without noise
    Exact,
    /// Estimated from the depths of the frame
    Auto,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum EdgesArg {
    /// Every neighbour counts: edges are rounded off
    Off,
    /// Neighbours that are not on the point's surface do not count
    Robust,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum EngineArg {
    Auto,
    Cpu,
    Gpu,
    Reference,
}

/// How to smooth; what is not given is taken from the preset.
#[derive(clap::Args)]
pub struct SmoothingArgs {
    /// A named setting; the options below change single values of it
    #[arg(long, value_enum)]
    pub preset: Option<PresetArg>,
    /// Whose noise it is: it sets the radius and how well edges are told from noise
    #[arg(long, value_enum)]
    pub sensor: Option<SensorArg>,
    /// What becomes of creases and steps
    #[arg(long, value_enum)]
    pub edges: Option<EdgesArg>,
    /// Turn pixels that float between two surfaces into holes first
    #[arg(long)]
    pub remove_floating: bool,
    /// Half width of the window: (2K+1)² candidates, K from 1 to 7
    #[arg(long, value_name = "K")]
    pub window: Option<u32>,
    /// Distance between candidates in pixels, 1 to 8; else that of the preset, shorter where pixels are coarser than a Kinect v1's
    #[arg(long, value_name = "S")]
    pub stride: Option<u32>,
    /// Radius of a neighbourhood in metres, or `sensor`: growing with distance as the sensor's noise does
    #[arg(long, value_name = "METRES|sensor", allow_negative_numbers = true)]
    pub radius: Option<RadiusArg>,
    /// Degree of the surface: 1 plane, 2 or 3 polynomial
    #[arg(long, value_name = "D")]
    pub degree: Option<u32>,
    /// Bandwidth of the Gaussian weights in metres; else the radius
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    pub bandwidth: Option<f32>,
    /// Which engine computes; one asked for by name never falls back to another (but a stream goes on with the CPU when its
    /// GPU is lost twice)
    #[arg(long, value_enum, default_value = "auto")]
    pub engine: EngineArg,
    /// Which GPU with --engine gpu, by its index or part of its name (see `planish devices`); else the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// Threads of the CPU engines; else one for each core
    #[arg(long, value_name = "N")]
    pub threads: Option<usize>,
}

impl SmoothingArgs {
    /// Whether the user chose the radius.
    pub fn has_radius(&self) -> bool {
        self.radius.is_some() || matches!(self.preset, Some(PresetArg::Paper))
    }

    /// The parameters, where a frame that a sensor could be estimated from is not at hand.
    pub fn params(&self) -> Result<SmoothParams> {
        if matches!(self.sensor, Some(SensorArg::Auto)) {
            bail!(
                "--sensor auto needs a frame to look at: `planish info` of an organized cloud says what it sees, name the nearest sensor here"
            );
        }
        self.params_for(None)
    }

    /// The parameters for a frame. Points without a grid are smoothed without a sensor.
    pub fn params_for(&self, cloud: Option<&OrganizedCloud>) -> Result<SmoothParams> {
        let sensor = self.sensor_of(cloud)?;
        let mut params = match self.preset {
            Some(PresetArg::Light) => SmoothParams::for_sensor(sensor, Strength::Light),
            None | Some(PresetArg::Default) => SmoothParams::for_sensor(sensor, Strength::Default),
            Some(PresetArg::Strong) => SmoothParams::for_sensor(sensor, Strength::Strong),
            Some(PresetArg::Paper) => SmoothParams::paper(),
        };
        params.window = self.window.unwrap_or(params.window);
        params.stride = self.stride.unwrap_or(params.stride);
        params.degree = self.degree.unwrap_or(params.degree);
        params.bandwidth_m = self.bandwidth.or(params.bandwidth_m);
        match self.radius {
            None => {}
            Some(RadiusArg::Sensor) => {
                params.radius = Radius::Sensor { depth_step_at_1m: sensor.depth_step_at_1m };
            }
            Some(RadiusArg::Metres(radius_m)) => params.radius = Radius::Fixed { radius_m },
        }
        match self.edges {
            None => {}
            Some(EdgesArg::Off) => params.edges = Edges::Off,
            Some(EdgesArg::Robust) => params.edges = Edges::Robust { noise_at_1m: sensor.noise_at_1m },
        }
        params.validate()?;
        Ok(params)
    }

    /// Whether the stride is left to the frame's resolution: neither given nor the report's.
    pub fn adapts_stride(&self) -> bool {
        self.stride.is_none() && !matches!(self.preset, Some(PresetArg::Paper))
    }

    /// The parameters for a frame's resolution.
    pub fn at_resolution_of(&self, params: SmoothParams, frame: Frame<'_>) -> SmoothParams {
        if self.adapts_stride() { params.at_resolution_of(frame) } else { params }
    }

    /// Whose noise it is; of a frame, where it is to be estimated.
    fn sensor_of(&self, cloud: Option<&OrganizedCloud>) -> Result<Sensor> {
        Ok(match (self.sensor, cloud) {
            (None | Some(SensorArg::Kinect1), _) | (Some(SensorArg::Auto), None) => Sensor::KINECT_V1,
            (Some(SensorArg::Stereo), _) => Sensor::STEREO,
            (Some(SensorArg::Exact), _) => Sensor::EXACT,
            (Some(SensorArg::Auto), Some(cloud)) => Sensor::estimate(cloud)
                .context("--sensor auto: too few depths to estimate a sensor from; name one, as --sensor kinect1")?,
        })
    }

    /// The noise by which floating pixels are told, if they are to be removed.
    pub fn floating_noise_at_1m(&self, cloud: Option<&OrganizedCloud>) -> Result<Option<f32>> {
        Ok(if self.remove_floating { Some(self.sensor_of(cloud)?.noise_at_1m) } else { None })
    }

    pub fn engine(&self) -> Engine {
        match self.engine {
            EngineArg::Auto => Engine::Auto,
            EngineArg::Cpu => Engine::Cpu,
            EngineArg::Gpu => Engine::Gpu,
            EngineArg::Reference => Engine::Reference,
        }
    }

    /// What a smoother is opened with.
    pub fn options(&self, outputs: Outputs) -> Result<SmootherOptions> {
        if self.adapter.is_some() && self.engine() != Engine::Gpu {
            bail!("--adapter chooses among GPUs: it needs --engine gpu");
        }
        let gpu = GpuOptions { adapter: self.adapter.clone(), ..GpuOptions::default() };
        Ok(SmootherOptions { engine: self.engine(), outputs, threads: self.threads, gpu, ..SmootherOptions::default() })
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
