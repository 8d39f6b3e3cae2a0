//! Finds the neighbours of a pixel, with a strided window and a gate on distance (docs/method.md, section 2).
//!
//! A window never leaves the image and never wraps from one row into the next.

use glam::DVec3;

use crate::params::EngineParams;

/// One point per pixel or cell, row by row, in sensor coordinates; holes have non-finite coordinates.
pub(super) struct Grid {
    pub points: Vec<DVec3>,
    pub width: usize,
    pub height: usize,
}

impl Grid {
    /// Returns the point of pixel (u, v), unless it is a hole.
    pub fn point(&self, u: usize, v: usize) -> Option<DVec3> {
        let p = self.points[v * self.width + u];
        p.is_finite().then_some(p)
    }

    /// Returns the first valid point of each cell of `cell_px` x `cell_px` pixels.
    pub fn cells(&self, cell_px: usize) -> Self {
        let (width, height) = (self.width.div_ceil(cell_px), self.height.div_ceil(cell_px));
        let first = |(u, v): (usize, usize)| {
            let rows = cell_px * v..(cell_px * (v + 1)).min(self.height);
            let columns = cell_px * u..(cell_px * (u + 1)).min(self.width);
            rows.flat_map(|row| columns.clone().map(move |column| (column, row)))
                .find_map(|(column, row)| self.point(column, row))
        };
        let cells = (0..height).flat_map(|v| (0..width).map(move |u| (u, v)));
        Self { points: cells.map(|cell| first(cell).unwrap_or(DVec3::NAN)).collect(), width, height }
    }
}

/// Width of the range of squared distances over which the gate fades out, as a share of the squared radius, on which
/// the range is centred.
const FADE: f64 = 1.0 / 16.0;

/// Returns the weight of a point at an offset from another: 1 up to 0.984 of the radius, 1/2 at the radius, 0 beyond
/// 1.016 of the radius.
pub(super) fn fading_gate(offset: DVec3, radius_m: f64) -> f64 {
    (0.5 + (1.0 - offset.length_squared() / (radius_m * radius_m)) / FADE).clamp(0.0, 1.0)
}

/// Returns the distance within which points have a positive weight, slightly more than the radius.
pub(super) fn reach_m(radius_m: f64) -> f64 {
    radius_m * (1.0 + 0.5 * FADE).sqrt()
}

/// A neighbour of a point on a grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbour {
    /// Column and row in the window, in samples from its centre.
    pub place: [isize; 2],
    /// Offset q - p from the point, in metres.
    pub offset: DVec3,
}

/// Returns the distance in cells from the centre of a window to its i-th column of samples.
pub(super) fn sample_offset(i: isize, params: &EngineParams) -> isize {
    i.signum() * (i.unsigned_abs() * params.stride as usize).div_ceil(params.cell_px()) as isize
}

/// Returns the neighbours of the valid point p of cell (u, v) among the samples, in row order.
pub(super) fn neighbours(
    samples: &Grid,
    (u, v): (usize, usize),
    p: DVec3,
    params: &EngineParams,
    radius_m: f64,
) -> Vec<Neighbour> {
    let mut neighbours = Vec::with_capacity(params.candidates());
    let window = params.window as isize;
    let inside = |centre: usize, i: isize, size: usize| {
        centre.checked_add_signed(sample_offset(i, params)).filter(|&coordinate| coordinate < size)
    };
    for j in -window..=window {
        let Some(row) = inside(v, j, samples.height) else { continue };
        for i in -window..=window {
            let Some(column) = inside(u, i, samples.width) else { continue };
            let Some(q) = samples.point(column, row) else { continue };
            let offset = q - p;
            if fading_gate(offset, radius_m) > 0.0 {
                neighbours.push(Neighbour { place: [i, j], offset });
            }
        }
    }
    neighbours
}
