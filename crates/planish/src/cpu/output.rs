//! The rows of a result: split between tasks, written a vector at a time, straight into the caller's buffers.
//!
//! Depth is made here too (docs/method.md, section 7).

use fearless_simd::{Simd, SimdBase, SimdFloat};
use glam::Vec3;

use super::plane::Plane;
use super::project::Projected;
use super::row_tasks::SplitRows;
use super::vector::Vec3 as Lanes3;
use crate::camera::{Camera, Rays};
use crate::engine::AdmittedFrame;
use crate::outputs::{SmoothedMut, VectorsMut};
use crate::pose::RigidTransform;
use crate::smoothed::depth_along_ray_m;
use crate::status::Status;

/// A band of rows of every requested output.
pub(super) struct OutputRows<'a> {
    /// The first row's number in the image.
    pub(super) first: usize,
    pub(super) width: usize,
    rows: usize,
    out: SmoothedMut<'a>,
    /// What computing depth needs, if requested.
    depth: Option<DepthOutput<'a>>,
}

#[derive(Clone, Copy)]
struct DepthOutput<'a> {
    camera: &'a Camera,
    rays: &'a Rays,
    /// Where the sensor stands, if the cloud's frame is another than its own.
    cloud_from_sensor: Option<RigidTransform>,
}

impl SplitRows for OutputRows<'_> {
    fn count(&self) -> usize {
        self.rows
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, width, depth, out, .. } = self;
        let at = rows * width;
        let (points, points_rest) = out.points.map(|vectors| vectors.split_at(at)).unzip();
        let (normals, normals_rest) = out.normals.map(|vectors| vectors.split_at(at)).unzip();
        let (curvature, curvature_rest) = out.curvature.map(|values| values.split_at_mut(at)).unzip();
        let (status, status_rest) = out.status.map(|values| values.split_at_mut(at)).unzip();
        let (neighbours, neighbours_rest) = out.neighbours.map(|values| values.split_at_mut(at)).unzip();
        let (raw, raw_rest) = out.depth.map(|values| values.split_at_mut(at)).unzip();
        let upper = SmoothedMut { points, normals, curvature, status, neighbours, depth: raw };
        let lower = SmoothedMut {
            points: points_rest,
            normals: normals_rest,
            curvature: curvature_rest,
            status: status_rest,
            neighbours: neighbours_rest,
            depth: raw_rest,
        };
        (
            Self { first, width, rows, out: upper, depth },
            Self { first: first + rows, width, rows: self.rows - rows, out: lower, depth },
        )
    }
}

impl<'a> OutputRows<'a> {
    /// All rows of a frame's result; `rays` are its camera's.
    pub(super) fn all(admitted: &AdmittedFrame<'a>, rays: &'a Rays, out: SmoothedMut<'a>) -> Self {
        let (width, height) = admitted.frame.shape();
        let camera = admitted.frame.camera().filter(|_| out.depth.is_some());
        let depth =
            camera.map(|camera| DepthOutput { camera, rays, cloud_from_sensor: admitted.geometry.cloud_from_sensor });
        Self { first: 0, width, rows: height, out, depth }
    }

    /// Whether normals must be computed.
    pub(super) fn has_normals(&self) -> bool {
        self.out.normals.is_some() || self.depth.is_some()
    }

    /// Writes the results of the pixels from column u of the `row`-th of these rows on; `p` are the points as measured.
    #[inline(always)]
    pub(super) fn store<S: Simd>(
        &mut self,
        row: usize,
        u: usize,
        p: Lanes3<S>,
        projected: &Projected<S>,
        plane: &Plane<S>,
        n: S::f32s,
    ) {
        let end = self.width.min(u + S::f32s::LEN);
        let at = row * self.width + u..row * self.width + end;
        if let Some(points) = &mut self.out.points {
            put_vectors(points, at.clone(), projected.point);
        }
        if let Some(normals) = &mut self.out.normals {
            put_vectors(normals, at.clone(), projected.normal);
        }
        if let (Some(output), Some(depth)) = (self.depth, &mut self.out.depth) {
            // Through a distorted lens the ray of a pixel is that of its point.
            let by_point = output.rays.are_distorted();
            let rays = output.rays.row(self.first + row);
            for (lane, out) in depth[at.clone()].iter_mut().enumerate() {
                let point = output.point_in_sensor(in_lane(&projected.point, lane));
                let normal = output.direction_in_sensor(in_lane(&projected.normal, lane));
                let ray = if by_point {
                    let p = output.point_in_sensor(in_lane(&p, lane));
                    [p.x / p.z, p.y / p.z]
                } else {
                    rays.at(u + lane)
                };
                *out = output.camera.raw_depth(depth_along_ray_m(ray, point.to_array(), normal.to_array()));
            }
        }
        if let Some(curvature) = &mut self.out.curvature {
            let out = &mut curvature[at.clone()];
            put(plane.curvature, out);
            // Curvature is present exactly where the normal is.
            for (value, &status) in out.iter_mut().zip(projected.status.as_slice()) {
                if status < 3.0 {
                    *value = f32::NAN;
                }
            }
        }
        if let Some(status) = &mut self.out.status {
            let codes: S::i32s = projected.status.to_int();
            for (out, &code) in status[at.clone()].iter_mut().zip(codes.as_slice()) {
                *out = Status::of_code(code as u8);
            }
        }
        if let Some(neighbours) = &mut self.out.neighbours {
            let counts: S::u32s = n.to_int();
            for (out, &n) in neighbours[at].iter_mut().zip(counts.as_slice()) {
                *out = n;
            }
        }
    }

