//! Estimates the standard error of each smoothed position (docs/method.md, section 17) from the residuals of the
//! frame itself, whichever engine smoothed it.

pub(crate) mod constants;
mod correlation;
mod rows;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use self::constants::{BIAS_HALF_PX, EXPONENT, FACTOR, FEW_PIXELS, FOLLOWING_FACTOR, LEAST_DEVIATION, STEREO_AREA};
use crate::frame::{Frame, FrameGeometry, RangeRule};
use crate::params::{Edges, EngineParams};
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::threads::Threads;

/// Parameters of the estimate of standard errors.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sigma {
    pub(crate) geometry: FrameGeometry,
    pub(crate) params: EngineParams,
}

/// Buffers that are reused from frame to frame.
#[derive(Default)]
pub(crate) struct SigmaBuffers {
    /// Smoothed range of each pixel, in metres.
    ranges_m: Vec<f32>,
    /// Standard deviation of the sensor at the smoothed range of each pixel, in metres.
    deviations_m: Vec<f32>,
    /// Residuals in standard deviations of the sensor; 0 for pixels without a residual.
    values: Vec<f32>,
    counts: Vec<f32>,
    /// 1 for pixels with a step to the pixel on the right or below, otherwise 0.
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
    pub(crate) fn estimate(
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
        let model = ErrorScale::of(&self.params).model(correlation::area(values, counts, shape));
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
                // `set_errors` reads the number of frames from this buffer and replaces it with the error.
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

    /// Sets the ranges, the sensor's standard deviations at these ranges, and the residuals.
    fn set_residuals(&self, frame: Frame<'_>, smoothed: &Smoothed, status: &[Status], buffers: &mut SigmaBuffers) {
        let (width, level) = (smoothed.width, Level::new());
        let sensor = self.params.sensor.sigma;
        let SigmaBuffers { ranges_m, deviations_m, values, counts, .. } = buffers;
        let rows = ranges_m.par_chunks_mut(width).zip(deviations_m.par_chunks_mut(width));
        let rows = rows.zip(values.par_chunks_mut(width)).zip(counts.par_chunks_mut(width)).enumerate();
        rows.for_each(|(v, (((ranges_m, deviations_m), values), counts))| {
            let row = v * width..(v + 1) * width;
            // `set_residuals` reads the measured ranges from `values` and replaces them with the residuals.
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
}

/// Factors that convert residuals to standard errors and depend only on the smoothing parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ErrorScale {
    /// Ratio of the standard error to the deviation of the residuals, for one neighbour and a correlation area of one
    /// pixel.
    pub(crate) gain: f64,
    /// Minimum correlation area in pixels.
    pub(crate) least_area: f64,
    /// Minimum variance of residuals, in units of the sensor's variance.
    pub(crate) least_variance: f32,
}

impl ErrorScale {
    pub(crate) fn of(params: &EngineParams) -> Self {
        let pixels_of_sample = if params.averages_blocks() { params.stride.pow(2) } else { 1 };
        let side = 2 * params.window + 1;
        let follows_noise = pixels_of_sample * side * side < FEW_PIXELS;
        let [_, linear, square] = params.sensor.sigma;
        let is_plain = params.edges == Edges::Off && follows_noise;
        let gain = FACTOR * if is_plain { FOLLOWING_FACTOR } else { 1.0 };
        Self {
            gain: gain / f64::from(pixels_of_sample).sqrt(),
            least_area: if follows_noise && square > linear { STEREO_AREA } else { 1.0 },
            least_variance: if follows_noise { 1.0 } else { LEAST_DEVIATION.powi(2) },
        }
    }

    /// Returns the error model for a correlation area in pixels.
    fn model(&self, area: f64) -> rows::ErrorModel {
        let area = area.max(self.least_area);
        rows::ErrorModel {
            gain: (self.gain * area.powf(EXPONENT)) as f32,
            least_variance: self.least_variance,
            variance_of_mean: (area / (2 * BIAS_HALF_PX + 1).pow(2) as f64).min(1.0) as f32,
        }
    }
}
