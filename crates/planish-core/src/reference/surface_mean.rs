//! The mean of the surfaces that the pixels of a block have found (docs/method.md, section 10). Metres.

use glam::DVec3;

use super::bend::rises;
use super::project;
use super::window::Grid;
use super::{PointResult, Surface};

/// Surfaces count up to this many times the width within which neighbours count.
const MEAN_WIDTH: f64 = 1.5;
/// Surfaces count from the first cosine between their normals on, and fully from the second on.
const ALIKE: [f64; 2] = [0.9, 0.95];
/// If less than the first share of the surfaces count, they may be on one side of an edge, and only their tangent
/// planes matter. From the second share on, so does how they bend.
const AROUND: [f64; 2] = [0.6, 0.9];

/// Points with fewer neighbours, which hardly determine a normal, stay.
const LEAST_NEIGHBOURS: u32 = 5;

/// The results of all pixels, each on its own surface.
pub(super) struct Results<'a> {
    pub(super) grid: &'a Grid,
    pub(super) results: &'a [PointResult],
    /// Half the width of a block, in pixels.
    pub(super) half: usize,
    /// Whether points move along their rays.
    pub(super) on_ray: bool,
}

impl Results<'_> {
    /// Moves the result of the valid point p of pixel (u, v) onto the mean of the surfaces around it. If its block were
    /// a chessboard, only the fields of the pixel's own colour would count.
    pub(super) fn on_mean(&self, (u, v): (usize, usize), p: DVec3, surface: &Surface, radius_m: f64) -> PointResult {
        let Self { grid, results, on_ray, .. } = *self;
        let own = results[v * grid.width + u];
        if !own.status.has_normal() || own.neighbours < LEAST_NEIGHBOURS {
            return own;
        }
        let half = self.half as isize;
        let (mut places, mut total) = (0.0, 0.0);
        let (mut height_m, mut offset, mut normal) = (0.0, DVec3::ZERO, DVec3::ZERO);
        for (dv, du) in (-half..=half).flat_map(|dv| (-half..=half).map(move |du| (dv, du))) {
            if (du + dv) % 2 != 0 {
                continue;
            }
            places += 1.0;
            let Some(column) = u.checked_add_signed(du).filter(|&u| u < grid.width) else { continue };
            let Some(row) = v.checked_add_signed(dv).filter(|&v| v < grid.height) else { continue };
            let at = row * grid.width + column;
            let other = results[at];
            if !other.status.has_normal() {
                continue;
            }
            let to_other = grid.points[at] + other.displacement - (p + own.displacement);
            // Rounding decides which side of a surface seen edge-on faces the sensor.
            let cosine = own.normal.dot(other.normal);
            let other_normal = cosine.signum() * other.normal;
            let e = to_other.dot(other_normal);
            let near = (1.0 - (e / (MEAN_WIDTH * surface.width_m)).powi(2)).max(0.0);
            let weight = near * rises(cosine.abs(), ALIKE);
            total += weight;
            height_m += weight * e;
            offset += weight * to_other;
            normal += weight * other_normal;
        }
        // Its own surface counts, so there is a total.
        let normal = normal.normalize();
        let bend_m = offset.dot(normal) - height_m;
        let height_m = (height_m + 0.5 * rises(total / places, AROUND) * bend_m) / total;
        let along = project::along_ray(height_m * normal, normal, p, radius_m);
        let moved = if on_ray { along * p } else { height_m * normal };
        let displacement = own.displacement + moved;
        // Both steps together stay within the limits of one.
        if displacement.length() > radius_m.min(project::MAX_ALONG * p.length()) {
            return own;
        }
        let normal = if normal.dot(p) > 0.0 { -normal } else { normal };
        PointResult { displacement, depth_scale: own.depth_scale + along, normal, ..own }
    }
}
