//! The scores of a method on the suite.

use glam::DVec3;
use serde::Serialize;

use super::curves::{CurveReport, Curves};
use super::geometry::{angle_deg, distance_to_surface, floats, measured_point, plane, step_m};
use super::suite::{Case, Gauges};
use super::{edge_band, flat_pixels};
use crate::simulate::{DepthNoise, Gauge, Truth};
use planish_core::Xyz;

/// Distance from the nearest discontinuity above which a pixel counts as flat, in pixels.
pub(super) const FLAT_MARGIN_PX: usize = 6;
/// Maximum distance in pixels between a step and a pixel of its edge band.
pub(super) const EDGE_MARGIN_PX: usize = 3;
/// Maximum distance from a crease at which its faces are measured, in pixels.
const CREASE_PX: usize = 6;
/// Number of image rows per piece of a crease. Planes are fitted to each piece separately.
const CREASE_ROWS: usize = 24;

/// Angular error above which a facet counts as a speck, in degrees.
pub(super) const SPECK_DEG: f32 = 30.0;

/// The ranges of z in which flat surfaces are scored, in metres.
const RANGES_M: [(f64, f64); 3] = [(0.5, 1.5), (1.5, 2.5), (2.5, 4.2)];
/// The ranges of the angle of incidence in which flat surfaces are scored, in degrees.
const ANGLES_DEG: [(f64, f64); 3] = [(0.0, 30.0), (30.0, 60.0), (60.0, 75.0)];

/// Scores on flat surfaces within one range of z.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct RangeReport {
    /// Lower limit of z in metres.
    pub near_m: f64,
    /// Upper limit of z in metres.
    pub far_m: f64,
    /// Number of pixels with a point.
    pub pixels: usize,
    /// Root of the mean squared distance to the true surface along its normal, in millimetres.
    pub rmse_mm: f64,
    /// Mean signed distance to the true surface, positive towards the camera, in millimetres.
    pub bias_mm: f64,
    /// Bias in depth steps of a Kinect v1.
    pub bias_steps: f64,
    /// Mean angle between a point's normal and the true normal, in degrees.
    pub normal_mean_deg: f64,
    /// Median angle between a point's normal and the true normal, in degrees.
    pub normal_median_deg: f64,
    /// Share of normals less than 10° from the true normal.
    pub normal_under_10_deg: f64,
    /// Mean angle between the facets spanned by adjacent pixels and the true surface, in degrees. This error is visible
    /// in meshes and shaded renderings.
    pub facet_mean_deg: f64,
    /// 95th percentile of the angle between the facets and the true surface, in degrees.
    pub facet_95_deg: f64,
}

/// Scores on flat surfaces within one range of the angle of incidence, between normal and ray.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct AngleReport {
    /// Lower limit of the angle in degrees.
    pub from_deg: f64,
    /// Upper limit of the angle in degrees.
    pub to_deg: f64,
    /// Number of pixels with a point.
    pub pixels: usize,
    /// Root of the mean squared distance to the true surface along its normal, in depth steps of a Kinect v1 at that
    /// range.
    pub rmse_steps: f64,
    /// Mean angle between a point's normal and the true normal, in degrees.
    pub normal_mean_deg: f64,
    /// Mean angle between the facets of adjacent pixels and the true surface, in degrees.
    pub facet_mean_deg: f64,
}

