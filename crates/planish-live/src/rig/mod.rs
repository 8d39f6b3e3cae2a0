//! Rigs: several cameras as one sensor.
//!
//! A [`Rig`] lists cameras and their poses; [`Rig::read`] reads it from a `rig.json`, and [`calibration`] converts
//! ROS, Kalibr and COLMAP calibrations. [`RigStream`] runs it: each camera has a thread, and [`Matcher`] groups
//! frames into moments by their timestamps. Each moment is smoothed by the method that [`RigWay`] selects;
//! [`RigSink`]s receive each camera's frame and one [fused](RigFrame::fused) cloud in the rig's frame.

pub mod calibration;
mod capture;
mod facing;
mod file;
mod flight;
mod flights;
mod frame;
mod fused;
mod general;
mod matching;
mod merge;
mod merged;
mod options;
mod picture;
#[cfg(feature = "rerun")]
mod rerun;
mod sinks;
mod smoother;
mod statistics;
mod stream;
mod together;
mod video;
mod viewpoint;
mod views;
mod voxels;

use std::path::{Path, PathBuf};

use crate::source::{Alignment, SourceOptions, StreamMode};
use planish_core::{Camera, CloudParams, Edges, FrameError, ParamError, SensorModel, SensorPose};

#[cfg(feature = "rerun")]
pub use self::rerun::RigRerunSink;
pub use file::rig_to_json;
pub use frame::RigFrame;
pub use fused::fuse;
pub use matching::{Matcher, MatcherCounts, Moment};
pub use merge::merge;
pub use options::RigOptions;
pub use picture::{PictureSink, top_down};
pub use sinks::{CamerasSink, FusedSink, RigSink};
pub use smoother::{RigResults, RigSmoother, RigWay};
pub use statistics::{CameraStatistics, RigStatistics};
pub use stream::{RigEvent, RigStream};
pub use viewpoint::Viewpoint;

/// Default tolerance between timestamps of one moment, in seconds: about half a frame interval at 30 Hz.
const DEFAULT_TOLERANCE_S: f64 = 0.016;

/// Maximum number of cameras that the field `camera` of a fused cloud distinguishes.
const MOST_CAMERAS: usize = 256;

/// Maximum number of viewpoints. Each is an additional view of the points of all cameras.
const MOST_VIEWPOINTS: usize = 64;
/// Maximum number of pixels of all viewpoints together. Each pixel takes about 80 bytes while a moment is smoothed.
const MOST_VIEWPOINT_PIXELS: usize = 1 << 24;

/// Default radius for merged points, in metres: the radius of a single frame's window at a distance of about 1.2 m.
const MERGED_RADIUS_M: f32 = 0.03;

/// Minimum radius for points thinned to voxels, in voxels. A disc of this radius on a surface covers about 30 voxels,
/// three times the number of coefficients of a polynomial of degree 3.
const VOXELS_IN_RADIUS: f32 = 3.0;

/// Default maximum distance between two cameras' surfaces due to pose errors, in metres: 0.2° and 2 mm at 1.5 m, plus
/// a margin.
const DEFAULT_REGISTRATION_M: f64 = 0.01;

/// Maximum absolute time offset in seconds, longer than the time since any clock's epoch.
const MOST_OFFSET_S: f64 = 1e10;

/// Maximum length of a camera name in characters; the name is also used for files and folders.
const LONGEST_NAME: usize = 64;

/// A set of rigidly mounted cameras.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Rig {
    /// 1 to 256 cameras with distinct names.
    pub cameras: Vec<RigCamera>,
    /// Name of the rig's frame (`frame_id` in ROS); it does not affect results.
    pub frame: Option<String>,
    /// Maximum difference between timestamps of one moment, in seconds: above 0, at most 1.
    pub tolerance_s: f64,
    /// The clock by which frames are matched.
    pub clock: Clock,
    /// Up to 64 camera-free viewpoints, smoothed as additional views.
    pub viewpoints: Vec<Viewpoint>,
}

/// The clock by which frames are matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Clock {
    /// The frames' own timestamps. Frames without a timestamp are matched by arrival time if their camera is live,
    /// otherwise by their index, assuming 30 frames per second.
    #[default]
    Source,
    /// Time of arrival, for live cameras with unrelated clocks.
    Arrival,
}

