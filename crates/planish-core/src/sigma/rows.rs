//! Loops over the pixels of a row. Callers compile them for each instruction set.

use super::constants::{
    BIAS_DEVIATIONS, BIAS_HALF_PX, BIAS_WEIGHT, CLIP, FIXED_SHARE, HALF_PX, LEAST_DEVIATION_M, MOST_SHARE,
    NEAR_STEP_FACTOR, NEAR_STEP_PX, STEP_DEVIATIONS, STEP_SHARE,
};
use crate::status::Status;

/// Model of the errors as a function of the residuals.
#[derive(Debug, Clone, Copy)]
pub(super) struct ErrorModel {
    /// Ratio of the standard error to the deviation of the residuals, for a point with one neighbour.
    pub(super) gain: f32,
    /// Minimum variance of residuals, in units of the sensor's variance.
    pub(super) least_variance: f32,
    /// Variance of the mean residual over a small window, relative to the variance of one residual.
    pub(super) variance_of_mean: f32,
}

/// The smoothed ranges of a row, and the other values of its pixels.
#[derive(Clone, Copy)]
pub(super) struct OfRow<'a> {
    pub(super) ranges_m: &'a [f32],
    pub(super) deviations_m: &'a [f32],
    pub(super) status: &'a [Status],
    pub(super) neighbours: &'a [u32],
}

#[inline(always)]
fn is_on_surface(status: Status) -> bool {
    matches!(status, Status::Plane | Status::Polynomial2 | Status::Polynomial3)
}

/// Replaces the measured ranges in `values` with residuals in standard deviations of the sensor; 0 for pixels without
/// a residual. Sets `deviations_m`, and `counts` to 1 for pixels with a residual.
#[inline(always)]
pub(super) fn set_residuals(
    [values, counts, deviations_m]: [&mut [f32]; 3],
    ranges_m: &[f32],
    status: &[Status],
    [constant, linear, square]: [f32; 3],
) {
    let outputs = values.iter_mut().zip(counts).zip(deviations_m);
    for (((value, count), deviation_m), (range_m, status)) in outputs.zip(ranges_m.iter().zip(status)) {
        *deviation_m = (constant + range_m * (linear + range_m * square)).max(LEAST_DEVIATION_M);
        let residual = (*value - range_m) / *deviation_m;
        // False for a NaN.
        let counts_here = (residual.abs() < f32::INFINITY) & is_on_surface(*status);
        *value = if counts_here { residual.clamp(-CLIP, CLIP) } else { 0.0 };
        *count = if counts_here { 1.0 } else { 0.0 };
    }
}

/// Marks the pixels of a row with a step to the pixel on the right or below.
#[inline(always)]
pub(super) fn mark_steps(steps: &mut [u8], [here_m, below_m]: [&[f32]; 2], deviations_m: &[f32]) {
    let last = here_m.len().saturating_sub(1);
    for (u, step) in steps.iter_mut().enumerate() {
        let limit_m = (STEP_DEVIATIONS * deviations_m[u]).max(STEP_SHARE * here_m[u]);
        let [right, below] = [here_m[(u + 1).min(last)], below_m[u]].map(|m| (here_m[u] - m).abs() > limit_m);
        *step = u8::from(right | below);
    }
}

/// Column sums of the windows around the pixels of a row, with a margin on both sides.
pub(super) struct Windows {
    squares: Vec<f32>,
    counts: Vec<f32>,
    small_values: Vec<f32>,
    small_counts: Vec<f32>,
    steps: Vec<u8>,
}

/// Number of values in the margin on either side of a row.
const MARGIN: usize = HALF_PX;

impl Windows {
    pub(super) fn new(width: usize) -> Self {
        let [squares, counts, small_values, small_counts] = std::array::from_fn(|_| vec![0.0; width + 2 * MARGIN]);
        Self { squares, counts, small_values, small_counts, steps: vec![0; width + 2 * MARGIN] }
    }

