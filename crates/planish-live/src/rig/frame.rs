//! The results of a moment.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use super::Rig;
use crate::stream::StreamFrame;
use planish_core::clean::voxel_downsample;
use planish_core::{FrameError, Outputs, PointCloud};

/// The frames of a moment with their results, as sinks receive them.
#[non_exhaustive]
pub struct RigFrame {
    /// Index among the smoothed moments, from 0.
    pub index: u64,
    /// The earliest timestamp of the moment's frames in seconds, including time offsets.
    pub time_s: f64,
    /// Each camera's frame and result, in the order of the rig's cameras; `None` for a camera without a smoothed
    /// frame.
    pub cameras: Vec<Option<StreamFrame>>,
    /// The rig.
    pub rig: Arc<Rig>,
    /// The fields that were computed.
    pub outputs: Outputs,
    /// Time from the arrival of the moment's first frame until the results were available.
    pub latency: Duration,
    /// Voxel size in metres if the points were thinned to voxels.
    pub voxel_m: Option<f64>,
    pub(super) fused: OnceLock<Result<PointCloud, FrameError>>,
}

impl RigFrame {
    /// Returns all smoothed points in the rig's frame, with the fields of their frames, the computed outputs, and
    /// `camera`, the index of the camera. If points were thinned, returns one point per voxel: the mean of the
    /// smoothed points of all cameras in it, with their fields. The cloud is computed on the first call.
    pub fn fused(&self) -> Result<&PointCloud, FrameError> {
        let fused = self.fused.get_or_init(|| {
            let frames = self.cameras.iter().map(|frame| frame.as_ref().map(|frame| (&frame.source, &frame.smoothed)));
            let fused = self.rig.fuse(&frames.collect::<Vec<_>>(), self.outputs)?;
            match self.voxel_m {
                Some(size_m) => voxel_downsample(&fused, size_m).map_err(FrameError::BadVoxel),
                None => Ok(fused),
            }
        });
        fused.as_ref().map_err(Clone::clone)
    }
}
