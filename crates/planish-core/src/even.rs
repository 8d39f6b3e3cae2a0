//! Even spacing of a smoothed cloud (docs/method.md, section 8).
//!
//! Smoothing removes the noise across the surface. The noise along the surface remains, in the form of clumps and
//! gaps. Here each point is repelled by its neighbours within its tangent plane. A spring, whose strength depends on
//! the noise, ties the point to its smoothed position. Results depend only on the nearest points, in a fixed order,
//! so they are bit-identical for any number of threads.

use glam::Vec3;
use rayon::prelude::*;

use crate::constants::MEDIAN_SQUARE;
use crate::frame::PointsView;
use crate::neighbours::PointIndex;
use crate::smoothed::Smoothed;

/// Number of nearest positions that may repel a point.
const NEIGHBOURS: usize = 16;
/// Rank of the neighbour whose distance determines the spacing.
const SPACING_BY: usize = 12;
const STEPS: usize = 6;
/// Share of the repulsion that each step applies.
const STEP: f32 = 0.5;
/// Distance within which points repel each other, in spacings.
const REACH: f32 = 1.6;
/// Strength of the spring if the noise equals the spacing.
const SPRING: f32 = 0.5;
/// Maximum ratio of squared spacing to squared noise in the strength of the spring.
const STIFFEST: f32 = 100.0;
/// Maximum offset of a point, in standard deviations of the noise.
const FARTHEST: f32 = 1.5;
/// Cosine between the normals of two points up to which the points count as being on different surfaces.
const ONE_SURFACE: f32 = 0.7;
/// Sine of the angle between the line through two points and the plane halfway between their tangent planes, above
/// which the points count as being on different surfaces.
const STEEPEST: f32 = 0.5;
/// Maximum distance that a point moves along its normal back onto the surface, as a share of its offset. Curved
/// surfaces require less.
const MOST_CURVED: f32 = 0.25;
/// Cosine between normals at which the weight of a neighbour's plane is 0; the weight grows linearly with the cosine.
const ONE_PLANE: f32 = 0.5;

/// Moves the points of a smoothed cloud along their surface so that they are spaced evenly. Points without a normal are
/// left unchanged.
pub(crate) fn space_evenly(measured: &PointsView<'_>, smoothed: &mut Smoothed) {
    let Some(normals) = &smoothed.normals else { return };
    let mut index = PointIndex::default();
    index.fill(&measured.moved_to(&smoothed.points));
    let [mut x, mut y, mut z] = [(); 3].map(|()| vec![0.0; measured.len()]);
    measured.copy_to(0..measured.len(), &mut x, &mut y, &mut z);
    let mut points: Vec<Point> = (0..index.len()).map(|place| Point::at(index.point(place))).collect();
    for i in 0..measured.len() {
        let Some(place) = index.place(i) else { continue };
        let point = &mut points[place];
        let normal = Vec3::from_array(normals.get(i));
        point.normal = if normal.is_finite() { normal } else { Vec3::ZERO };
        point.variance = point.at.distance_squared(Vec3::new(x[i], y[i], z[i]));
    }
    let neighbours: Vec<Neighbours> = map(&points, |place, point| nearest_of(&index, place, point));
    points = map(&points, |place, point| {
        let farthest = points[neighbours[place][SPACING_BY - 1] as usize].at.distance(point.at);
        // A hexagonal grid with this spacing has `SPACING_BY` points on a disk of radius `farthest`.
        let spacing_m = farthest * (std::f32::consts::TAU / (SPACING_BY as f32 * 3f32.sqrt())).sqrt();
        Point { spacing_m, ..*point }
    });
    let most = noise_of(&points);
    points = map(&points, |place, point| point.averaged(&neighbours[place], &points, most));
    for _ in 0..STEPS {
        points = map(&points, |place, point| point.pushed(&neighbours[place], &points));
    }
    for i in 0..measured.len() {
        if let Some(place) = index.place(i)
            && points[place].normal != Vec3::ZERO
        {
            smoothed.points.set(i, points[place].on_surface(&neighbours[place], &points).to_array());
        }
    }
}

/// The places in the index of the nearest other points, nearest first.
type Neighbours = [u32; NEIGHBOURS];

/// A smoothed point, stored at its place in the index.
#[derive(Debug, Clone, Copy)]
struct Point {
    at: Vec3,
    /// The unit normal, or zero.
    normal: Vec3,
    /// Variance of the noise in m².
    variance: f32,
    /// Distance in metres between evenly spaced points of the same density.
    spacing_m: f32,
    /// The displacement along the tangent plane so far, in metres.
    offset: Vec3,
}