    /// Writes holes for the pixels from column u on.
    #[inline(always)]
    pub(super) fn store_holes(&mut self, row: usize, u: usize, lanes: usize) {
        let end = self.width.min(u + lanes);
        let at = row * self.width + u..row * self.width + end;
        for vectors in [&mut self.out.points, &mut self.out.normals].into_iter().flatten() {
            match vectors {
                VectorsMut::Planes(planes) => planes.iter_mut().for_each(|plane| plane[at.clone()].fill(f32::NAN)),
                VectorsMut::Rows(rows) => rows[at.clone()].fill([f32::NAN; 3]),
                VectorsMut::Rows4(rows) => rows[at.clone()].iter_mut().for_each(|row| row[..3].fill(f32::NAN)),
            }
        }
        if let Some(curvature) = &mut self.out.curvature {
            curvature[at.clone()].fill(f32::NAN);
        }
        if let Some(depth) = &mut self.out.depth {
            depth[at.clone()].fill(0);
        }
        if let Some(status) = &mut self.out.status {
            status[at.clone()].fill(Status::Hole);
        }
        if let Some(neighbours) = &mut self.out.neighbours {
            neighbours[at].fill(0);
        }
    }
}

impl DepthOutput<'_> {
    fn point_in_sensor(&self, p: Vec3) -> Vec3 {
        self.cloud_from_sensor.map_or(p, |transform| transform.to_sensor(p.as_dvec3()).as_vec3())
    }

    fn direction_in_sensor(&self, v: Vec3) -> Vec3 {
        self.cloud_from_sensor.map_or(v, |transform| (transform.rotation.transpose() * v.as_dvec3()).as_vec3())
    }
}

/// Extracts the vector of one lane.
#[inline(always)]
fn in_lane<S: Simd>(v: &Lanes3<S>, lane: usize) -> Vec3 {
    Vec3::new(v.x.as_slice()[lane], v.y.as_slice()[lane], v.z.as_slice()[lane])
}

/// Stores vectors; fewer than all lanes at the right border.
#[inline(always)]
fn put_vectors<S: Simd>(out: &mut VectorsMut<'_>, at: std::ops::Range<usize>, vectors: Lanes3<S>) {
    let Lanes3 { x, y, z } = vectors;
    match out {
        VectorsMut::Planes([out_x, out_y, out_z]) => {
            put(x, &mut out_x[at.clone()]);
            put(y, &mut out_y[at.clone()]);
            put(z, &mut out_z[at]);
        }
        VectorsMut::Rows(rows) => {
            let lanes = x.as_slice().iter().zip(y.as_slice()).zip(z.as_slice());
            for (row, ((&x, &y), &z)) in rows[at].iter_mut().zip(lanes) {
                *row = [x, y, z];
            }
        }
        VectorsMut::Rows4(rows) => {
            let lanes = x.as_slice().iter().zip(y.as_slice()).zip(z.as_slice());
            for (row, ((&x, &y), &z)) in rows[at].iter_mut().zip(lanes) {
                row[..3].copy_from_slice(&[x, y, z]);
            }
        }
    }
}

/// Stores as many lanes as `out` has room for.
#[inline(always)]
fn put<V: SimdBase<S, Element = f32>, S: Simd>(values: V, out: &mut [f32]) {
    if out.len() == V::LEN {
        values.store_slice(out);
    } else {
        let lanes = out.len();
        out.copy_from_slice(&values.as_slice()[..lanes]);
    }
}
