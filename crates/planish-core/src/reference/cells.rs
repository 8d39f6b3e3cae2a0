//! Derives the results of pixels from the surfaces of the cells around them (docs/method.md, section 10). Lengths are
//! in metres.

use glam::DVec3;

use super::bend::rises;
use super::edges::STAY_WEIGHT;
use super::project;
use super::window::{Grid, fading_gate};
use super::{PointResult, Status, Surface};

/// Distance from a pixel along either axis at which a cell's share falls to 0 when the surface of the pixel's point
/// is found.
const FIND_REACH_PX: usize = 3;
/// Distance from a pixel along either axis at which a cell's share falls to 0 when surfaces are averaged.
const REACH_PX: usize = 4;
/// Sum of the shares within [`REACH_PX`], wherever the pixel is in its cell.
const ALL_SHARES: f64 = 4.0;
/// Distance from a pixel along either axis at which a cell's share falls to 0 when block means are averaged.
const MEAN_REACH_PX: usize = 2;
/// Sum of the weights of the surfaces around a point up to which the point is on none of them.
const LEAST_WEIGHT: f64 = 1e-12;
/// Distance of a surface from the point up to which it counts in the mean, in standard deviations of the noise.
const MEAN_WIDTH: f64 = 1.5;
/// Cosine between the normals of two surfaces above which one counts in the mean of the other, and the cosine from
/// which it counts fully.
const ALIKE: [f64; 2] = [0.9, 0.95];
/// Share of the surfaces around a point that must count for their bend to matter, and the share from which the bend
/// matters fully. With fewer, surfaces may be on one side of an edge, and only their tangent planes matter.
const AROUND: [f64; 2] = [0.6, 0.9];
/// Value added to the certainties of surfaces when their normals are averaged, so that the mean normal is defined
/// even if all of them are uncertain.
const LEAST_CERTAINTY: f64 = 1e-6;
/// Length of the mean normal of the surfaces around a point below which the point moves less. The mean normal is
/// short if the surfaces disagree, are uncertain or are seen edge-on.
const AGREEING: f64 = 0.5;
/// Sum of the weights of the block means around a pixel below which their mean is drawn towards the pixel's point.
const LEAST_MEANS: f64 = 0.1;
/// Weight of a zero displacement in the mean of the surfaces around a point that are like its own.
const MEAN_STAY: f64 = 0.05;
/// Length of the mean normal of the surfaces around a point below which rounding decides its direction.
const LEAST_NORMAL: f64 = 1e-15;
/// Cosine between a surface's normal and a point's ray below which the surface counts in proportion to the cosine,
/// since rounding decides which side faces the sensor.
const SIDE_COSINE: f64 = 0.1;
/// Minimum factor by which a surface counts, however small the cosine between its normal and the ray.
const LEAST_SIDE: f64 = 1e-6;
/// Length of a ray in metres below which surfaces count fully, because rounding then determines the ray's direction.
const LEAST_RAY_M: f64 = 1e-4;

/// The surfaces of all cells.
pub(super) struct CellSurfaces<'a> {
    /// The point of each cell.
    pub(super) cells: &'a Grid,
    /// Block means, if blocks are averaged.
    pub(super) means: Option<&'a Grid>,
    /// The surfaces of the cells' points.
    pub(super) surfaces: &'a [Option<Surface>],
    /// The results of the cells' points.
    pub(super) results: &'a [PointResult],
    /// True if points move along their rays.
    pub(super) on_ray: bool,
}

/// A pixel's valid point.
pub(super) struct Point {
    pub(super) p: DVec3,
    pub(super) radius_m: f64,
    pub(super) noise_m: f64,
    /// Maximum distance of block means from the point.
    pub(super) block_gate_m: f64,
}

/// The surface that a point is on.
struct Found {
    normal: DVec3,
    /// Distance from the point along the normal.
    height_m: f64,
    trust: f64,
    /// The result of the cell with the largest weight.
    best: PointResult,
}