/// A camera of a rig.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct RigCamera {
    /// Name of the camera: 1 to 64 letters, digits, `-`, `_` and `.`, not starting with a dot, and not `rig.json`.
    pub name: String,
    /// Name of the frame source, as passed to [`source::open`](crate::source::open); `None` for a bare calibration.
    pub source: Option<String>,
    /// Intrinsics and distortion; `None` keeps the source's. A width and height of 0 accept frames of any shape.
    pub camera: Option<Camera>,
    /// Units per metre of the camera's depth images; `None` keeps the source's (5000 for a data set in TUM layout).
    pub depth_units_per_metre: Option<f64>,
    /// Pose in the rig's frame, rig_from_camera. The camera looks along +z, with x to the right and y down, like the
    /// optical frames of ROS.
    pub pose: SensorPose,
    /// Sensor model of the camera's depth; `None` keeps the parameters' model.
    pub sensor: Option<SensorModel>,
    /// Offset added to the camera's timestamps, in seconds.
    pub time_offset_s: f64,
    /// The image to which depth and colour are mapped, for RealSense and OpenNI2 cameras.
    pub alignment: Option<Alignment>,
    /// Stream mode, for RealSense and OpenNI2 cameras.
    pub mode: Option<StreamMode>,
}

impl Rig {
    /// Creates a rig of these cameras, whose frames are matched by their timestamps, with a tolerance of 16 ms.
    pub fn new(cameras: Vec<RigCamera>) -> Result<Self, ParamError> {
        let (tolerance_s, clock) = (DEFAULT_TOLERANCE_S, Clock::Source);
        let rig = Self { cameras, frame: None, tolerance_s, clock, viewpoints: Vec::new() };
        rig.validate()?;
        Ok(rig)
    }

    /// Sets the maximum difference between timestamps of one moment, in seconds.
    pub fn with_tolerance_s(self, tolerance_s: f64) -> Self {
        Self { tolerance_s, ..self }
    }

    /// Sets the clock by which frames are matched.
    pub fn with_clock(self, clock: Clock) -> Self {
        Self { clock, ..self }
    }

    /// Sets the camera-free viewpoints that are smoothed as additional views.
    pub fn with_viewpoints(self, viewpoints: Vec<Viewpoint>) -> Self {
        Self { viewpoints, ..self }
    }

    /// Returns the rig as written to a `rig.json` in `folder`. Source paths, relative to the working directory in
    /// `self`, become relative to `folder` if they are inside it, and absolute otherwise.
    pub fn seen_from(&self, folder: &Path) -> Self {
        let mut rig = self.clone();
        for camera in &mut rig.cameras {
            camera.source = camera.source.as_ref().map(|source| source_seen_from(folder, source));
        }
        rig
    }

    /// Returns the index of the camera with this name.
    pub fn index_of(&self, name: &str) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.name == name)
    }

    /// Refuses rigs without cameras, invalid or duplicate names, invalid poses and times, two cameras on one device,
    /// and invalid viewpoints.
    pub fn validate(&self) -> Result<(), ParamError> {
        let bad = |field, value: String, allowed| Err(ParamError { field, value, allowed });
        if self.cameras.is_empty() || self.cameras.len() > MOST_CAMERAS {
            return bad("cameras", self.cameras.len().to_string(), "1 to 256 cameras");
        }
        // False for a NaN.
        let is_tolerance = self.tolerance_s > 0.0 && self.tolerance_s <= 1.0;
        if !is_tolerance {
            return bad("tolerance_s", self.tolerance_s.to_string(), "above 0 and at most 1 s");
        }
        if self.viewpoints.len() > MOST_VIEWPOINTS {
            return bad("viewpoints", self.viewpoints.len().to_string(), "at most 64");
        }
        self.viewpoints.iter().enumerate().try_for_each(|(i, viewpoint)| viewpoint.validate(i))?;
        let pixels: usize =
            self.viewpoints.iter().map(|viewpoint| viewpoint.camera.width * viewpoint.camera.height).sum();
        if pixels > MOST_VIEWPOINT_PIXELS {
            return bad(
                "viewpoints",
                format!("{pixels} pixels"),
                "at most 16,777,216 pixels (2^24) in all viewpoints together",
            );
        }
        for (i, camera) in self.cameras.iter().enumerate() {
            camera.validate()?;
            let before = &self.cameras[..i];
            if before.iter().any(|other| other.name.eq_ignore_ascii_case(&camera.name)) {
                return bad("camera.name", camera.name.clone(), "camera names must be unique");
            }
            let is_device = |source: &&String| crate::source::is_camera(source);
            if let Some(source) = camera.source.as_ref().filter(is_device)
                && before.iter().any(|other| other.source.as_ref() == Some(source))
            {
                let value = format!("{source} (camera {:?})", camera.name);
                return bad(
                    "camera.source",
                    value,
                    "two cameras cannot share a device; name each by serial number or index",
                );
            }
        }
        Ok(())
    }
}

