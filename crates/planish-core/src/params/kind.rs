//! The parameters for either kind of input.

use super::cloud::CloudParams;
use super::frame::FrameParams;
use crate::error::ParamError;

/// The parameters of a frame on a grid, or of an unorganized cloud.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Params {
    /// Parameters for frames on a grid.
    Frame(FrameParams),
    /// Parameters for unorganized clouds.
    Cloud(CloudParams),
}

impl From<FrameParams> for Params {
    fn from(params: FrameParams) -> Self {
        Self::Frame(params)
    }
}

impl From<CloudParams> for Params {
    fn from(params: CloudParams) -> Self {
        Self::Cloud(params)
    }
}

impl Params {
    /// Refuses every value outside its range.
    pub fn validate(&self) -> Result<(), ParamError> {
        match self {
            Self::Frame(params) => params.validate(),
            Self::Cloud(params) => params.validate(),
        }
    }
}
