//! The standard error of each smoothed position (docs/method.md, section 17), from the residuals of the frame itself:
//! what any engine has made of it.

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
const LEAST_DEVIATION_M: f64 = 1e-5;
/// The largest lag of the correlation, in pixels.
const MOST_LAG_PX: usize = 6;
/// Correlations below this are noise of the estimate.
const LEAST_CORRELATION: f64 = 0.02;
/// The correlation is estimated from every third row and column.
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
const MOST_SHARE: f64 = 0.85;
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
    /// Residuals in deviations, their squares, and 1 for pixels that have one.
    values: Vec<f32>,
    squares: Vec<f32>,
    counts: Vec<f32>,
    /// Means of squares and of residuals.
    variances: Vec<f32>,
    means: Vec<f32>,
    /// Steps, and the pixels near one.
    steps: Vec<u8>,
    near: Vec<u8>,
}

impl SigmaBuffers {
    fn resize(&mut self, pixels: usize) {
        let Self { ranges_m, deviations_m, values, squares, counts, variances, means, steps, near, .. } = self;
        for buffer in [ranges_m, deviations_m, values, squares, counts, variances, means] {
            buffer.resize(pixels, 0.0);
        }
        steps.resize(pixels, 0);
        near.resize(pixels, 0);
    }
}

fn is_on_surface(status: Status) -> bool {
    matches!(status, Status::Plane | Status::Polynomial2 | Status::Polynomial3)
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
        let shape @ (width, _) = (smoothed.width, smoothed.height);
        let sensor = &self.params.sensor;
        let (Some(status), Some(neighbours)) = (&smoothed.status, &smoothed.neighbours) else {
            return sigma_m.fill(f32::NAN);
        };
        let SigmaBuffers { ranges_m, deviations_m, values, squares, counts, variances, means, steps, near, .. } =
            buffers;
        let rows = ranges_m.par_chunks_mut(width).zip(deviations_m.par_chunks_mut(width));
        let rows = rows.zip(values.par_chunks_mut(width)).zip(squares.par_chunks_mut(width));
        let rows = rows.zip(counts.par_chunks_mut(width)).enumerate();
        rows.for_each(|(v, ((((ranges_m, deviations_m), values), squares), counts))| {
            for u in 0..width {
                let i = v * width + u;
                let (measured_m, range_m) = self.ranges_m(frame, smoothed, (u, v));
                let deviation_m = sensor.sigma_m(range_m).max(LEAST_DEVIATION_M);
                let residual = ((measured_m - range_m) / deviation_m) as f32;
                let counts_here = residual.is_finite() && is_on_surface(status[i]);
                let value = if counts_here { residual.clamp(-CLIP, CLIP) } else { 0.0 };
                (ranges_m[u], deviations_m[u]) = (range_m as f32, deviation_m as f32);
                (values[u], squares[u], counts[u]) = (value, value * value, f32::from(u8::from(counts_here)));
            }
        });
        let pixels_of_sample = if self.params.averages_blocks() { self.params.stride.pow(2) } else { 1 };
        let side = 2 * self.params.window + 1;
        let follows_noise = pixels_of_sample * side * side < FEW_PIXELS;
        let [_, linear, square] = sensor.sigma;
        let least_area = if follows_noise && square > linear { STEREO_AREA } else { 1.0 };
        let area = correlation_area(values, counts, shape).max(least_area);
        let least = if follows_noise { 1.0 } else { LEAST_DEVIATION.powi(2) };
        set_means(variances, [squares, counts], shape, HALF_PX, 1.0);
        set_means(means, [values, counts], shape, BIAS_HALF_PX, 0.0);
        mark_near_steps([steps, near], [ranges_m, deviations_m], shape);
        let of_means = (area / (2 * BIAS_HALF_PX + 1).pow(2) as f64).min(1.0) as f32;
        let is_plain = self.params.edges == Edges::Off && follows_noise;
        let gain = FACTOR * area.powf(EXPONENT) * if is_plain { FOLLOWING_FACTOR } else { 1.0 };
        let (gain, most_share) = ((gain / f64::from(pixels_of_sample).sqrt()) as f32, MOST_SHARE as f32);
        let of_pixel = |i: usize| {
            let deviation_m = deviations_m[i];
            if !ranges_m[i].is_finite() || !status[i].has_point() {
                return f32::NAN;
            }
            let variance = variances[i].max(least);
            let raw = variance.sqrt() * deviation_m;
            if !is_on_surface(status[i]) {
                return raw;
            }
            let share = (gain / (neighbours[i].max(1) as f32).sqrt()).min(most_share);
            let of_step = if near[i] > 0 { NEAR_STEP_FACTOR } else { 1.0 };
            let frames = smoothed.frames.as_ref().map_or(1.0, |frames| frames[i].max(1.0));
            let of_noise = raw * share * of_step * (FIXED_SHARE + (1.0 - FIXED_SHARE) / frames).sqrt();
            let bias = (means[i].abs() - BIAS_DEVIATIONS * (of_means * variance).sqrt()).max(0.0);
            (of_noise.powi(2) + (BIAS_WEIGHT * bias * deviation_m).powi(2)).sqrt()
        };
        sigma_m.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            row.iter_mut().enumerate().for_each(|(u, sigma_m)| *sigma_m = of_pixel(v * width + u));
        });
    }

    /// Returns the ranges of a pixel as measured and smoothed.
    fn ranges_m(&self, frame: Frame<'_>, smoothed: &Smoothed, (u, v): (usize, usize)) -> (f64, f64) {
        let (Self { geometry, .. }, i) = (self, v * smoothed.width + u);
        let range_m = |point: glam::DVec3| match (geometry.cloud_from_sensor, geometry.rule) {
            (None, RangeRule::Depth { .. }) => point.z.abs(),
            (transform, _) => geometry.range_m(transform.map_or(point, |transform| transform.to_sensor(point))),
        };
        let measured_m = match frame {
            Frame::Depth(depth) => f64::from(depth.depth_m(u, v)),
            Frame::Points(points) => range_m(points.point(i)),
        };
        (measured_m, range_m(glam::Vec3::from_array(smoothed.points.get(i)).as_dvec3()))
    }
}

