//! The point on the surface and its normal (docs/method.md, section 7).

use glam::DVec3;

use super::plane::Plane;
use super::polynomial::Polynomial;
use crate::status::Status;

/// Displacement, normal and status of the point p. A point that would move further than the radius takes the plane's foot.
pub(super) fn project(
    p: DVec3,
    sensor: DVec3,
    plane: &Plane,
    polynomial: Option<&Polynomial>,
    radius_m: f64,
) -> (DVec3, DVec3, Status) {
    let on_plane = (plane.foot, plane.normal, Status::Plane);
    let Some(polynomial) = polynomial else { return on_plane };
    let moved = plane.foot + polynomial.height * plane.normal;
    let within = moved.length_squared() <= radius_m * radius_m;
    // A NaN is not within.
    if !within {
        return on_plane;
    }
    let normal = (plane.normal - polynomial.gradient).normalize();
    let towards_sensor = if normal.dot(p - sensor) > 0.0 { -normal } else { normal };
    (moved, towards_sensor, Status::of_degree(polynomial.degree))
}

/// Below this cosine of the angle of incidence the point's own depth is more accurate than the tangent plane.
const GRAZING_COSINE: f64 = 0.2;

/// The depth where the ray (x, y, 1) of a pixel meets the tangent plane of its smoothed point.
pub(super) fn depth_along_ray_m([ray_x, ray_y]: [f64; 2], point: DVec3, normal: DVec3) -> f64 {
    let ray = DVec3::new(ray_x, ray_y, 1.0);
    let along = ray.dot(normal);
    // Also false for a NaN normal.
    if along.abs() > GRAZING_COSINE * ray.length() { point.dot(normal) / along } else { point.z }
}
