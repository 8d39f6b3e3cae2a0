//! The weighted polynomial over the plane (docs/method.md, section 5). Lengths are in metres, relative to p.

use glam::{DMat3, DVec3};

use super::Surface;
use super::bend::rises;
use super::edges::WIDTH;
use super::plane::Plane;
use super::solve::solve;
use super::window::fading_gate;
use crate::params::EngineParams;

/// The height f(a, b) of the surface over the plane, as its value and slopes at the foot of p.
#[derive(Debug, Clone, Copy)]
pub(super) struct Polynomial {
    /// The degree that the number of neighbours supports: 2 or 3.
    pub degree: u32,
    /// Height over the foot along the normal, c_00, in metres.
    pub height: f64,
    /// Gradient at the foot as a vector in the plane, (c_10 u + c_01 v)/h, in metres per metre.
    pub gradient: DVec3,
}

/// Maximum exponent for the distance from the surface: a distant neighbour keeps exp(-8) of its weight, which f32
/// still represents well.
const MAX_OFF_SURFACE: f64 = 8.0;
/// Maximum ridge of the fit to all neighbours, which applies if no plane fits.
const LOW_RIDGE: f64 = 3e-4;
/// Maximum ridge of the fit to all neighbours if there are six: a polynomial of degree 2 has six coefficients, and
/// would fit them exactly.
const FEWEST_RIDGE: f64 = 3e-3;
const FEWEST: u32 = 6;
/// Ratio of the neighbours' variance about the polynomial of all neighbours to the noise's variance, up to which that
/// polynomial counts fully, and the ratio from which it does not count.
const CLOSE: [f64; 2] = [0.3, 0.8];

/// Returns the number of coefficients of a polynomial of a degree in two variables: 3, 6, 10.
fn coefficient_count(degree: u32) -> usize {
    ((degree + 1) * (degree + 2) / 2) as usize
}

/// Returns the exponents (i, j) of the monomials a^i b^j up to a degree, ordered by degree: 1, a, b, a², ab, b², a³,
/// ...
fn monomials(degree: u32) -> impl Iterator<Item = (u32, u32)> {
    (0..=degree).flat_map(|total| (0..=total).map(move |j| (total - j, j)))
}

/// Returns the weight of a monomial in the ridge, R of (6.2) in docs/method.md: the binomial norm of the derivatives,
/// which makes the ridge independent of the in-plane axes.
fn ridge_weight((i, j): (u32, u32)) -> f64 {
    if i + j == 0 {
        return 0.0;
    }
    let binomial = (0..j).fold(1.0, |product, k| product * f64::from(i + j - k) / f64::from(k + 1));
    1.0 / binomial
}

/// Returns two unit vectors that complete the unit vector n to an orthonormal frame (Duff et al. 2017).
pub(super) fn tangents(n: DVec3) -> (DVec3, DVec3) {
    let sign = 1f64.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (DVec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), DVec3::new(b, sign + n.y * n.y * a, -n.y))
}

/// Fits the polynomial of the highest degree, up to `degree`, that the neighbours support; `None` if that is 1, the
/// plane itself. Where no plane fits, it is replaced by the polynomial of all neighbours, if that is close to them.
pub(super) fn over(
    surface: &Surface,
    plane: &Plane,
    offsets: &[DVec3],
    radius_m: f64,
    bandwidth_m: f64,
    params: &EngineParams,
) -> Option<Polynomial> {
    let degree = (2..=params.degree).rev().find(|&d| coefficient_count(d) <= surface.neighbours as usize)?;
    let ridge = f64::from(params.ridge);
    let near_plane =
        Fitting { plane, bend: surface.bend, width_m: surface.width_m, radius_m, bandwidth_m, ridge, degree };
    let (kept, _) = near_plane.fit(offsets);
    if surface.no_plane_fits == 0.0 {
        return Some(kept);
    }
    let low_ridge = if surface.neighbours == FEWEST { FEWEST_RIDGE } else { LOW_RIDGE };
    let (of_all, variance) = Fitting { width_m: f64::INFINITY, ridge: ridge.min(low_ridge), ..near_plane }.fit(offsets);
    let noise_variance = (surface.width_m / WIDTH).powi(2);
    let close = 1.0 - rises(variance / noise_variance, CLOSE);
    Some(kept.mix(&of_all, surface.no_plane_fits * close))
}