/// The scores of a method on the suite. Scores that could not be measured are NaN (null in JSON).
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Report {
    /// Scores on flat surfaces, by range of z.
    pub ranges: Vec<RangeReport>,
    /// Scores on flat surfaces, by range of the angle of incidence.
    pub angles: Vec<AngleReport>,
    /// Share of specks: facets of flat surfaces from 0.5 to 2.5 m that are more than 30° off.
    pub speck_share: f64,
    /// Median over flat pixels of the second difference of z along a row, divided by z², in 1e-3/m. High values
    /// indicate lattice or gravel artefacts.
    pub lattice: f64,
    /// Root mean square error on flat surfaces per 0.2 m bin of z: the centre of the bin in metres, and the error in
    /// millimetres. Bins with fewer than 1000 pixels are omitted.
    pub over_z: Vec<(f64, f64)>,
    /// Mean distance to the nearest true surface within 3 pixels of a step, in millimetres.
    pub edge_mean_mm: f64,
    /// Share of the points within 3 pixels of a step that float between two surfaces: more than 1 cm and 4.6 standard
    /// deviations (three depth steps of a Kinect v1) from either.
    pub flying_share: f64,
    /// Mean error of the measured angle of a 90° edge at 1 m, in degrees. The angle is measured between planes fitted
    /// to the points up to 6 pixels from the edge.
    pub crease_deg: f64,
    /// Mean error of the normals up to 6 pixels from the 90° edge, in degrees.
    pub crease_normal_deg: f64,
    /// Relative radius error of spheres: the mean distance of their points from the centre, divided by the radius,
    /// minus 1.
    pub sphere_radius_bias: f64,
    /// Relative radius error of cylinders: the mean distance of their points from the axis, divided by the radius,
    /// minus 1.
    pub cylinder_radius_bias: f64,
    /// Scores on curved surfaces, by shape, radius and range.
    pub curves: Vec<CurveReport>,
    /// Share of the measured pixels that have no point.
    pub lost_share: f64,
    /// Share of the measured pixels on a surface (not floating) that have no point.
    pub lost_true_share: f64,
    /// Recall of floating-pixel removal: the share of measured pixels floating between two surfaces that have no
    /// point.
    pub floating_removed: f64,
    /// Precision of floating-pixel removal: the share of lost pixels that were floating.
    pub removed_floating: f64,
    /// Number of pixels that have a point although nothing was measured there.
    pub invented: usize,
}

/// Width of the bins of [`Report::over_z`] in metres.
const BIN_M: f64 = 0.2;
/// Number of bins of [`Report::over_z`].
const BINS: usize = 22;

/// Running sums for a mean and a root mean square.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sum {
    pub(super) count: usize,
    sum: f64,
    squares: f64,
}

impl Sum {
    pub(super) fn add(&mut self, value: f64) {
        self.count += 1;
        self.sum += value;
        self.squares += value * value;
    }

    pub(super) fn mean(&self) -> f64 {
        self.sum / self.count as f64
    }

    pub(super) fn rms(&self) -> f64 {
        (self.squares / self.count as f64).sqrt()
    }
}

/// The errors of the flat pixels in one range of z or of the angle of incidence.
#[derive(Debug, Clone, Default)]
struct Flat {
    off_m: Sum,
    off_steps: Sum,
    normals_deg: Vec<f32>,
    facets_deg: Vec<f32>,
}

impl Flat {
    fn add(&mut self, error: &PixelError) {
        self.off_m.add(error.off_m);
        self.off_steps.add(error.off_m / error.step_m);
        self.normals_deg.extend(error.normal_deg.map(|deg| deg as f32));
        self.facets_deg.extend(error.facet_deg.map(|deg| deg as f32));
    }

    fn normals_under(&self, limit_deg: f32) -> f64 {
        let under = self.normals_deg.iter().filter(|&&deg| deg < limit_deg).count();
        under as f64 / self.normals_deg.len() as f64
    }
}

pub(super) fn mean_deg(angles: &[f32]) -> f64 {
    angles.iter().map(|&deg| f64::from(deg)).sum::<f64>() / angles.len() as f64
}

/// Returns the quantile of `values` at `share` (0 to 1); NaN if `values` is empty.
pub(super) fn quantile(values: &[f32], share: f64) -> f64 {
    let mut values = values.to_vec();
    let at = (values.len() as f64 * share) as usize;
    match values.get(at) {
        None => f64::NAN,
        Some(_) => f64::from(*values.select_nth_unstable_by(at, f32::total_cmp).1),
    }
}

