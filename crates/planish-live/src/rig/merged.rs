//! All points of a moment as one general cloud, and its result given back to the cameras.

use std::sync::{Arc, Mutex, PoisonError};

use glam::DVec3;
use rayon::prelude::*;

use super::fused::{Part, fuse_parts, rig_from_points};
use super::voxels::InVoxels;
use super::{RigResults, RigSmoother};
use planish_core::{
    CloudParams, Error, FleetDevice, Frame, FrameError, PointCloud, Progress, Smoothed, Smoother, SmootherOptions,
    Status, Xyz,
    internal::{Rays, RigidTransform},
};

/// The smoother of all points together.
pub(super) struct General {
    params: CloudParams,
    /// The size of the voxels that points are thinned to; `None` for all points.
    voxel_m: Option<f64>,
    smoother: Option<Smoother>,
    stopper: Stopper,
}

/// Ends the work on all points together, from another thread: on millions of points it takes seconds.
#[derive(Clone, Default)]
pub(super) struct Stopper(Arc<Mutex<Option<Arc<Progress>>>>);

impl Stopper {
    /// Ends the work that is under way, which becomes [`EngineError::Stopped`](planish_core::EngineError::Stopped); has no effect if there is none.
    pub(super) fn stop(&self) {
        if let Some(progress) = &*self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            progress.stop();
        }
    }

    fn watch(&self, smoother: &Smoother) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = smoother.progress();
    }
}

impl General {
    pub(super) fn new(params: CloudParams) -> Self {
        Self { params, voxel_m: None, smoother: None, stopper: Stopper::default() }
    }

    pub(super) fn with_voxel_m(self, voxel_m: Option<f64>) -> Self {
        Self { voxel_m, ..self }
    }

    pub(super) fn voxel_m(&self) -> Option<f64> {
        self.voxel_m
    }

    pub(super) fn stopper(&self) -> Stopper {
        self.stopper.clone()
    }

    pub(super) fn close(&mut self) {
        self.smoother = None;
    }

    /// Opens the engine, if it is not, on the device or on that of the options.
    pub(super) fn open(
        &mut self,
        options: &SmootherOptions,
        device: Option<&FleetDevice>,
    ) -> Result<&mut Smoother, Error> {
        Ok(match &mut self.smoother {
            Some(smoother) => smoother,
            empty => {
                let options = device.map_or_else(|| options.clone(), |device| device.options(options));
                // Points are carried onto the voxels' tangent planes.
                let with_normals = options.outputs.with_points(true).with_normals(true);
                let outputs = if self.voxel_m.is_some() { with_normals } else { options.outputs };
                let smoother = Smoother::open_clouds(self.params, &options.with_outputs(outputs))?;
                self.stopper.watch(&smoother);
                empty.insert(smoother)
            }
        })
    }
}

/// The frames of a moment, and where they were taken from.
pub(super) struct PlacedFrames<'a> {
    /// Each with what takes its points into the rig's frame.
    frames: Vec<Option<(Frame<'a>, RigidTransform)>>,
    /// Of those that are depth images.
    rays: Vec<Arc<Rays>>,
    /// Where each camera stands in the rig's frame.
    lenses: Vec<DVec3>,
}

