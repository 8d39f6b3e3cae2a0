//! Quality of filled holes: holes cut into frames, where the true depth is known, and the sensor's own holes.

use std::f64::consts::PI;

use serde::Serialize;

use super::edge_band;
use super::evaluation::{EDGE_MARGIN_PX, quantile};
use super::geometry::step_m;
use crate::simulate::{NO_OBJECT, Random, Truth};
use planish_core::DepthFrame;

/// Number of holes cut into a frame of [`PIXELS`] pixels; other frames get a proportional number.
const CUTS: usize = 250;
/// Number of pixels of the frame into which [`CUTS`] holes are cut.
const PIXELS: usize = 640 * 480;
/// Maximum ratio of length to width for a cut hole.
const LONGEST: f64 = 3.0;
const STREAM_CUTS: u64 = 7;
/// Depth error in metres above which a filled pixel is on a wrong surface, if the error also exceeds three depth steps
/// of a Kinect v1.
const WRONG_M: f64 = 0.02;

/// Cuts holes into a frame. Returns a mask of the measured pixels that were cut out.
pub fn cut_holes(frame: &mut DepthFrame, width_px: u32, seed: u64) -> Vec<bool> {
    let mut cut = hole_mask((frame.camera.width, frame.camera.height), width_px, seed);
    for (cut, raw) in cut.iter_mut().zip(&mut frame.raw) {
        *cut &= *raw != 0;
        *raw = if *cut { 0 } else { *raw };
    }
    cut
}

/// Returns a mask of randomly placed holes: ellipses up to `width_px` pixels wide.
pub fn hole_mask((width, height): (usize, usize), width_px: u32, seed: u64) -> Vec<bool> {
    let mut random = Random::new(seed, STREAM_CUTS);
    let mut cut = vec![false; width * height];
    for _ in 0..(CUTS * width * height).div_ceil(PIXELS) {
        let (u, v) = (random.between(0.0, width as f64), random.between(0.0, height as f64));
        let narrow = 0.5 * random.between(1.5, f64::from(width_px) + 0.5);
        let (long, (sin, cos)) = (narrow * random.between(1.0, LONGEST), (PI * random.uniform()).sin_cos());
        let first = |at: f64| (at - long).max(0.0) as usize;
        for y in first(v)..((v + long) as usize + 1).min(height) {
            for x in first(u)..((u + long) as usize + 1).min(width) {
                let (x_px, y_px) = (x as f64 - u, y as f64 - v);
                let (along, across) = ((x_px * cos + y_px * sin) / long, (y_px * cos - x_px * sin) / narrow);
                cut[y * width + x] |= along * along + across * across < 1.0;
            }
        }
    }
    cut
}

/// Results over a set of holes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct HoleReport {
    /// Number of pixels in the holes.
    pub pixels: usize,
    /// Share of the pixels that were filled.
    pub filled: f64,
    /// Root mean square depth error of filled pixels, in millimetres.
    pub rms_mm: f64,
    /// Median depth error of filled pixels, in millimetres.
    pub median_mm: f64,
    /// Share of the filled pixels on a wrong surface: their depth error exceeds 2 cm and three depth steps of a Kinect
    /// v1.
    pub wrong: f64,
    /// Share of the filled pixels whose error is at most one standard error; NaN without standard errors.
    pub within_one: f64,
    /// Share of the filled pixels whose error is at most two standard errors; NaN without standard errors.
    pub within_two: f64,
    /// Share of the filled pixels whose error exceeds three standard errors; NaN without standard errors.
    pub over_three: f64,
}

/// Results for cut holes and for the sensor's own holes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct FillReport {
    /// Results in cut holes, more than 3 pixels from any depth step.
    pub cut: HoleReport,
    /// Results in cut holes, within 3 pixels of a depth step.
    pub cut_near_steps: HoleReport,
    /// Results in the sensor's own holes.
    pub own: HoleReport,
}

#[derive(Debug, Clone, Default)]
struct Errors {
    pixels: usize,
    /// Number of filled pixels at which the truth has a surface.
    on_surfaces: usize,
    squares: f64,
    errors_mm: Vec<f32>,
    wrong: usize,
    stated: usize,
    within: [usize; 3],
}