impl CellSurfaces<'_> {
    /// Returns the result of a pixel's point.
    pub(super) fn result(&self, pixel: (usize, usize), point: &Point) -> PointResult {
        let &Point { p, radius_m, noise_m, .. } = point;
        let own = self.results[self.own_cell(pixel)];
        let Some(Found { normal, height_m, best, trust }) = self.surface(pixel, point) else {
            return match own.status {
                Status::Degenerate => PointResult { displacement: DVec3::ZERO, depth_scale: 1.0, ..own },
                Status::TooFew => PointResult { neighbours: own.neighbours, status: own.status, ..PointResult::hole() },
                _ => PointResult { status: Status::TooFew, ..PointResult::hole() },
            };
        };
        let step = |height_m: f64, normal: DVec3| {
            let along = project::along_ray(height_m * normal, normal, p, radius_m);
            (if self.on_ray { along * p } else { height_m * normal }, along)
        };
        let (first, along) = step(height_m, normal);
        let (height_m, normal) = self.mean(pixel, p + first, normal, noise_m);
        let (second, more_along) = step(trust * height_m, normal);
        // Both steps together must stay within the limits of a single step.
        let left_m = (radius_m.min(project::MAX_ALONG * p.length()) - first.length()).max(0.0);
        let share = if second.length() > left_m { left_m / second.length() } else { 1.0 };
        PointResult {
            displacement: first + share * second,
            depth_scale: 1.0 + along + share * more_along,
            normal: if normal.dot(p) > 0.0 { -normal } else { normal },
            ..best
        }
    }

    fn certainty(&self, cell: usize) -> f64 {
        self.surfaces[cell].map_or(0.0, |surface| surface.certainty)
    }

    fn own_cell(&self, (u, v): (usize, usize)) -> usize {
        v / 2 * self.cells.width + u / 2
    }

    /// Derives the surface of a point from the surfaces of the cells around it.
    fn surface(&self, pixel: (usize, usize), point: &Point) -> Option<Found> {
        let mean_offset = self.mean_offset(pixel, point);
        let (mut total, mut certain, mut sum, mut height_m) = (0.0, 0.0, DVec3::ZERO, 0.0);
        let (mut most, mut best) = (0.0, PointResult::hole());
        for (cell, share) in self.around(pixel, FIND_REACH_PX) {
            let result = self.results[cell];
            if !result.status.has_normal() {
                continue;
            }
            let offset = self.cells.points[cell] + result.displacement - point.p;
            let from_mean = (offset - mean_offset).dot(result.normal) / point.noise_m;
            let near = share * fading_gate(offset, point.radius_m);
            let ray_m = point.p.length();
            let side = if ray_m < LEAST_RAY_M { 1.0 } else { -result.normal.dot(point.p) / (SIDE_COSINE * ray_m) };
            let side = side.clamp(-1.0, 1.0).abs().max(LEAST_SIDE).copysign(side);
            let weight = near * (1.0 + from_mean * from_mean).powi(-4);
            let certainty = self.certainty(cell);
            let by_certainty = weight * (certainty + LEAST_CERTAINTY);
            if by_certainty > most {
                (most, best) = (by_certainty, result);
            }
            total += weight;
            certain += weight * certainty * side.abs();
            sum += by_certainty * side * result.normal;
            height_m += weight * certainty * side * offset.dot(result.normal);
        }
        let height_m = height_m / certain.max(f64::MIN_POSITIVE);
        let trust = (sum.length() / (AGREEING * total)).min(1.0).powi(2);
        // Normals of equal surfaces that face opposite sides cancel.
        let normal = if sum.length() < LEAST_NORMAL * total { best.normal } else { sum.normalize() };
        (total > LEAST_WEIGHT).then_some(Found { normal, height_m: height_m * trust, best, trust })
    }

    /// Returns the height over `point` of the mean of the surfaces around it that are like its own, and the normal of
    /// the mean.
    fn mean(&self, pixel: (usize, usize), point: DVec3, own_normal: DVec3, noise_m: f64) -> (f64, DVec3) {
        let (mut total, mut height_m, mut offset) = (0.0, 0.0, DVec3::ZERO);
        let mut normal = STAY_WEIGHT * own_normal;
        for (cell, share) in self.around(pixel, REACH_PX) {
            let other = self.results[cell];
            if !other.status.has_normal() {
                continue;
            }
            let to_other = self.cells.points[cell] + other.displacement - point;
            let cosine = own_normal.dot(other.normal);
            let other_normal = if cosine < 0.0 { -other.normal } else { other.normal };
            let e = to_other.dot(other_normal);
            let near = (1.0 - (e / (MEAN_WIDTH * noise_m)).powi(2)).max(0.0);
            let weight = share * self.certainty(cell) * near * rises(cosine.abs(), ALIKE);
            total += weight;
            height_m += weight * e;
            offset += weight * to_other;
            normal += weight * other_normal;
        }
        let normal = normal.normalize();
        let bend_m = offset.dot(normal) - height_m;
        ((height_m + 0.5 * rises(total / ALL_SHARES, AROUND) * bend_m) / (total + MEAN_STAY), normal)
    }

    /// Returns the offset from a point to the mean of the block means around it; 0 if blocks are not averaged.
    fn mean_offset(&self, pixel: (usize, usize), point: &Point) -> DVec3 {
        let Some(means) = self.means else { return DVec3::ZERO };
        let (mut total, mut sum) = (0.0, DVec3::ZERO);
        for (cell, share) in self.around(pixel, MEAN_REACH_PX) {
            let offset = means.points[cell] - point.p;
            if offset.is_finite() {
                let weight =
                    share * (1.0 - offset.length_squared() / (point.block_gate_m * point.block_gate_m)).max(0.0);
                total += weight;
                sum += weight * offset;
            }
        }
        sum / total.max(LEAST_MEANS)
    }

    /// Returns the cells that are less than `reach_px` pixels from a pixel along both axes, and their shares.
    fn around(&self, (u, v): (usize, usize), reach_px: usize) -> impl Iterator<Item = (usize, f64)> {
        let width = self.cells.width;
        let (columns, rows) = (shares(u, width, reach_px), shares(v, self.cells.height, reach_px));
        rows.into_iter().flat_map(move |(row, down)| {
            columns.clone().into_iter().map(move |(column, across)| (row * width + column, across * down))
        })
    }
}

/// Returns the cells along an axis that are less than `reach_px` pixels from a pixel, and their shares, which fall
/// linearly from 1 to 0.
fn shares(pixel: usize, cells: usize, reach_px: usize) -> Vec<(usize, f64)> {
    let share = |cell: usize| 1.0 - (2 * cell).abs_diff(pixel) as f64 / reach_px as f64;
    let own = pixel / 2;
    (own.saturating_sub(reach_px)..cells.min(own + reach_px))
        .map(|cell| (cell, share(cell)))
        .filter(|&(_, share)| share > 0.0)
        .collect()
}
