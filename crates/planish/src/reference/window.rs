//! The neighbours of a pixel: a strided window and a gate on distance (docs/method.md, section 2).
//!
//! A window never leaves the image and never wraps from one row into the next.

use glam::DVec3;

use crate::params::SmoothParams;

/// Points on a grid in the sensor's frame, row by row; a hole is not finite.
pub(super) struct Grid {
    pub points: Vec<DVec3>,
    pub width: usize,
    pub height: usize,
}

impl Grid {
    /// The point of pixel (u, v), unless it is a hole.
    pub fn point(&self, u: usize, v: usize) -> Option<DVec3> {
        let p = self.points[v * self.width + u];
        p.is_finite().then_some(p)
    }
}

/// Fills `offsets` with q - p for every neighbour q of the valid point p of pixel (u, v), in row order.
pub(super) fn gather(grid: &Grid, u: usize, v: usize, params: &SmoothParams, radius_m: f64, offsets: &mut Vec<DVec3>) {
    offsets.clear();
    let Some(p) = grid.point(u, v) else { return };
    let (window, stride) = (params.window as isize, params.stride as isize);
    let inside = |centre: usize, delta: isize, size: usize| {
        centre.checked_add_signed(delta * stride).filter(|&coordinate| coordinate < size)
    };
    for dv in -window..=window {
        let Some(row) = inside(v, dv, grid.height) else { continue };
        for du in -window..=window {
            let Some(column) = inside(u, du, grid.width) else { continue };
            let Some(q) = grid.point(column, row) else { continue };
            let offset = q - p;
            if offset.length_squared() <= radius_m * radius_m {
                offsets.push(offset);
            }
        }
    }
}