impl RigCamera {
    /// Creates a camera with this name and pose, without a source.
    pub fn new(name: &str, pose: SensorPose) -> Self {
        Self {
            name: name.to_owned(),
            source: None,
            camera: None,
            depth_units_per_metre: None,
            pose,
            sensor: None,
            time_offset_s: 0.0,
            alignment: None,
            mode: None,
        }
    }

    /// Sets the source.
    pub fn with_source(self, source: Option<String>) -> Self {
        Self { source, ..self }
    }

    /// Sets the intrinsics; `None` keeps the source's.
    pub fn with_camera(self, camera: Option<Camera>) -> Self {
        Self { camera, ..self }
    }

    /// Sets the number of depth units per metre; `None` keeps the source's.
    pub fn with_depth_units_per_metre(self, depth_units_per_metre: Option<f64>) -> Self {
        Self { depth_units_per_metre, ..self }
    }

    /// Sets the sensor model; `None` keeps the parameters' model.
    pub fn with_sensor(self, sensor: Option<SensorModel>) -> Self {
        Self { sensor, ..self }
    }

    /// Sets the offset added to timestamps, in seconds.
    pub fn with_time_offset_s(self, time_offset_s: f64) -> Self {
        Self { time_offset_s, ..self }
    }

    /// Returns the options for opening the camera's source.
    pub fn source_options(&self) -> SourceOptions {
        SourceOptions::default()
            .with_camera(self.camera)
            .with_tum_units_per_metre(self.depth_units_per_metre)
            .with_alignment(self.alignment)
            .with_mode(self.mode)
    }

    fn validate(&self) -> Result<(), ParamError> {
        let of = |problem: ParamError| ParamError {
            value: format!("{} (camera {:?})", problem.value, self.name),
            ..problem
        };
        let is_allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        let is_name = (1..=LONGEST_NAME).contains(&self.name.len())
            && !self.name.starts_with('.')
            && self.name.chars().all(is_allowed)
            // `rig.json` is in the same folder as the cameras' results.
            && !self.name.eq_ignore_ascii_case("rig.json");
        if !is_name {
            let allowed = "1 to 64 letters, digits, -, _ and ., not starting with a dot, and not rig.json";
            return Err(ParamError { field: "camera.name", value: format!("{:?}", self.name), allowed });
        }
        if let Err(FrameError::BadPose(problem)) = self.pose.validate() {
            return Err(of(problem));
        }
        // PCD files mark an unknown orientation by zeros; a rig's camera needs a known orientation.
        if self.pose.orientation == [0.0; 4] {
            let value = "0, 0, 0, 0".to_owned();
            return Err(of(ParamError { field: "orientation", value, allowed: "a quaternion of length 1" }));
        }
        if let Some(sensor) = self.sensor {
            sensor.validate().map_err(of)?;
        }
        // False for a NaN.
        let is_offset = self.time_offset_s.abs() <= MOST_OFFSET_S;
        if !is_offset {
            let value = self.time_offset_s.to_string();
            return Err(of(ParamError { field: "time_offset_s", value, allowed: "-1e10 to 1e10 s" }));
        }
        Ok(())
    }
}

/// Returns parameters for smoothing the points of several depth cameras as one cloud: a radius of 3 cm, edges kept,
/// points without neighbours removed.
pub fn merged_params() -> CloudParams {
    CloudParams::default().with_radius_m(MERGED_RADIUS_M).with_edges(Edges::Robust).with_remove_isolated(true)
}

