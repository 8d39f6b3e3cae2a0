//! The reference engine: docs/method.md to the letter, in f64, written to be read. It is the oracle of the fast engines,
//! so it shares no code with them and is never optimised.
//!
//! One file a stage: [`radius`] (section 3), [`window`] (2), [`plane`] (4), [`polynomial`] and [`solve`] (5, 6),
//! [`project`] (7), [`edges`] (10). General clouds differ in the neighbours only: [`general`] (8).

mod edges;
mod eigen;
mod general;
mod plane;
mod polynomial;
mod project;
mod radius;
mod solve;
mod window;

use glam::DVec3;
use rayon::prelude::*;

use crate::cloud::OrganizedCloud;
use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::params::{Edges, SmoothParams};
use crate::smoothed::{Outputs, Smoothed, Status};
use crate::threads::Threads;
use plane::Plane;

pub(crate) use eigen::symmetric_eigen;
pub(crate) use general::smooth_general;

/// What the reference finds for one point.
#[derive(Debug, Clone, Copy)]
struct PointResult {
    position: DVec3,
    normal: DVec3,
    curvature: f64,
    status: Status,
    neighbours: u32,
}

impl PointResult {
    fn hole() -> Self {
        Self { position: DVec3::NAN, normal: DVec3::NAN, curvature: f64::NAN, status: Status::Hole, neighbours: 0 }
    }
}

/// Sections 4 to 7 for one point `p`, given its neighbours as offsets from it (itself included, as zero).
fn smooth_point(p: DVec3, sensor: DVec3, offsets: &[DVec3], radius_m: f64, params: &SmoothParams) -> PointResult {
    let neighbours = offsets.len() as u32;
    if neighbours < 3 {
        return PointResult { status: Status::TooFew, neighbours, ..PointResult::hole() };
    }
    let Some(plane) = plane::fit(offsets, p - sensor) else {
        return PointResult { position: p, status: Status::Degenerate, neighbours, ..PointResult::hole() };
    };
    surface_point(p, sensor, offsets, radius_m, params, &plane, f64::INFINITY)
}

/// Sections 5 to 7 over a plane. `width_m` is how far from the plane a neighbour still counts (section 10).
fn surface_point(
    p: DVec3,
    sensor: DVec3,
    offsets: &[DVec3],
    radius_m: f64,
    params: &SmoothParams,
    plane: &Plane,
    width_m: f64,
) -> PointResult {
    let bandwidth_m = params.bandwidth_m.map_or(radius_m, f64::from);
    let polynomial = polynomial::fit(offsets, plane, radius_m, bandwidth_m, width_m, params.degree);
    let (position, normal, status) = project::project(p, sensor, plane, polynomial.as_ref(), radius_m);
    PointResult { position, normal, curvature: plane.curvature, status, neighbours: offsets.len() as u32 }
}

/// The reference engine for organized clouds.
pub(crate) struct Reference {
    params: SmoothParams,
    outputs: Outputs,
    threads: Threads,
}

impl Reference {
    pub(crate) fn open(params: SmoothParams, outputs: Outputs, threads: Option<usize>) -> Result<Self, EngineError> {
        Ok(Self { params, outputs, threads: Threads::open(threads)? })
    }

    pub(crate) fn smooth(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        let pitch_at_1m = frame.pixel_pitch_at_1m(&mut Vec::new());
        let deprojected;
        let cloud = match frame {
            Frame::Cloud(cloud) => cloud,
            Frame::Depth(depth) => {
                deprojected = depth.deproject()?;
                &deprojected
            }
        };
        let first_planes = match self.params.edges {
            Edges::Off => None,
            Edges::Robust { noise_at_1m } => {
                let noise_at_1m = f64::from(noise_at_1m);
                let first_plane = |p: DVec3, offsets: &[DVec3], radius_m: f64, _: (usize, usize)| {
                    edges::first_plane(p, offsets, radius_m, noise_at_1m)
                };
                let planes = self.for_each_pixel(cloud, pitch_at_1m, None, first_plane);
                Some(edges::FirstPlanes::new(cloud.width(), planes, noise_at_1m, &self.params))
            }
        };
        let smooth = |p: DVec3, offsets: &[DVec3], radius_m: f64, pixel: (usize, usize)| match first_planes
            .as_ref()
            .and_then(|planes| planes.surface(pixel, p, radius_m))
        {
            None => smooth_point(p, DVec3::ZERO, offsets, radius_m, &self.params),
            Some((plane, width_m)) => surface_point(p, DVec3::ZERO, offsets, radius_m, &self.params, &plane, width_m),
        };
        let results = self.for_each_pixel(cloud, pitch_at_1m, PointResult::hole(), smooth);
        out.prepare(cloud.width(), cloud.height(), self.outputs);
        store(results.into_iter(), out);
        Ok(())
    }

    /// `work` on every valid point, its neighbours' offsets, its radius and its pixel; `hole` for the others.
    fn for_each_pixel<T: Clone + Send + Sync>(
        &self,
        cloud: &OrganizedCloud,
        pitch_at_1m: f64,
        hole: T,
        work: impl Fn(DVec3, &[DVec3], f64, (usize, usize)) -> T + Sync,
    ) -> Vec<T> {
        let pixel = |offsets: &mut Vec<DVec3>, u: usize, v: usize| {
            let Some(p) = window::point(cloud, u, v) else { return hole.clone() };
            let radius_m = radius::radius_m(&self.params, pitch_at_1m, p.z);
            window::gather(cloud, u, v, &self.params, radius_m, offsets);
            work(p, offsets, radius_m, (u, v))
        };
        let row = |v: usize| {
            let mut offsets = Vec::new();
            (0..cloud.width()).map(|u| pixel(&mut offsets, u, v)).collect::<Vec<_>>()
        };
        let rows: Vec<_> = self.threads.install(|| (0..cloud.height()).into_par_iter().map(row).collect());
        rows.into_iter().flatten().collect()
    }
}

/// Rounds the results to f32 into whichever outputs are there.
fn store(results: impl Iterator<Item = PointResult>, out: &mut Smoothed) {
    for (i, result) in results.enumerate() {
        if !out.points.is_empty() {
            out.points.set(i, result.position.as_vec3().to_array());
        }
        if let Some(normals) = &mut out.normals {
            normals.set(i, result.normal.as_vec3().to_array());
        }
        if let Some(curvature) = &mut out.curvature {
            curvature[i] = result.curvature as f32;
        }
        if let Some(status) = &mut out.status {
            status[i] = result.status;
        }
        if let Some(neighbours) = &mut out.neighbours {
            neighbours[i] = result.neighbours;
        }
    }
}
