//! The standard error of each smoothed position (docs/method.md, section 17), from the residuals of the frame itself:
//! what any engine has made of it.

mod correlation;
mod rows;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use crate::frame::{Frame, FrameGeometry, RangeRule};
use crate::params::{Edges, EngineParams};
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::threads::Threads;

/// Half-width in pixels of the windows over which residuals are averaged.
const HALF_PX: usize = 4;
/// Residuals are clamped to this many standard deviations, so that a floating pixel does not count as noise.
const CLIP: f32 = 6.0;
/// Residuals show at least this share of the sensor's deviation, and that is at least this many metres: where all
/// pixels have the same raw value, or the sensor is exact, points still have an error.
const LEAST_DEVIATION: f32 = 0.1;
const LEAST_DEVIATION_M: f32 = 1e-5;
/// The largest lag of the correlation, in pixels.
const MOST_LAG_PX: usize = 6;
/// Correlations below this are noise of the estimate.
const LEAST_CORRELATION: f64 = 0.02;
/// The correlation is estimated from every third row.
const STEP_PX: usize = 3;
/// The standard error in units of the residual deviation over the root of the number of samples, measured on simulated
/// frames of every sensor; and the exponent of the area of correlation, whose estimate from residuals is low.
const FACTOR: f64 = 1.38;
const EXPONENT: f64 = 0.6;
/// Within this many pixels of a step, the error is larger by this factor.
const NEAR_STEP_PX: usize = 3;
const NEAR_STEP_FACTOR: f32 = 1.45;
/// A step between adjacent pixels, in standard deviations of the sensor and in shares of the range.
const STEP_DEVIATIONS: f32 = 8.0;
const STEP_SHARE: f32 = 0.02;
/// Windows of fewer pixels follow the noise, so residuals do not show all of it: it is at least the sensor's, with at
/// least this area of correlation where it grows with the square of the range, as with stereo and structured light.
const FEW_PIXELS: u32 = 150;
const STEREO_AREA: f64 = 8.0;
/// There, polynomials without kept edges follow the noise by this factor, and at most this share of it is left.
const FOLLOWING_FACTOR: f64 = 2.0;
const MOST_SHARE: f32 = 0.85;
/// A mean residual over a window of this half-width in pixels shows that smoothing flattened the surface, if it exceeds
/// its noise by this many deviations. This share of the rest is added as an error.
const BIAS_HALF_PX: usize = 2;
const BIAS_DEVIATIONS: f32 = 2.0;
const BIAS_WEIGHT: f32 = 0.5;
/// The share of the variance that is the same in every frame of a stationary sensor, and so does not fall over time.
const FIXED_SHARE: f32 = 0.65;

/// How standard errors are estimated.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sigma {
    pub(super) geometry: FrameGeometry,
    pub(super) params: EngineParams,
}

/// Buffers that are kept from frame to frame.
#[derive(Default)]
pub(super) struct SigmaBuffers {
    /// The smoothed range of each pixel, and the sensor's deviation there.
    ranges_m: Vec<f32>,
    deviations_m: Vec<f32>,
    /// Residuals in deviations, and 1 for pixels that have one.
    values: Vec<f32>,
    counts: Vec<f32>,
    /// 1 for pixels with a step to the next one.
    steps: Vec<u8>,
}

impl SigmaBuffers {
    fn resize(&mut self, pixels: usize) {
        let Self { ranges_m, deviations_m, values, counts, steps } = self;
        for buffer in [ranges_m, deviations_m, values, counts] {
            buffer.resize(pixels, 0.0);
        }
        steps.resize(pixels, 0);
    }
}

impl Sigma {
    /// Estimates the standard errors of a frame's result.
    pub(super) fn estimate(
        &self,
        frame: Frame<'_>,
        smoothed: &mut Smoothed,
        threads: &Threads,
        buffers: &mut SigmaBuffers,
    ) {
        let pixels = smoothed.width * smoothed.height;
        let mut sigma_m = smoothed.sigma.take().unwrap_or_default();
        sigma_m.resize(pixels, f32::NAN);
        buffers.resize(pixels);
        threads.install(|| self.fill(frame, smoothed, buffers, &mut sigma_m));
        smoothed.sigma = Some(sigma_m);
    }