/// Returns parameters for merged points thinned to one per voxel of `voxel_m` metres: the radius is 3 cm, or three
/// voxels if that is larger.
pub fn merged_params_in_voxels(voxel_m: f64) -> CloudParams {
    merged_params().with_radius_m(MERGED_RADIUS_M.max(VOXELS_IN_RADIUS * voxel_m as f32))
}

/// Resolves a source named in a file: paths are relative to the file's folder.
fn resolve_source(folder: &Path, source: &str) -> String {
    let path_of = |path: &str| folder.join(path).to_string_lossy().into_owned();
    match source.split_once(':') {
        _ if matches!(source, "kinect" | "realsense" | "openni2" | "synthetic") => source.to_owned(),
        Some(("kinect" | "synthetic", _)) => source.to_owned(),
        Some((kind @ ("realsense" | "openni2"), name)) if folder.join(name).is_file() => {
            format!("{kind}:{}", path_of(name))
        }
        Some(("realsense" | "openni2", _)) => source.to_owned(),
        _ => path_of(source),
    }
}

/// Returns the source as named in a rig file in `folder`: a path inside the folder becomes relative, any other
/// absolute.
fn source_seen_from(folder: &Path, source: &str) -> String {
    let seen = |path: &str| {
        let whole = |path: &Path| path.canonicalize().or_else(|_| std::path::absolute(path));
        match (whole(Path::new(path)), whole(folder)) {
            // The path starts with `./`, since a folder may be named like a camera type, such as `kinect`.
            (Ok(path), Ok(folder)) => match path.strip_prefix(&folder) {
                Ok(within) => Path::new(".").join(within).to_string_lossy().into_owned(),
                Err(_) => path.to_string_lossy().into_owned(),
            },
            _ => path.to_owned(),
        }
    };
    match source.split_once(':') {
        _ if matches!(source, "kinect" | "realsense" | "openni2" | "synthetic") => source.to_owned(),
        Some(("kinect" | "synthetic", _)) => source.to_owned(),
        Some((kind @ ("realsense" | "openni2"), name)) if Path::new(name).is_file() => format!("{kind}:{}", seen(name)),
        Some(("realsense" | "openni2", _)) => source.to_owned(),
        _ => seen(source),
    }
}

/// Returns the folder that contains a file.
fn folder_of(path: &Path) -> PathBuf {
    path.parent().map(Path::to_path_buf).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig(names: &[&str]) -> Result<Rig, ParamError> {
        Rig::new(names.iter().map(|name| RigCamera::new(name, SensorPose::IDENTITY)).collect())
    }

    #[test]
    fn cameras_need_names_of_their_own() {
        assert!(rig(&["left", "right.2", "a-b_c"]).is_ok());
        for names in [&["left", "left"][..], &["left", "LEFT"], &[""], &["a/b"], &[".."], &["é"], &[]] {
            let error = rig(names).unwrap_err();
            assert!(error.field == "camera.name" || names.is_empty(), "{error}");
        }
    }

    #[test]
    fn what_is_no_place_time_or_device_of_its_own_is_refused_with_the_camera_s_name() {
        let of = |change: &dyn Fn(&mut RigCamera)| {
            let mut rig = rig(&["left", "right"]).unwrap();
            rig.cameras.iter_mut().for_each(change);
            rig.validate().unwrap_err().to_string()
        };
        for said in [
            of(&|camera| camera.pose.orientation = [2.0, 0.0, 0.0, 0.0]),
            of(&|camera| camera.pose.position_m = [f64::NAN, 0.0, 0.0]),
            of(&|camera| camera.time_offset_s = f64::INFINITY),
            of(&|camera| camera.source = Some("realsense".into())),
            of(&|camera| camera.sensor = Some(SensorModel::new([0.0; 3], [f32::NAN; 3]))),
        ] {
            assert!(said.contains("\"left\"") || said.contains("\"right\""), "{said}");
        }
        // Two cameras may share the simulator or one file.
        let mut rig = rig(&["left", "right"]).unwrap();
        rig.cameras.iter_mut().for_each(|camera| camera.source = Some("synthetic".into()));
        assert!(rig.validate().is_ok());
        assert!(rig.with_tolerance_s(f64::NAN).validate().is_err());
    }
}