impl Polynomial {
    /// Interpolates between this polynomial and another over the same plane, given the other's share.
    fn mix(&self, other: &Self, share: f64) -> Self {
        let height = (1.0 - share) * self.height + share * other.height;
        Self { degree: self.degree, height, gradient: (1.0 - share) * self.gradient + share * other.gradient }
    }
}

/// A fit to the neighbours of a point.
#[derive(Clone, Copy)]
struct Fitting<'a> {
    plane: &'a Plane,
    /// Bend, in 1/m, of the paraboloid over the plane. Heights are measured from the paraboloid.
    bend: DMat3,
    /// Distance from the paraboloid, in metres, over which the weight of neighbours falls off.
    width_m: f64,
    radius_m: f64,
    bandwidth_m: f64,
    ridge: f64,
    degree: u32,
}

impl Fitting<'_> {
    /// Returns the polynomial, and the minimum of (6.1) in docs/method.md divided by the sum of the weights, in m²:
    /// about the variance of the neighbours.
    fn fit(&self, offsets: &[DVec3]) -> (Polynomial, f64) {
        let &Self { plane, bend, width_m, radius_m, bandwidth_m, ridge, degree } = self;
        let (u, v) = tangents(plane.normal);
        let h = radius_m.min(2.0 * plane.largest_variance.sqrt());

        let m = coefficient_count(degree);
        let mut normal_matrix = vec![vec![0.0; m]; m];
        let mut right_side = vec![0.0; m];
        let mut squares = 0.0;
        for &offset in offsets {
            let x = offset - plane.foot;
            let (a, b) = (x.dot(u) / h, x.dot(v) / h);
            let f_m = x.dot(plane.normal) - 0.5 * x.dot(bend * x);
            let off_surface = ((f_m / width_m) * (f_m / width_m)).min(MAX_OFF_SURFACE);
            let gaussian = (-x.length_squared() / (bandwidth_m * bandwidth_m) - off_surface).exp();
            let w = fading_gate(offset, radius_m) * gaussian;
            let powers: Vec<f64> = monomials(degree).map(|(i, j)| a.powi(i as i32) * b.powi(j as i32)).collect();
            for (row, power) in powers.iter().enumerate() {
                for (column, other) in powers.iter().enumerate() {
                    normal_matrix[row][column] += w * power * other;
                }
                right_side[row] += w * power * f_m;
            }
            squares += w * f_m * f_m;
        }
        let total = normal_matrix[0][0];
        for (k, monomial) in monomials(degree).enumerate() {
            normal_matrix[k][k] += ridge * total * ridge_weight(monomial);
        }
        let c = solve(&normal_matrix, &right_side);
        let explained: f64 = c.iter().zip(&right_side).map(|(c, t)| c * t).sum();
        let polynomial = Polynomial { degree, height: c[0], gradient: (c[1] * u + c[2] * v) / h };
        // If all weights are 0, the variance is unknown.
        (polynomial, if total > 0.0 { (squares - explained) / total } else { f64::INFINITY })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn monomials_are_ordered_by_degree() {
        let expected = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)];
        assert_eq!(monomials(3).collect::<Vec<_>>(), expected);
        assert_eq!([1, 2, 3].map(coefficient_count), [3, 6, 10]);
    }

    #[test]
    fn the_ridge_weighs_mixed_derivatives_once() {
        let weights: Vec<f64> = monomials(3).map(ridge_weight).collect();
        assert_eq!(weights, [0.0, 1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0 / 3.0, 1.0 / 3.0, 1.0]);
    }

    #[test]
    fn tangents_complete_an_orthonormal_frame() {
        for n in [DVec3::Z, -DVec3::Z, DVec3::X, -DVec3::Y, DVec3::new(0.3, -0.5, -0.2).normalize()] {
            let (u, v) = tangents(n);
            for product in [u.dot(v), u.dot(n), v.dot(n), u.length() - 1.0, v.length() - 1.0] {
                assert!(product.abs() < 1e-15);
            }
        }
    }
}
