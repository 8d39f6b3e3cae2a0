//! The rows of a result: split between tasks, written a vector at a time.

use fearless_simd::{Simd, SimdBase, SimdFloat};

use super::halves::Halves;
use super::plane::Plane;
use super::project::Projected;
use crate::smoothed::{Smoothed, Status};

/// Status by code, with room for every 3-bit index: no code needs a check.
const STATUS: [Status; 8] = {
    let [hole, few, line, plane, quadratic, cubic] = Status::ALL;
    [hole, few, line, plane, quadratic, cubic, hole, hole]
};

/// Some rows of every output that is wanted.
pub(super) struct Rows<'a> {
    /// The first row's number in the image.
    pub(super) first: usize,
    pub(super) width: usize,
    points: [&'a mut [f32]; 3],
    normals: Option<[&'a mut [f32]; 3]>,
    curvature: Option<&'a mut [f32]>,
    status: Option<&'a mut [Status]>,
    neighbours: Option<&'a mut [u32]>,
}

fn split<'a, T, const N: usize>(planes: [&'a mut [T]; N], at: usize) -> ([&'a mut [T]; N], [&'a mut [T]; N]) {
    let mut before: [&'a mut [T]; N] = std::array::from_fn(|_| Default::default());
    let mut after: [&'a mut [T]; N] = std::array::from_fn(|_| Default::default());
    for (k, plane) in planes.into_iter().enumerate() {
        (before[k], after[k]) = plane.split_at_mut(at);
    }
    (before, after)
}

impl Halves for Rows<'_> {
    fn count(&self) -> usize {
        self.points[0].len() / self.width
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let at = rows * self.width;
        let (points, points_after) = split(self.points, at);
        let (normals, normals_after) = self.normals.map(|planes| split(planes, at)).unzip();
        let (curvature, curvature_after) = self.curvature.map(|plane| plane.split_at_mut(at)).unzip();
        let (status, status_after) = self.status.map(|plane| plane.split_at_mut(at)).unzip();
        let (neighbours, neighbours_after) = self.neighbours.map(|plane| plane.split_at_mut(at)).unzip();
        let (first, width) = (self.first, self.width);
        (
            Rows { first, width, points, normals, curvature, status, neighbours },
            Rows {
                first: first + rows,
                width,
                points: points_after,
                normals: normals_after,
                curvature: curvature_after,
                status: status_after,
                neighbours: neighbours_after,
            },
        )
    }
}

impl<'a> Rows<'a> {
    /// All rows of a result whose buffers have their lengths.
    pub(super) fn all(out: &'a mut Smoothed) -> Self {
        Self {
            first: 0,
            width: out.width,
            points: [&mut out.points.x, &mut out.points.y, &mut out.points.z],
            normals: out.normals.as_mut().map(|n| [&mut n.x[..], &mut n.y[..], &mut n.z[..]]),
            curvature: out.curvature.as_deref_mut(),
            status: out.status.as_deref_mut(),
            neighbours: out.neighbours.as_deref_mut(),
        }
    }

    /// Whether normals are wanted.
    pub(super) fn has_normals(&self) -> bool {
        self.normals.is_some()
    }

    /// Writes the results of the pixels from column u of the `row`-th of these rows on.
    #[inline(always)]
    pub(super) fn store<S: Simd>(
        &mut self,
        row: usize,
        u: usize,
        projected: &Projected<S>,
        plane: &Plane<S>,
        n: S::f32s,
    ) {
        let end = self.width.min(u + S::f32s::LEN);
        let at = row * self.width + u..row * self.width + end;
        for (plane, values) in self.points.iter_mut().zip([projected.point.x, projected.point.y, projected.point.z]) {
            put(values, &mut plane[at.clone()]);
        }
        if let Some(normals) = &mut self.normals {
            for (plane, values) in normals.iter_mut().zip([projected.normal.x, projected.normal.y, projected.normal.z])
            {
                put(values, &mut plane[at.clone()]);
            }
        }
        if let Some(curvature) = &mut self.curvature {
            let out = &mut curvature[at.clone()];
            put(plane.curvature, out);
            // A normal and a curvature are there together; their lanes are told by the status.
            for (value, &status) in out.iter_mut().zip(projected.status.as_slice()) {
                if status < 3.0 {
                    *value = f32::NAN;
                }
            }
        }
        if let Some(status) = &mut self.status {
            let codes: S::i32s = projected.status.to_int();
            for (out, &code) in status[at.clone()].iter_mut().zip(codes.as_slice()) {
                *out = STATUS[code as usize & 7];
            }
        }
        if let Some(neighbours) = &mut self.neighbours {
            let counts: S::u32s = n.to_int();
            for (out, &n) in neighbours[at].iter_mut().zip(counts.as_slice()) {
                *out = n;
            }
        }
    }

    /// The same where every pixel is a hole.
    #[inline(always)]
    pub(super) fn store_holes(&mut self, row: usize, u: usize, lanes: usize) {
        let end = self.width.min(u + lanes);
        let at = row * self.width + u..row * self.width + end;
        let planes = self.points.iter_mut().chain(self.normals.iter_mut().flatten()).chain(self.curvature.iter_mut());
        for plane in planes {
            plane[at.clone()].fill(f32::NAN);
        }
        if let Some(status) = &mut self.status {
            status[at.clone()].fill(Status::Hole);
        }
        if let Some(neighbours) = &mut self.neighbours {
            neighbours[at].fill(0);
        }
    }
}

/// Stores as many lanes as `out` has room for: fewer than all at the right border.
#[inline(always)]
fn put<V: SimdBase<S, Element = f32>, S: Simd>(values: V, out: &mut [f32]) {
    if out.len() == V::LEN {
        values.store_slice(out);
    } else {
        let lanes = out.len();
        out.copy_from_slice(&values.as_slice()[..lanes]);
    }
}