impl RigSmoother {
    pub(super) fn smooth_merged(&mut self, frames: &[Option<Frame<'_>>]) -> Result<RigResults, Error> {
        let (outputs, threads) = (self.options.outputs, self.threads.clone());
        let frames = self.placed(frames)?;
        let together = threads.install(|| Together::of(&frames));
        let results = match self.general.voxel_m {
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

    /// Does something with the engine for all points together, which is opened if it is not.
    pub(super) fn with_general<T>(&mut self, work: impl FnOnce(&mut Smoother) -> Result<T, Error>) -> Result<T, Error> {
        let Self { options, devices, failed, general, engine, .. } = self;
        let device = devices.first();
        let result = general.open(options, device).and_then(|smoother| {
            *engine = smoother.engine();
            work(smoother)
        });
        *failed = device.filter(|_| matches!(result, Err(Error::Engine(_)))).cloned();
        result
    }
}

/// The points of all cameras in the rig's frame.
pub(super) struct Together {
    /// Camera by camera, holes left out, with the field `camera`.
    pub(super) cloud: PointCloud,
    cameras: Vec<Option<Measured>>,
}

/// What a camera measured, in its own frame.
struct Measured {
    positions: Xyz,
    shape: (usize, usize),
    rig_from_points: RigidTransform,
    /// Where the camera stands in the rig's frame.
    lens: DVec3,
}

/// Smooths the points of all cameras as one cloud; each camera gets its own back, on its grid and in the frame of its points.
fn smooth(smoother: &mut Smoother, together: &Together) -> Result<Vec<Option<Smoothed>>, Error> {
    let mut smoothed = Smoothed::default();
    if !together.cloud.is_empty() {
        smoother.smooth(&together.cloud, &mut smoothed)?;
    }
    Ok(together.given_back(&smoothed))
}

impl Together {
    pub(super) fn of(PlacedFrames { frames, rays, lenses }: &PlacedFrames<'_>) -> Self {
        let measured = frames.par_iter().zip(rays).zip(lenses).map(|((frame, rays), &lens)| {
            let (frame, rig_from_points) = (*frame)?;
            Some(Measured::of(frame, rays, rig_from_points, lens))
        });
        let cameras: Vec<Option<Measured>> = measured.collect();
        let measured = cameras.iter().enumerate().filter_map(|(i, measured)| Some((i, measured.as_ref()?)));
        let parts: Vec<Part<'_>> = measured.map(|(i, measured)| measured.part(i)).collect();
        let mut cloud = PointCloud::new(Xyz::default());
        fuse_parts(&parts, &mut cloud);
        Self { cloud, cameras }
    }

    /// From where a camera looks, in the frame of the points.
    pub(super) fn lens(&self, camera: usize) -> DVec3 {
        let lens = self.cameras.get(camera).and_then(|camera| Some(camera.as_ref()?.lens));
        lens.unwrap_or_default() - DVec3::from_array(self.cloud.origin_m)
    }

    /// Of each camera what was found for its points, from results for all.
    pub(super) fn given_back(&self, all: &Smoothed) -> Vec<Option<Smoothed>> {
        let origin = DVec3::from_array(self.cloud.origin_m);
        let pixels = self.cameras.par_iter().map(|camera| camera.as_ref().map_or_else(Vec::new, Measured::pixels));
        let pixels: Vec<Vec<usize>> = pixels.collect();
        let mut first = 0;
        let mut placed = Vec::with_capacity(pixels.len());
        for (camera, pixels) in self.cameras.iter().zip(pixels) {
            let begin = first;
            first += pixels.len();
            placed.push((camera, begin, pixels));
        }
        let back = placed.into_par_iter().map(|(camera, first, pixels)| {
            let camera = camera.as_ref()?;
            Some(camera.given_back(all, first, &pixels, origin))
        });
        back.collect()
    }
}

impl Measured {
    fn of(frame: Frame<'_>, rays: &Rays, rig_from_points: RigidTransform, lens: DVec3) -> Self {
        let positions = match frame {
            Frame::Points(points) => (0..points.len()).map(|i| points.get(i).map(|value| value as f32)).collect(),
            Frame::Depth(depth) => depth.deproject_with(rays),
        };
        Self { positions, shape: frame.shape(), rig_from_points, lens }
    }

    fn part(&self, camera: usize) -> Part<'_> {
        let (rig_from_points, positions) = (self.rig_from_points, self.positions.as_slices());
        Part { camera, rig_from_points, positions, attributes: Vec::new() }
    }

    /// Those that are no holes.
    fn pixels(&self) -> Vec<usize> {
        (0..self.positions.len()).filter(|&i| self.positions.is_finite(i)).collect()
    }

    /// What was found for the points of these pixels, which begin at `first` of all, in the frame that they came from; normals face the camera.
    fn given_back(&self, all: &Smoothed, first: usize, its_pixels: &[usize], origin: DVec3) -> Smoothed {
        let (width, height) = self.shape;
        let pixels = width * height;
        let points_from_rig = self.rig_from_points.inverse();
        let mut back = Smoothed { width, height, points: Xyz::filled(pixels, f32::NAN), ..Smoothed::default() };
        back.normals = all.normals.as_ref().map(|_| Xyz::filled(pixels, f32::NAN));
        back.curvature = all.curvature.as_ref().map(|_| vec![f32::NAN; pixels]);
        back.status = all.status.as_ref().map(|_| vec![Status::Hole; pixels]);
        back.neighbours = all.neighbours.as_ref().map(|_| vec![0; pixels]);
        for (i, &pixel) in (first..).zip(its_pixels) {
            let in_rig = origin + all.points.vector(i);
            back.points.set(pixel, points_from_rig.to_cloud(in_rig).as_vec3().to_array());
            if let (Some(normals), Some(of_all)) = (&mut back.normals, &all.normals) {
                let normal = of_all.vector(i);
                let facing = if normal.dot(in_rig - self.lens) > 0.0 { -normal } else { normal };
                normals.set(pixel, (points_from_rig.rotation * facing).as_vec3().to_array());
            }
            if let (Some(curvature), Some(of_all)) = (&mut back.curvature, &all.curvature) {
                curvature[pixel] = of_all[i];
            }
            if let (Some(status), Some(of_all)) = (&mut back.status, &all.status) {
                status[pixel] = of_all[i];
            }
            if let (Some(neighbours), Some(of_all)) = (&mut back.neighbours, &all.neighbours) {
                neighbours[pixel] = of_all[i];
            }
        }
        back
    }
}
