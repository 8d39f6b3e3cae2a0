//! Tests whether stated standard errors are calibrated: the shares of points within one and two standard errors.

use planish_core::Xyz;
use serde::Serialize;

use super::edge_band;
use super::evaluation::EDGE_MARGIN_PX;
use crate::simulate::Truth;

/// The ranges of z in which points away from steps are counted, in metres.
const RANGES_M: [(f64, f64); 4] = [(0.4, 0.9), (0.9, 1.5), (1.5, 2.5), (2.5, 5.0)];

/// Numbers of points, by error relative to the stated standard error.
#[derive(Debug, Clone, Default)]
pub struct Calibration {
    ranges: [Counts; RANGES_M.len()],
    near_steps: Counts,
}

/// The shares of points whose error is within one and two standard errors. A normal distribution has 68.3 % and 95.4
/// %.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct CalibrationReport {
    /// Lower limit of z in metres; NaN (null in JSON) for the report on pixels within 3 pixels of a step, at any
    /// range.
    pub near_m: f64,
    /// Upper limit of z in metres; NaN (null in JSON) for the report on pixels within 3 pixels of a step.
    pub far_m: f64,
    /// Number of points.
    pub pixels: u64,
    /// Share of points within one standard error of the truth.
    pub within_one: f64,
    /// Share of points within two standard errors of the truth.
    pub within_two: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Counts {
    pixels: u64,
    within: [u64; 2],
}

impl Calibration {
    /// Adds the points of a frame, with their standard errors along the ray, in metres.
    pub fn add(&mut self, truth: &Truth, points: &Xyz, sigma_m: &[f32]) {
        let near = edge_band(truth, EDGE_MARGIN_PX);
        for i in 0..points.len() {
            let (z_m, true_m) = (f64::from(points.z()[i]), f64::from(truth.points.z()[i]));
            // False for a hole, whose z is NaN.
            if (z_m - true_m).abs() >= 0.0 && sigma_m[i] >= 0.0 {
                let range = RANGES_M.iter().position(|&(near_m, far_m)| (near_m..far_m).contains(&true_m));
                let counts = match (near[i], range) {
                    (true, _) => &mut self.near_steps,
                    (false, Some(range)) => &mut self.ranges[range],
                    (false, None) => continue,
                };
                let off = (z_m - true_m).abs() / f64::from(sigma_m[i]);
                counts.pixels += 1;
                counts.within[0] += u64::from(off <= 1.0);
                counts.within[1] += u64::from(off <= 2.0);
            }
        }
    }

    /// Returns one report per range of z, followed by one for points near steps.
    pub fn report(&self) -> Vec<CalibrationReport> {
        let ranges = RANGES_M.iter().copied().chain([(f64::NAN, f64::NAN)]);
        let counts = self.ranges.iter().chain([&self.near_steps]);
        let of = |((near_m, far_m), counts): ((f64, f64), &Counts)| {
            let [within_one, within_two] = counts.within.map(|within| within as f64 / counts.pixels as f64);
            CalibrationReport { near_m, far_m, pixels: counts.pixels, within_one, within_two }
        };
        ranges.zip(counts).map(of).collect()
    }
}