    /// Adds up the columns of the windows of row `v`.
    #[inline(always)]
    pub(super) fn set(
        &mut self,
        v: usize,
        [values, counts]: [&[f32]; 2],
        steps: &[u8],
        (width, height): (usize, usize),
    ) {
        let rows = |half_px: usize| v.saturating_sub(half_px)..(v + half_px + 1).min(height);
        let inner = MARGIN..MARGIN + width;
        for sums in [&mut self.squares, &mut self.counts, &mut self.small_values, &mut self.small_counts] {
            sums.fill(0.0);
        }
        self.steps.fill(0);
        for row in rows(HALF_PX).map(|row| row * width..(row + 1) * width) {
            let sums = self.squares[inner.clone()].iter_mut().zip(&mut self.counts[inner.clone()]);
            for ((square, count), (value, counts)) in sums.zip(values[row.clone()].iter().zip(&counts[row])) {
                *square += value * value;
                *count += counts;
            }
        }
        for row in rows(BIAS_HALF_PX).map(|row| row * width..(row + 1) * width) {
            let sums = self.small_values[inner.clone()].iter_mut().zip(&mut self.small_counts[inner.clone()]);
            for ((sum, count), (value, counts)) in sums.zip(values[row.clone()].iter().zip(&counts[row])) {
                *sum += value;
                *count += counts;
            }
        }
        for row in rows(NEAR_STEP_PX).map(|row| row * width..(row + 1) * width) {
            self.steps[inner.clone()].iter_mut().zip(&steps[row]).for_each(|(any, step)| *any |= step);
        }
    }

    /// Replaces the numbers of averaged frames in `errors` with standard errors; NaN for pixels without a point.
    #[inline(always)]
    pub(super) fn set_errors(&self, errors: &mut [f32], row: OfRow<'_>, model: &ErrorModel) {
        let width = errors.len();
        let OfRow { ranges_m, deviations_m, status, neighbours } = row;
        let (ranges_m, deviations_m) = (&ranges_m[..width], &deviations_m[..width]);
        let (status, neighbours) = (&status[..width], &neighbours[..width]);
        for (u, error) in errors.iter_mut().enumerate() {
            let sum = |sums: &[f32], half_px: usize| {
                sums[u + MARGIN - half_px..][..2 * half_px + 1].iter().fold(0.0, |sum, value| sum + value)
            };
            // Without residuals in the window, the noise is the sensor's and there is no bias.
            let count = sum(&self.counts, HALF_PX);
            let variance = if count > 0.0 { sum(&self.squares, HALF_PX) / count } else { 1.0 };
            let mean = sum(&self.small_values, BIAS_HALF_PX) / sum(&self.small_counts, BIAS_HALF_PX).max(1.0);
            let near =
                self.steps[u + MARGIN - NEAR_STEP_PX..][..2 * NEAR_STEP_PX + 1].iter().fold(0, |any, step| any | step);
            let variance = variance.max(model.least_variance);
            let raw_m = variance.sqrt() * deviations_m[u];
            let share = (model.gain / (neighbours[u].max(1) as f32).sqrt()).min(MOST_SHARE);
            let of_step = if near > 0 { NEAR_STEP_FACTOR } else { 1.0 };
            let of_time = (FIXED_SHARE + (1.0 - FIXED_SHARE) / error.max(1.0)).sqrt();
            let noise_m = raw_m * share * of_step * of_time;
            let bias = (mean.abs() - BIAS_DEVIATIONS * (model.variance_of_mean * variance).sqrt()).max(0.0);
            let bias_m = BIAS_WEIGHT * bias * deviations_m[u];
            let smoothed_m = (noise_m * noise_m + bias_m * bias_m).sqrt();
            let has_point = (ranges_m[u].abs() < f32::INFINITY) & status[u].has_point();
            let error_m = if is_on_surface(status[u]) { smoothed_m } else { raw_m };
            *error = if has_point { error_m } else { f32::NAN };
        }
    }
}
