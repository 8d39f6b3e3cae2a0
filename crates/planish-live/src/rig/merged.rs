//! Smooths all points of a moment as one unorganized cloud, and returns each camera's points.

use std::sync::Arc;

use super::fused::rig_from_points;
use super::together::{PlacedFrames, Together};
use super::voxels::InVoxels;
use super::{RigResults, RigSmoother};
use planish_core::{Error, Frame, FrameError, Smoothed, Smoother, internal::RigidTransform};

impl RigSmoother {
    pub(super) fn smooth_merged(&mut self, frames: &[Option<Frame<'_>>]) -> Result<RigResults, Error> {
        let (outputs, threads) = (self.options.outputs, self.threads.clone());
        let frames = self.placed(frames)?;
        let together = threads.install(|| Together::of(&frames));
        let results = match self.general.voxel_m() {
            Some(size_m) => {
                let mut voxels = threads.install(|| InVoxels::of(together, size_m))?;
                self.with_general(|smoother| voxels.smooth(smoother))?;
                threads.install(|| voxels.given_back(outputs))
            }
            None => self.with_general(|smoother| threads.install(|| smooth(smoother, &together)))?,
        };
        Ok(results.into_iter().map(|result| result.map(Ok)).collect())
    }

    pub(super) fn placed<'a>(&mut self, frames: &[Option<Frame<'a>>]) -> Result<PlacedFrames<'a>, FrameError> {
        let placed = self.cameras.iter().zip(frames).map(|(camera, frame)| {
            let place = |frame| Ok((frame, rig_from_points(camera.rig_from_camera, frame)?));
            frame.map(place).transpose()
        });
        let frames: Vec<Option<(Frame<'a>, RigidTransform)>> = placed.collect::<Result<_, FrameError>>()?;
        for (camera, frame) in self.cameras.iter_mut().zip(&frames) {
            if let Some((Frame::Depth(depth), _)) = frame {
                Arc::make_mut(&mut camera.rays).set(depth.camera());
            }
        }
        let rays = self.cameras.iter().map(|camera| Arc::clone(&camera.rays)).collect();
        let lenses = self.cameras.iter().map(|camera| camera.rig_from_camera.translation).collect();
        Ok(PlacedFrames { frames, rays, lenses })
    }

    /// Calls a function with the engine for merged clouds, which is opened if necessary.
    pub(super) fn with_general<T>(&mut self, work: impl FnOnce(&mut Smoother) -> Result<T, Error>) -> Result<T, Error> {
        let outputs = self.outputs_in_space();
        let Self { options, devices, failed, general, engine, .. } = self;
        let device = devices.first();
        let result = general.open(options, outputs, device).and_then(|smoother| {
            *engine = smoother.engine();
            work(smoother)
        });
        *failed = device.filter(|_| matches!(result, Err(Error::Engine(_)))).cloned();
        result
    }
}

/// Smooths the points of all cameras as one cloud. Returns each camera's points on the camera's grid and in the
/// coordinate frame of the input points.
fn smooth(smoother: &mut Smoother, together: &Together) -> Result<Vec<Option<Smoothed>>, Error> {
    let mut smoothed = Smoothed::default();
    if !together.cloud.is_empty() {
        smoother.smooth(&together.cloud, &mut smoothed)?;
    }
    Ok(together.given_back(&smoothed))
}