    fn fill(&self, frame: Frame<'_>, smoothed: &Smoothed, buffers: &mut SigmaBuffers, sigma_m: &mut [f32]) {
        let shape @ (width, height) = (smoothed.width, smoothed.height);
        let (Some(status), Some(neighbours)) = (&smoothed.status, &smoothed.neighbours) else {
            return sigma_m.fill(f32::NAN);
        };
        let level = Level::new();
        self.set_residuals(frame, smoothed, status, buffers);
        let SigmaBuffers { ranges_m, deviations_m, values, counts, steps } = buffers;
        let model = self.error_model(correlation::area(values, counts, shape));
        steps.par_chunks_mut(width).enumerate().for_each(|(v, steps)| {
            let of_row = |v: usize| &ranges_m[v * width..(v + 1) * width];
            let deviations_m = &deviations_m[v * width..(v + 1) * width];
            let ranges_m = [of_row(v), of_row((v + 1).min(height - 1))];
            dispatch!(level, _simd => rows::mark_steps(steps, ranges_m, deviations_m));
        });
        sigma_m.par_chunks_mut(width).enumerate().for_each_init(
            || rows::Windows::new(width),
            |windows, (v, sigma_m)| {
                let row = v * width..(v + 1) * width;
                // The number of frames becomes the error.
                match &smoothed.frames {
                    Some(frames) => sigma_m.copy_from_slice(&frames[row.clone()]),
                    None => sigma_m.fill(1.0),
                }
                let of_row = rows::OfRow {
                    ranges_m: &ranges_m[row.clone()],
                    deviations_m: &deviations_m[row.clone()],
                    status: &status[row.clone()],
                    neighbours: &neighbours[row],
                };
                dispatch!(level, _simd => {
                    windows.set(v, [values, counts], steps, shape);
                    windows.set_errors(sigma_m, of_row, &model);
                });
            },
        );
    }

    /// Sets the ranges, the sensor's deviations there, and the residuals.
    fn set_residuals(&self, frame: Frame<'_>, smoothed: &Smoothed, status: &[Status], buffers: &mut SigmaBuffers) {
        let (width, level) = (smoothed.width, Level::new());
        let sensor = self.params.sensor.sigma;
        let SigmaBuffers { ranges_m, deviations_m, values, counts, .. } = buffers;
        let rows = ranges_m.par_chunks_mut(width).zip(deviations_m.par_chunks_mut(width));
        let rows = rows.zip(values.par_chunks_mut(width)).zip(counts.par_chunks_mut(width)).enumerate();
        rows.for_each(|(v, (((ranges_m, deviations_m), values), counts))| {
            let row = v * width..(v + 1) * width;
            // The measured ranges become the residuals.
            match frame {
                Frame::Depth(depth) => values.iter_mut().enumerate().for_each(|(u, m)| *m = depth.depth_m(u, v)),
                Frame::Points(points) => {
                    let points = row.clone().map(|i| points.point(i));
                    values.iter_mut().zip(points).for_each(|(m, point)| *m = self.range_m(point));
                }
            }
            if self.geometry.cloud_from_sensor.is_none() && matches!(self.geometry.rule, RangeRule::Depth { .. }) {
                ranges_m.iter_mut().zip(&smoothed.points.z()[row.clone()]).for_each(|(m, z)| *m = z.abs());
            } else {
                let points = row.clone().map(|i| glam::Vec3::from_array(smoothed.points.get(i)).as_dvec3());
                ranges_m.iter_mut().zip(points).for_each(|(m, point)| *m = self.range_m(point));
            }
            dispatch!(level, _simd => rows::set_residuals([values, counts, deviations_m], ranges_m, &status[row], sensor));
        });
    }

    /// Returns the range of a point.
    fn range_m(&self, point: glam::DVec3) -> f32 {
        let range_m = match (self.geometry.cloud_from_sensor, self.geometry.rule) {
            (None, RangeRule::Depth { .. }) => point.z.abs(),
            (transform, _) => self.geometry.range_m(transform.map_or(point, |transform| transform.to_sensor(point))),
        };
        range_m as f32
    }

    /// Returns how errors follow from residuals, if the noise of this number of pixels counts as one.
    fn error_model(&self, area: f64) -> rows::ErrorModel {
        let pixels_of_sample = if self.params.averages_blocks() { self.params.stride.pow(2) } else { 1 };
        let side = 2 * self.params.window + 1;
        let follows_noise = pixels_of_sample * side * side < FEW_PIXELS;
        let [_, linear, square] = self.params.sensor.sigma;
        let area = area.max(if follows_noise && square > linear { STEREO_AREA } else { 1.0 });
        let is_plain = self.params.edges == Edges::Off && follows_noise;
        let gain = FACTOR * area.powf(EXPONENT) * if is_plain { FOLLOWING_FACTOR } else { 1.0 };
        rows::ErrorModel {
            gain: (gain / f64::from(pixels_of_sample).sqrt()) as f32,
            least_variance: if follows_noise { 1.0 } else { LEAST_DEVIATION.powi(2) },
            variance_of_mean: (area / (2 * BIAS_HALF_PX + 1).pow(2) as f64).min(1.0) as f32,
        }
    }
}
