//! Block means: each sample of the windows is the mean of the points in the block around its pixel or cell
//! (docs/method.md, sections 2 and 10). Lengths are in metres.

use glam::DVec3;

use super::Surface;
use super::radius::spacing_m;
use super::window::{Grid, fading_gate};
use crate::frame::FrameGeometry;
use crate::params::EngineParams;

/// Minimum gate of a block, in depth steps of the sensor.
const STEPS: f64 = 2.5;
/// Minimum gate of a block, in half-widths of the block.
const HALF_WIDTHS: f64 = 3.0;

/// Maximum distance of a block's points from the surface for them to count if edges are kept, as a multiple of the
/// width within which neighbours count.
const SURFACE_WIDTH: f64 = 1.5;
/// Square root of the minimum weight of a block's point by its distance from the surface.
const MIN_WEIGHT: f64 = 0.02;

/// Returns the maximum distance between a cell's point p and the points of its block.
pub(super) fn gate_m(params: &EngineParams, geometry: &FrameGeometry, p: DVec3) -> f64 {
    let width_m = params.block_half_px() as f64 * spacing_m(geometry, p);
    (STEPS * params.sensor.step_m(geometry.range_m(p))).max(HALF_WIDTHS * width_m)
}

/// Returns the offset from the valid point p of cell (u, v) to the mean of its block. If edges are kept, points are
/// weighted by their distance from the surface of p.
pub(super) fn mean_offset(
    grid: &Grid,
    (u, v): (usize, usize),
    p: DVec3,
    params: &EngineParams,
    geometry: &FrameGeometry,
    surface: Option<&Surface>,
) -> DVec3 {
    let gate_m = gate_m(params, geometry, p);
    let half = params.block_half_px();
    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
    let cell_px = params.cell_px();
    let (first_row, first_column) = (v * cell_px, u * cell_px);
    for row in first_row.saturating_sub(half)..(first_row + cell_px + half).min(grid.height) {
        for column in first_column.saturating_sub(half)..(first_column + cell_px + half).min(grid.width) {
            let Some(q) = grid.point(column, row) else { continue };
            let offset = q - p;
            let on_surface = |surface: &Surface| {
                let f_m = surface.plane.map_or(0.0, |plane| (offset - plane.foot).dot(plane.normal));
                let f = f_m / (SURFACE_WIDTH * surface.width_m);
                (1.0 - (1.0 - surface.no_plane_fits) * f * f).max(MIN_WEIGHT)
            };
            let on_surface = surface.map_or(1.0, on_surface);
            let weight = fading_gate(offset, gate_m) * on_surface * on_surface;
            sum += weight * offset;
            total += weight;
        }
    }
    // p has a weight, except in a block of zero extent.
    if total > 0.0 { sum / total } else { DVec3::ZERO }
}
