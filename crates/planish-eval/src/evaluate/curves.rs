//! The scores of a method on curved surfaces of known radius.

use serde::Serialize;

use super::evaluation::{Sum, facet, mean_deg, quantile};
use super::flat_pixels;
use super::geometry::angle_deg;
use crate::simulate::{Curve, Truth};
use planish_core::Xyz;

/// Minimum distance of a scored pixel from a depth step or another object, in pixels. The thinnest cylinder is hardly
/// wider.
const MARGIN_PX: usize = 2;
/// Minimum cosine of the angle of incidence of a scored pixel. At steeper angles, the sensor itself loses and shifts
/// points.
const MIN_COSINE: f64 = 0.5;
/// Minimum number of scored pixels for a surface to be reported; with fewer, the scores are unreliable.
const MIN_PIXELS: usize = 200;

/// Scores on a curved surface of known radius at one range.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct CurveReport {
    /// `cylinder`, `sphere`, `torus`, `saddle`, or, for comparison, the flat `board`.
    pub name: &'static str,
    /// Smallest radius of curvature in metres; infinite (null in JSON) for the board.
    pub radius_m: f64,
    /// Distance of the surface's centre from the camera along z, in metres.
    pub range_m: f64,
    /// Number of pixels with a point.
    pub pixels: usize,
    /// Root of the mean squared distance to the true surface along its normal, in millimetres.
    pub rmse_mm: f64,
    /// Mean signed distance to the true surface, positive towards the camera, in millimetres.
    pub bias_mm: f64,
    /// Mean angle between a point's normal and the true normal, in degrees.
    pub normal_mean_deg: f64,
    /// Mean angle between the facets of adjacent pixels and the true surface, in degrees.
    pub facet_mean_deg: f64,
    /// 95th percentile of the angle between the facets and the true surface, in degrees.
    pub facet_95_deg: f64,
}

/// The errors on one curved surface.
#[derive(Debug, Clone)]
struct Errors {
    curve: Curve,
    range_m: f64,
    off_m: Sum,
    normals_deg: Vec<f32>,
    facets_deg: Vec<f32>,
}

/// The errors on all curved surfaces, accumulated over cases.
#[derive(Debug, Clone, Default)]
pub(super) struct Curves(Vec<Errors>);

impl Curves {
    /// Adds a result for a scene whose objects are at `range_m`.
    pub(super) fn add(&mut self, truth: &Truth, (curves, range_m): (&[Curve], f64), points: &Xyz, normals: &Xyz) {
        let on_one_surface = flat_pixels(truth, MARGIN_PX);
        for &curve in curves {
            let known = self.0.iter().position(|other| (other.curve, other.range_m) == (curve, range_m));
            let at = known.unwrap_or(self.0.len());
            if known.is_none() {
                let (off_m, normals_deg, facets_deg) = Default::default();
                self.0.push(Errors { curve, range_m, off_m, normals_deg, facets_deg });
            }
            let usable: Vec<bool> = (0..on_one_surface.len())
                .map(|i| {
                    on_one_surface[i]
                        && truth.objects[i] == curve.object
                        && truth.incidence_cosine(i) >= MIN_COSINE
                        && points.is_finite(i)
                })
                .collect();
            let errors = &mut self.0[at];
            for i in (0..usable.len()).filter(|&i| usable[i]) {
                let n = truth.normals.vector(i);
                errors.off_m.add((points.vector(i) - truth.points.vector(i)).dot(n));
                if normals.is_finite(i) {
                    errors.normals_deg.push(angle_deg(n, normals.vector(i)) as f32);
                }
                let facet = facet(points, &usable, i, truth.camera.width);
                errors.facets_deg.extend(facet.map(|facet| angle_deg(n, facet) as f32));
            }
        }
    }

    pub(super) fn report(&self) -> Vec<CurveReport> {
        let report = |errors: &Errors| CurveReport {
            name: errors.curve.name,
            radius_m: errors.curve.radius_m,
            range_m: errors.range_m,
            pixels: errors.off_m.count,
            rmse_mm: 1e3 * errors.off_m.rms(),
            bias_mm: 1e3 * errors.off_m.mean(),
            normal_mean_deg: mean_deg(&errors.normals_deg),
            facet_mean_deg: mean_deg(&errors.facets_deg),
            facet_95_deg: quantile(&errors.facets_deg, 0.95),
        };
        self.0.iter().filter(|errors| errors.off_m.count >= MIN_PIXELS).map(report).collect()
    }
}
