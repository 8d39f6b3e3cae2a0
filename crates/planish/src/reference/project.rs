//! The point on the surface and its normal (docs/method.md, section 7).

use glam::DVec3;

use super::plane::Plane;
use super::polynomial::Polynomial;
use crate::smoothed::Status;

/// Position, normal and status of the point p. A point that would move further than the radius takes the plane's foot.
pub(super) fn project(
    p: DVec3,
    sensor: DVec3,
    plane: &Plane,
    polynomial: Option<&Polynomial>,
    radius_m: f64,
) -> (DVec3, DVec3, Status) {
    let on_plane = (p + plane.foot, plane.normal, Status::Plane);
    let Some(polynomial) = polynomial else { return on_plane };
    let moved = plane.foot + polynomial.height * plane.normal;
    let within = moved.length_squared() <= radius_m * radius_m;
    // A NaN is not within.
    if !within {
        return on_plane;
    }
    let normal = (plane.normal - polynomial.gradient).normalize();
    let towards_sensor = if normal.dot(p - sensor) > 0.0 { -normal } else { normal };
    (p + moved, towards_sensor, Status::of_degree(polynomial.degree))
}