impl Errors {
    fn add(&mut self, z_m: f32, true_m: f32, sigma_m: Option<f32>) {
        self.pixels += 1;
        if !z_m.is_finite() || z_m == 0.0 {
            return;
        }
        let off_m = f64::from(z_m - true_m).abs();
        // A filled pixel where the truth lacks a surface is wrong, but its error in metres is undefined.
        if off_m.is_finite() {
            self.on_surfaces += 1;
            self.squares += off_m * off_m;
        }
        self.errors_mm.push(1e3 * off_m as f32);
        self.wrong += usize::from(off_m > WRONG_M.max(3.0 * step_m(true_m.into())));
        if let Some(sigma_m) = sigma_m {
            self.stated += 1;
            for (count, k) in self.within.iter_mut().zip([1.0, 2.0, 3.0]) {
                *count += usize::from(off_m <= k * f64::from(sigma_m));
            }
        }
    }

    fn report(&self) -> HoleReport {
        let filled = self.errors_mm.len() as f64;
        let [within_one, within_two, within_three] = self.within.map(|count| count as f64 / self.stated as f64);
        HoleReport {
            pixels: self.pixels,
            filled: filled / self.pixels as f64,
            rms_mm: 1e3 * (self.squares / self.on_surfaces as f64).sqrt(),
            median_mm: quantile(&self.errors_mm, 0.5),
            wrong: self.wrong as f64 / filled,
            within_one,
            within_two,
            over_three: 1.0 - within_three,
        }
    }
}

/// Accumulates results in holes.
#[derive(Debug, Clone, Default)]
pub struct FillEvaluation {
    cut: Errors,
    cut_near_steps: Errors,
    own: Errors,
}

impl FillEvaluation {
    /// Adds a result: depth in metres (NaN or 0 for holes), and standard errors per pixel, if known.
    pub fn add(&mut self, truth: &Truth, frame: &DepthFrame, cut: &[bool], z_m: &[f32], sigma_m: Option<&[f32]>) {
        let near = edge_band(truth, EDGE_MARGIN_PX);
        for i in (0..cut.len()).filter(|&i| frame.raw[i] == 0) {
            let true_m = if truth.objects[i] == NO_OBJECT { f32::INFINITY } else { truth.points.z()[i] };
            let errors = match (cut[i], near[i]) {
                (true, false) => &mut self.cut,
                (true, true) => &mut self.cut_near_steps,
                (false, _) => &mut self.own,
            };
            errors.add(z_m[i], true_m, sigma_m.map(|sigma_m| sigma_m[i]));
        }
    }

    /// Adds a real frame. `known_m` is the depth in metres of the pixels that were cut out, and NaN for all others.
    pub fn add_known(&mut self, known_m: &[f32], z_m: &[f32], sigma_m: Option<&[f32]>) {
        for i in (0..known_m.len()).filter(|&i| known_m[i].is_finite()) {
            self.cut.add(z_m[i], known_m[i], sigma_m.map(|sigma_m| sigma_m[i]));
        }
    }

    /// Returns the results so far.
    pub fn report(&self) -> FillReport {
        FillReport { cut: self.cut.report(), cut_near_steps: self.cut_near_steps.report(), own: self.own.report() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::Suite;

    #[test]
    fn cut_holes_are_scored_against_the_truth() {
        let case = Suite::default().cases(1).unwrap().swap_remove(0);
        let mut frame = case.frame.clone();
        let cut = cut_holes(&mut frame, 8, 1);
        let count = cut.iter().filter(|cut| **cut).count();
        assert!((3000..20_000).contains(&count), "{count}");
        for (i, &cut) in cut.iter().enumerate() {
            assert_eq!(frame.raw[i], if cut { 0 } else { case.frame.raw[i] });
        }
        // The results are the truth itself, then a depth 10 cm off, then nothing.
        let sigma_m = vec![0.02; cut.len()];
        let of = |by_m: f32| {
            let z_m: Vec<f32> = case.truth.points.z().iter().map(|z_m| z_m + by_m).collect();
            let mut filling = FillEvaluation::default();
            filling.add(&case.truth, &frame, &cut, &z_m, Some(&sigma_m));
            filling.report()
        };
        let (exact, off, empty) = (of(0.0), of(0.1), of(f32::NAN));
        assert_eq!((exact.cut.filled, exact.cut.rms_mm, exact.cut.over_three), (1.0, 0.0, 0.0));
        assert_eq!(exact.cut.pixels + exact.cut_near_steps.pixels, count);
        assert!((off.cut.rms_mm - 100.0).abs() < 0.1 && off.cut.over_three == 1.0 && off.cut.wrong > 0.9);
        assert_eq!(empty.cut.filled, 0.0);
    }
}
