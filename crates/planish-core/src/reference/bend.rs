//! Bending of the surface, within a window and between the planes around a point (docs/method.md, section 10).
//! Tensors are in 1/m: at an offset x along its tangent plane, a surface with normal n and tensor T is x·Tx/2 above
//! that plane.

use glam::{DMat3, DVec3};

use super::plane::Plane;
use super::polynomial::tangents;
use super::window::{Neighbour, fading_gate, sample_offset};
use crate::params::EngineParams;

/// Minimum variance along a plane, as a share of the squared radius.
const LEAST_SPREAD: f64 = 0.01;
/// Maximum bend of a window, in units of 1/radius.
const MOST_WINDOW_BEND: f64 = 4.0;

/// Sum of the planes' weights up to which the bend is not estimated.
const LEAST_WEIGHT: f64 = 1e-12;
/// Damping of the bend between planes, as a share of the squared radius.
const DAMPING: f64 = 0.009;
/// Spread of the normals up to which the surface is flat, in units of the noise divided by the radius. From twice
/// this spread on, the bend counts fully.
const LEAST_TURN: f64 = 1.0;
/// Share of the normals' variance that a bend must explain to count, and the share from which it counts fully.
const EXPLAINED: [f64; 2] = [0.65, 0.85];
/// Share of the bend between planes that must also be measured within their windows for the bend to count, and the
/// share from which it counts fully. Windows on a round object bend too, but windows next to a crease are flat.
const SHARED: [f64; 2] = [0.2, 0.4];
/// Maximum bend of a surface, in units of 1/radius.
const MOST_BEND: f64 = 1.2;
/// Returns the position of a value between two limits: 0 up to `from`, 1 from `to` on, and linear in between.
pub(super) fn rises(value: f64, [from, to]: [f64; 2]) -> f64 {
    ((value - from) / (to - from)).clamp(0.0, 1.0)
}

/// Returns x y^T.
fn outer(x: DVec3, y: DVec3) -> DMat3 {
    DMat3::from_cols(x * y.x, x * y.y, x * y.z)
}

/// Returns the sum of the products of corresponding entries of two matrices.
fn inner(a: DMat3, b: DMat3) -> f64 {
    a.x_axis.dot(b.x_axis) + a.y_axis.dot(b.y_axis) + a.z_axis.dot(b.z_axis)
}

fn norm(a: DMat3) -> f64 {
    inner(a, a).sqrt()
}

fn trace(a: DMat3) -> f64 {
    a.x_axis.x + a.y_axis.y + a.z_axis.z
}

/// Returns the sum of a window's principal curvatures in 1/m (docs/method.md, (10.13)). It is computed from the mean
/// height of the neighbours in the inner part of the window over the plane fitted to all neighbours.
pub(super) fn of_window(neighbours: &[Neighbour], plane: &Plane, radius_m: f64, params: &EngineParams) -> f64 {
    let half = params.window as isize;
    let middle = half / 2;
    let (mut total, mut height_m) = (0.0, 0.0);
    for neighbour in neighbours.iter().filter(|n| n.place.iter().all(|place| place.abs() <= middle)) {
        let weight = fading_gate(neighbour.offset, radius_m);
        total += weight;
        height_m += weight * (neighbour.offset - plane.foot).dot(plane.normal);
    }
    let spread_of = |half: isize| {
        let squares: isize = (-half..=half).map(|i| sample_offset(i, params).pow(2)).sum();
        squares as f64 / (2 * half + 1) as f64
    };
    let share = spread_of(middle) / spread_of(half);
    let spread = spread(plane).max(LEAST_SPREAD * radius_m * radius_m);
    let bend = -4.0 * height_m / (total.max(1.0) * (1.0 - share) * spread);
    bend.clamp(-MOST_WINDOW_BEND / radius_m, MOST_WINDOW_BEND / radius_m)
}

/// A plane near p, from which the bend is estimated.
pub(super) struct Slope {
    pub weight: f64,
    /// Offset of the plane's centroid from p.
    pub offset: DVec3,
    pub normal: DVec3,
    /// Sum of the principal curvatures in the plane's window, in 1/m.
    pub window_bend: f64,
}

/// The bend of the surface around p, and the mean offset from p of the planes from which it was estimated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bend {
    pub tensor: DMat3,
    pub centre: DVec3,
}

