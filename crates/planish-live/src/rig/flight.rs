//! A moment in flight.

use planish_core::{Error, FrameError, SmoothedView, internal::RigidTransform};

use super::together::Together;
use super::voxels::InVoxels;

/// A moment in flight.
pub(super) struct Flight {
    /// Of each camera that has a frame, what takes its points into the rig's frame.
    pub(super) rig_from_points: Vec<Option<RigidTransform>>,
    pub(super) results: FlightResults,
}

pub(super) enum FlightResults {
    /// Where each camera's frame is.
    Submitted(Vec<Submitted>),
    Landed(RigViews),
    /// All points together, which wait to be brought into voxels.
    Together(Box<Together>),
    /// In voxels, which wait to be smoothed.
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
    /// The camera has no frame.
    Nothing,
    /// In its smoother.
    Flying,
    Refused(FrameError),
}

/// Of each camera its result, wherever that is.
pub(super) type RigViews = Vec<Option<Result<SmoothedView, FrameError>>>;
