//! Finds radii from the density of the points (docs/method.md, section 8).

use fearless_simd::{Level, Select, Simd, SimdBase, SimdFloat, SimdMask, dispatch};

use super::super::polynomial_in_range;
use super::super::row_tasks::SplitRows;
use super::super::sensor::Sensor;
use super::super::vector::{Mask, Vec3, splat};
use super::gather::{Gathered, Reach, load};
use crate::neighbours::{LEAF, PointIndex};
use crate::range::{DENSITIES_IN_CLOUD, MAX_RANGE_M, RangeRules, WINDOWS_IN_CLOUD};

/// First trial reach, in radii of the previous vector of points.
const FIRST_REACH: f32 = 1.2;
/// Factor between successive trial reaches.
const NEXT_REACH: f32 = 1.5;
/// Maximum number of trial reaches before the remaining lanes are solved one by one.
const TRIES: usize = 4;
/// Maximum number of Newton steps; five to eight usually suffice.
const MOST_STEPS: usize = 50;

/// The radii of the points of some leaves.
pub(super) struct RadiusRows<'a> {
    pub(super) first: usize,
    pub(super) radii: &'a mut [f32],
}

impl SplitRows for RadiusRows<'_> {
    fn count(&self) -> usize {
        self.radii.len() / LEAF
    }

    fn split_at(self, leaves: usize) -> (Self, Self) {
        let (radii, rest) = self.radii.split_at_mut(LEAF * leaves);
        (Self { first: self.first, radii }, Self { first: self.first + leaves, radii: rest })
    }
}

/// Target density of a radius.
#[derive(Clone, Copy)]
pub(super) struct Density {
    /// Half the number of neighbours that evenly spread points would have within the radius.
    pub(super) half: f32,
    /// Maximum radius, in metres.
    pub(super) largest_m: f32,
    /// Minimum radius by range; `None` if the sensor is unknown.
    pub(super) least: Option<LeastRadius>,
}

/// The minimum radius of points by their range.
#[derive(Clone, Copy)]
pub(super) struct LeastRadius {
    pub(super) sensor: Sensor,
    pub(super) rules: RangeRules,
}

impl LeastRadius {
    /// Returns radii by density, raised to the radii by range within bounds.
    #[inline(always)]
    fn raise<S: Simd>(&self, simd: S, p: Vec3<S>, radius: S::f32s) -> S::f32s {
        let ray = self.sensor.ray(simd, p);
        let range = ray.dot(ray).sqrt().min(splat(simd, MAX_RANGE_M));
        let window = range * splat(simd, self.rules.linear);
        let steps = polynomial_in_range(simd, self.rules.radius, range);
        let ranged = steps.max(window).min(window * splat(simd, WINDOWS_IN_CLOUD));
        radius.max(ranged.min(radius * splat(simd, DENSITIES_IN_CLOUD)))
    }
}

/// Finds the radius of every point of the leaves.
#[inline(never)]
pub(super) fn solve(level: Level, index: &PointIndex, density: Density, rows: &mut RadiusRows<'_>) {
    dispatch!(level, simd => solve_rows(simd, index, density, rows));
}

#[inline(always)]
fn solve_rows<S: Simd>(simd: S, index: &PointIndex, density: Density, rows: &mut RadiusRows<'_>) {
    let mut gathered = Gathered::default();
    let mut squares = Vec::new();
    let mut last_m = None;
    let (nan, zero) = (splat(simd, f32::NAN), splat(simd, 0.0));
    for at in (0..rows.radii.len()).step_by(S::f32s::LEN) {
        let place = LEAF * rows.first + at;
        let p = load(simd, index, place);
        let valid: Mask<S> = p.x.simd_eq(p.x);
        if !valid.any_true() {
            break;
        }
        let near_m = last_m.unwrap_or_else(|| reach_m(index, density, index.point(place)));
        let mut reach = splat(simd, (FIRST_REACH * near_m).min(density.largest_m));
        let mut radius = nan;
        // Lanes that have no radius yet; the other lanes gather no more candidates.
        let mut missing = valid;
        for _ in 0..TRIES {
            gathered.fill(simd, index, p, Reach { outer: missing.select(reach, nan), inner: zero });
            let guess = splat(simd, near_m).min(reach);
            radius = missing.select(radii_within(simd, &gathered, p, [guess, reach], density, &mut squares), radius);
            missing &= radius.simd_ne(radius);
            if !missing.any_true() {
                break;
            }
            reach *= splat(simd, NEXT_REACH);
        }
        // If the trial reaches were too small, solve the remaining lanes one by one.
        if missing.any_true() {
            let mut lanes = [f32::NAN; LEAF];
            lanes[..S::f32s::LEN].copy_from_slice(radius.as_slice());
            for lane in (0..S::f32s::LEN).filter(|&lane| place + lane < index.len()) {
                if lanes[lane].is_nan() {
                    let reach = reach_m(index, density, index.point(place + lane));
                    let mut reaches = [f32::NAN; LEAF];
                    reaches[lane] = reach;
                    let outer = S::f32s::from_slice(simd, &reaches[..S::f32s::LEN]);
                    gathered.fill(simd, index, p, Reach { outer, inner: zero });
                    let alone = radii_within(simd, &gathered, p, [splat(simd, reach); 2], density, &mut squares);
                    let radius_m = alone.as_slice()[lane];
                    lanes[lane] = if radius_m.is_nan() { density.largest_m } else { radius_m };
                }
            }
            radius = S::f32s::from_slice(simd, &lanes[..S::f32s::LEN]);
        }
        let radius = radius.min(splat(simd, density.largest_m));
        let wide = density.least.map_or(radius, |least| least.raise(simd, p, radius));
        wide.min(splat(simd, density.largest_m)).store_slice(&mut rows.radii[at..at + S::f32s::LEN]);
        let lanes = &radius.as_slice()[..S::f32s::LEN.min(index.len() - place)];
        // Ignore lanes with much larger radii than the smallest: they are a poor estimate for the next vector.
        let least = lanes.iter().copied().fold(f32::INFINITY, f32::min);
        let ordinary = lanes.iter().copied().filter(|radius| *radius <= 2.0 * least);
        last_m = Some(ordinary.fold(least, f32::max));
    }
}

