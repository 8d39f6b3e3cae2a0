//! Rigs of several cameras.

use std::path::PathBuf;

use clap::ValueEnum;
use planish::rig::RigWay;
use planish::simulate::PoseErrors;

const SIMULATION: &str = "Simulation";

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum RigWayArg {
    /// Each camera's frame separately, then merged (the default)
    Each,
    /// All points as one unorganized cloud: surfaces seen by several cameras become one; slow without a GPU
    Merged,
    /// Range images of all points from each camera's position: surfaces become one too, at the speed of frames
    Views,
}

impl From<RigWayArg> for RigWay {
    fn from(arg: RigWayArg) -> Self {
        match arg {
            RigWayArg::Each => Self::Each,
            RigWayArg::Merged => Self::Merged,
            RigWayArg::Views => Self::Views,
        }
    }
}

#[derive(clap::Args)]
#[command(after_help = "Examples:\n  planish rig tf_static.yaml --out rig.json --source left=realsense:0123\n  \
                        planish rig --simulate 4 --out simulated")]
pub struct RigArgs {
    /// rig.json to check and describe, or a calibration to convert
    ///
    /// Calibrations: static transforms of ROS (the output of `ros2 topic echo /tf_static`), a URDF, Kalibr's
    /// camchain.yaml, COLMAP's rig_config.json, or a folder with COLMAP's cameras.txt and images.txt.
    #[arg(required_unless_present = "simulate")]
    pub file: Option<PathBuf>,
    /// rig.json to write; with --simulate a folder
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Source of a camera's frames, such as left=realsense:0123 or right=recordings/right; may be repeated
    ///
    /// Sources are those of `planish stream`; paths are relative to the current folder.
    #[arg(long, value_name = "NAME=SOURCE")]
    pub source: Vec<String>,
    /// For ROS transforms: coordinate frame of the rig [default: the root]
    #[arg(long, value_name = "FRAME")]
    pub base: Option<String>,
    /// For ROS transforms: frame of a camera; may be repeated
    ///
    /// By default, all frames whose names end in depth_optical_frame or, if there are none, in optical_frame.
    #[arg(long, value_name = "FRAME")]
    pub frame: Vec<String>,
    /// For COLMAP: metres per unit of the model
    #[arg(long, value_name = "METRES")]
    pub scale: Option<f64>,
    /// Number of cameras (2 to 8) of a simulated rig around a table
    ///
    /// Writes its recordings and rig.json into the folder --out.
    #[arg(long, value_name = "CAMERAS", conflicts_with_all = ["file", "source", "base", "frame", "scale"], requires = "out",
          value_parser = clap::value_parser!(u8).range(2..=8), help_heading = SIMULATION)]
    pub simulate: Option<u8>,
    /// Number of frames per camera
    #[arg(long, value_name = "N", default_value_t = 30, requires = "simulate", value_parser = clap::value_parser!(u64).range(1..), help_heading = SIMULATION)]
    pub frames: u64,
    /// Seed of scene and noise
    #[arg(long, default_value_t = 1, requires = "simulate", help_heading = SIMULATION)]
    pub seed: u64,
    /// Errors of the written poses in degrees and millimetres
    #[arg(long, value_name = "DEG,MM", requires = "simulate", help_heading = SIMULATION)]
    pub pose_errors: Option<PoseErrorsArg>,
    /// Print a report as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Errors of poses: an angle in degrees and a length in millimetres.
#[derive(Clone, Copy)]
pub struct PoseErrorsArg(pub PoseErrors);

impl std::str::FromStr for PoseErrorsArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed =
            text.split_once(',').and_then(|(deg, mm)| Some((deg.trim().parse().ok()?, mm.trim().parse().ok()?)));
        let within = |value: f64, most: f64| (0.0..=most).contains(&value);
        match parsed {
            Some((deg, mm)) if within(deg, 10.0) && within(mm, 100.0) => Ok(Self(PoseErrors::new(deg, 1e-3 * mm))),
            _ => Err("expected two numbers, up to 10 degrees and up to 100 millimetres, such as 0.2,2".to_owned()),
        }
    }
}