/// Returns the number of pixels whose noise counts as one: the sum of the correlations of the residuals over all lags.
fn correlation_area(values: &[f32], counts: &[f32], (width, height): (usize, usize)) -> f64 {
    let along = |step: usize, columns: usize, rows: usize| {
        let correlation = |lag: usize| {
            let of_row = |v: usize| {
                let (mut product, mut square) = (0.0f32, 0.0f32);
                for u in (0..columns).step_by(STEP_PX) {
                    let (i, j) = (v * width + u, v * width + u + lag * step);
                    // Values are 0 where they do not count.
                    product += values[i] * values[j];
                    square += 0.5 * (values[i].powi(2) + values[j].powi(2)) * counts[i] * counts[j];
                }
                [f64::from(product), f64::from(square)]
            };
            let of_rows: Vec<[f64; 2]> =
                (0..rows.div_ceil(STEP_PX)).into_par_iter().map(|row| of_row(row * STEP_PX)).collect();
            let [product, square] = [0, 1].map(|k| of_rows.iter().map(|row| row[k]).sum::<f64>());
            if square > 0.0 { product / square } else { 0.0 }
        };
        let mut sum = 1.0;
        for lag in 1..=MOST_LAG_PX {
            let correlation = correlation(lag);
            if correlation < LEAST_CORRELATION {
                break;
            }
            sum += 2.0 * correlation;
        }
        sum
    };
    along(1, width.saturating_sub(MOST_LAG_PX), height) * along(width, width, height.saturating_sub(MOST_LAG_PX))
}

/// Sets the quotients of two sums over a window around each pixel, or `without` where the second is 0.
fn set_means(
    means: &mut [f32],
    [values, counts]: [&[f32]; 2],
    (width, height): (usize, usize),
    half_px: usize,
    without: f32,
) {
    means.par_chunks_mut(width).enumerate().for_each(|(v, means)| {
        // Sums of each column over the rows of the window, then over its columns.
        let (mut sums, mut numbers) = (vec![0.0f32; width], vec![0.0f32; width]);
        for row in v.saturating_sub(half_px)..(v + half_px + 1).min(height) {
            let row = row * width..(row + 1) * width;
            sums.iter_mut().zip(&values[row.clone()]).for_each(|(sum, value)| *sum += value);
            numbers.iter_mut().zip(&counts[row]).for_each(|(sum, count)| *sum += count);
        }
        // In f64, so that nothing is left of what has passed.
        let (mut sum, mut number) = (0.0f64, 0.0f64);
        for u in 0..(width + half_px) {
            if u < width {
                (sum, number) = (sum + f64::from(sums[u]), number + f64::from(numbers[u]));
            }
            if let Some(at) = u.checked_sub(half_px) {
                means[at] = if number > 0.0 { (sum / number) as f32 } else { without };
                if let Some(first) = at.checked_sub(half_px) {
                    (sum, number) = (sum - f64::from(sums[first]), number - f64::from(numbers[first]));
                }
            }
        }
    });
}

/// Marks the pixels near a step of the smoothed surface.
fn mark_near_steps(
    [steps, near]: [&mut [u8]; 2],
    [ranges_m, deviations_m]: [&[f32]; 2],
    (width, height): (usize, usize),
) {
    steps.par_chunks_mut(width).enumerate().for_each(|(v, steps)| {
        let of_row = |v: usize| &ranges_m[v * width..(v + 1) * width];
        let (here, deviations_m) = (of_row(v), &deviations_m[v * width..(v + 1) * width]);
        let below = of_row((v + 1).min(height - 1));
        for (u, step) in steps.iter_mut().enumerate() {
            let limit_m = (STEP_DEVIATIONS * deviations_m[u]).max(STEP_SHARE * here[u]);
            let right = here[(u + 1).min(width - 1)];
            *step = u8::from((here[u] - right).abs() > limit_m) | u8::from((here[u] - below[u]).abs() > limit_m);
        }
    });
    near.par_chunks_mut(width).enumerate().for_each(|(v, near)| {
        let mut columns = vec![0u8; width];
        for row in v.saturating_sub(NEAR_STEP_PX)..(v + NEAR_STEP_PX + 1).min(height) {
            let row = &steps[row * width..(row + 1) * width];
            columns.iter_mut().zip(row).for_each(|(column, step)| *column |= step);
        }
        for (u, near) in near.iter_mut().enumerate() {
            let window = u.saturating_sub(NEAR_STEP_PX)..(u + NEAR_STEP_PX + 1).min(width);
            *near = columns[window].iter().fold(0, |any, column| any | column);
        }
    });
}
