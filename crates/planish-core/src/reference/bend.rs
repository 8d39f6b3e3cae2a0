//! How the surface bends: within a window, and between the planes around a point (docs/method.md, section 10). Tensors in
//! 1/m: a surface with normal n and tensor T is x·Tx/2 above its tangent plane, at an offset x along it.

use glam::{DMat3, DVec3};

use super::plane::Plane;
use super::polynomial::tangents;
use super::window::{Neighbour, fading_gate};

/// The tensor of a window with few columns or rows is damped, by this share of the sums over a whole window.
const WINDOW_DAMPING: f64 = 0.08;
/// The least variance of the neighbours' columns or rows.
const LEAST_PLACES: f64 = 1e-3;
/// Windows whose strides span less than this share of the squared radius are lines.
const LEAST_AREA: f64 = 1e-6;
/// A quadric needs this many neighbours.
const LEAST_NEIGHBOURS: usize = 6;

/// Planes that weigh less together say nothing about the bend.
const LEAST_WEIGHT: f64 = 1e-12;
/// A window bends by at most this much over the radius.
const MOST_WINDOW_BEND: f64 = 4.0;
/// Damps the bend between planes, as a share of the squared radius.
const DAMPING: f64 = 0.009;
/// Windows beside a crease are flat, those on a round object are not. If less than this share of the bend between planes
/// is also within their windows, there is no bend...
const SHARED_FROM: f64 = 0.2;
/// ...and from this share on it counts fully.
const SHARED_TO: f64 = 0.5;
/// Planes whose normals spread by less than this many times the noise over the radius are on a flat surface; those that
/// spread twice as much count fully.
const LEAST_SPREAD: f64 = 1.0;
/// A surface bends by at most this much over the radius.
const MOST_BEND: f64 = 1.2;
/// The variance that a bend adds to a window, in squares of the window's spread times the bend. About a sixth of a disc's,
/// since the bend is uncertain.
const VARIANCE: f64 = 0.0125;

/// Returns x y^T.
fn outer(x: DVec3, y: DVec3) -> DMat3 {
    DMat3::from_cols(x * y.x, x * y.y, x * y.z)
}

/// The sum of the products of all entries.
fn inner(a: DMat3, b: DMat3) -> f64 {
    a.x_axis.dot(b.x_axis) + a.y_axis.dot(b.y_axis) + a.z_axis.dot(b.z_axis)
}

fn norm(a: DMat3) -> f64 {
    inner(a, a).sqrt()
}

fn trace(a: DMat3) -> f64 {
    a.x_axis.x + a.y_axis.y + a.z_axis.z
}

/// Returns how the surface in a window of half width `window` bends: regressions of the neighbours' distances from the
/// plane on those parts of i², i j and j² that a plane does not explain, with (i, j) their place in the window.
pub(super) fn of_window(neighbours: &[Neighbour], plane: &Plane, radius_m: f64, window: u32) -> DMat3 {
    if neighbours.len() < LEAST_NEIGHBOURS {
        return DMat3::ZERO;
    }
    let half = f64::from(window);
    let mean_square = half * (half + 1.0) / 3.0;
    let whole_row =
        |value: &dyn Fn(f64) -> f64| (-(window as i32)..=window as i32).map(|i| value(f64::from(i))).sum::<f64>();
    // Sums over a whole window: of (i² - mean)², and of (i j)².
    let whole_square = (2.0 * half + 1.0) * whole_row(&|i| (i * i - mean_square) * (i * i - mean_square));
    let whole_mixed = whole_row(&|i| i * i) * whole_row(&|i| i * i);

    let weighted = || neighbours.iter().map(|neighbour| (fading_gate(neighbour.offset, radius_m), neighbour));
    let sum = |value: &dyn Fn(&Neighbour) -> f64| weighted().map(|(g, neighbour)| g * value(neighbour)).sum::<f64>();
    let total = sum(&|_| 1.0);
    let height_m = |n: &Neighbour| (n.offset - plane.foot).dot(plane.normal);
    // Along columns or rows: the second derivative by the place, and the offset of one stride.
    let along = |axis: usize| {
        let place = |n: &Neighbour| n.place[axis];
        let square = |n: &Neighbour| n.place[axis] * n.place[axis] - mean_square;
        let mean_place = sum(&place) / total;
        let places = (sum(&|n| place(n) * place(n)) - total * mean_place * mean_place).max(LEAST_PLACES * total);
        let squares = sum(&|n| square(n) * square(n)) - sum(&square) * sum(&square) / total;
        let both = sum(&|n| square(n) * place(n)) - mean_place * sum(&square);
        let unexplained = (squares - both * both / places).max(0.0) + WINDOW_DAMPING * whole_square;
        let stride = weighted().map(|(g, n)| g * (place(n) - mean_place) * n.offset).sum::<DVec3>() / places;
        (2.0 * sum(&|n| height_m(n) * square(n)) / unexplained, stride)
    };
    let ((columns, right), (rows, down)) = (along(0), along(1));
    let product = |n: &Neighbour| n.place[0] * n.place[1];
    let mixed = sum(&|n| height_m(n) * product(n)) / (sum(&|n| product(n) * product(n)) + WINDOW_DAMPING * whole_mixed);
    // Gradients of the place along the plane.
    let n = plane.normal;
    let area = right.cross(down).dot(n);
    if area.abs() <= LEAST_AREA * radius_m * radius_m {
        return DMat3::ZERO;
    }
    let (column, row) = (down.cross(n) / area, n.cross(right) / area);
    let tensor =
        columns * outer(column, column) + mixed * (outer(column, row) + outer(row, column)) + rows * outer(row, row);
    let limit = MOST_WINDOW_BEND / (norm(tensor) * radius_m).max(MOST_WINDOW_BEND);
    limit * tensor
}

