//! Rigs of several cameras.

use std::path::PathBuf;

use clap::ValueEnum;
use planish::rig::RigWay;
use planish::simulate::PoseErrors;

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum RigWayArg {
    /// Each camera's frame on its own, then merged (the default)
    Each,
    /// All points as one general cloud: surfaces that several cameras see become one; slow without a GPU
    Merged,
    /// As range images of what all cameras see from where each stands: the same, at the pace of frames
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
pub struct RigArgs {
    /// A rig.json, to check and describe; or a calibration to make one of: the static transforms of ROS (`ros2 topic
    /// echo /tf_static` in a file), a URDF, Kalibr's camchain.yaml, COLMAP's rig_config.json, or a folder with COLMAP's
    /// cameras.txt and images.txt
    #[arg(required_unless_present = "simulate")]
    pub file: Option<PathBuf>,
    /// The rig.json to write
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Where a camera's frames come from, as `planish stream` takes it, files and folders as from here:
    /// left=realsense:0123, right=recordings/right
    #[arg(long, value_name = "NAME=SOURCE")]
    pub source: Vec<String>,
    /// Of transforms of ROS: the frame that becomes the rig's, if not the one that all others hang on
    #[arg(long, value_name = "FRAME")]
    pub base: Option<String>,
    /// Of transforms of ROS: a frame that is a camera; else those whose names end in depth_optical_frame, or in
    /// optical_frame
    #[arg(long, value_name = "FRAME")]
    pub frame: Vec<String>,
    /// Of COLMAP, whose units are any: metres in one
    #[arg(long, value_name = "METRES")]
    pub scale: Option<f64>,
    /// Simulate a rig of so many cameras (2 to 8) round a table instead, and write its recordings and rig.json into the
    /// folder of --out
    #[arg(long, value_name = "CAMERAS", conflicts_with_all = ["file", "source", "base", "frame", "scale"], requires = "out",
          value_parser = clap::value_parser!(u8).range(2..=8))]
    pub simulate: Option<u8>,
    /// Of a simulated rig: frames of each camera
    #[arg(long, value_name = "N", default_value_t = 30, requires = "simulate", value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: u64,
    /// Of a simulated rig: the seed of scene and noise
    #[arg(long, default_value_t = 1, requires = "simulate")]
    pub seed: u64,
    /// Of a simulated rig: how far the written poses are off, in degrees and millimetres
    #[arg(long, value_name = "DEG,MM", requires = "simulate")]
    pub pose_errors: Option<PoseErrorsArg>,
    /// Print one JSON object to standard output
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
            _ => Err("two numbers, at most 10 degrees and 100 millimetres, as 0.2,2".to_owned()),
        }
    }
}
