//! Computes the point on the surface, its normal and its status (docs/method.md, section 7).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::plane::{Points, Surface};
use super::polynomial::Polynomial;
use super::vector::{Mask, Vec3, splat};
use crate::constants::{GRAZING_COSINE, MAX_ALONG, coefficient_count};

pub(super) struct Projected<S: Simd> {
    pub(super) point: Vec3<S>,
    /// The surface's normal, or the plane's if normals are not needed.
    pub(super) normal: Vec3<S>,
    /// Code of the [`crate::Status`], as a float.
    pub(super) status: S::f32s,
    /// Ratio of the depth at which the ray meets the surface to the measured depth, if needed; NaN for a hole.
    pub(super) depth_scale: S::f32s,
}

/// Settings for moving points onto the surface.
#[derive(Clone, Copy)]
pub(super) struct Projection {
    /// True if points move along their rays rather than along the plane's normals.
    pub(super) on_ray: bool,
    /// True if normals are needed, by the caller or a later stage.
    pub(super) needs_normal: bool,
    /// True if the depth of the ray's intersection with the surface is needed.
    pub(super) needs_depth: bool,
    /// True if points with too few neighbours are kept unchanged.
    pub(super) keeps_isolated: bool,
    /// Minimum number of neighbours of a smoothed point.
    pub(super) least_neighbours: f32,
}

/// Moves points onto the polynomial, or onto the plane if D = 1, the polynomial is farther away than the radius, or
/// the neighbours are too few for it.
#[inline(always)]
pub(super) fn project<S: Simd, const D: usize>(
    simd: S,
    points: Points<S>,
    surface: &Surface<S>,
    polynomial: Option<&Polynomial<S>>,
    projection: Projection,
) -> Projected<S> {
    let Points { p, ray, radius, valid } = points;
    let Surface { plane, n, .. } = surface;
    let n = *n;
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let mut moved = plane.height;
    let mut normal = plane.normal;
    let mut status = splat(simd, 3.0);
    if let Some(&Polynomial { height, slopes: [slope_a, slope_b], a_axis, b_axis }) = polynomial {
        let surface = plane.height + height;
        // A NaN is not within the radius.
        let within: Mask<S> = (surface * surface).simd_le(radius * radius);
        let on_surface = within & n.simd_ge(splat(simd, coefficient_count(2) as f32));
        moved = on_surface.select(surface, moved);
        if projection.needs_normal {
            let tilted = plane.normal.add_scaled(-slope_a, a_axis).add_scaled(-slope_b, b_axis);
            let length = tilted.dot(tilted).sqrt();
            let away: Mask<S> = tilted.dot(ray).simd_gt(zero);
            let scale = away.select(-one, one) / length;
            normal = tilted.scale(scale).or(on_surface, normal);
        }
        let cubic: Mask<S> = n.simd_ge(splat(simd, coefficient_count(3) as f32));
        let degree = if D == 3 { cubic.select(splat(simd, 5.0), splat(simd, 4.0)) } else { splat(simd, 4.0) };
        status = on_surface.select(degree, status);
    }
    let on_line = plane.degenerate;
    let mut along = zero;
    if projection.on_ray || projection.needs_depth {
        along = on_line.select(zero, along_ray(simd, moved * plane.normal.dot(normal), normal, ray, radius));
    }
    let on_surface = if projection.on_ray { p.add_scaled(along, ray) } else { p.add_scaled(moved, plane.normal) };
    let point = p.or(on_line, on_surface);
    let nan = Vec3::splat(simd, f32::NAN);
    let few: Mask<S> = n.simd_lt(splat(simd, projection.least_neighbours));
    let (alone, few_status) = if projection.keeps_isolated { (p, splat(simd, 6.0)) } else { (nan, one) };
    Projected {
        point: alone.or(few, point),
        normal: nan.or(few | on_line, normal),
        status: valid.select(few.select(few_status, on_line.select(splat(simd, 2.0), status)), zero),
        depth_scale: few.select(splat(simd, f32::NAN), along + one),
    }
}

/// Returns the distance along the ray, in ray lengths, from its end to the tangent plane, which is `height` from the
/// ray's end along `normal`. With c the cosine of the angle of incidence, 1/c is replaced by c/max(c², 0.2²).
#[inline(always)]
pub(super) fn along_ray<S: Simd>(simd: S, height: S::f32s, normal: Vec3<S>, ray: Vec3<S>, radius: S::f32s) -> S::f32s {
    // A lower bound, since a point at the sensor has no ray.
    let least = splat(simd, f32::MIN_POSITIVE);
    let square = ray.dot(ray).max(least);
    let across = ray.dot(normal);
    let divisor = (across * across).max(square * splat(simd, GRAZING_COSINE * GRAZING_COSINE)).max(least);
    let along = height * across / divisor;
    let limit = (radius / square.sqrt()).min(splat(simd, MAX_ALONG));
    // False for NaN, which occurs if a point's squares overflow f32; the limit is then 0.
    let within: Mask<S> = along.abs().simd_le(limit);
    within.select(along, limit.copysign(along))
}
