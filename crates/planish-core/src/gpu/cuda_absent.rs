//! CUDA's memory where it cannot be shared: opening is an error.

use std::convert::Infallible;

use crate::camera::Camera;
use crate::error::{EngineError, Error};
use crate::settings::Settings;

/// Smooths depth images in CUDA's memory, on Linux; on this system it cannot be opened.
pub struct CudaSmoother(Infallible);

#[allow(missing_docs, clippy::missing_safety_doc)]
impl CudaSmoother {
    pub fn open(_: &Settings, _: &Camera, _: bool) -> Result<Self, Error> {
        let reason = "memory is shared with CUDA on Linux only".to_owned();
        Err(EngineError::Unavailable { engine: "gpu", reason }.into())
    }

    pub fn gpu_name(&self) -> &str {
        match self.0 {}
    }

    pub fn channels(&self) -> usize {
        match self.0 {}
    }

    pub unsafe fn smooth(&mut self, _: u64, _: usize, _: u64, _: usize) -> Result<(), Error> {
        match self.0 {}
    }

    pub unsafe fn submit(&mut self, _: u64, _: usize, _: usize) -> Result<(), Error> {
        match self.0 {}
    }

    pub unsafe fn receive(&mut self, _: u64, _: usize) -> Result<bool, Error> {
        match self.0 {}
    }

    pub fn in_flight(&self) -> usize {
        match self.0 {}
    }

    pub const fn max_in_flight(&self) -> usize {
        match self.0 {}
    }
}