impl Point {
    fn at(at: [f32; 3]) -> Self {
        Self { at: Vec3::from_array(at), normal: Vec3::ZERO, variance: 0.0, spacing_m: 0.0, offset: Vec3::ZERO }
    }

    /// Returns the point with noise variance and spacing averaged over the point and its neighbours. The variance is
    /// measured by how far smoothing moved the points. Where smoothing distorts a surface, points move farther than the
    /// noise, so `most` limits the variance.
    fn averaged(&self, neighbours: &[u32], points: &[Self], most: f32) -> Self {
        let Self { mut variance, mut spacing_m, .. } = *self;
        for &other in neighbours {
            variance += points[other as usize].variance;
            spacing_m += points[other as usize].spacing_m;
        }
        let count = (NEIGHBOURS + 1) as f32;
        Self { variance: (variance / count).min(most), spacing_m: spacing_m / count, ..*self }
    }

    /// Returns half the sum of the normals of this point and another, and the absolute cosine between the normals;
    /// `None` if the points are on different surfaces, such as the two sides of a thin wall.
    fn between(&self, other: &Self) -> Option<(Vec3, f32)> {
        let cosine = self.normal.dot(other.normal);
        let between = 0.5 * (self.normal + cosine.signum() * other.normal);
        let away = self.at - other.at;
        let is_beside = cosine.abs() > ONE_SURFACE && between.dot(away).abs() <= STEEPEST * away.length();
        is_beside.then_some((between, cosine.abs()))
    }

    /// Returns the point after a step along its tangent plane: neighbours push it away, the spring pulls it back.
    fn pushed(&self, neighbours: &[u32], points: &[Self]) -> Self {
        let reach_m = REACH * self.spacing_m;
        let mut push = Vec3::ZERO;
        for neighbour in neighbours.iter().map(|&other| &points[other as usize]) {
            let away = self.at + self.offset - neighbour.at - neighbour.offset;
            if self.between(neighbour).is_some() {
                push += (1.0 - away.length() / reach_m).max(0.0).powi(2) * away.normalize_or_zero();
            }
        }
        let offset = self.offset + STEP * reach_m * (push - push.dot(self.normal) * self.normal);
        let stiffness = SPRING * STEP * (self.spacing_m.powi(2) / self.variance).min(STIFFEST);
        let offset = (offset / (1.0 + stiffness)).clamp_length_max(FARTHEST * self.variance.sqrt());
        Self { offset, ..*self }
    }

    /// Returns the moved point, put back onto the surface. Its mean height above the planes halfway between its tangent
    /// plane and each neighbour's is subtracted along its normal. Such planes cut a surface of constant curvature.
    fn on_surface(&self, neighbours: &[u32], points: &[Self]) -> Vec3 {
        let place = self.at + self.offset;
        let (mut height, mut weights) = (0.0, 0.0);
        for neighbour in neighbours.iter().map(|&other| &points[other as usize]).chain([self]) {
            let Some((between, cosine)) = self.between(neighbour) else { continue };
            let away = place - neighbour.at;
            let nearness = (1.0 - away.length_squared() / (REACH * self.spacing_m).powi(2)).max(0.0).powi(2);
            let weight = nearness * (cosine - ONE_PLANE);
            height += weight * between.dot(away);
            weights += weight;
        }
        let most_m = MOST_CURVED * self.offset.length();
        place - if weights > 0.0 { (height / weights).clamp(-most_m, most_m) } else { 0.0 } * self.normal
    }
}

/// Returns the noise variance that explains the median squared distance by which smoothing moved the points.
fn noise_of(points: &[Point]) -> f32 {
    let mut squares: Vec<f32> = points.iter().filter(|p| p.normal != Vec3::ZERO).map(|point| point.variance).collect();
    let middle = squares.len() / 2;
    if squares.is_empty() {
        0.0
    } else {
        *squares.select_nth_unstable_by(middle, f32::total_cmp).1 / MEDIAN_SQUARE as f32
    }
}

/// Returns the places in the index of the nearest other points, padded with the point's own place if there are fewer
/// than 16.
fn nearest_of(index: &PointIndex, place: usize, point: &Point) -> Neighbours {
    let mut nearest = index.nearest(point.at.to_array()).map(|(_, other)| other).filter(|&other| other != place as u32);
    std::array::from_fn(|_| nearest.next().unwrap_or(place as u32))
}

/// Computes a value for each point in parallel.
fn map<T: Send>(points: &[Point], value: impl Fn(usize, &Point) -> T + Sync) -> Vec<T> {
    points.par_iter().enumerate().map(|(place, point)| value(place, point)).collect()
}

#[cfg(test)]
mod tests;
