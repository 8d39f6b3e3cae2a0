//! Estimation of a sensor model from one frame of the sensor.

use super::{NOISE_IN_STEPS, SensorModel};
use crate::cloud::OrganizedCloud;
use crate::frame::{Frame, PointsView, RangeRule};

/// Distance in pixels between the three depths of a second difference: far enough that noise is hardly correlated,
/// near enough that most surfaces are straight.
const LAG_PX: usize = 4;
/// Quantile of the second differences above which they are attributed to edges.
const STRAIGHT_SHARE: f64 = 0.75;
/// Mean of the second differences below [`STRAIGHT_SHARE`] for independent normal noise, in standard deviations of
/// the noise: 0.515 sqrt(6). (Their median would jump from one whole depth step to the next.)
const MEAN_DEVIATIONS: f64 = 1.262;
/// Minimum number of second differences in a frame, and in each interval of ranges.
const MIN_SAMPLES: usize = 1000;
/// Ratio of the bounds of an interval of ranges.
const INTERVAL_RATIO: f64 = 1.25;
/// Minimum ratio of the farthest to the nearest range that a polynomial needs. `c2 z²` alone has no minimum; three
/// coefficients need the square of this ratio.
const RATIO_PER_COEFFICIENT: f64 = 1.8;
/// Maximum ratio of the squared relative residuals at which a polynomial with more coefficients is preferred.
const WORTHWHILE: f64 = 0.5;
/// Maximum value of each coefficient of a sensor's noise, in metres at a range of 1 m.
const MAX_SIGMA_M: f64 = 0.1;
/// Maximum value of each coefficient of a sensor's depth step, in metres at a range of 1 m.
const MAX_STEP_M: f64 = 0.2;

/// Measurements in one interval of ranges.
struct Interval {
    range_m: f64,
    value_m: f64,
    weight: f64,
}

impl SensorModel {
    /// Estimates the model from a frame: the step from the gaps between distinct ranges, the noise from the
    /// deviations of ranges in a row from a straight line. `None` if the frame has too few ranges, or they are
    /// unknown.
    ///
    /// Step and noise are robust averages, computed in intervals of the range. The number of coefficients depends on
    /// the spread of ranges: a single surface at 1 m cannot show how noise grows with range, and gets the z² law. In
    /// a scene of foliage, texture is mistaken for noise.
    pub fn estimate(cloud: &OrganizedCloud) -> Option<Self> {
        Self::estimate_from(Frame::Points(PointsView::from_organized(cloud).ok()?))
    }

    /// Same as [`estimate`](Self::estimate), for a borrowed frame, of which only the ranges are copied.
    pub fn estimate_from(frame: Frame<'_>) -> Option<Self> {
        let (width, _) = frame.grid()?;
        let ranges = match frame {
            Frame::Points(view) if matches!(view.range_rule(), RangeRule::Constant { .. }) => return None,
            Frame::Points(view) => view.ranges_m(),
            Frame::Depth(depth) => {
                let (width, height) = frame.shape();
                let depth_m = |i: usize| f64::from(depth.depth_m(i % width, i / width));
                (0..width * height).map(depth_m).collect()
            }
        };
        Self::estimate_ranges(ranges, width)
    }

