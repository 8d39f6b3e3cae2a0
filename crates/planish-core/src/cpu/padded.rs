//! A frame with a border, from which all windows are loaded.
//!
//! Points are copied or deprojected (docs/method.md, section 1), in the cloud's frame. x, y and z are each stored as
//! rows of `row_len` values, with `border` rows and columns of NaN around the image, whose width is padded with NaN
//! to a multiple of [`MAX_LANES`]. Every load of a window, for every vector of pixels, is then a plain load inside
//! the buffer. NaN and infinite values fail the gate.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase};

use super::channels::{Channels, MAX_LANES, Part};
use super::row_tasks::{SplitRows, halve};
use super::vector::Vec3;
use crate::camera::{Rays, RowRays, RowRaysY, depth_m};
use crate::frame::{DepthSamples, Frame};
use crate::smoothing_engine::AdmittedFrame;

/// Number of rows that one task fills, enough to outweigh the cost of the task.
const ROWS_PER_TASK: usize = 32;

pub(super) struct PaddedFrame {
    xyz: Channels<3>,
    /// Number of values from one row to the next.
    pub(super) row_len: usize,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Number of border columns and rows before the image.
    pub(super) border: usize,
}

/// A band of image rows of the three channels.
pub(super) struct PaddedRows<'a> {
    /// Index of the band's first row in the image.
    pub(super) first: usize,
    row_len: usize,
    border: usize,
    xyz: [&'a mut [f32]; 3],
}

impl PaddedRows<'_> {
    /// Returns the index of column u in row `row` of this band.
    pub(super) fn index(&self, row: usize, u: usize) -> usize {
        row * self.row_len + self.border + u
    }

    /// Stores a vector of points at an index. The lanes of a row's last vector beyond the image are NaN and fall into
    /// the padding.
    #[inline(always)]
    pub(super) fn store<S: Simd>(&mut self, at: usize, points: Vec3<S>) {
        let lanes = at..at + S::f32s::LEN;
        let [x, y, z] = &mut self.xyz;
        points.x.store_slice(&mut x[lanes.clone()]);
        points.y.store_slice(&mut y[lanes.clone()]);
        points.z.store_slice(&mut z[lanes]);
    }
}

impl SplitRows for PaddedRows<'_> {
    fn count(&self) -> usize {
        self.xyz[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, row_len, border, xyz } = self;
        let [(x, x_rest), (y, y_rest), (z, z_rest)] = xyz.map(|values| values.split_at_mut(rows * row_len));
        (
            Self { first, row_len, border, xyz: [x, y, z] },
            Self { first: first + rows, row_len, border, xyz: [x_rest, y_rest, z_rest] },
        )
    }
}

impl PaddedFrame {
    pub(super) fn new(width: usize, height: usize, border: usize) -> Self {
        let row_len = border + width.next_multiple_of(MAX_LANES) + border;
        let xyz = Channels::new(row_len * (height + 2 * border), f32::NAN);
        Self { xyz, row_len, width, height, border }
    }

    /// Returns channels with the layout of this frame, filled with zeros.
    pub(super) fn channels<const N: usize>(&self) -> Channels<N> {
        Channels::new(self.row_len * (self.height + 2 * self.border), 0.0)
    }

    pub(super) fn bytes(&self) -> usize {
        self.xyz.bytes()
    }

    /// Returns the index of pixel (u, v) of the image.
    #[inline(always)]
    pub(super) fn index(&self, u: usize, v: usize) -> usize {
        (v + self.border) * self.row_len + u + self.border
    }

    /// Returns the points of the vector of pixels that starts at an index.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, at: usize) -> Vec3<S> {
        self.xyz.vector(simd, 0, at)
    }

    /// Returns the part for loading points at indices `first` to `last`. Panics if these are outside the frame.
    #[inline(always)]
    pub(super) fn part(&self, first: usize, last: usize) -> Part<'_, 3> {
        self.xyz.part(first, last)
    }

    /// Returns the rows of the image.
    pub(super) fn rows(&mut self) -> PaddedRows<'_> {
        let (row_len, border) = (self.row_len, self.border);
        let image = border * row_len..(border + self.height) * row_len;
        PaddedRows { first: 0, row_len, border, xyz: self.xyz.range_mut(image) }
    }

    /// Copies a frame, which must have this buffer's shape. `rays` must belong to the frame's camera.
    pub(super) fn fill(&mut self, admitted: &AdmittedFrame<'_>, rays: &Rays, parallel: bool) {
        let (row_len, width, border) = (self.row_len, self.width, self.border);
        let rows = self.rows();
        let fill_rows = |rows: PaddedRows<'_>| {
            let count = rows.count();
            let PaddedRows { first, xyz: [x, y, z], .. } = rows;
            for row in 0..count {
                let at = row * row_len + border..row * row_len + border + width;
                points_of_row(
                    admitted,
                    rays,
                    first + row,
                    0..width,
                    [&mut x[at.clone()], &mut y[at.clone()], &mut z[at]],
                );
            }
        };
        if parallel {
            halve(ROWS_PER_TASK, rows, &fill_rows);
        } else {
            fill_rows(rows);
        }
    }
}

/// Copies or deprojects the points of some columns of row v.
pub(super) fn points_of_row(
    admitted: &AdmittedFrame<'_>,
    rays: &Rays,
    v: usize,
    columns: Range<usize>,
    [x, y, z]: [&mut [f32]; 3],
) {
    match admitted.frame {
        Frame::Points(points) => {
            let start = v * admitted.frame.shape().0;
            points.copy_to(start + columns.start..start + columns.end, x, y, z);
        }
        Frame::Depth(depth) => {
            match depth.row(v) {
                DepthSamples::U16(raw) => {
                    let metres_per_unit = depth.camera().metres_per_unit();
                    z.iter_mut().zip(&raw[columns.clone()]).for_each(|(z, &raw)| *z = depth_m(raw, metres_per_unit));
                }
                DepthSamples::F32(metres) => z.iter_mut().zip(&metres[columns.clone()]).for_each(|(z, &metres)| {
                    *z = if metres > 0.0 && metres.is_finite() { metres } else { f32::NAN };
                }),
            }
            deproject_row(rays.row(v), columns, z, x, y);
        }
    }
}

/// Computes x and y from z, bit-identical to [`crate::DepthFrame::deproject`].
fn deproject_row(rays: RowRays<'_>, columns: Range<usize>, z: &[f32], x: &mut [f32], y: &mut [f32]) {
    x.iter_mut().zip(&rays.x[columns.clone()]).zip(z).for_each(|((x, ray_x), z)| *x = ray_x * z);
    match rays.y {
        RowRaysY::Same(ray_y) => y.iter_mut().zip(z).for_each(|(y, z)| *y = ray_y * z),
        RowRaysY::Each(rays_y) => {
            y.iter_mut().zip(&rays_y[columns]).zip(z).for_each(|((y, ray_y), z)| *y = ray_y * z);
        }
    }
}