/// The errors of a pixel's point and normal.
struct PixelError {
    /// Distance to the true tangent plane in metres, positive towards the camera.
    off_m: f64,
    step_m: f64,
    normal_deg: Option<f64>,
    facet_deg: Option<f64>,
}

/// Accumulates the scores of a method over cases.
#[derive(Debug, Clone, Default)]
pub struct Evaluation {
    ranges: [Flat; 3],
    angles: [Flat; 3],
    /// Second differences of z along rows, divided by z², in 1/m.
    second_differences: Vec<f32>,
    over_z: [Sum; BINS],
    edge_m: Sum,
    flying: usize,
    crease_deg: Sum,
    crease_normal_deg: Sum,
    sphere: Sum,
    cylinder: Sum,
    curves: Curves,
    measured: usize,
    lost: usize,
    lost_true: usize,
    floating: usize,
    invented: usize,
}

impl Evaluation {
    /// Adds a result: points in camera coordinates, one per pixel of the case's frame, and their normals.
    pub fn add(&mut self, case: &Case, points: &Xyz, normals: &Xyz) {
        let truth = &case.truth;
        if let Gauges::Curves(curves, range_m) = &case.gauges {
            self.curves.add(truth, (curves, *range_m), points, normals);
            return;
        }
        for (i, &raw) in case.frame.raw.iter().enumerate() {
            let (measured, there) = (case.frame.camera.depth_m(raw).is_finite(), points.is_finite(i));
            self.measured += usize::from(measured);
            let point = measured_point(&case.frame, i, raw);
            let is_floating = measured && floats(truth, &case.noise, i, point);
            self.floating += usize::from(is_floating);
            if measured && !there {
                self.lost += 1;
                self.lost_true += usize::from(!is_floating);
            }
            self.invented += usize::from(there && !measured);
        }
        match &case.gauges {
            Gauges::Surfaces => {
                self.add_flat(truth, points, normals);
                self.add_edges(truth, &case.noise, points);
            }
            Gauges::Shapes(gauge) => self.add_shapes(truth, gauge, points, normals),
            Gauges::Curves(..) => {}
        }
    }

    fn add_flat(&mut self, truth: &Truth, points: &Xyz, normals: &Xyz) {
        let flat = flat_pixels(truth, FLAT_MARGIN_PX);
        for i in (0..flat.len()).filter(|&i| flat[i] && points.is_finite(i)) {
            let n = truth.normals.vector(i);
            let normal_deg = normals.is_finite(i).then(|| angle_deg(n, normals.vector(i)));
            let z = f64::from(truth.points.z()[i]);
            let off_m = (points.vector(i) - truth.points.vector(i)).dot(n);
            let facet_deg = facet(points, &flat, i, truth.camera.width).map(|facet| angle_deg(n, facet));
            let error = PixelError { off_m, step_m: step_m(z), normal_deg, facet_deg };
            self.second_differences.extend(second_difference(points, &flat, i, truth.camera.width));
            if let Some(bin) = self.over_z.get_mut((z / BIN_M) as usize) {
                bin.add(off_m);
            }
            let incidence_deg = truth.incidence_cosine(i).clamp(-1.0, 1.0).acos().to_degrees();
            for (flat, (from, to)) in self.ranges.iter_mut().zip(RANGES_M) {
                if (from..to).contains(&z) {
                    flat.add(&error);
                }
            }
            for (flat, (from, to)) in self.angles.iter_mut().zip(ANGLES_DEG) {
                if (from..to).contains(&incidence_deg) {
                    flat.add(&error);
                }
            }
        }
    }

    fn add_edges(&mut self, truth: &Truth, noise: &DepthNoise, points: &Xyz) {
        let band = edge_band(truth, EDGE_MARGIN_PX);
        for i in (0..band.len()).filter(|&i| band[i] && points.is_finite(i)) {
            let p = points.vector(i);
            self.edge_m.add(distance_to_surface(truth, i, p));
            self.flying += usize::from(floats(truth, noise, i, p));
        }
    }