    fn estimate_ranges(ranges: Vec<f64>, width: usize) -> Option<Self> {
        let mut bends: Vec<(f64, f64)> = Vec::new();
        for row in ranges.chunks_exact(width) {
            for u in LAG_PX..row.len().saturating_sub(LAG_PX) {
                let [before, at, behind] = [row[u - LAG_PX], row[u], row[u + LAG_PX]];
                let bend = (before - 2.0 * at + behind).abs();
                if bend.is_finite() && at > 0.0 {
                    bends.push((at, bend / MEAN_DEVIATIONS));
                }
            }
        }
        if bends.len() < MIN_SAMPLES {
            return None;
        }
        let mut sorted: Vec<f64> = ranges.into_iter().filter(|range| *range > 0.0 && range.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        sorted.dedup();
        let gaps: Vec<(f64, f64)> = sorted.windows(2).map(|pair| (pair[0], pair[1] - pair[0])).collect();

        let sigma = fit(&intervals(&bends, MIN_SAMPLES, lower_mean), MAX_SIGMA_M)?;
        // Exact depths are nearly all distinct: the gaps between them are tiny, and are not depth steps.
        let step = fit(&intervals(&gaps, MIN_SAMPLES / 50, median), MAX_STEP_M).unwrap_or_default();
        // Rounding to the step is noise too, and the radius must exceed the noise.
        let rounding = step.map(|c| c / 12f64.sqrt());
        let sigma = larger(sigma, rounding, &bends);
        let step = larger(step, sigma.map(|c| c / NOISE_IN_STEPS), &bends);
        Some(Self::new(step.map(|c| c.min(1.0) as f32), sigma.map(|c| c.min(1.0) as f32)))
    }
}

/// Returns the polynomial that is larger at the median range of the samples.
fn larger(a: [f64; 3], b: [f64; 3], samples: &[(f64, f64)]) -> [f64; 3] {
    let range_m = median(&mut samples.iter().map(|&(range_m, _)| range_m).collect::<Vec<_>>());
    let at = |[c0, c1, c2]: [f64; 3]| c0 + range_m * (c1 + range_m * c2);
    if at(a) >= at(b) { a } else { b }
}

/// Returns the typical value in each interval of the range with enough samples; the typical value of all samples if
/// no interval has enough.
fn intervals(samples: &[(f64, f64)], min_samples: usize, typical: fn(&mut [f64]) -> f64) -> Vec<Interval> {
    let mut by_interval: std::collections::BTreeMap<i32, Vec<(f64, f64)>> = Default::default();
    for &(range_m, value_m) in samples {
        by_interval.entry((range_m.ln() / INTERVAL_RATIO.ln()).floor() as i32).or_default().push((range_m, value_m));
    }
    let measure = |samples: &[(f64, f64)]| {
        let range_m = median(&mut samples.iter().map(|&(range_m, _)| range_m).collect::<Vec<_>>());
        // Values are divided by the squared range, so that all ranges within the interval have the same weight.
        let shares = samples.iter().map(|&(range_m, value_m)| value_m / (range_m * range_m));
        let share = typical(&mut shares.collect::<Vec<_>>());
        Interval { range_m, value_m: share * range_m * range_m, weight: (samples.len() as f64).sqrt() }
    };
    let enough = |samples: &&Vec<(f64, f64)>| samples.len() >= min_samples;
    let found: Vec<Interval> = by_interval.values().filter(enough).map(|samples| measure(samples)).collect();
    if found.is_empty() && !samples.is_empty() { vec![measure(samples)] } else { found }
}

/// Returns the polynomial with the fewest coefficients that fits the intervals; no coefficient is negative. It tries c2
/// alone, c1 alone, c0 alone, pairs, and all three.
fn fit(intervals: &[Interval], max_at_1m: f64) -> Option<[f64; 3]> {
    let nearest = intervals.iter().map(|i| i.range_m).fold(f64::INFINITY, f64::min);
    let farthest = intervals.iter().map(|i| i.range_m).fold(0.0, f64::max);
    let mut best: Option<([f64; 3], f64)> = None;
    for powers in [&[2][..], &[1], &[0], &[0, 2], &[0, 1], &[1, 2], &[0, 1, 2]] {
        let needs = RATIO_PER_COEFFICIENT.powi(powers.len() as i32 - 1);
        let spread_suffices = farthest >= needs * nearest && intervals.len() > powers.len();
        // Without enough spread, the law of triangulation is used.
        if powers != [2] && !(spread_suffices && farthest >= RATIO_PER_COEFFICIENT * nearest) {
            continue;
        }
        let Some((coefficients, residual)) = least_squares(intervals, powers) else { continue };
        let bound = |residual: f64| if powers.len() > 1 { WORTHWHILE * residual } else { 0.8 * residual };
        if best.is_none_or(|(_, least)| residual < bound(least)) {
            best = Some((coefficients, residual));
        }
    }
    let (coefficients, _) = best?;
    // A frame of one wall at one depth has almost no gaps, and a frame of noise has few distinct depths. Bounds on the
    // coefficients keep both estimates usable.
    Some(coefficients.map(|c| c.min(max_at_1m)))
}

/// Fits the monomials z^powers by least squares of relative residuals. Returns the coefficients and the residual;
/// `None` if a coefficient is negative or undetermined.
fn least_squares(intervals: &[Interval], powers: &[i32]) -> Option<([f64; 3], f64)> {
    let n = powers.len();
    let mut matrix = vec![vec![0.0; n + 1]; n];
    let scaled: Vec<(Vec<f64>, f64)> = intervals
        .iter()
        .filter(|interval| interval.value_m > 0.0)
        .map(|i| (powers.iter().map(|&power| i.range_m.powi(power) / i.value_m).collect(), i.weight))
        .collect();
    if scaled.is_empty() {
        // All values are zero, so the polynomial is zero.
        return Some(([0.0; 3], 0.0));
    }
    for (terms, weight) in &scaled {
        for row in 0..n {
            for column in 0..n {
                matrix[row][column] += weight * terms[row] * terms[column];
            }
            matrix[row][n] += weight * terms[row];
        }
    }
    for pivot in 0..n {
        if matrix[pivot][pivot].abs() < 1e-12 {
            return None;
        }
        for row in (0..n).filter(|&row| row != pivot) {
            let factor = matrix[row][pivot] / matrix[pivot][pivot];
            let of_pivot = matrix[pivot].clone();
            matrix[row].iter_mut().zip(of_pivot).for_each(|(value, above)| *value -= factor * above);
        }
    }
    let solution: Vec<f64> = (0..n).map(|row| matrix[row][n] / matrix[row][row]).collect();
    if !solution.iter().all(|c| *c >= 0.0) {
        return None;
    }
    let residual = |(terms, weight): &(Vec<f64>, f64)| {
        let fitted: f64 = terms.iter().zip(&solution).map(|(term, c)| term * c).sum();
        weight * (fitted - 1.0).powi(2)
    };
    let residual = scaled.iter().map(residual).sum();
    let mut coefficients = [0.0; 3];
    for (&power, &c) in powers.iter().zip(&solution) {
        coefficients[power as usize] = c;
    }
    Some((coefficients, residual))
}

/// Returns the mean of the values up to the quantile [`STRAIGHT_SHARE`].
fn lower_mean(values: &mut [f64]) -> f64 {
    let count = ((values.len() as f64 * STRAIGHT_SHARE) as usize).clamp(1, values.len());
    let (lower, last, _) = values.select_nth_unstable_by(count - 1, f64::total_cmp);
    (lower.iter().sum::<f64>() + *last) / count as f64
}

pub(super) fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::testing::{DepthNoise, Random, Scene, simulated};
    use crate::xyz::Xyz;

