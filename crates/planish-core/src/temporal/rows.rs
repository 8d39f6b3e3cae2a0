//! The two passes of the filter over rows of pixels, a vector of them at a time.
//!
//! The first pass measures how each pixel changed; the second takes the changes of the pixels around into account and
//! updates the state. Planes have rows of `pitch` pixels, a multiple of [`TILE`], and two rows of zeros on either side.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask};

use super::Domain;
use super::state::{FIRST_VARIANCE, Unpacked};
use super::tiles::{TILE, Tile};
use crate::cpu::vector::{Mask, splat};

/// Rows around a plane.
pub(super) const MARGIN: usize = 2;
/// Columns around a row; a multiple of every vector's lanes.
const SIDE: usize = 16;
/// Beyond this, the inverse of depth leaves f32.
const MOST_DEPTH_M: f32 = 1e18;
/// Noise below this share of a value is below what f32 resolves.
const LEAST_NOISE: f32 = 1e-6;
/// Changes are limited to this many sigmas in means over 5x5 pixels, and over tiles.
const CLIP: f32 = 8.0;
const CLIP_OF_TILE: f32 = 4.0;
/// A pixel whose change exceeds this many deviations may show a new surface.
const CANDIDATE: f32 = 4.0;
/// Deviations are at least this when single pixels are compared, in sigmas.
const LEAST_DEVIATION: f32 = 0.7;
/// A supported candidate whose change exceeds this many deviations is a new surface at once. Real noise exceeds
/// [`CANDIDATE`] now and then, for one frame.
const AT_ONCE: f32 = 5.0;
/// A candidate with this much support in 3x3 pixels, itself included, is a new surface at once.
const SUPPORT: f32 = 3.0;
/// Frames that a pixel must have for a single change to wait.
const FRAMES_TO_WAIT: f32 = 3.0;
/// Deviations of the mean change, of its bias, and of the own change, that halve a pixel's frames.
const CHANGE: f32 = 2.5;
const BIAS: f32 = 1.2;
const OWN_CHANGE: f32 = 6.0;
/// Share by which the bias follows the mean change.
const LEAK: f32 = 0.25;
/// Share by which the variance follows, of a pixel of the most frames.
const LEARN: f32 = 1.0 / 16.0;
const LEAST_VARIANCE: f32 = 0.04;
const MOST_VARIANCE: f32 = 2.25;
/// Frames for which a hole's state is kept.
const MEMORY: f32 = 8.0;
/// A calm neighbour of a hole differs by less than this many deviations.
const CALM: f32 = 3.0;
/// Outweighs all calm pixels of 5x5.
pub(super) const NOT_CALM: f32 = -100.0;

/// What both passes know.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rule {
    pub(super) domain: Domain,
    /// Standard deviation of depth: coefficients of 1, z and z².
    pub(super) sigma: [f32; 3],
    pub(super) most_frames: f32,
}

/// A row of the first pass.
pub(super) struct ChangeRow<'a> {
    pub(super) depth_m: &'a [f32],
    pub(super) mean: &'a [f32],
    pub(super) frames_variance: &'a [u32],
    pub(super) bias_idle: &'a [u32],
    /// The change of each pixel in sigmas; NaN without one.
    pub(super) changes: &'a mut [f32],
    /// Sums over five columns of the clipped changes, and of their number; sums over three columns of the signs of
    /// candidates.
    pub(super) sums: &'a mut [f32],
    pub(super) counts: &'a mut [f32],
    pub(super) signs: &'a mut [f32],
    /// Sums of the changes of each tile, and their number, which this row adds to.
    pub(super) tiles: &'a mut [[f32; 2]],
}

