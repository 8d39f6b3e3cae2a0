//! Edge preservation: the surface that a point lies on is found from the planes around it, and neighbours off that surface are
//! excluded (docs/method.md, section 10). Metres.

use glam::DVec3;

use super::plane::{self, Plane};
use crate::params::{SmoothParams, edge_shift_px};
use crate::sensor::SensorModel;

/// A plane through fewer points than this is not used.
const MIN_NEIGHBOURS: usize = 6;
/// The noise is at least this share of the radius.
const MIN_NOISE: f64 = 0.01;
/// How much a plane's distance from p weighs beside its own residual, both squared.
const DISTANCE_WEIGHT: f64 = 0.5;
/// Neighbours count up to this many standard deviations of the noise from the surface.
const WIDTH: f64 = 1.8;

/// A plane that its points hardly determine counts as noisier: by this share of the noise's variance for a disc.
const DOUBT_WEIGHT: f64 = 0.01;

/// No camera measures a surface steeper than this; what looks like one is a row of points far apart.
const MIN_INCIDENCE_COSINE: f64 = 0.05;

/// The plane of a pixel's own window.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstPlane {
    at: DVec3,
    plane: Plane,
    /// Variance of its points about it, plus its own uncertainty, in m².
    residual: f64,
}

/// `None` where the neighbours are too few, on a line, or on a plane seen edge-on.
pub(super) fn first_plane(p: DVec3, offsets: &[DVec3], noise_m: f64) -> Option<FirstPlane> {
    let plane = if offsets.len() < MIN_NEIGHBOURS { None } else { plane::fit(offsets, p) }?;
    if plane.normal.dot(p).abs() < MIN_INCIDENCE_COSINE * p.length() {
        return None;
    }
    let residual = plane.smallest_variance + DOUBT_WEIGHT * plane.doubt * noise_m * noise_m;
    Some(FirstPlane { at: p, plane, residual })
}

/// The standard deviation of depth at a range.
pub(super) fn noise_m(sensor: &SensorModel, range_m: f64, radius_m: f64) -> f64 {
    sensor.sigma_m(range_m).max(MIN_NOISE * radius_m)
}

/// The first planes of a frame.
pub(super) struct FirstPlanes {
    width: usize,
    planes: Vec<Option<FirstPlane>>,
    /// Distance in pixels to the eight planes considered.
    shift_px: isize,
}

impl FirstPlanes {
    pub(super) fn new(width: usize, planes: Vec<Option<FirstPlane>>, params: &SmoothParams) -> Self {
        Self { width, planes, shift_px: edge_shift_px(params.window * params.stride) as isize }
    }

    fn get(&self, u: Option<usize>, v: Option<usize>) -> Option<&FirstPlane> {
        let (u, v) = (u.filter(|&u| u < self.width)?, v?);
        self.planes.get(v * self.width + u)?.as_ref()
    }

    /// Returns the plane that p at a pixel lies on, from its own and the eight first planes around it, and how far from it a
    /// neighbour counts; `None` if the pixel has no first plane, or the plane is further away than the radius.
    pub(super) fn surface(
        &self,
        (u, v): (usize, usize),
        p: DVec3,
        radius_m: f64,
        noise_m: f64,
    ) -> Option<(Plane, f64)> {
        let own = self.get(Some(u), Some(v))?;
        let (mut normal, mut height_m, mut total) = (DVec3::ZERO, 0.0, 0.0);
        for dv in [-self.shift_px, 0, self.shift_px] {
            for du in [-self.shift_px, 0, self.shift_px] {
                let Some(first) = self.get(u.checked_add_signed(du), v.checked_add_signed(dv)) else { continue };
                let offset = first.at - p;
                if offset.length_squared() > radius_m * radius_m {
                    continue;
                }
                let plane = &first.plane;
                // From p to the plane along its normal.
                let to_plane_m = (offset + plane.foot).dot(plane.normal);
                let residual = first.residual + DISTANCE_WEIGHT * to_plane_m * to_plane_m;
                let weight = (1.0 + residual / (noise_m * noise_m)).powi(-4);
                normal += weight * plane.normal;
                height_m += weight * to_plane_m;
                total += weight;
            }
        }
        // Planes that disagree may lie further away than a point may move.
        if (height_m / total).abs() > radius_m {
            return None;
        }
        // The foot is the same whichever way the normal points.
        let foot = height_m / total * normal.normalize();
        let normal = if normal.dot(p) > 0.0 { -normal.normalize() } else { normal.normalize() };
        // The curvature, and the extent that is the unit of the fit, are those of its own window.
        Some((Plane { normal, foot, ..own.plane }, WIDTH * noise_m))
    }
}
