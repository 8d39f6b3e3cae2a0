//! The camera of a depth image, and the pose of a cloud's sensor.

use std::path::{Path, PathBuf};
use std::sync::Once;

use anyhow::{Context, Result, bail};
use planish::io::{Trajectory, read_trajectory};
use planish::{Camera, SensorPose, Settings, io};
use planish_bench::errln;

use super::CAMERA;

#[derive(clap::Args, Clone)]
pub struct CameraArgs {
    /// Intrinsics of the depth camera in pixels
    #[arg(long, value_name = "FX,FY,CX,CY", conflicts_with = "camera_file", allow_hyphen_values = true)]
    pub camera: Option<Intrinsics>,
    /// File with intrinsics and lens distortion
    ///
    /// JSON (fx, fy, cx, cy, or a matrix), the YAML of a ROS camera_info, OpenCV's YAML or XML, a 3x3 or 4x4 matrix as
    /// text, or COLMAP's cameras.txt.
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    pub camera_file: Option<PathBuf>,
    /// Depth units per metre: 1000 for millimetres, 5000 for TUM and ICL-NUIM
    ///
    /// The inverse of librealsense's depth scale. Floating-point depth is in metres without it.
    #[arg(long, value_name = "UNITS", alias = "depth-scale", allow_negative_numbers = true, hide_short_help = true, help_heading = CAMERA)]
    pub depth_units_per_metre: Option<f64>,
    /// The camera that the input has itself.
    #[arg(skip)]
    own: Option<Camera>,
}

#[derive(clap::Args)]
pub struct PosesArgs {
    /// Poses of a moving camera, with --temporal: TUM's groundtruth.txt, by time, or trajectory.log, by frame
    ///
    /// TUM's: time stamp in seconds, position in metres and quaternion x, y, z, w of the camera in the world. Names of
    /// files in a folder are then times in seconds.
    #[arg(long, value_name = "FILE", hide_short_help = true, help_heading = CAMERA)]
    pub poses: Option<PathBuf>,
}

impl PosesArgs {
    /// Reads the poses, if given.
    pub fn read(&self, settings: &Settings) -> Result<Option<Trajectory>> {
        let Some(file) = &self.poses else { return Ok(None) };
        if settings.temporal_params().is_none() {
            bail!("--poses applies only to smoothing over time; add --temporal steady");
        }
        if settings.tracks_camera() {
            bail!("--poses and --track cannot be combined; remove --track, since the poses state the camera's motion");
        }
        Ok(Some(read_trajectory(file)?))
    }
}

#[derive(clap::Args)]
pub struct PoseArgs {
    /// Pose of the sensor in the cloud's frame: position in metres and unit quaternion [default: the file's]
    ///
    /// The sensor looks along its z axis, with x to the right and y down.
    #[arg(long, value_name = "X,Y,Z,QW,QX,QY,QZ", allow_hyphen_values = true, hide_short_help = true, help_heading = CAMERA)]
    pub sensor_pose: Option<Pose>,
}

impl PoseArgs {
    /// Returns the pose, if given.
    pub fn pose(&self) -> Result<Option<SensorPose>> {
        let Some(Pose(numbers)) = self.sensor_pose else { return Ok(None) };
        let pose = SensorPose::from_viewpoint(numbers);
        pose.validate().context("--sensor-pose")?;
        Ok(Some(pose))
    }
}

impl CameraArgs {
    /// Returns these options, with the camera that an input contains itself, if any.
    pub fn or(&self, own: Option<Camera>) -> Self {
        Self { own, ..self.clone() }
    }

    /// Returns true if any camera option is set.
    pub fn is_given(&self) -> bool {
        self.camera.is_some() || self.camera_file.is_some() || self.depth_units_per_metre.is_some()
    }

    /// Returns the camera for frames of this shape; `None` if no option is set.
    pub fn camera(&self, shape: (usize, usize)) -> Result<Option<Camera>> {
        self.read(Some(shape))
    }

    /// Returns the camera for frames of unknown shape, which is then 0x0.
    pub fn camera_of_any_shape(&self) -> Result<Option<Camera>> {
        self.read(None)
    }

    fn read(&self, shape: Option<(usize, usize)>) -> Result<Option<Camera>> {
        let mut camera = match (&self.camera, &self.camera_file) {
            (Some(Intrinsics([fx, fy, cx, cy])), _) => Camera::new(shape.unwrap_or_default(), [*fx, *fy], [*cx, *cy]),
            (None, Some(file)) => {
                let read = io::read_camera_file(file, shape)?;
                // The file is read again for every frame of a folder.
                static TOLD: Once = Once::new();
                TOLD.call_once(|| read.notes.iter().for_each(|note| errln!("{}: {note}", file.display())));
                read.camera
            }
            (None, None) => match (self.own, shape) {
                (Some(own), Some(shape)) => own.with_shape(shape),
                _ => return Ok(None),
            },
        };
        if let Some(scale) = self.depth_units_per_metre {
            camera.depth_units_per_metre = scale;
        }
        // The other values must be valid for any shape.
        camera.with_shape((camera.width.max(1), camera.height.max(1))).validate()?;
        Ok(Some(camera))
    }

    /// Returns the camera of a depth image; an error if no camera is given.
    pub fn required(&self, shape: (usize, usize), file: &Path) -> Result<Camera> {
        let (width, height) = shape;
        self.camera(shape)?.with_context(|| {
            format!(
                "{}: a depth image of {width}x{height} needs its camera: add --camera FX,FY,CX,CY or --camera-file \
                 FILE, and --depth-units-per-metre if a unit is not a millimetre (Kinect v1: --camera 525,525,319.5,239.5)",
                file.display()
            )
        })
    }
}

/// fx, fy, cx, cy in pixels.
#[derive(Clone, Copy)]
pub struct Intrinsics([f64; 4]);

impl std::str::FromStr for Intrinsics {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers(text).map(Self).ok_or_else(|| "expected 4 numbers: FX,FY,CX,CY".to_owned())
    }
}

/// Pose of a sensor: position in metres, and quaternion w, x, y, z.
#[derive(Clone, Copy)]
pub struct Pose([f64; 7]);

impl std::str::FromStr for Pose {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers(text).map(Self).ok_or_else(|| "expected 7 numbers: X,Y,Z,QW,QX,QY,QZ".to_owned())
    }
}

/// Direction from the points to the viewer; from above by default.
#[derive(Clone, Copy)]
pub struct Direction(pub [f64; 3]);

impl Default for Direction {
    fn default() -> Self {
        Self([0.0, 0.0, 1.0])
    }
}

impl std::str::FromStr for Direction {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers(text).map(Self).ok_or_else(|| "expected 3 numbers: X,Y,Z".to_owned())
    }
}

pub(super) fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    numbers?.try_into().ok()
}
