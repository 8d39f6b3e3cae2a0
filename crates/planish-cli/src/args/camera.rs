//! The camera of a depth image, and the pose of a cloud's sensor.

use std::path::{Path, PathBuf};
use std::sync::Once;

use anyhow::{Context, Result, bail};
use planish::io::{ReadOptions, Trajectory, read_trajectory_with};
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
    /// The inverse of librealsense's depth scale. Without this option, floating-point depth is in metres.
    #[arg(long, value_name = "UNITS", alias = "depth-scale", allow_negative_numbers = true, hide_short_help = true, help_heading = CAMERA)]
    pub depth_units_per_metre: Option<f64>,
    /// The camera that the input itself contains.
    #[arg(skip)]
    own: Option<Camera>,
}

#[derive(clap::Args)]
pub struct PosesArgs {
    /// Poses of a moving camera, with --temporal: TUM's groundtruth.txt, by time, or trajectory.log, by frame
    ///
    /// A line of a TUM file has a time stamp in seconds, and the camera's position in metres and quaternion x, y, z, w
    /// in the world. With such a file, the names of a folder's files must be times in seconds.
    #[arg(long, value_name = "FILE", hide_short_help = true, help_heading = CAMERA)]
    pub poses: Option<PathBuf>,
    /// Topic of an MCAP recording with the poses of a moving camera, with --temporal: /tf, or a topic with odometry
    ///
    /// Supported messages are TFMessage, Odometry (which needs static transforms from the robot to the camera), and
    /// PoseStamped or PoseWithCovarianceStamped of the camera itself.
    #[arg(long, value_name = "TOPIC", hide_short_help = true, help_heading = CAMERA, conflicts_with = "poses")]
    pub pose_topic: Option<String>,
    /// Fixed coordinate frame, with --pose-topic [default: odom, or the root of the camera's frames]
    #[arg(long, value_name = "FRAME", hide_short_help = true, help_heading = CAMERA, requires = "pose_topic")]
    pub fixed_frame: Option<String>,
}

impl PosesArgs {
    /// Returns true if poses are given.
    pub fn are_given(&self) -> bool {
        self.poses.is_some() || self.pose_topic.is_some()
    }

    /// Returns an error if poses are given but have no effect with these settings.
    fn check(&self, settings: &Settings) -> Result<()> {
        let option = if self.poses.is_some() { "--poses" } else { "--pose-topic" };
        match settings.check_poses() {
            Err(_) if self.are_given() && settings.tracks_camera() => {
                bail!(
                    "{option} and --track cannot be combined; remove --track, since the poses state the camera's motion"
                )
            }
            Err(_) if self.are_given() => {
                bail!("{option} applies only to smoothing over time; add --temporal steady")
            }
            _ => Ok(()),
        }
    }

    /// Reads the poses of a file, if given.
    pub fn read(&self, settings: &Settings, input: &Path, options: &ReadOptions) -> Result<Option<Trajectory>> {
        self.check(settings)?;
        if self.pose_topic.is_some() {
            bail!("{}: --pose-topic applies only to MCAP recordings", input.display());
        }
        Ok(self.poses.as_deref().map(|file| read_trajectory_with(file, options)).transpose()?)
    }

    /// Reads the poses of a file or of the recording `input`, if given. `depth_topic` is the topic of the camera.
    #[cfg(feature = "mcap")]
    pub fn read_in(
        &self,
        settings: &Settings,
        input: &Path,
        depth_topic: Option<&str>,
        options: &ReadOptions,
    ) -> Result<Option<Trajectory>> {
        match self.topic() {
            Some(topic) if planish::bag::is_bag(input) => {
                self.check(settings)?;
                let file = planish::bag::file_of(input)?;
                Ok(Some(planish::bag::camera_trajectory(&file, depth_topic, &topic, options)?))
            }
            _ => self.read(settings, input, options),
        }
    }

    /// Reads the poses of a file, if given.
    #[cfg(not(feature = "mcap"))]
    pub fn read_in(
        &self,
        settings: &Settings,
        input: &Path,
        _depth_topic: Option<&str>,
        options: &ReadOptions,
    ) -> Result<Option<Trajectory>> {
        self.read(settings, input, options)
    }

    /// Returns the poses for smoothing a recording, if given.
    #[cfg(feature = "mcap")]
    pub fn of_recording(
        &self,
        settings: &Settings,
        options: &ReadOptions,
    ) -> Result<Option<planish::bag::CameraPoses>> {
        self.check(settings)?;
        Ok(match (self.topic(), &self.poses) {
            (Some(topic), _) => Some(planish::bag::CameraPoses::Topic(topic)),
            (None, Some(file)) => Some(planish::bag::CameraPoses::Trajectory(read_trajectory_with(file, options)?)),
            (None, None) => None,
        })
    }

    #[cfg(feature = "mcap")]
    fn topic(&self) -> Option<planish::bag::PoseTopic> {
        let topic = self.pose_topic.clone()?;
        Some(planish::bag::PoseTopic { topic, fixed_frame: self.fixed_frame.clone() })
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

    /// Returns the camera for frames of unknown shape; its width and height are 0.
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

    /// Returns the camera of a depth image, or an error if no camera is given.
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
