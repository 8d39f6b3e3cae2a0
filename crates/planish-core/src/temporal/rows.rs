//! The two passes of the temporal filter over rows of pixels, one vector of pixels at a time.
//!
//! The first pass measures the change of each pixel. The second combines it with the changes of the surrounding
//! pixels and updates the state. Planes have rows of `pitch` pixels, a multiple of [`TILE`]; those that the second
//! pass sums over several rows also have [`MARGIN`] rows of zeros above and below.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::Domain;
use super::constants::{
    AT_ONCE, BIAS, CANDIDATE, CHANGE, CLIP, CLIP_OF_TILE, FIRST_VARIANCE, FRAMES_TO_WAIT, LEAK, LEARN, LEARNT,
    LEAST_DEVIATION, LEAST_NOISE, LEAST_VARIANCE, MEMORY, MOST_DEPTH_M, MOST_VARIANCE, OWN_CHANGE, SUPPORT, TILE,
};
use super::state::Unpacked;
use super::tiles::Tile;
use crate::cpu::vector::{Mask, splat};

/// Number of rows of zeros above and below a plane.
pub(super) const MARGIN: usize = 2;
/// Number of columns of zeros on each side of a row; a multiple of every vector's lanes.
const SIDE: usize = 16;
/// Mean change below which an updated pixel is calm, in deviations.
const CALM: f32 = 3.0;
/// Value of a candidate in the plane of calm pixels; it outweighs the calm pixels in 5x5.
pub(super) const NOT_CALM: f32 = -100.0;

/// Parameters of both passes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rule {
    pub(super) domain: Domain,
    /// Standard deviation of depth: coefficients of 1, z and z².
    pub(super) sigma: [f32; 3],
    pub(super) most_frames: f32,
}

/// Data of a row in the first pass.
pub(super) struct ChangeRow<'a> {
    pub(super) depth_m: &'a [f32],
    pub(super) mean: &'a [f32],
    pub(super) frames_variance: &'a [u32],
    pub(super) bias_idle: &'a [u32],
    /// The change of each pixel in sigmas; NaN for holes and unknown pixels.
    pub(super) changes: &'a mut [f32],
    /// Sums of the clipped changes over five columns.
    pub(super) sums: &'a mut [f32],
    /// Numbers of pixels with a change over five columns.
    pub(super) counts: &'a mut [f32],
    /// Sums of the signs of candidates over three columns.
    pub(super) signs: &'a mut [f32],
}