    fn add_shapes(&mut self, truth: &Truth, gauge: &Gauge, points: &Xyz, normals: &Xyz) {
        let flat = flat_pixels(truth, FLAT_MARGIN_PX);
        for i in (0..flat.len()).filter(|&i| flat[i] && points.is_finite(i)) {
            // Skip steeper surfaces, on which the sensor itself loses and shifts points.
            if truth.incidence_cosine(i) < 0.5 {
                continue;
            }
            let p = points.vector(i);
            if truth.objects[i] == gauge.sphere {
                self.sphere.add((p - gauge.sphere_centre).length() / gauge.sphere_radius_m - 1.0);
            } else if truth.objects[i] == gauge.cylinder {
                let off = p - gauge.cylinder_centre;
                let from_axis = (off - off.dot(gauge.cylinder_axis) * gauge.cylinder_axis).length();
                self.cylinder.add(from_axis / gauge.cylinder_radius_m - 1.0);
            }
        }
        self.add_crease(truth, gauge, points, normals);
    }

    /// Adds, for each piece of the edge, the error of the angle between planes fitted to the points on either side,
    /// and the errors of the normals near the edge.
    fn add_crease(&mut self, truth: &Truth, gauge: &Gauge, points: &Xyz, normals: &Xyz) {
        let (width, height) = (truth.camera.width, truth.camera.height);
        // The column at which a row passes from the left face to the right face.
        let edge = |v: usize| -> Option<usize> {
            let row = v * width;
            (CREASE_PX..width.saturating_sub(CREASE_PX)).find(|&u| {
                let (left, right) = (row + u - 1, row + u);
                (u - CREASE_PX..u + CREASE_PX).all(|u| truth.objects[row + u] == gauge.wedge)
                    && angle_deg(truth.normals.vector(left), truth.normals.vector(right)) > 80.0
            })
        };
        for first in (0..(height + 1).saturating_sub(CREASE_ROWS)).step_by(CREASE_ROWS) {
            let rows: Option<Vec<(usize, usize)>> =
                (first..first + CREASE_ROWS).map(|v| edge(v).map(|u| (u, v))).collect();
            let Some(rows) = rows else { continue };
            let face = |columns: fn(usize) -> std::ops::Range<usize>| {
                let pixels = rows.iter().flat_map(|&(u, v)| columns(u).map(move |u| v * width + u));
                plane(pixels.filter(|&i| points.is_finite(i)).map(|i| points.vector(i)).collect())
            };
            let (left, right) = (face(|u| u - CREASE_PX..u), face(|u| u..u + CREASE_PX));
            if let (Some(left), Some(right)) = (left, right) {
                self.crease_deg.add((angle_deg(left.0, right.0) - 90.0).abs());
            }
            for (u, v) in rows {
                let beside = (u - CREASE_PX..u + CREASE_PX).map(|u| v * width + u);
                for i in beside.filter(|&i| normals.is_finite(i)) {
                    self.crease_normal_deg.add(angle_deg(normals.vector(i), truth.normals.vector(i)));
                }
            }
        }
    }

