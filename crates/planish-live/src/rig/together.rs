//! The points of all cameras in the rig's frame.

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use super::fused::{Part, fuse_parts};
use planish_core::{
    Frame, PointCloud, Smoothed, Status, Xyz,
    internal::{Rays, RigidTransform},
};

/// The frames of a moment and their poses.
pub(super) struct PlacedFrames<'a> {
    /// Each frame with the transform of its points to the rig's frame.
    pub(super) frames: Vec<Option<(Frame<'a>, RigidTransform)>>,
    /// The viewing rays of each camera, for depth images.
    pub(super) rays: Vec<Arc<Rays>>,
    /// The position of each camera in the rig's frame.
    pub(super) lenses: Vec<DVec3>,
}

/// The points of all cameras in the rig's frame.
pub(super) struct Together {
    /// The points camera by camera, without holes, with the field `camera`.
    pub(super) cloud: PointCloud,
    cameras: Vec<Option<Measured>>,
}

/// A camera's measurements in its own frame.
struct Measured {
    positions: Xyz,
    shape: (usize, usize),
    rig_from_points: RigidTransform,
    /// The camera's position in the rig's frame.
    lens: DVec3,
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

    /// Returns the position of a camera's lens in the frame of the points.
    pub(super) fn lens(&self, camera: usize) -> DVec3 {
        let lens = self.cameras.get(camera).and_then(|camera| Some(camera.as_ref()?.lens));
        lens.unwrap_or_default() - DVec3::from_array(self.cloud.origin_m)
    }

    /// Splits results for all points into results for each camera.
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

    /// Returns the indices of the pixels that are not holes.
    fn pixels(&self) -> Vec<usize> {
        (0..self.positions.len()).filter(|&i| self.positions.is_finite(i)).collect()
    }

    /// Returns the results for `its_pixels`, which begin at index `first` of `all`, in the frame of the input.
    /// Normals face the camera.
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
