//! Distances, angles and planes.

use glam::{DMat3, DVec3};

use crate::simulate::{DepthNoise, NO_OBJECT, Truth};
use planish_core::{DepthFrame, SensorModel};

/// Radius of the search for the true surface around a pixel, in pixels.
const NEAREST_PX: usize = 4;
/// Distance from the nearest surface, in metres, above which a point floats, if it also exceeds [`FLYING_DEVIATIONS`].
const FLYING_M: f64 = 0.01;
/// Distance from the nearest surface, in standard deviations of the sensor's noise, above which a point floats, if it
/// also exceeds [`FLYING_M`]. It is three depth steps of a Kinect v1.
const FLYING_DEVIATIONS: f64 = 4.6;

pub(super) fn angle_deg(a: DVec3, b: DVec3) -> f64 {
    a.dot(b).clamp(-1.0, 1.0).acos().to_degrees()
}

/// Returns the depth step of a Kinect v1 at depth `z`; both are in metres.
pub(super) fn step_m(z: f64) -> f64 {
    SensorModel::KINECT_V1.step_m(z)
}

/// Returns true if point `p`, seen at pixel i, is not on any surface.
pub(super) fn floats(truth: &Truth, noise: &DepthNoise, i: usize, p: DVec3) -> bool {
    // The search for the surface is slow, and most points are close to the truth.
    let limit_m = FLYING_M.max(FLYING_DEVIATIONS * noise.deviation_m(p.z));
    let is_close = (p - truth.points.vector(i)).length() <= limit_m;
    !is_close && distance_to_surface(truth, i, p) > limit_m
}

/// Returns the point that the camera measured at pixel i.
pub(super) fn measured_point(frame: &DepthFrame, i: usize, raw: u16) -> DVec3 {
    let camera = &frame.camera;
    let (u, v, z) = ((i % camera.width) as f64, (i / camera.width) as f64, f64::from(camera.depth_m(raw)));
    DVec3::new((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z)
}

/// Returns the distance in metres of a point from the true surface around pixel i. Each pixel's surface is taken as a
/// disc in its tangent plane, with a radius of one pixel.
pub(super) fn distance_to_surface(truth: &Truth, i: usize, p: DVec3) -> f64 {
    let (width, height) = (truth.camera.width, truth.camera.height);
    let (u, v) = (i % width, i / width);
    let mut nearest = f64::INFINITY;
    for v in v.saturating_sub(NEAREST_PX)..(v + NEAREST_PX + 1).min(height) {
        for j in (u.saturating_sub(NEAREST_PX)..(u + NEAREST_PX + 1).min(width)).map(|u| v * width + u) {
            if truth.objects[j] == NO_OBJECT {
                continue;
            }
            let (off, n) = (p - truth.points.vector(j), truth.normals.vector(j));
            let (along, pitch_m) = (off.dot(n), f64::from(truth.points.z()[j]) / truth.camera.fx);
            let beside = ((off.length_squared() - along * along).max(0.0).sqrt() - pitch_m).max(0.0);
            nearest = nearest.min(along * along + beside * beside);
        }
    }
    nearest.sqrt()
}

/// Fits a plane to points. Returns its normal (towards the camera), the centroid of the points, and their RMS distance
/// from the plane; `None` for fewer than 12 points.
pub(super) fn plane(points: Vec<DVec3>) -> Option<(DVec3, DVec3, f64)> {
    if points.len() < 12 {
        return None;
    }
    let centre = points.iter().sum::<DVec3>() / points.len() as f64;
    let mut covariance = DMat3::ZERO;
    for d in points.iter().map(|&p| p - centre) {
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    covariance *= 1.0 / points.len() as f64;
    let ([smallest, ..], [normal, ..]) = planish_core::internal::symmetric_eigen(covariance);
    let normal = if normal.dot(centre) > 0.0 { -normal } else { normal };
    Some((normal, centre, smallest.max(0.0).sqrt()))
}
