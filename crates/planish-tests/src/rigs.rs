//! Conversion of simulated cases to rigs and frames.

use planish::evaluate::{RigCase, RigCaseCamera};
use planish::rig::{Rig, RigCamera};
use planish::{Frame, IntoFrame};

/// Returns the rig of a case, with its stated poses.
pub fn rig_of(case: &RigCase) -> Rig {
    let camera = |(i, camera): (usize, &RigCaseCamera)| {
        RigCamera::new(&format!("camera{i}"), camera.stated.sensor_pose().unwrap())
    };
    Rig::new(case.cameras.iter().enumerate().map(camera).collect()).unwrap()
}

/// Returns a case's frames, one per camera.
pub fn frames_of(case: &RigCase) -> Vec<Option<Frame<'_>>> {
    case.cameras.iter().map(|camera| Some(camera.frame.into_frame().unwrap())).collect()
}
