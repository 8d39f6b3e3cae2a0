//! The neighbours of a pixel: a strided window and a gate on distance (docs/method.md, section 2).
//!
//! A window never leaves the image and never wraps from one row into the next.

use glam::DVec3;

use crate::params::EngineParams;

/// Points on a grid in the sensor's frame, row by row; a hole is not finite.
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
}

/// The gate fades out over this share of the squared radius, half of it on either side.
const FADE: f64 = 1.0 / 16.0;

/// Returns the weight of a point by its offset from another: 1 up to 0.984 of the radius, 1/2 at the radius, 0 beyond
/// 1.016 of it.
pub(super) fn fading_gate(offset: DVec3, radius_m: f64) -> f64 {
    (0.5 + (1.0 - offset.length_squared() / (radius_m * radius_m)) / FADE).clamp(0.0, 1.0)
}

/// Returns the distance within which points count at all, slightly more than the radius.
pub(super) fn reach_m(radius_m: f64) -> f64 {
    radius_m * (1.0 + 0.5 * FADE).sqrt()
}

/// A neighbour of a point on a grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbour {
    /// Column and row in the window, in strides from its centre.
    pub place: [f64; 2],
    /// q - p.
    pub offset: DVec3,
}

/// Returns the neighbours of the valid point p of pixel (u, v) among the samples, in row order.
pub(super) fn neighbours(
    samples: &Grid,
    (u, v): (usize, usize),
    p: DVec3,
    params: &EngineParams,
    radius_m: f64,
) -> Vec<Neighbour> {
    let mut neighbours = Vec::with_capacity(params.candidates());
    let (window, stride) = (params.window as isize, params.stride as isize);
    let inside = |centre: usize, delta: isize, size: usize| {
        centre.checked_add_signed(delta * stride).filter(|&coordinate| coordinate < size)
    };
    for dv in -window..=window {
        let Some(row) = inside(v, dv, samples.height) else { continue };
        for du in -window..=window {
            let Some(column) = inside(u, du, samples.width) else { continue };
            let Some(q) = samples.point(column, row) else { continue };
            let offset = q - p;
            if fading_gate(offset, radius_m) > 0.0 {
                neighbours.push(Neighbour { place: [du as f64, dv as f64], offset });
            }
        }
    }
    neighbours
}