    fn estimate(noise: DepthNoise, seed: u64) -> SensorModel {
        let frame = simulated(Scene::room(seed), noise, Camera::kinect_v1(), seed);
        SensorModel::estimate(&frame.deproject().unwrap()).unwrap()
    }

    #[test]
    fn a_simulated_kinect_is_found_to_be_one_and_a_perfect_camera_to_be_perfect() {
        for seed in 1..4 {
            let found = estimate(DepthNoise::default(), seed);
            let kinect = SensorModel::KINECT_V1;
            for range_m in [1.5, 2.5, 3.5] {
                assert!((0.7..1.5).contains(&(found.step_m(range_m) / kinect.step_m(range_m))), "{seed} {found:?}");
                assert!((0.6..1.5).contains(&(found.sigma_m(range_m) / kinect.sigma_m(range_m))), "{seed} {found:?}");
            }
            let perfect = estimate(DepthNoise::NONE, seed);
            // Its depths are rounded to millimetres.
            assert!(perfect.sigma_m(1.0) < 3e-4, "{perfect:?}");
        }
        let nothing = OrganizedCloud::from_positions(4, 4, Xyz::filled(16, f32::NAN)).unwrap();
        assert_eq!(SensorModel::estimate(&nothing), None);
    }

    /// Returns slanted walls at 0.7 to 6 m, with independent noise of a sensor model.
    fn slanted_walls(sigma: [f32; 3]) -> OrganizedCloud {
        let camera = Camera::kinect_v1();
        let model = SensorModel::from_noise(sigma);
        let mut random = Random::new(3, 0);
        let depth_m = (0..640 * 480).map(|i| {
            let z = 0.7 + 5.3 * (f64::from(i / 640) / 480.0).powi(2);
            (z + model.sigma_m(z) * random.normal()) as f32
        });
        OrganizedCloud::from_positions(640, 480, camera.deproject_m(depth_m)).unwrap()
    }

    #[test]
    fn floors_and_linear_growth_are_told_from_the_law_of_triangulation() {
        for sigma in [[4e-3, 0.0, 0.0], [0.0, 2.5e-3, 0.0], [0.0, 0.0, 2e-3], [3e-3, 0.0, 1e-3]] {
            let model = SensorModel::from_noise(sigma);
            let found = SensorModel::estimate(&slanted_walls(sigma)).unwrap();
            for range_m in [0.9, 2.0, 5.0] {
                let ratio = found.sigma_m(range_m) / model.sigma_m(range_m);
                assert!((0.85..1.15).contains(&ratio), "{sigma:?} at {range_m} m: {ratio}, {found:?}");
            }
        }
    }
}
