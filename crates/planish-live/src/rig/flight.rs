//! A moment in flight.

use planish_core::{
    Error, FrameError, SmoothedView,
    internal::{ResultSight, RigidTransform},
};

use super::together::Together;
use super::voxels::InVoxels;

/// A moment in flight.
pub(super) struct Flight {
    /// The transform into the rig's frame for each camera with a frame.
    pub(super) rig_from_points: Vec<Option<RigidTransform>>,
    pub(super) results: FlightResults,
}

pub(super) enum FlightResults {
    /// The state of each camera's frame.
    Submitted(Vec<Submitted>),
    Landed(RigViews),
    /// All points together, waiting to be sorted into voxels.
    Together(Box<Together>),
    /// Points in voxels, waiting to be smoothed.
    InVoxels(Box<InVoxels>),
}

impl FlightResults {
    pub(super) fn bring_into_voxels(&mut self, size_m: f64) -> Result<(), Error> {
        match std::mem::replace(self, Self::Landed(Vec::new())) {
            Self::Together(together) => *self = Self::InVoxels(Box::new(InVoxels::of(*together, size_m)?)),
            other => *self = other,
        }
        Ok(())
    }
}

pub(super) enum Submitted {
    /// No frame from this camera.
    Nothing,
    /// A frame in its camera's smoother, with its [`ResultSight`] if the result is smoothed over time.
    Flying(Option<Box<ResultSight>>),
    Refused(FrameError),
}

/// Each camera's result.
pub(super) type RigViews = Vec<Option<Result<SmoothedView, FrameError>>>;
