//! Computes the point on the surface and its normal (docs/method.md, section 7).

use glam::DVec3;

use super::plane::Plane;
use super::polynomial::Polynomial;
use crate::status::Status;

/// Cosine of the angle of incidence below which a point moves less and less along its ray.
const GRAZING_COSINE: f64 = 0.2;

/// Maximum motion of a point along its ray, as a share of its distance.
pub(super) const MAX_ALONG: f64 = 0.5;

pub(super) struct Projected {
    /// Displacement from the measured point to its position on the surface.
    pub displacement: DVec3,
    pub normal: DVec3,
    pub status: Status,
    /// Depth of the intersection of ray and surface, divided by the depth of the measured point.
    pub depth_scale: f64,
}

/// Moves the point p onto the plane or the polynomial over it, along its ray or along the plane's normal. If the
/// polynomial is farther away than the radius, the plane is used. No point moves by more than the radius.
pub(super) fn project(
    p: DVec3,
    sensor: DVec3,
    plane: &Plane,
    polynomial: Option<&Polynomial>,
    radius_m: f64,
    on_ray: bool,
) -> Projected {
    let mut surface = plane.foot;
    let (mut normal, mut status) = (plane.normal, Status::Plane);
    if let Some(polynomial) = polynomial {
        let on_polynomial = plane.foot + polynomial.height * plane.normal;
        // False for a NaN.
        if on_polynomial.length_squared() <= radius_m * radius_m {
            surface = on_polynomial;
            status = Status::of_degree(polynomial.degree);
            normal = (plane.normal - polynomial.gradient).normalize();
            if normal.dot(p - sensor) > 0.0 {
                normal = -normal;
            }
        }
    }
    let ray = p - sensor;
    let along = along_ray(surface, normal, ray, radius_m);
    let displacement = if on_ray { along * ray } else { surface };
    Projected { displacement, normal, status, depth_scale: 1.0 + along }
}

/// Returns the distance along the ray, in ray lengths, from its end (the origin here) to the tangent plane through
/// `surface`. With c the cosine of the angle of incidence, 1/c is replaced by c/max(c², 0.2²), since a grazing ray
/// determines the distance poorly.
pub(super) fn along_ray(surface: DVec3, normal: DVec3, ray: DVec3, radius_m: f64) -> f64 {
    let length = ray.length();
    let cosine = ray.dot(normal) / length;
    let along_m = surface.dot(normal) * cosine / (cosine * cosine).max(GRAZING_COSINE * GRAZING_COSINE);
    let limit = (radius_m / length).min(MAX_ALONG);
    // The ray of a point at the sensor is undefined.
    if length > 0.0 { (along_m / length).clamp(-limit, limit) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_meets_the_tangent_plane() {
        let ray = DVec3::new(0.3, -0.2, 1.5);
        for normal in [DVec3::new(0.1, 0.2, -1.0), DVec3::new(0.5, -0.5, -0.8)].map(DVec3::normalize) {
            let surface = 0.004 * normal;
            let along = along_ray(surface, normal, ray, 0.1);
            assert!(((along * ray - surface).dot(normal)).abs() < 1e-15, "{along}");
        }
        // At grazing incidence, the motion falls continuously to 0.
        let grazing = |cosine: f64| {
            let across = ray.cross(DVec3::X).normalize();
            let normal = cosine * ray.normalize() + (1.0 - cosine * cosine).sqrt() * across;
            along_ray(1e-3 * normal, normal, ray, 0.1) * ray.length()
        };
        assert!((grazing(0.2001) - grazing(0.1999)).abs() < 1e-5 && (grazing(0.2) - 5e-3).abs() < 1e-9);
        assert!((grazing(0.01) - 2.5e-4).abs() < 1e-9 && grazing(0.0) == 0.0);
        assert_eq!(along_ray(DVec3::X, DVec3::X, DVec3::ZERO, 0.1), 0.0);
    }
}
