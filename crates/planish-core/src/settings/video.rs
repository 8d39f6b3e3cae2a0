//! Settings for smoothing over time.

use super::{Settings, TemporalChoice};
use crate::error::ParamError;
use crate::temporal::TemporalParams;
use crate::threads::ONE_THREAD;

impl Settings {
    /// Returns the parameters for smoothing over time; `None` if frames are not smoothed over time.
    pub fn temporal_params(&self) -> Option<TemporalParams> {
        // WebAssembly builds omit smoothing over time, and `validate` refuses it there.
        let is_steady = self.temporal == Some(TemporalChoice::Steady) || self.tracks_camera();
        (is_steady && !ONE_THREAD).then_some(TemporalParams::STEADY)
    }

    /// Returns true if the motion of the camera is estimated from frame to frame.
    pub fn tracks_camera(&self) -> bool {
        self.track == Some(true)
    }

    /// Refuses settings with which the poses of a moving camera have no effect. Call this for inputs with poses.
    ///
    /// # Errors
    /// If frames are not smoothed over time, or if `track` estimates the motion.
    pub fn check_poses(&self) -> Result<(), ParamError> {
        let allowed = match (self.temporal_params(), self.tracks_camera()) {
            (None, _) => "poses need smoothing over time (temporal: steady)",
            (_, true) => "poses state the motion that track would estimate; omit one of the two",
            _ => return Ok(()),
        };
        Err(ParamError { field: "poses", value: "given".into(), allowed })
    }

    /// Refuses settings for smoothing over time. Call this for inputs that are not consecutive frames of one camera.
    ///
    /// # Errors
    /// If `temporal` is `steady`, or `track` is set.
    pub fn check_no_video(&self) -> Result<(), ParamError> {
        let allowed = "only for consecutive frames of a camera: a stream, a folder, a recording, a ROS topic, a rig, \
                       or a smoother in Python";
        match (self.temporal, self.tracks_camera()) {
            (Some(TemporalChoice::Steady), _) => Err(ParamError { field: "temporal", value: "steady".into(), allowed }),
            (_, true) => Err(ParamError { field: "track", value: "true".into(), allowed }),
            _ => Ok(()),
        }
    }
}