/// Data of a row in the second pass.
pub(super) struct UpdateRow<'a> {
    pub(super) depth_m: &'a mut [f32],
    pub(super) mean: &'a mut [f32],
    pub(super) frames_variance: &'a mut [u32],
    pub(super) bias_idle: &'a mut [u32],
    pub(super) changes: &'a [f32],
    /// Sums of this row, of the two rows above and of the two rows below.
    pub(super) sums: [&'a [f32]; 5],
    /// Counts of the same five rows.
    pub(super) counts: [&'a [f32]; 5],
    /// Signs of this row, of the row above and of the row below.
    pub(super) signs: [&'a [f32]; 3],
    pub(super) tiles: &'a [Tile],
    /// 1 for a calm pixel, [`NOT_CALM`] for a candidate, 0 otherwise; `None` if holes do not keep their last values.
    pub(super) calm: Option<&'a mut [f32]>,
}

/// Buffers for the rows of a band of tiles.
#[derive(Debug, Clone)]
pub(super) struct RowBuffers {
    /// Clipped changes, with [`SIDE`] zeros on each side.
    clipped: Vec<f32>,
    /// 1 for each pixel with a change, with [`SIDE`] zeros on each side.
    counted: Vec<f32>,
    /// Signs of candidates, with [`SIDE`] zeros on each side.
    signs: Vec<f32>,
    /// Sums of the changes in each column over the rows of a band.
    column_sums: Vec<f32>,
    /// Numbers of changes in each column over the rows of a band.
    column_counts: Vec<f32>,
}

impl RowBuffers {
    pub(super) fn of_pitch(pitch: usize) -> Self {
        let [clipped, counted, signs] = [(); 3].map(|()| vec![0.0; pitch + 2 * SIDE]);
        let [column_sums, column_counts] = [(); 2].map(|()| vec![0.0; pitch]);
        Self { clipped, counted, signs, column_sums, column_counts }
    }

    /// Clears the column sums at the start of a band.
    pub(super) fn begin(&mut self) {
        self.column_sums.fill(0.0);
        self.column_counts.fill(0.0);
    }

    /// Writes the sum and the number of the changes of each tile of the band.
    pub(super) fn sum_tiles(&self, tiles: &mut [[f32; 2]]) {
        let columns = self.column_sums.chunks_exact(TILE).zip(self.column_counts.chunks_exact(TILE));
        for (tile, (sums, counts)) in tiles.iter_mut().zip(columns) {
            *tile = [sums.iter().sum(), counts.iter().sum()];
        }
    }
}

/// The averaged quantity and its standard deviation, for pixels with depth.
struct Measured<S: Simd> {
    valid: Mask<S>,
    value: S::f32s,
    noise: S::f32s,
}

impl Rule {
    #[inline(always)]
    fn measure<S: Simd>(&self, simd: S, depth_m: S::f32s) -> Measured<S> {
        let one = splat(simd, 1.0);
        let valid = depth_m.simd_gt(splat(simd, 0.0)) & depth_m.simd_lt(splat(simd, MOST_DEPTH_M));
        let z = valid.select(depth_m, one);
        let [c0, c1, c2] = self.sigma;
        let (value, noise) = match self.domain {
            Domain::InverseDepth => {
                let inverse = one / z;
                let noise = splat(simd, c0).mul_add(inverse, splat(simd, c1)).mul_add(inverse, splat(simd, c2));
                (inverse, noise)
            }
            Domain::Depth => (z, splat(simd, c2).mul_add(z, splat(simd, c1)).mul_add(z, splat(simd, c0))),
        };
        Measured { valid, value, noise: noise.max(value * splat(simd, LEAST_NOISE)) }
    }

    /// Returns true for measured depths, false for holes.
    #[inline(always)]
    pub(super) fn is_valid(&self, depth_m: f32) -> bool {
        depth_m > 0.0 && depth_m < MOST_DEPTH_M
    }

    /// Returns the averaged quantity and its standard deviation at one depth.
    #[inline(always)]
    pub(super) fn value(&self, depth_m: f32) -> (f32, f32) {
        let [c0, c1, c2] = self.sigma;
        let (value, noise) = match self.domain {
            Domain::InverseDepth => (1.0 / depth_m, (c0 / depth_m + c1) / depth_m + c2),
            Domain::Depth => (depth_m, (c2 * depth_m + c1) * depth_m + c0),
        };
        (value, noise.max(LEAST_NOISE * value))
    }
}

/// Returns the deviation for comparisons of single pixels, in sigmas.
#[inline(always)]
fn single_deviation<S: Simd>(simd: S, variance: S::f32s) -> S::f32s {
    variance.sqrt().max(splat(simd, LEAST_DEVIATION))
}

#[inline(always)]
fn fourth_power<S: Simd>(value: S::f32s) -> S::f32s {
    let square = value * value;
    square * square
}

/// Measures the changes of a row.
#[inline(always)]
pub(super) fn measure_changes<S: Simd>(simd: S, rule: Rule, row: ChangeRow<'_>, buffers: &mut RowBuffers) {
    let lanes = S::f32s::LEN;
    let pitch = row.depth_m.len();
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let RowBuffers { clipped, counted, signs, column_sums, column_counts } = buffers;
    let inner = SIDE..SIDE + pitch;
    // The vectors are iterated in lockstep, which avoids bounds checks.
    let inputs = row.depth_m.chunks_exact(lanes).zip(row.mean.chunks_exact(lanes));
    let inputs = inputs.zip(row.frames_variance.chunks_exact(lanes)).zip(row.bias_idle.chunks_exact(lanes));
    let outputs = row.changes.chunks_exact_mut(lanes).zip(clipped[inner.clone()].chunks_exact_mut(lanes));
    let outputs = outputs.zip(counted[inner.clone()].chunks_exact_mut(lanes));
    let outputs = outputs.zip(signs[inner].chunks_exact_mut(lanes));
    let columns = column_sums.chunks_exact_mut(lanes).zip(column_counts.chunks_exact_mut(lanes));
    for ((inputs, outputs), (column_sum, column_count)) in inputs.zip(outputs).zip(columns) {
        let (((depth_m, mean), frames_variance), bias_idle) = inputs;
        let (((changes, clipped), counted), signs) = outputs;
        let state = Unpacked::load(simd, mean, frames_variance, bias_idle);
        let measured = rule.measure(simd, S::f32s::from_slice(simd, depth_m));
        let is_both = measured.valid & state.frames.simd_gt(zero);
        let uncertainty = (one + one / state.frames.max(one)).sqrt();
        let change = (measured.value - state.mean) / (measured.noise * uncertainty);
        let limit = splat(simd, CANDIDATE) * single_deviation(simd, state.variance);
        let is_candidate = is_both & change.abs().simd_gt(limit);
        is_both.select(change, splat(simd, f32::NAN)).store_slice(changes);
        let clip = splat(simd, CLIP);
        is_both.select(change.max(-clip).min(clip), zero).store_slice(clipped);
        is_both.select(one, zero).store_slice(counted);
        let sign = change.simd_lt(zero).select(-one, one);
        is_candidate.select(sign, zero).store_slice(signs);
        let is_update = is_both & !is_candidate;
        let clip = splat(simd, CLIP_OF_TILE);
        let change = is_update.select(change.max(-clip).min(clip), zero);
        (S::f32s::from_slice(simd, column_sum) + change).store_slice(column_sum);
        (S::f32s::from_slice(simd, column_count) + is_update.select(one, zero)).store_slice(column_count);
    }
    sum_neighbours(simd, clipped, row.sums, 2);
    sum_neighbours(simd, counted, row.counts, 2);
    sum_neighbours(simd, signs, row.signs, 1);
}

/// Sums the values of each column and of its neighbours up to `reach` columns away; `reach` is 1 or 2.
#[inline(always)]
fn sum_neighbours<S: Simd>(simd: S, values: &[f32], sums: &mut [f32], reach: usize) {
    let (lanes, pitch) = (S::f32s::LEN, sums.len());
    let from = |shift: usize| values[SIDE + shift - 2..SIDE + shift - 2 + pitch].chunks_exact(lanes);
    let three = from(1).zip(from(2)).zip(from(3));
    let outer = from(0).zip(from(4));
    for ((sums, ((left, middle), right)), (first, last)) in sums.chunks_exact_mut(lanes).zip(three).zip(outer) {
        let load = |values: &[f32]| S::f32s::from_slice(simd, values);
        let sum = match reach {
            1 => load(left) + load(middle) + load(right),
            _ => ((load(first) + load(left)) + (load(middle) + load(right))) + load(last),
        };
        sum.store_slice(sums);
    }
}

/// The vectors of five rows at the same columns.
type Five<T> = (((T, T), (T, T)), T);

/// Iterates over the vectors of five rows in lockstep.
#[inline(always)]
fn five_rows(rows: [&[f32]; 5], lanes: usize) -> impl Iterator<Item = Five<&[f32]>> {
    let [a, b, c, d, e] = rows.map(|row| row.chunks_exact(lanes));
    a.zip(b).zip(d.zip(e)).zip(c)
}

#[inline(always)]
fn sum_of_five<S: Simd>(simd: S, (((a, b), (d, e)), c): Five<&[f32]>) -> S::f32s {
    let load = |values: &[f32]| S::f32s::from_slice(simd, values);
    ((load(a) + load(b)) + (load(d) + load(e))) + load(c)
}

/// Updates the state of a row, and replaces its depths.
#[inline(always)]
pub(super) fn update<S: Simd>(simd: S, rule: Rule, row: UpdateRow<'_>) {
    let lanes = S::f32s::LEN;
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let UpdateRow { depth_m, mean, frames_variance, bias_idle, changes, sums, counts, signs, tiles, mut calm } = row;
    // The vectors are iterated in lockstep, which avoids bounds checks.
    let [above, own, below] = signs.map(|row| row.chunks_exact(lanes));
    let around = five_rows(sums, lanes).zip(five_rows(counts, lanes)).zip(above.zip(own).zip(below));
    let state = mean.chunks_exact_mut(lanes).zip(frames_variance.chunks_exact_mut(lanes));
    let state = state.zip(bias_idle.chunks_exact_mut(lanes));
    let own = depth_m.chunks_exact_mut(lanes).zip(changes.chunks_exact(lanes));
    for (vector, ((state, (depths_m, change)), around)) in state.zip(own).zip(around).enumerate() {
        let load = |values: &[f32]| S::f32s::from_slice(simd, values);
        let ((sums, counts), ((above, own), below)) = around;
        let ((means, frames_variance), bias_idle) = state;
        let old = Unpacked::load(simd, means, frames_variance, bias_idle);
        let depth_m = load(depths_m);
        let measured = rule.measure(simd, depth_m);
        let change = load(change);
        let is_both: Mask<S> = change.simd_eq(change);
        let change = is_both.select(change, zero);
        let mean_change = sum_of_five(simd, sums) / sum_of_five(simd, counts).max(one);
        let deviation = old.variance.sqrt();
        let single = single_deviation(simd, old.variance);
        let is_candidate = is_both & change.abs().simd_gt(splat(simd, CANDIDATE) * single);
        let sign = change.simd_lt(zero).select(-one, one);
        let is_supported: Mask<S> = (sign * (load(above) + load(own) + load(below))).simd_ge(splat(simd, SUPPORT));
        let may_wait = old.idle.simd_lt(one) & old.frames.simd_ge(splat(simd, FRAMES_TO_WAIT));
        let is_large: Mask<S> = change.abs().simd_gt(splat(simd, AT_ONCE) * single);
        let waits = is_candidate & !(is_supported & is_large) & may_wait;
        let is_reset = is_candidate & !waits;
        let is_update = is_both & !is_candidate;
        // For updates: earlier frames count less where the surroundings or the pixel itself changed.
        let from_bias = (mean_change - old.bias).abs().min(splat(simd, 3.0) * deviation);
        let bias = old.bias + splat(simd, LEAK) * (mean_change - old.bias);
        let by_change = fourth_power::<S>(mean_change / (splat(simd, CHANGE) * deviation));
        let by_bias = fourth_power::<S>(bias / (splat(simd, BIAS) * deviation));
        let by_own = fourth_power::<S>(change / (splat(simd, OWN_CHANGE) * single));
        let tile = splat(simd, tiles[vector * lanes / TILE].weight);
        let weight = tile / ((one + by_change + by_bias) * (one + by_own));
        let frames = old.frames.mul_add(weight, one).min(splat(simd, rule.most_frames));
        let mean = old.mean + (measured.value - old.mean) / frames;
        let learnt = splat(simd, LEARNT) * from_bias * from_bias - old.variance;
        let share = old.frames * splat(simd, LEARN / rule.most_frames);
        let variance = share.mul_add(learnt, old.variance);
        let variance = variance.max(splat(simd, LEAST_VARIANCE)).min(splat(simd, MOST_VARIANCE));
        // A pixel that was not known, or shows a new surface, starts again.
        let is_new = (measured.valid & !is_both) | is_reset;
        let is_seen = is_update | is_new;
        let idle = is_seen.select(zero, old.idle + one);
        let is_forgotten: Mask<S> = idle.simd_gt(splat(simd, MEMORY));
        let frames = is_update.select(frames, is_new.select(one, is_forgotten.select(zero, old.frames)));
        let new = Unpacked {
            mean: is_update.select(mean, is_new.select(measured.value, old.mean)),
            frames,
            variance: is_update
                .select(variance, is_reset.select(old.variance.min(splat(simd, FIRST_VARIANCE)), old.variance)),
            bias: is_update.select(bias, is_new.select(zero, old.bias)),
            idle: is_forgotten.select(zero, idle),
        };
        let carried = Unpacked::<S>::carried_bit(simd);
        let carried = waits.select(carried, S::u32s::splat(simd, 0));
        let filtered = match rule.domain {
            Domain::InverseDepth => one / new.mean,
            Domain::Depth => new.mean,
        };
        let nan = splat(simd, f32::NAN);
        (is_update | waits).select(filtered, is_new.select(depth_m, nan)).store_slice(depths_m);
        if let Some(calm) = &mut calm {
            let is_calm = is_update & mean_change.abs().simd_lt(splat(simd, CALM) * deviation);
            let calm = &mut calm[vector * lanes..(vector + 1) * lanes];
            is_candidate.select(splat(simd, NOT_CALM), is_calm.select(one, zero)).store_slice(calm);
        }
        new.store(simd, carried, means, frames_variance, bias_idle);
    }
}