/// A plane near p, as the bend is measured from it.
pub(super) struct Slope {
    pub weight: f64,
    /// Offset of its centroid from p.
    pub offset: DVec3,
    pub normal: DVec3,
    /// The bend in its window.
    pub of_window: DMat3,
}

/// How the surface bends around p, and the mean offset of the planes that say so.
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
        // A plane's place t and its slope s, the sine of its angle: on a circle s grows with t by 1/r.
        let place = |s: &Slope| [s.offset.dot(u), s.offset.dot(v)];
        let slope = |s: &Slope| [-s.normal.dot(u), -s.normal.dot(v)];
        let mean_place = [0, 1].map(|k| mean(&|s| place(s)[k]));
        let mean_slope = [0, 1].map(|k| mean(&|s| slope(s)[k]));
        let places = |i: usize, j: usize| mean(&|s| (place(s)[i] - mean_place[i]) * (place(s)[j] - mean_place[j]));
        let slopes_by = |i: usize, j: usize| mean(&|s| (slope(s)[i] - mean_slope[i]) * (place(s)[j] - mean_place[j]));
        let damping = DAMPING * radius_m * radius_m;
        // The symmetric H = (h11, h12, h22) that minimises mean |s - H t|² + damping |H|².
        let (a11, a12, a22) = (places(0, 0) + damping, places(0, 1), places(1, 1) + damping);
        let matrix =
            DMat3::from_cols(DVec3::new(a11, a12, 0.0), DVec3::new(a12, a11 + a22, a12), DVec3::new(0.0, a12, a22));
        let h = matrix.inverse() * DVec3::new(slopes_by(0, 0), slopes_by(0, 1) + slopes_by(1, 0), slopes_by(1, 1));
        let tensor = h.x * outer(u, u) + h.y * (outer(u, v) + outer(v, u)) + h.z * outer(v, v);
        let centre = mean_place[0] * u + mean_place[1] * v;
        let size = norm(tensor);
        if size <= 0.0 {
            return Self { centre, ..Self::NONE };
        }
        let of_windows = slopes.iter().map(|s| s.weight * s.of_window).fold(DMat3::ZERO, |a, b| a + b) * (1.0 / total);
        let shared = inner(tensor, of_windows) / (size * size);
        let shared = ((shared - SHARED_FROM) / (SHARED_TO - SHARED_FROM)).clamp(0.0, 1.0);
        let mean_normal = slopes.iter().map(|s| s.weight * s.normal).sum::<DVec3>() / total;
        let spread = (1.0 - mean_normal.length_squared()).max(0.0).sqrt();
        let certain = (spread * radius_m / (LEAST_SPREAD * noise_m) - 1.0).clamp(0.0, 1.0);
        let limit = (MOST_BEND / (size * radius_m)).min(1.0);
        Self { tensor: shared * certain * limit * tensor, centre }
    }

    /// Returns the normal at p of the surface with normal n at the centre.
    pub(super) fn normal_at_p(&self, n: DVec3) -> DVec3 {
        (n + self.tensor * self.centre).normalize()
    }

    /// Returns the tensor along the plane with normal n.
    pub(super) fn along(&self, n: DVec3) -> DMat3 {
        let onto = DMat3::IDENTITY - outer(n, n);
        onto * self.tensor * onto
    }
}

/// Returns how much higher the bent surface is at p than a plane fitted to it, whose centroid is at this offset.
pub(super) fn rise_m(tensor: DMat3, offset: DVec3, plane: &Plane) -> f64 {
    0.5 * offset.dot(tensor * offset) - 0.25 * spread(plane) * trace(tensor)
}

/// Returns the variance that the bend adds to the points about a plane, in m².
pub(super) fn variance(tensor: DMat3, plane: &Plane) -> f64 {
    VARIANCE * inner(tensor, tensor) * spread(plane) * spread(plane)
}

/// The variance of the points along the plane, in m².
fn spread(plane: &Plane) -> f64 {
    plane.middle_variance + plane.largest_variance
}