/// Returns the distance within which to gather candidates for a single point's radius, found by visiting positions
/// from the nearest on until there are enough.
fn reach_m(index: &PointIndex, density: Density, point: [f32; 3]) -> f32 {
    let (mut n, mut sum) = (0.0, 0.0);
    for (square, _) in index.nearest(point) {
        if square == f32::INFINITY {
            // The squared distance overflows f32.
            break;
        }
        // The sums so far cover exactly the points within this distance.
        if square > 0.0 && n - sum / square > density.half {
            // Slightly larger, so that rounding excludes no candidate.
            return (1.001 * square.sqrt()).min(density.largest_m);
        }
        n += 1.0;
        sum += square;
    }
    density.largest_m
}

/// Returns the radii of lanes with enough candidates within `reach`; NaN for the others. The search starts at
/// `guess`, which must not exceed `reach`.
///
/// The sum of 1 - d²/r² is convex and decreasing in u = 1/r², and linear between two candidates. From a radius that
/// is too large, Newton's method reaches the solution without overshooting, and stops there. From a radius that is
/// too small, its first step leads to one that is too large.
#[inline(always)]
fn radii_within<S: Simd>(
    simd: S,
    gathered: &Gathered,
    p: Vec3<S>,
    [guess, reach]: [S::f32s; 2],
    density: Density,
    buffer: &mut Vec<S::f32s>,
) -> S::f32s {
    let squares = gathered.squares(simd, p, buffer);
    let half = splat(simd, density.half);
    let furthest = reach * reach;
    let (mut n, mut sum) = within(simd, squares, guess * guess);
    let mut enough: Mask<S> = n.simd_gt(half) & (sum / (n - half)).simd_le(furthest);
    if !enough.all_true() {
        // In lanes in which no step leads from the guess to a radius within reach, start from the reach.
        let (all, total) = within(simd, squares, furthest);
        (n, sum) = (enough.select(n, all), enough.select(sum, total));
        enough |= ((all - half) * furthest).simd_ge(total);
    }
    let mut limit = furthest;
    for _ in 0..MOST_STEPS {
        limit = sum / (n - half);
        let (other, of_other) = within(simd, squares, limit);
        let same: Mask<S> = other.simd_eq(n);
        if (same | !enough).all_true() {
            break;
        }
        (n, sum) = (enough.select(other, n), enough.select(of_other, sum));
    }
    enough.select(limit.sqrt(), splat(simd, f32::NAN))
}

/// Returns the number of candidates whose squared distances are below a limit, and the sum of these squared
/// distances.
#[inline(always)]
fn within<S: Simd>(simd: S, squares: &[S::f32s], limit: S::f32s) -> (S::f32s, S::f32s) {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    // Each quantity has two sums, since an addition has a longer latency than the other work per candidate.
    let (mut n, mut sum) = ([zero; 2], [zero; 2]);
    let pairs = squares.chunks_exact(2);
    for (&square, k) in pairs.remainder().iter().zip([0]) {
        let near: Mask<S> = square.simd_lt(limit);
        n[k] += near.select(one, zero);
        sum[k] += near.select(square, zero);
    }
    for pair in pairs {
        for k in [0, 1] {
            let near: Mask<S> = pair[k].simd_lt(limit);
            n[k] += near.select(one, zero);
            sum[k] += near.select(pair[k], zero);
        }
    }
    (n[0] + n[1], sum[0] + sum[1])
}
