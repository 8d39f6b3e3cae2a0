//! The arguments, and how they become the library's types. Defaults live in the library: options here are `Option`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand, ValueEnum};
use planish::io::Encoding;
use planish::{
    Camera, Edges, Engine, GpuOptions, OrganizedCloud, Outputs, Radius, Sensor, SmoothParams, SmootherOptions, Strength,
};

/// Smooth point clouds of depth cameras: organized in, organized out, colour and holes kept.
#[derive(Parser)]
#[command(version, about, after_help = "Start with `planish demo`, then `planish smooth your.pcd smooth.pcd`.")]
pub struct Args {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Subcommand)]
pub enum Command {
    /// Simulate a noisy depth frame, smooth it, and show the difference
    Demo(DemoArgs),
    /// Smooth a file, or every frame of a folder
    Smooth(SmoothArgs),
    /// Say what a file holds
    Info(InfoArgs),
    /// Draw the relief of an organized cloud
    Render(RenderArgs),
    /// Smooth frames as they come: from a Kinect, a data set, a folder, the simulator
    Stream(StreamArgs),
    /// Record frames as they come into a data set in TUM layout
    Record(RecordArgs),
    /// Say what this machine computes with: instruction sets, GPUs, and what `auto` takes
    Devices(DevicesArgs),
    /// Measure how good the surface is: on simulated frames against their truth, or on a file by itself
    Evaluate(EvaluateArgs),
    /// Measure the engines, each result held against the reference first
    Bench(BenchArgs),
}

#[derive(clap::Args)]
pub struct DemoArgs {
    /// Folder for raw.pcd, smoothed.pcd and before-after.png
    #[arg(long, value_name = "DIR", default_value = "planish-demo")]
    pub out: PathBuf,
    /// Which scene and which noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
}