/// A row of the second pass.
pub(super) struct UpdateRow<'a> {
    pub(super) depth_m: &'a mut [f32],
    pub(super) mean: &'a mut [f32],
    pub(super) frames_variance: &'a mut [u32],
    pub(super) bias_idle: &'a mut [u32],
    pub(super) changes: &'a [f32],
    /// The row in question and those around it.
    pub(super) sums: [&'a [f32]; 5],
    pub(super) counts: [&'a [f32]; 5],
    pub(super) signs: [&'a [f32]; 3],
    pub(super) tiles: &'a [Tile],
    /// 1 for a calm pixel, [`NOT_CALM`] for a candidate.
    pub(super) calm: &'a mut [f32],
}

/// Buffers of a row with zeros on both sides.
#[derive(Debug, Clone)]
pub(super) struct RowBuffers {
    clipped: Vec<f32>,
    counted: Vec<f32>,
    signs: Vec<f32>,
}

impl RowBuffers {
    pub(super) fn of_pitch(pitch: usize) -> Self {
        let [clipped, counted, signs] = [(); 3].map(|()| vec![0.0; pitch + 2 * SIDE]);
        Self { clipped, counted, signs }
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

    /// Returns false for holes.
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

/// Returns the deviation with which single pixels are compared.
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
    let RowBuffers { clipped, counted, signs } = buffers;
    for u in (0..pitch).step_by(lanes) {
        let at = u..u + lanes;
        let state =
            Unpacked::load(simd, &row.mean[at.clone()], &row.frames_variance[at.clone()], &row.bias_idle[at.clone()]);
        let measured = rule.measure(simd, S::f32s::from_slice(simd, &row.depth_m[at.clone()]));
        let is_both = measured.valid & state.frames.simd_gt(zero);
        let uncertainty = (one + one / state.frames.max(one)).sqrt();
        let change = (measured.value - state.mean) / (measured.noise * uncertainty);
        let limit = splat(simd, CANDIDATE) * single_deviation(simd, state.variance);
        let is_candidate = is_both & change.abs().simd_gt(limit);
        is_both.select(change, splat(simd, f32::NAN)).store_slice(&mut row.changes[at.clone()]);
        let clip = splat(simd, CLIP);
        let padded = SIDE + u..SIDE + u + lanes;
        is_both.select(change.max(-clip).min(clip), zero).store_slice(&mut clipped[padded.clone()]);
        is_both.select(one, zero).store_slice(&mut counted[padded.clone()]);
        let sign = change.simd_lt(zero).select(-one, one);
        is_candidate.select(sign, zero).store_slice(&mut signs[padded]);
        let is_update = is_both & !is_candidate;
        let clip = splat(simd, CLIP_OF_TILE);
        let [sum, count] = &mut row.tiles[u / TILE];
        for value in is_update.select(change.max(-clip).min(clip), zero).as_slice() {
            *sum += value;
        }
        *count += is_update.to_bitmask().count_ones() as f32;
    }
    for u in (0..pitch).step_by(lanes) {
        let at = u..u + lanes;
        sum_of_five(simd, clipped, SIDE + u).store_slice(&mut row.sums[at.clone()]);
        sum_of_five(simd, counted, SIDE + u).store_slice(&mut row.counts[at.clone()]);
        let load = |from: usize| S::f32s::from_slice(simd, &signs[from..from + lanes]);
        let three = load(SIDE + u - 1) + load(SIDE + u) + load(SIDE + u + 1);
        three.store_slice(&mut row.signs[at]);
    }
}

/// Returns the sums of the values up to two columns away.
#[inline(always)]
fn sum_of_five<S: Simd>(simd: S, values: &[f32], at: usize) -> S::f32s {
    let load = |from: usize| S::f32s::from_slice(simd, &values[from..from + S::f32s::LEN]);
    ((load(at - 2) + load(at - 1)) + (load(at) + load(at + 1))) + load(at + 2)
}

/// Updates the state of a row, and replaces its depths.
#[inline(always)]
pub(super) fn update<S: Simd>(simd: S, rule: Rule, row: UpdateRow<'_>) {
    let lanes = S::f32s::LEN;
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    for u in (0..row.changes.len()).step_by(lanes) {
        let at = u..u + lanes;
        let load = |values: &[f32]| S::f32s::from_slice(simd, &values[u..u + lanes]);
        let old =
            Unpacked::load(simd, &row.mean[at.clone()], &row.frames_variance[at.clone()], &row.bias_idle[at.clone()]);
        let depth_m = load(row.depth_m);
        let measured = rule.measure(simd, depth_m);
        let change = load(row.changes);
        let is_both: Mask<S> = change.simd_eq(change);
        let change = is_both.select(change, zero);
        let [a, b, c, d, e] = row.counts;
        let count = ((load(a) + load(b)) + (load(d) + load(e))) + load(c);
        let [a, b, c, d, e] = row.sums;
        let mean_change = (((load(a) + load(b)) + (load(d) + load(e))) + load(c)) / count.max(one);
        let deviation = old.variance.sqrt();
        let single = single_deviation(simd, old.variance);
        let is_candidate = is_both & change.abs().simd_gt(splat(simd, CANDIDATE) * single);
        let [a, b, c] = row.signs;
        let sign = change.simd_lt(zero).select(-one, one);
        let is_supported: Mask<S> = (sign * (load(a) + load(b) + load(c))).simd_ge(splat(simd, SUPPORT));
        let may_wait = old.idle.simd_lt(one) & old.frames.simd_ge(splat(simd, FRAMES_TO_WAIT));
        let is_large: Mask<S> = change.abs().simd_gt(splat(simd, AT_ONCE) * single);
        let waits = is_candidate & !(is_supported & is_large) & may_wait;
        let is_reset = is_candidate & !waits;
        let is_update = is_both & !is_candidate;
        // An update: frames fade where the surroundings or the pixel itself changed.
        let from_bias = (mean_change - old.bias).abs().min(splat(simd, 3.0) * deviation);
        let bias = old.bias + splat(simd, LEAK) * (mean_change - old.bias);
        let by_change = fourth_power::<S>(mean_change / (splat(simd, CHANGE) * deviation));
        let by_bias = fourth_power::<S>(bias / (splat(simd, BIAS) * deviation));
        let by_own = fourth_power::<S>(change / (splat(simd, OWN_CHANGE) * single));
        let tile = splat(simd, row.tiles[u / TILE].weight);
        let weight = tile / ((one + by_change + by_bias) * (one + by_own));
        let frames = old.frames.mul_add(weight, one).min(splat(simd, rule.most_frames));
        let mean = old.mean + (measured.value - old.mean) / frames;
        let learnt = splat(simd, 0.875) * from_bias * from_bias - old.variance;
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
        (is_update | waits).select(filtered, is_new.select(depth_m, nan)).store_slice(&mut row.depth_m[at.clone()]);
        let is_calm = is_update & mean_change.abs().simd_lt(splat(simd, CALM) * deviation);
        is_candidate.select(splat(simd, NOT_CALM), is_calm.select(one, zero)).store_slice(&mut row.calm[at.clone()]);
        new.store(
            simd,
            carried,
            &mut row.mean[at.clone()],
            &mut row.frames_variance[at.clone()],
            &mut row.bias_idle[at],
        );
    }
}
