//! The point on the surface, its normal and its status (docs/method.md, section 7).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::plane::Plane;
use super::polynomial::Fit;
use super::vector::{Mask, Vec3, splat};
use crate::method::coefficient_count;

pub(super) struct Projected<S: Simd> {
    pub(super) point: Vec3<S>,
    /// The plane's where the normal is not wanted.
    pub(super) normal: Vec3<S>,
    /// Codes of [`crate::Status`], as numbers.
    pub(super) status: S::f32s,
}

/// Puts points on the plane (D = 1, or where `fit` does not apply) or on the polynomial with the coefficients c. `ray` leads from
/// the sensor to p.
#[allow(clippy::too_many_arguments)]
#[inline(always)]
pub(super) fn project<S: Simd, const D: usize>(
    simd: S,
    p: Vec3<S>,
    ray: Vec3<S>,
    plane: &Plane<S>,
    fit: Option<(&Fit<S>, [S::f32s; 3])>,
    radius: S::f32s,
    n: S::f32s,
    wants_normal: bool,
) -> Projected<S> {
    let mut moved = plane.height;
    let mut normal = plane.normal;
    let mut status = splat(simd, 3.0);
    if let Some((fit, [height, slope_a, slope_b])) = fit {
        let surface = height.mul_add(fit.metres, plane.height);
        // A NaN is not within the radius.
        let within: Mask<S> = (surface * surface).simd_le(radius * radius);
        let on_surface = within & n.simd_ge(splat(simd, coefficient_count(2) as f32));
        moved = on_surface.select(surface, moved);
        if wants_normal {
            let tilted = plane
                .normal
                .add_scaled(-(slope_a * fit.metres), fit.a_axis)
                .add_scaled(-(slope_b * fit.metres), fit.b_axis);
            let length = tilted.dot(tilted).sqrt();
            let away: Mask<S> = tilted.dot(ray).simd_gt(splat(simd, 0.0));
            let scale = away.select(splat(simd, -1.0), splat(simd, 1.0)) / length;
            normal = tilted.scale(scale).or(on_surface, normal);
        }
        let cubic: Mask<S> = n.simd_ge(splat(simd, coefficient_count(3) as f32));
        let degree = if D == 3 { cubic.select(splat(simd, 5.0), splat(simd, 4.0)) } else { splat(simd, 4.0) };
        status = on_surface.select(degree, status);
    }
    let on_line = plane.degenerate;
    let point = p.or(on_line, p.add_scaled(moved, plane.normal));
    let nan = Vec3::splat(simd, f32::NAN);
    let few: Mask<S> = n.simd_lt(splat(simd, 3.0));
    let hole: Mask<S> = n.simd_lt(splat(simd, 1.0));
    Projected {
        point: nan.or(few, point),
        normal: nan.or(few | on_line, normal),
        status: hole.select(splat(simd, 0.0), few.select(splat(simd, 1.0), on_line.select(splat(simd, 2.0), status))),
    }
}