#[derive(clap::Args)]
pub struct SmoothArgs {
    /// A cloud (.pcd, .ply, .npy), a depth image (.png, .tiff, .npy), or a folder of them
    pub input: PathBuf,
    /// The file or folder to write; depth in and .png, .tiff or .npy out gives depth
    pub output: PathBuf,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Fields to add to the points, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    /// How the points of a .pcd or .ply are stored
    #[arg(long, value_enum)]
    pub encoding: Option<EncodingArg>,
    /// File type for a folder of results, when it is not that of the input
    #[arg(long, value_name = "EXTENSION")]
    pub format: Option<String>,
    /// Smooth the loaded frame this many times, for timing
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct InfoArgs {
    /// The file
    pub file: PathBuf,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct RenderArgs {
    /// An organized cloud, or a depth image with --camera
    pub file: PathBuf,
    /// The picture to write: relief, and beside it the colours if there are any
    pub output: PathBuf,
    #[command(flatten)]
    pub camera: CameraArgs,
}

#[derive(clap::Args)]
pub struct StreamArgs {
    /// kinect[:INDEX], synthetic[:SEED], a data set in TUM layout, a recording of libfreenect, a folder of frames, or one
    /// file, repeated
    pub source: String,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub limits: LimitArgs,
    /// Write every result into this folder
    #[arg(long, value_name = "DIR")]
    pub save: Option<PathBuf>,
    /// What to write there
    #[arg(long, value_enum, requires = "save")]
    pub format: Option<StreamFormatArg>,
    /// Show raw and smoothed clouds, depth, latency and rate in the viewer of Rerun
    #[cfg(feature = "rerun")]
    #[arg(long, conflicts_with = "rrd")]
    pub rerun: bool,
    /// Write the same as a file that the viewer of Rerun opens; some 7 MB a frame
    #[cfg(feature = "rerun")]
    #[arg(long, value_name = "FILE")]
    pub rrd: Option<PathBuf>,
    /// Fields to add to the points, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "FIELDS")]
    pub fields: Vec<FieldArg>,
    /// Print one JSON object to standard output at the end
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct LimitArgs {
    /// Give frames so many a second, as a live camera does; else as fast as they are taken
    #[arg(long, value_name = "N")]
    pub fps: Option<f64>,
    /// End after so many frames
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// End after so many seconds
    #[arg(long, value_name = "S")]
    pub duration: Option<f64>,
    /// Wait for a camera that was unplugged to come back
    #[arg(long)]
    pub reconnect: bool,
}

#[derive(clap::Args)]
pub struct RecordArgs {
    /// kinect[:INDEX], synthetic[:SEED], or any other source of depth
    pub source: String,
    /// The folder to make
    pub folder: PathBuf,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub limits: LimitArgs,
    /// Print one JSON object to standard output at the end
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum StreamFormatArg {
    /// Organized clouds (the default)
    Pcd,
    Ply,
    /// 16-bit depth images
    Png,
}

#[derive(clap::Args)]
pub struct DevicesArgs {
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct EvaluateArgs {
    /// Simulate so many seeds, from 1 on; three frames each
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..))]
    pub seeds: u64,
    /// Simulate this seed alone
    #[arg(long, value_name = "SEED", conflicts_with = "seeds")]
    pub seed: Option<u64>,
    /// A real organized cloud, or a depth image with --camera: how flat it is piece by piece, before and after
    #[arg(long, value_name = "FILE", conflicts_with_all = ["seeds", "seed", "export", "out"])]
    pub input: Option<PathBuf>,
    /// Write the simulated frames as organized clouds into this folder and do nothing else, for other programs to smooth
    #[arg(long, value_name = "DIR", conflicts_with_all = ["results", "out"])]
    pub export: Option<PathBuf>,
    /// Measure what another program made of those: organized clouds of the same names, perhaps with normals, in this folder; with
    /// --input the one that it made of that file
    #[arg(long, value_name = "DIR|FILE")]
    pub results: Option<PathBuf>,
    /// Folder for report.json, error-over-z.svg and, but with --results, an error map of each frame of the first seed
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub smoothing: SmoothingArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(clap::Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    pub what: BenchCommand,
}

#[derive(Subcommand)]
pub enum BenchCommand {
    /// The GPU engine: its kernels, one frame at a time, frames in flight, batches
    Gpu(BenchGpuArgs),
    /// Experiment 1 of the 2011 report: times of a frame, and how many times the serial method's
    Speedup(ExperimentArgs),
    /// Experiment 2: time over the candidates of a window
    Connectivity(ExperimentArgs),
    /// Experiment 3: the scene several times over, as a tall cloud and as a batch; threads
    Scaleup(ExperimentArgs),
    /// Where the time of a frame goes
    Profile(ExperimentArgs),
    /// A frame raw and smoothed, and its largest plane before and after
    Quality(ExperimentArgs),
    /// All five, one after the other
    All(ExperimentArgs),
}

#[derive(clap::Args)]
pub struct ExperimentArgs {
    /// Which engines, separated by commas; else, or with auto, all that this machine has but GPUs in software
    #[arg(long, value_enum, value_delimiter = ',', value_name = "ENGINES")]
    pub engine: Vec<EngineArg>,
    /// Frames: organized clouds; else a simulated room and a simulated table
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub input: Vec<PathBuf>,
    /// Fewer and shorter measurements: all five in about a minute on two cores
    #[arg(long)]
    pub quick: bool,
    /// Folder for each experiment's JSON, Markdown and plots
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

#[derive(clap::Args)]
pub struct BenchGpuArgs {
    /// A frame: an organized cloud of a camera at 640x480 with a focal length of 525; else a simulated one
    #[arg(long, value_name = "FILE")]
    pub input: Option<PathBuf>,
    /// Which GPU, by its index or part of its name (see `planish devices`); else the first real one
    #[arg(long, value_name = "NAME|INDEX")]
    pub adapter: Option<String>,
    /// Frames for each figure
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u32).range(2..))]
    pub runs: u32,
    /// Print one JSON object to standard output
    #[arg(long)]
    pub json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FieldArg {
    /// normal_x, normal_y, normal_z
    Normals,
    /// Surface variation
    Curvature,
    /// What became of each point: 0 hole, 1 too few neighbours, 2 line, 3 plane, 4 and 5 polynomial of degree 2 and 3
    Status,
    /// Nothing (the default)
    None,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum EncodingArg {
    Ascii,
    Binary,
    Compressed,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum EngineArg {
    Auto,
    Cpu,
    Gpu,
    Reference,
}

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
    /// Distance between candidates in pixels, 1 to 8
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

/// fx, fy, cx, cy in pixels.
#[derive(Clone, Copy)]
pub struct Intrinsics([f64; 4]);

impl std::str::FromStr for Intrinsics {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
        numbers.and_then(|numbers| numbers.try_into().ok()).map(Self).ok_or_else(|| "4 numbers: FX,FY,CX,CY".to_owned())
    }
}

#[derive(clap::Args)]
pub struct CameraArgs {
    /// Intrinsics of the depth camera in pixels
    #[arg(long, value_name = "FX,FY,CX,CY", conflicts_with = "camera_file")]
    pub camera: Option<Intrinsics>,
    /// Intrinsics as JSON: fx, fy, cx, cy, or Open3D's intrinsic_matrix
    #[arg(long, value_name = "FILE.json")]
    pub camera_file: Option<PathBuf>,
    /// Depth units in a metre: 1000 for millimetres, 5000 for TUM and ICL-NUIM
    #[arg(long, value_name = "UNITS_PER_METRE")]
    pub depth_scale: Option<f64>,
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

/// The outputs that fields are made from.
pub fn outputs_of(fields: &[FieldArg]) -> Outputs {
    let wants = |field| fields.contains(&field);
    Outputs {
        normals: wants(FieldArg::Normals),
        curvature: wants(FieldArg::Curvature),
        status: wants(FieldArg::Status),
        ..Outputs::POINTS
    }
}

impl SmoothArgs {
    pub fn outputs(&self) -> Outputs {
        outputs_of(&self.fields)
    }

    pub fn encoding(&self) -> Encoding {
        match self.encoding {
            None | Some(EncodingArg::Binary) => Encoding::Binary,
            Some(EncodingArg::Ascii) => Encoding::Ascii,
            Some(EncodingArg::Compressed) => Encoding::BinaryCompressed,
        }
    }
}

impl CameraArgs {
    /// The camera for frames of this shape; `None` if the user gave none.
    pub fn camera(&self, (width, height): (usize, usize)) -> Result<Option<Camera>> {
        let mut camera = match (&self.camera, &self.camera_file) {
            (Some(Intrinsics([fx, fy, cx, cy])), _) => {
                Camera { width, height, fx: *fx, fy: *fy, cx: *cx, cy: *cy, ..Camera::kinect_v1() }
            }
            (None, Some(file)) => read_camera(file, (width, height))?,
            (None, None) => return Ok(None),
        };
        if let Some(scale) = self.depth_scale {
            camera.depth_units_per_metre = scale;
        }
        camera.validate()?;
        Ok(Some(camera))
    }

    /// The camera for frames whose shape is not known yet: 0x0 where it was not said.
    pub fn camera_of_any_shape(&self) -> Result<Option<Camera>> {
        let mut camera = match (&self.camera, &self.camera_file) {
            (Some(Intrinsics([fx, fy, cx, cy])), _) => {
                Camera { width: 0, height: 0, fx: *fx, fy: *fy, cx: *cx, cy: *cy, ..Camera::kinect_v1() }
            }
            (None, Some(file)) => {
                let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
                Camera::from_json_of_any_shape(&text).with_context(|| file.display().to_string())?
            }
            (None, None) => return Ok(None),
        };
        if let Some(scale) = self.depth_scale {
            camera.depth_units_per_metre = scale;
        }
        // Whatever the shape is to be, the rest must describe a camera.
        Camera { width: camera.width.max(1), height: camera.height.max(1), ..camera }.validate()?;
        Ok(Some(camera))
    }

    /// The camera, which a depth image cannot do without.
    pub fn required(&self, shape: (usize, usize), file: &Path) -> Result<Camera> {
        let (width, height) = shape;
        self.camera(shape)?.with_context(|| {
            format!(
                "{}: a depth image of {width}x{height} needs its camera: add --camera FX,FY,CX,CY or --camera-file \
                 FILE.json, and --depth-scale if a unit is not a millimetre (Kinect v1: --camera 525,525,319.5,239.5)",
                file.display()
            )
        })
    }
}

fn read_camera(file: &Path, shape: (usize, usize)) -> Result<Camera> {
    let text = fs::read_to_string(file).with_context(|| file.display().to_string())?;
    Camera::from_json(&text, shape).with_context(|| file.display().to_string())
}
