//! Reads rigs from calibrations of other programs: ROS static transforms (the output of `ros2 topic echo /tf_static`,
//! or a URDF), Kalibr's camchain, and COLMAP's rig_config.json or text model. The type is detected from the contents.
//!
//! A calibration states the poses of cameras, and sometimes their intrinsics; the sources of their frames are added
//! later.

mod colmap;
mod kalibr;
mod ros;

use std::path::Path;

use super::file::MAX_BYTES;
use super::{Rig, RigCamera};
use planish_core::{FormatError, IoError, internal::RigidTransform};
use planish_io::{self as io, ReadOptions};

const HELP: &str = "a calibration is a list of static transforms (ros2 topic echo /tf_static), a URDF, Kalibr's \
                    camchain.yaml, COLMAP's \
                    rig_config.json, or a folder with COLMAP's cameras.txt and images.txt";

/// Information that a calibration lacks.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct CalibrationOptions {
    /// For ROS transforms: the frame that becomes the rig's; `None` selects the root of the tree.
    pub base: Option<String>,
    /// For ROS transforms: the camera frames. If empty, all frames whose names end in `depth_optical_frame` or,
    /// without such frames, in `optical_frame`.
    pub frames: Vec<String>,
    /// For COLMAP models, whose scale is arbitrary: metres per unit.
    pub metres_per_unit: f64,
}

impl Default for CalibrationOptions {
    fn default() -> Self {
        Self { base: None, frames: Vec::new(), metres_per_unit: 1.0 }
    }
}

impl CalibrationOptions {
    /// Sets the ROS frame that becomes the rig's.
    pub fn with_base(self, base: Option<String>) -> Self {
        Self { base, ..self }
    }

    /// Sets the ROS frames of the cameras.
    pub fn with_frames(self, frames: Vec<String>) -> Self {
        Self { frames, ..self }
    }

    /// Sets the scale of a COLMAP model, in metres per unit.
    pub fn with_metres_per_unit(self, metres_per_unit: f64) -> Self {
        Self { metres_per_unit, ..self }
    }

    /// Returns an error if the options name ROS frames, which `what` does not have.
    fn refuse_of_ros(&self, what: &str) -> Result<(), FormatError> {
        let given = [("base", self.base.is_some()), ("frames", !self.frames.is_empty())];
        match given.iter().find(|(_, is_given)| *is_given) {
            Some((name, _)) => Err(malformed(format!("{what} has no ROS frames; omit {name}"))),
            None => Ok(()),
        }
    }

    /// Returns an error if the options set a scale, since lengths in `what` are in metres.
    fn refuse_scale(&self, what: &str) -> Result<(), FormatError> {
        if self.metres_per_unit == 1.0 {
            return Ok(());
        }
        Err(malformed(format!("{what} is in metres; omit the scale, which applies only to COLMAP")))
    }
}

/// Reads a calibration as a rig of cameras without sources.
pub fn read(path: &Path, options: &CalibrationOptions) -> Result<Rig, IoError> {
    let read = || {
        if path.is_dir() {
            options.refuse_of_ros("a COLMAP model")?;
            return rig_of(colmap::model(path, options)?, None);
        }
        let bytes = io::read_bytes(path, &ReadOptions::default().with_max_memory_bytes(MAX_BYTES))?;
        let text = String::from_utf8(bytes).map_err(|_| malformed(format!("the file is not text; {HELP}")))?;
        parse(&text, options)
    };
    read().map_err(IoError::at(path))
}

/// Parses the text of a calibration file.
fn parse(text: &str, options: &CalibrationOptions) -> Result<Rig, FormatError> {
    match text.trim_start().chars().next() {
        Some('<') => {
            options.refuse_scale("a URDF")?;
            of_tree(ros::urdf(text)?, options)
        }
        Some('[') => {
            options.refuse_of_ros("a COLMAP rig")?;
            rig_of(colmap::rig_config(text, options)?, None)
        }
        _ if kalibr::is_camchain(text) => {
            options.refuse_of_ros("a Kalibr camchain")?;
            options.refuse_scale("a Kalibr camchain")?;
            rig_of(kalibr::camchain(text)?, None)
        }
        _ if text.contains("transforms:") => {
            options.refuse_scale("a list of ROS transforms")?;
            of_tree(ros::transforms(text)?, options)
        }
        _ => Err(malformed(format!("unknown kind of calibration; {HELP}"))),
    }
}

fn of_tree(tree: ros::Tree, options: &CalibrationOptions) -> Result<Rig, FormatError> {
    let (base, cameras) = tree.cameras(options)?;
    rig_of(cameras, Some(base))
}

fn rig_of(cameras: Vec<RigCamera>, frame: Option<String>) -> Result<Rig, FormatError> {
    let rig = Rig::new(cameras).map_err(|error| malformed(error.to_string()))?;
    Ok(Rig { frame, ..rig })
}

fn malformed(problem: impl Into<String>) -> FormatError {
    FormatError::Malformed(problem.into())
}

/// Returns a camera at this pose.
fn camera_at(name: &str, rig_from_camera: &RigidTransform) -> RigCamera {
    RigCamera::new(name, planish_core::SensorPose::from_transform(rig_from_camera))
}

/// Converts a text to a camera name: characters that are not allowed become `_`.
fn as_name(text: &str) -> String {
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    let name: String = text.trim_matches('/').chars().map(|c| if is_allowed(c) { c } else { '_' }).collect();
    name.trim_start_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_that_do_not_apply_are_refused() {
        let with_base = || CalibrationOptions::default().with_base(Some("base".into()));
        let with_scale = || CalibrationOptions::default().with_metres_per_unit(0.1);
        let transforms = "transforms:\n- header: {frame_id: a}\n";
        for (text, options, said) in [
            ("[]", with_base(), "base"),
            ("cam0:\n  T_cam_imu: []\n", with_base(), "base"),
            ("cam0:\n  T_cam_imu: []\n", with_scale(), "metres"),
            (transforms, with_scale(), "metres"),
        ] {
            let error = parse(text, &options).unwrap_err().to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
    }

    #[test]
    fn what_is_no_calibration_says_what_would_be() {
        for text in ["", "hello", "{\"cameras\":[]}", "fx: 1", "<html/>", "[]", "[1]"] {
            let said = parse(text, &CalibrationOptions::default()).unwrap_err().to_string();
            assert!(!said.is_empty() && (text.starts_with(['<', '[']) || said.contains("camchain")), "{text}: {said}");
        }
    }
}