    /// Returns the scores so far.
    pub fn report(&self) -> Report {
        let range = |(flat, (near_m, far_m)): (&Flat, (f64, f64))| RangeReport {
            near_m,
            far_m,
            pixels: flat.off_m.count,
            rmse_mm: 1e3 * flat.off_m.rms(),
            bias_mm: 1e3 * flat.off_m.mean(),
            bias_steps: flat.off_steps.mean(),
            normal_mean_deg: mean_deg(&flat.normals_deg),
            normal_median_deg: quantile(&flat.normals_deg, 0.5),
            normal_under_10_deg: flat.normals_under(10.0),
            facet_mean_deg: mean_deg(&flat.facets_deg),
            facet_95_deg: quantile(&flat.facets_deg, 0.95),
        };
        let angle = |(flat, (from_deg, to_deg)): (&Flat, (f64, f64))| AngleReport {
            from_deg,
            to_deg,
            pixels: flat.off_steps.count,
            rmse_steps: flat.off_steps.rms(),
            normal_mean_deg: mean_deg(&flat.normals_deg),
            facet_mean_deg: mean_deg(&flat.facets_deg),
        };
        let near = || self.ranges[..2].iter().flat_map(|flat| &flat.facets_deg);
        Report {
            ranges: self.ranges.iter().zip(RANGES_M).map(range).collect(),
            angles: self.angles.iter().zip(ANGLES_DEG).map(angle).collect(),
            speck_share: near().filter(|&&deg| deg > SPECK_DEG).count() as f64 / near().count() as f64,
            lattice: 1e3 * quantile(&self.second_differences, 0.5),
            over_z: (0..BINS)
                .filter(|&bin| self.over_z[bin].count >= 1000)
                .map(|bin| ((bin as f64 + 0.5) * BIN_M, 1e3 * self.over_z[bin].rms()))
                .collect(),
            edge_mean_mm: 1e3 * self.edge_m.mean(),
            flying_share: self.flying as f64 / self.edge_m.count as f64,
            crease_deg: self.crease_deg.mean(),
            crease_normal_deg: self.crease_normal_deg.mean(),
            sphere_radius_bias: self.sphere.mean(),
            cylinder_radius_bias: self.cylinder.mean(),
            curves: self.curves.report(),
            lost_share: self.lost as f64 / self.measured as f64,
            lost_true_share: self.lost_true as f64 / self.measured as f64,
            floating_removed: (self.lost - self.lost_true) as f64 / self.floating as f64,
            removed_floating: (self.lost - self.lost_true) as f64 / self.lost as f64,
            invented: self.invented,
        }
    }
}

/// Returns the temporal noise for a static camera and a static scene, in millimetres: the root mean square, over flat
/// pixels and `results`, of a point's deviation along the true normal from its mean over `results`. Pixels that have
/// no point in one of the results are skipped.
pub fn jitter_mm(truth: &Truth, results: &[Xyz]) -> f64 {
    let flat = flat_pixels(truth, FLAT_MARGIN_PX);
    let mut stir = Sum::default();
    for i in (0..flat.len()).filter(|&i| flat[i] && results.iter().all(|points| points.is_finite(i))) {
        let n = truth.normals.vector(i);
        let mut off = Sum::default();
        for points in results {
            off.add((points.vector(i) - truth.points.vector(i)).dot(n));
        }
        stir.add((off.squares / off.count as f64 - off.mean() * off.mean()).max(0.0).sqrt());
    }
    if results.is_empty() { f64::NAN } else { 1e3 * stir.rms() }
}

/// Returns the unit normal of the triangle between pixel i and its right and lower neighbours; `None` unless all three
/// are `usable` and have points. The normal of a degenerate triangle is zero, which counts as edge-on.
pub(super) fn facet(points: &Xyz, usable: &[bool], i: usize, width: usize) -> Option<DVec3> {
    let [right, below] = [i + 1, i + width];
    if right % width == 0
        || below >= usable.len()
        || ![i, right, below].iter().all(|&j| usable[j] && points.is_finite(j))
    {
        return None;
    }
    let p = points.vector(i);
    // A flipped facet keeps its normal, which faces away from the camera.
    Some((points.vector(below) - p).cross(points.vector(right) - p).normalize_or_zero())
}

/// Returns |z(u-1) - 2 z(u) + z(u+1)|/z² along a row; `None` unless all three pixels are flat and have points.
fn second_difference(points: &Xyz, flat: &[bool], i: usize, width: usize) -> Option<f32> {
    let at_border = i.is_multiple_of(width) || (i + 1).is_multiple_of(width);
    if at_border || ![i - 1, i, i + 1].iter().all(|&j| flat[j] && points.is_finite(j)) {
        return None;
    }
    let z = |j: usize| points.z()[j];
    Some((z(i - 1) - 2.0 * z(i) + z(i + 1)).abs() / (z(i) * z(i)))
}
