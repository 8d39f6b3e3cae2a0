//! The standard error of each smoothed position (docs/method.md, section 17), from the residuals of the frame itself:
//! what any engine has made of it.

use rayon::prelude::*;

use super::Session;
use crate::error::{Error, FrameError, ParamError};
use crate::frame::{Frame, FrameGeometry, GeometryScratch, RangeRule};
use crate::outputs::{Outputs, SmoothedMut};
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

/// How a result gets its standard errors when it is received.
#[derive(Debug, Clone, Copy)]
pub(super) struct ForSigma {
    geometry: FrameGeometry,
    params: EngineParams,
    /// The outputs that were requested.
    outputs: Outputs,
}

/// Returns the outputs from which the standard errors follow.
pub(super) fn needed(outputs: Outputs, is_over_time: bool) -> Outputs {
    let outputs = outputs.with_sigma(false).with_points(true).with_status(true).with_neighbours(true);
    outputs.with_frames(outputs.frames || is_over_time)
}

impl Session {
    /// Smooths a frame and estimates the error of each point.
    pub(super) fn smooth_with_sigma(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        check_sensor(frame)?;
        let outputs = self.options.outputs;
        self.options.outputs = needed(outputs, self.over_time(frame).is_some());
        let result = self.smooth(frame, out);
        self.options.outputs = outputs;
        result?;
        match self.for_sigma(frame) {
            Some(for_sigma) => {
                let threads = self.threads_for_sigma()?;
                for_sigma.add_to(frame, out, &threads);
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// Returns the threads that estimate errors, kept from frame to frame.
    pub(super) fn threads_for_sigma(&mut self) -> Result<Threads, Error> {
        let wanted = self.options.threads;
        match &self.sigma_threads {
            Some((threads, open)) if *threads == wanted => Ok(open.clone()),
            _ => {
                let open = Threads::open(wanted)?;
                self.sigma_threads = Some((wanted, open.clone()));
                Ok(open)
            }
        }
    }

    /// As [`smooth_with_sigma`](Self::smooth_with_sigma), into the caller's buffers.
    pub(super) fn smooth_with_sigma_into(&mut self, frame: Frame<'_>, mut out: SmoothedMut<'_>) -> Result<(), Error> {
        let mut smoothed = std::mem::take(&mut self.with_sigma);
        let result = self.smooth_with_sigma(frame, &mut smoothed);
        if result.is_ok() {
            out.copy_from(&smoothed);
        }
        self.with_sigma = smoothed;
        result
    }

    /// Returns how the last frame that an engine was opened for gets its standard errors, if they are requested.
    pub(super) fn for_sigma(&mut self, frame: Frame<'_>) -> Option<ForSigma> {
        let params = self.open.as_ref()?.open_for().params;
        let outputs = self.options.outputs;
        let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
        outputs.sigma.then_some(ForSigma { geometry, params, outputs })
    }
}

/// Refuses clouds without a grid, and grids whose sensor could be anywhere: they have no rays.
pub(super) fn check_sensor(frame: Frame<'_>) -> Result<(), Error> {
    match frame {
        Frame::Points(points) if points.grid().is_none() => {
            let allowed = "only for frames on a grid";
            Err(ParamError { field: "outputs", value: "sigma".into(), allowed }.into())
        }
        Frame::Points(points) if points.seen_from().is_none() => Err(FrameError::UnknownSensor.into()),
        _ => Ok(()),
    }
}

impl ForSigma {
    /// Adds the standard errors to the result of a frame, and leaves the outputs that were requested.
    pub(super) fn add_to(&self, frame: Frame<'_>, smoothed: &mut Smoothed, threads: &Threads) {
        smoothed.sigma = Some(threads.install(|| self.sigma_m(frame, smoothed)));
        let (width, height) = (smoothed.width, smoothed.height);
        smoothed.prepare(width, height, self.outputs);
    }

    fn sigma_m(&self, frame: Frame<'_>, smoothed: &Smoothed) -> Vec<f32> {
        let shape @ (width, _) = (smoothed.width, smoothed.height);
        let sensor = &self.params.sensor;
        let (Some(status), Some(neighbours)) = (&smoothed.status, &smoothed.neighbours) else {
            return vec![f32::NAN; width * smoothed.height];
        };
        // The sensor's deviation of each smoothed point, and the residual in its units; NaN without either.
        let seen: Vec<(f32, f32, f32)> = (0..width * smoothed.height)
            .into_par_iter()
            .with_min_len(width)
            .map(|i| {
                let (measured_m, range_m) = self.ranges_m(frame, smoothed, i);
                let deviation_m = sensor.sigma_m(range_m).max(LEAST_DEVIATION_M) as f32;
                (range_m as f32, deviation_m, (measured_m - range_m) as f32 / deviation_m)
            })
            .collect();
        let is_smooth = |i: usize| matches!(status[i], Status::Plane | Status::Polynomial2 | Status::Polynomial3);
        let residual = |i: usize| {
            let residual = seen[i].2;
            (residual.is_finite() && is_smooth(i)).then(|| residual.clamp(-CLIP, CLIP))
        };
        let residuals: Vec<Option<f32>> = (0..seen.len()).into_par_iter().with_min_len(width).map(residual).collect();
        let pixels_of_sample = if self.params.averages_blocks() { self.params.stride.pow(2) } else { 1 };
        let side = 2 * self.params.window + 1;
        let follows_noise = pixels_of_sample * side * side < FEW_PIXELS;
        let [_, linear, square] = sensor.sigma;
        let least_area = if follows_noise && square > linear { STEREO_AREA } else { 1.0 };
        let area = correlation_area(&residuals, shape).max(least_area);
        let [mut variances, means] = windowed(&residuals, shape);
        let least = if follows_noise { 1.0 } else { LEAST_DEVIATION.powi(2) };
        variances.iter_mut().for_each(|variance| *variance = variance.max(least));
        let of_means = (area / (2 * BIAS_HALF_PX + 1).pow(2) as f64).min(1.0) as f32;
        let steps = near_steps(&seen, shape);
        let is_plain = self.params.edges == Edges::Off && follows_noise;
        let gain = FACTOR * area.powf(EXPONENT) * if is_plain { FOLLOWING_FACTOR } else { 1.0 };
        let sigma_m = |i: usize| {
            let (range_m, deviation_m, _) = seen[i];
            if !range_m.is_finite() || !status[i].has_point() {
                return f32::NAN;
            }
            let raw = variances[i].sqrt() * deviation_m;
            if !is_smooth(i) {
                return raw;
            }
            let pixels = f64::from(neighbours[i].max(1) * pixels_of_sample);
            let share = (gain / pixels.sqrt()).min(MOST_SHARE) as f32;
            let of_step = if steps[i] { NEAR_STEP_FACTOR } else { 1.0 };
            let frames = smoothed.frames.as_ref().map_or(1.0, |frames| frames[i].max(1.0));
            let of_noise = raw * share * of_step * (FIXED_SHARE + (1.0 - FIXED_SHARE) / frames).sqrt();
            let bias = (means[i].abs() - BIAS_DEVIATIONS * (of_means * variances[i]).sqrt()).max(0.0);
            (of_noise.powi(2) + (BIAS_WEIGHT * bias * deviation_m).powi(2)).sqrt()
        };
        (0..seen.len()).into_par_iter().with_min_len(width).map(sigma_m).collect()
    }

    /// Returns the ranges of a pixel as measured and smoothed.
    fn ranges_m(&self, frame: Frame<'_>, smoothed: &Smoothed, i: usize) -> (f64, f64) {
        let Self { geometry, .. } = self;
        let range_m = |point: glam::DVec3| match (geometry.cloud_from_sensor, geometry.rule) {
            (None, RangeRule::Depth { .. }) => point.z.abs(),
            (transform, _) => geometry.range_m(transform.map_or(point, |transform| transform.to_sensor(point))),
        };
        let measured_m = match frame {
            Frame::Depth(depth) => f64::from(depth.depth_m(i % smoothed.width, i / smoothed.width)),
            Frame::Points(points) => range_m(points.point(i)),
        };
        (measured_m, range_m(glam::Vec3::from_array(smoothed.points.get(i)).as_dvec3()))
    }
}

/// Returns the number of pixels whose noise counts as one: the sum of the correlations of the residuals over all lags.
fn correlation_area(residuals: &[Option<f32>], (width, height): (usize, usize)) -> f64 {
    let along = |step: usize, columns: usize, rows: usize| {
        let correlation = |lag: usize| {
            let of_row = |v: usize| {
                let (mut product, mut square) = (0.0, 0.0);
                for u in (0..columns).step_by(STEP_PX) {
                    let i = v * width + u;
                    if let (Some(a), Some(b)) = (residuals[i], residuals[i + lag * step]) {
                        product += f64::from(a * b);
                        square += 0.5 * f64::from(a * a + b * b);
                    }
                }
                (product, square)
            };
            let of_rows: Vec<(f64, f64)> =
                (0..rows).step_by(STEP_PX).collect::<Vec<_>>().into_par_iter().map(of_row).collect();
            let (product, square) = of_rows.iter().fold((0.0, 0.0), |(a, b), (c, d)| (a + c, b + d));
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

/// Returns the mean squares and the means of the residuals in windows around each pixel; 1, the square of the sensor's
/// own, and 0 where there are none.
fn windowed(residuals: &[Option<f32>], shape: (usize, usize)) -> [Vec<f32>; 2] {
    let [values, squares, counts] = [|value| value, |value: f32| value * value, |_: f32| 1.0]
        .map(|of| residuals.par_iter().map(|residual| residual.map_or(0.0, of)).collect::<Vec<f32>>());
    [mean_of(&squares, &counts, shape, HALF_PX, 1.0), mean_of(&values, &counts, shape, BIAS_HALF_PX, 0.0)]
}

/// Returns the quotients of two sums over a window around each pixel, or `without` where the second is 0.
fn mean_of(values: &[f32], counts: &[f32], (width, height): (usize, usize), half_px: usize, without: f32) -> Vec<f32> {
    let mut means = vec![without; width * height];
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
                if number > 0.0 {
                    means[at] = (sum / number) as f32;
                }
                if let Some(first) = at.checked_sub(half_px) {
                    (sum, number) = (sum - f64::from(sums[first]), number - f64::from(numbers[first]));
                }
            }
        }
    });
    means
}

/// Returns which pixels are near a step of the smoothed surface.
fn near_steps(seen: &[(f32, f32, f32)], (width, height): (usize, usize)) -> Vec<bool> {
    let is_step = |i: usize, j: usize| {
        let ((a_m, deviation_m, _), (b_m, ..)) = (seen[i], seen[j]);
        (a_m - b_m).abs() > (STEP_DEVIATIONS * deviation_m).max(STEP_SHARE * a_m)
    };
    let has_step = |i: usize| {
        let (u, v) = (i % width, i / width);
        (u + 1 < width && is_step(i, i + 1)) || (v + 1 < height && is_step(i, i + width))
    };
    let steps: Vec<u8> = (0..seen.len()).into_par_iter().with_min_len(width).map(|i| u8::from(has_step(i))).collect();
    let mut near = vec![false; seen.len()];
    near.par_chunks_mut(width).enumerate().for_each(|(v, near)| {
        let mut columns = vec![0u8; width];
        for row in v.saturating_sub(NEAR_STEP_PX)..(v + NEAR_STEP_PX + 1).min(height) {
            let row = &steps[row * width..(row + 1) * width];
            columns.iter_mut().zip(row).for_each(|(column, step)| *column |= step);
        }
        for (u, near) in near.iter_mut().enumerate() {
            let window = u.saturating_sub(NEAR_STEP_PX)..(u + NEAR_STEP_PX + 1).min(width);
            *near = columns[window].iter().fold(0, |any, column| any | column) > 0;
        }
    });
    near
}
