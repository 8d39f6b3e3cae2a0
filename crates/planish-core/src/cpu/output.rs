//! The rows of a result. They are split between tasks and written one vector at a time, directly to the caller's
//! buffers.

use fearless_simd::{Simd, SimdBase, SimdFloat};

use super::project::{Projected, Projection};
use super::row_tasks::SplitRows;
use super::vector::Vec3;
use crate::camera::Camera;
use crate::constants::LEAST_NEIGHBOURS;
use crate::outputs::{SmoothedMut, VectorsMut};
use crate::smoothed::Smoothed;
use crate::smoothing_engine::AdmittedFrame;
use crate::status::Status;

/// A band of rows of every requested output.
pub(super) struct OutputRows<'a> {
    /// Index of the band's first row in the image.
    pub(super) first: usize,
    pub(super) width: usize,
    rows: usize,
    out: SmoothedMut<'a>,
    /// The camera that defines the raw depth unit, if raw depth is requested.
    camera: Option<&'a Camera>,
}

impl SplitRows for OutputRows<'_> {
    fn count(&self) -> usize {
        self.rows
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, width, camera, out, .. } = self;
        let at = rows * width;
        let (points, points_rest) = out.points.map(|vectors| vectors.split_at(at)).unzip();
        let (normals, normals_rest) = out.normals.map(|vectors| vectors.split_at(at)).unzip();
        let (curvature, curvature_rest) = out.curvature.map(|values| values.split_at_mut(at)).unzip();
        let (status, status_rest) = out.status.map(|values| values.split_at_mut(at)).unzip();
        let (neighbours, neighbours_rest) = out.neighbours.map(|values| values.split_at_mut(at)).unzip();
        let (raw, raw_rest) = out.depth.map(|values| values.split_at_mut(at)).unzip();
        let (depth_m, depth_m_rest) = out.depth_m.map(|values| values.split_at_mut(at)).unzip();
        // Engines that smooth single frames neither count frames nor estimate errors.
        let none = SmoothedMut::default();
        let upper = SmoothedMut { points, normals, curvature, status, neighbours, depth: raw, depth_m, ..none };
        let lower = SmoothedMut {
            points: points_rest,
            normals: normals_rest,
            curvature: curvature_rest,
            status: status_rest,
            neighbours: neighbours_rest,
            depth: raw_rest,
            depth_m: depth_m_rest,
            ..SmoothedMut::default()
        };
        (
            Self { first, width, rows, out: upper, camera },
            Self { first: first + rows, width, rows: self.rows - rows, out: lower, camera },
        )
    }
}

impl<'a> OutputRows<'a> {
    /// Returns all rows of a frame's result.
    pub(super) fn all(admitted: &AdmittedFrame<'a>, out: SmoothedMut<'a>) -> Self {
        let (width, height) = admitted.frame.shape();
        let camera = admitted.frame.camera().filter(|_| out.depth.is_some());
        Self { first: 0, width, rows: height, out, camera }
    }

    /// Returns all rows of a result without a camera.
    pub(super) fn of_grid((width, height): (usize, usize), out: SmoothedMut<'a>) -> Self {
        Self { first: 0, width, rows: height, out, camera: None }
    }

    /// Returns the settings for moving points onto the surface, given the requested outputs.
    pub(super) fn projection(&self, on_ray: bool) -> Projection {
        let needs_depth = self.camera.is_some() || self.out.depth_m.is_some();
        Projection {
            on_ray,
            needs_normal: self.out.normals.is_some() || on_ray || needs_depth,
            needs_depth,
            keeps_isolated: false,
            least_neighbours: LEAST_NEIGHBOURS,
        }
    }

    /// Writes the results of a vector of pixels that starts at column u of row `row` of this band, with their
    /// measured depths, curvatures and numbers of neighbours.
    #[inline(always)]
    pub(super) fn store<S: Simd>(
        &mut self,
        row: usize,
        u: usize,
        projected: &Projected<S>,
        [depth, curvature, n]: [S::f32s; 3],
    ) {
        let end = self.width.min(u + S::f32s::LEN);
        let at = row * self.width + u..row * self.width + end;
        if let Some(points) = &mut self.out.points {
            put_vectors(points, at.clone(), projected.point);
        }
        if let Some(normals) = &mut self.out.normals {
            put_vectors(normals, at.clone(), projected.normal);
        }
        if let (Some(camera), Some(raw)) = (self.camera, &mut self.out.depth) {
            let smoothed = depth * projected.depth_scale;
            for (out, &depth_m) in raw[at.clone()].iter_mut().zip(smoothed.as_slice()) {
                *out = camera.raw_depth(depth_m);
            }
        }
        if let Some(depth_m) = &mut self.out.depth_m {
            put(depth * projected.depth_scale, &mut depth_m[at.clone()]);
        }
        if let Some(out) = &mut self.out.curvature {
            let out = &mut out[at.clone()];
            put(curvature, out);
            // Only points with a normal have a finite curvature.
            for (value, &status) in out.iter_mut().zip(projected.status.as_slice()) {
                if !(3.0..6.0).contains(&status) {
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

    /// Fills row `i` of a one-column result from position `place(i)` of `from`; `None` makes it a hole.
    pub(super) fn take_from(&mut self, from: &Smoothed, place: impl Fn(usize) -> Option<usize>) {
        let first = self.first;
        self.out.take_from(self.rows, from, |row| place(first + row));
    }

    /// Writes holes to `lanes` pixels, starting at column u of row `row` of this band.
    #[inline(always)]
    pub(super) fn store_holes(&mut self, row: usize, u: usize, lanes: usize) {
        let end = self.width.min(u + lanes);
        let at = row * self.width + u..row * self.width + end;
        for vectors in [&mut self.out.points, &mut self.out.normals].into_iter().flatten() {
            match vectors {
                VectorsMut::Planes(planes) => planes.iter_mut().for_each(|plane| plane[at.clone()].fill(f32::NAN)),
                VectorsMut::Rows(rows) => rows[at.clone()].fill([f32::NAN; 3]),
                VectorsMut::Rows4(rows) => rows[at.clone()].iter_mut().for_each(|row| row[..3].fill(f32::NAN)),
                VectorsMut::Strided(vectors) => at.clone().for_each(|i| vectors.set(i, [f32::NAN; 3])),
            }
        }
        if let Some(curvature) = &mut self.out.curvature {
            curvature[at.clone()].fill(f32::NAN);
        }
        if let Some(depth) = &mut self.out.depth {
            depth[at.clone()].fill(0);
        }
        if let Some(depth_m) = &mut self.out.depth_m {
            depth_m[at.clone()].fill(f32::NAN);
        }
        if let Some(status) = &mut self.out.status {
            status[at.clone()].fill(Status::Hole);
        }
        if let Some(neighbours) = &mut self.out.neighbours {
            neighbours[at].fill(0);
        }
    }
}

/// Stores the lanes that fit in `at`: fewer than all at the right border.
#[inline(always)]
fn put_vectors<S: Simd>(out: &mut VectorsMut<'_>, at: std::ops::Range<usize>, vectors: Vec3<S>) {
    let Vec3 { x, y, z } = vectors;
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
        VectorsMut::Strided(vectors) => {
            let lanes = x.as_slice().iter().zip(y.as_slice()).zip(z.as_slice());
            for (i, ((&x, &y), &z)) in at.zip(lanes) {
                vectors.set(i, [x, y, z]);
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
