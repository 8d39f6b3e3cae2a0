//! The frame as padded planes: the input of every window load.
//!
//! Stage: copy or deproject (docs/method.md, section 1). Layout: x, y and z each as rows of `row_len` values, `reach` rows and
//! columns of NaN around the image and at least [`MAX_LANES`] - 1 behind its last column, so that every load of a window, at
//! every vector of pixels, is a plain load inside the plane. A NaN fails the gate, and so does everything not finite: an
//! infinite distance is over every radius.

use std::ops::Range;

use rayon::join;

use crate::camera::Rays;
use crate::cloud::Xyz;
use crate::frame::Frame;

/// The widest vector of f32 that any SIMD level has.
pub(super) const MAX_LANES: usize = 16;

/// Rows that one task fills: enough to be worth a task.
const ROWS_A_TASK: usize = 32;

pub(super) struct Planes {
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
    pub(super) z: Vec<f32>,
    /// Values from one row to the next.
    pub(super) row_len: usize,
    pub(super) width: usize,
    height: usize,
    /// Border in pixels: window times stride.
    reach: usize,
    rays: Rays,
}

/// Rows of the three planes, image rows only, starting with one image row.
struct Rows<'a> {
    first: usize,
    x: &'a mut [f32],
    y: &'a mut [f32],
    z: &'a mut [f32],
}

impl<'a> Rows<'a> {
    fn split_at(self, rows: usize, row_len: usize) -> (Self, Self) {
        let (x0, x1) = self.x.split_at_mut(rows * row_len);
        let (y0, y1) = self.y.split_at_mut(rows * row_len);
        let (z0, z1) = self.z.split_at_mut(rows * row_len);
        (Rows { first: self.first, x: x0, y: y0, z: z0 }, Rows { first: self.first + rows, x: x1, y: y1, z: z1 })
    }
}

impl Planes {
    pub(super) fn new(width: usize, height: usize, reach: usize) -> Self {
        let row_len = reach + width.next_multiple_of(MAX_LANES) + reach;
        let len = row_len * (height + 2 * reach) + MAX_LANES;
        let nan = || vec![f32::NAN; len];
        Self { x: nan(), y: nan(), z: nan(), row_len, width, height, reach, rays: Rays::default() }
    }

    /// Bytes of the planes.
    pub(super) fn bytes(&self) -> usize {
        3 * size_of_val(&self.x[..])
    }

    /// Takes a frame of the shape the planes were made for.
    pub(super) fn fill(&mut self, frame: Frame<'_>, parallel: bool) {
        let (row_len, width, reach) = (self.row_len, self.width, self.reach);
        let image = reach * row_len..(reach + self.height) * row_len;
        let rows =
            Rows { first: 0, x: &mut self.x[image.clone()], y: &mut self.y[image.clone()], z: &mut self.z[image] };
        match frame {
            Frame::Cloud(cloud) => {
                let positions = cloud.positions();
                fill_rows(rows, row_len, parallel, &|v, x, y, z| {
                    copy_row(positions, v * width..(v + 1) * width, reach, x, y, z)
                });
            }
            Frame::Depth(depth) => {
                self.rays.set(&depth.camera);
                let rays = &self.rays;
                fill_rows(rows, row_len, parallel, &|v, x, y, z| {
                    let columns = reach..reach + width;
                    let raw = &depth.raw[v * width..(v + 1) * width];
                    let (x, y, z) = (&mut x[columns.clone()], &mut y[columns.clone()], &mut z[columns]);
                    deproject_row(raw, depth.camera.metres_per_unit(), &rays.x, rays.y[v], x, y, z);
                });
            }
        }
    }
}

/// Fills all rows, if allowed in parallel where there are many.
fn fill_rows(
    rows: Rows<'_>,
    row_len: usize,
    parallel: bool,
    fill: &(impl Fn(usize, &mut [f32], &mut [f32], &mut [f32]) + Sync),
) {
    let count = rows.x.len() / row_len;
    if parallel && count > ROWS_A_TASK {
        let (upper, lower) = rows.split_at(count / 2, row_len);
        join(|| fill_rows(upper, row_len, parallel, fill), || fill_rows(lower, row_len, parallel, fill));
        return;
    }
    let Rows { first, x, y, z } = rows;
    let planes = x.chunks_exact_mut(row_len).zip(y.chunks_exact_mut(row_len)).zip(z.chunks_exact_mut(row_len));
    for (i, ((x, y), z)) in planes.enumerate() {
        fill(first + i, x, y, z);
    }
}

fn copy_row(from: &Xyz, pixels: Range<usize>, reach: usize, x: &mut [f32], y: &mut [f32], z: &mut [f32]) {
    for (plane, from) in [(x, &from.x), (y, &from.y), (z, &from.z)] {
        plane[reach..reach + pixels.len()].copy_from_slice(&from[pixels.clone()]);
    }
}

/// Equal bit for bit to [`crate::Camera::depth_m`] and its products with the rays.
fn deproject_row(
    raw: &[u16],
    metres_per_unit: f32,
    ray_x: &[f32],
    ray_y: f32,
    x: &mut [f32],
    y: &mut [f32],
    z: &mut [f32],
) {
    for ((((&raw, &ray_x), x), y), z) in raw.iter().zip(ray_x).zip(x).zip(y).zip(z) {
        let hole = raw == 0 || raw == crate::camera::SATURATED_DEPTH;
        *z = if hole { f32::NAN } else { f32::from(raw) * metres_per_unit };
        *x = ray_x * *z;
        *y = ray_y * *z;
    }
}