impl Bend {
    pub(super) const NONE: Self = Self { tensor: DMat3::ZERO, centre: DVec3::ZERO };

    /// Estimates the bend from the slopes of planes around a surface with normal n.
    pub(super) fn between(slopes: &[Slope], n: DVec3, radius_m: f64, noise_m: f64) -> Self {
        let (u, v) = tangents(n);
        let total = slopes.iter().map(|slope| slope.weight).sum::<f64>();
        if total <= LEAST_WEIGHT {
            return Self::NONE;
        }
        let mean = |value: &dyn Fn(&Slope) -> f64| slopes.iter().map(|s| s.weight * value(s)).sum::<f64>() / total;
        // A plane's position t and its slope s, the sine of its angle. On a circle of radius r, s changes by 1/r per
        // unit of t.
        let place = |s: &Slope| [s.offset.dot(u), s.offset.dot(v)];
        let slope = |s: &Slope| [-s.normal.dot(u), -s.normal.dot(v)];
        let mean_place = [0, 1].map(|k| mean(&|s| place(s)[k]));
        let mean_slope = [0, 1].map(|k| mean(&|s| slope(s)[k]));
        let places = |i: usize, j: usize| mean(&|s| (place(s)[i] - mean_place[i]) * (place(s)[j] - mean_place[j]));
        let slopes_by = |i: usize, j: usize| mean(&|s| (slope(s)[i] - mean_slope[i]) * (place(s)[j] - mean_place[j]));
        let damping = DAMPING * radius_m * radius_m;
        // The symmetric H = (h11, h12, h22) that minimises mean |s - H t|² + damping |H|².
        let matrix = |damping: f64| {
            let (a11, a12, a22) = (places(0, 0) + damping, places(0, 1), places(1, 1) + damping);
            DMat3::from_cols(DVec3::new(a11, a12, 0.0), DVec3::new(a12, a11 + a22, a12), DVec3::new(0.0, a12, a22))
        };
        let right_side = DVec3::new(slopes_by(0, 0), slopes_by(0, 1) + slopes_by(1, 0), slopes_by(1, 1));
        let h = matrix(damping).inverse() * right_side;
        let tensor = h.x * outer(u, u) + h.y * (outer(u, v) + outer(v, u)) + h.z * outer(v, v);
        let centre = mean_place[0] * u + mean_place[1] * v;
        let size = norm(tensor);
        let mean_normal = slopes.iter().map(|s| s.weight * s.normal).sum::<DVec3>() / total;
        // Variance of the normals, and the part of it that H t explains.
        let turns = (1.0 - mean_normal.length_squared()).max(0.0);
        let explained = h.dot(right_side).powi(2) / h.dot(matrix(0.0) * h);
        // If the tensor is zero or the normals do not turn, the surface is flat.
        if !(size > 0.0 && turns > 0.0 && explained > 0.0) {
            return Self { centre, ..Self::NONE };
        }
        let least_turn = LEAST_TURN * noise_m / radius_m;
        let turns_enough = rises(turns.sqrt(), [least_turn, 2.0 * least_turn]);
        let window_bend = mean(&|s| s.window_bend);
        let trace = trace(tensor);
        let shared = window_bend * trace / (trace * trace).max(0.5 * size * size);
        let limit = (MOST_BEND / (size * radius_m)).min(1.0);
        let factor = turns_enough * rises(explained / turns, EXPLAINED) * rises(shared, SHARED) * limit;
        Self { tensor: factor * tensor, centre }
    }

    /// Returns the surface's normal at p, given its normal n at the centre.
    pub(super) fn normal_at_p(&self, n: DVec3) -> DVec3 {
        (n + self.tensor * self.centre).normalize()
    }

    /// Returns the tensor projected onto the plane with normal n.
    pub(super) fn along(&self, n: DVec3) -> DMat3 {
        let onto = DMat3::IDENTITY - outer(n, n);
        onto * self.tensor * onto
    }
}

/// Returns the height in metres, at p, of the bent surface over a plane fitted to it with its centroid at `offset`
/// from p.
pub(super) fn rise_m(tensor: DMat3, offset: DVec3, plane: &Plane) -> f64 {
    0.5 * offset.dot(tensor * offset) - 0.25 * spread(plane) * trace(tensor)
}

/// Returns the variance of the points along the plane, in m².
fn spread(plane: &Plane) -> f64 {
    plane.middle_variance + plane.largest_variance
}
