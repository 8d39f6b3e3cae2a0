//! Estimates a cloud's noise from how far smoothing moves a sample of its points, and chooses the number of
//! neighbours, the edge handling and the number of passes (docs/method.md, section 8).

use fearless_simd::Level;
use glam::Vec3;

use super::held_out::{FirstPass, HeldOut, Miss, ONE_IN};
use super::leaves::{Kernels, SmoothedLeaf, Way};
use crate::constants::MEDIAN_SQUARE;
use crate::cpu::sensor::Sensor;
use crate::frame::{Frame, FrameGeometry, GeometryScratch, PointsView};
use crate::neighbours::{LEAF, PointIndex};
use crate::params::Edges;

/// The numbers of neighbours to try, each about √2 times the previous one.
const TRIED: [u32; 10] = [40, 57, 80, 113, 160, 226, 320, 453, 640, 905];
/// Smaller numbers of neighbours, for thin walls and fine shapes.
const FEW: [u32; 4] = [10, 14, 20, 28];
/// Ratio of the mean square motion with 40 neighbours to that with 20 above which [`FEW`] is considered.
const GROWS: f64 = 2.0;
/// Minimum mean |cosine| between normals with 20 neighbours for [`FEW`] to be considered; a smaller value means
/// noise.
const COHERENT: f64 = 0.77;
/// Ratio of the RMS motion with 40 neighbours to the mean radius above which [`FEW`] is considered; smaller motions
/// are rounding errors.
const LEAST_MOTION: f64 = 1e-4;
/// Approximate number of points that are smoothed for each number of neighbours tried.
const SAMPLE: usize = 2000;
/// Minimum ratio of the mean radius to the RMS motion for neighbourhoods to count as wider than the noise.
const CLEAR_RATIO: f64 = 3.2;
/// Neighbourhoods also count as wider than the noise if the ratio of the mean radius to the RMS motion is at least this
/// many times the smallest ratio found with fewer neighbours.
const CLEAR_RISE: f64 = 1.2;
/// Number of coefficients of the polynomial: with K neighbours, the fit follows 6/K of the noise's variance.
const COEFFICIENTS: f64 = 6.0;
/// Numerator of the share of the noise's variance that remains after smoothing: 12/K with K neighbours.
const LEFT: f64 = 12.0;

/// Ratio of the mean radius with 40 neighbours to the noise below which a cloud gets a first pass.
const NOISY: f64 = 8.0;
/// Maximum noise at which edges may be kept, as the ratio of the mean radius with 40 neighbours to the noise.
const NOISIEST: f64 = 1.6;
/// Ratio of the mean radius with 40 neighbours to the noise above which there is nothing to smooth.
const CLEAN: f64 = 1000.0;
/// Reach of a first pass around held-out points, in mean radii with 40 neighbours: more than twice the radius with
/// 905.
const REACH: f32 = 12.0;
/// Reduction of the mean square error, in standard errors, above which a smoothing counts as better than another.
const SURE: f64 = 1.0;

/// The two sides of a wall count as merged if the kurtosis of the held-out points' distances is below 3, the kurtosis
/// of noise, by more than this and by more than [`FLAT_ERRORS`].
const FLAT: f64 = 0.25;
/// Difference of the kurtosis from 3 above which the distances with 40 neighbours have two peaks; that of a uniform
/// distribution is 1.2.
const TWO_PEAKS: f64 = 1.25;
/// Counterpart of [`FLAT`] in standard errors of the kurtosis.
const FLAT_ERRORS: f64 = 3.0;
/// Difference of the kurtosis from 3 above which more points of a small cloud are held out before it is judged.
const FLAT_IN_FEW: f64 = 0.05;
/// Number of held-out points that suffices to judge the kurtosis.
const ENOUGH: usize = 4000;
/// Fewer neighbours are chosen, to keep the sides of walls apart, if they reduce the mean square distance to less than
/// this share.
const MUCH_LESS: f64 = 2.0 / 3.0;

/// The estimated noise of an unorganized cloud, and the smoothing parameters that suit its noise and shape.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct CloudEstimate {
    /// The number of neighbours that suits the noise and the shape, 10 to 905.
    pub neighbours: u32,
    /// The edge handling: edges are kept if that reduces the error at held-out points.
    pub edges: Edges,
    /// The number of neighbours of a first pass; `None` for a single pass. Noisy clouds need a first pass because their
    /// points are so far from the surface that a single pass cannot find all its detail.
    pub first_neighbours: Option<u32>,
    /// The standard deviation of the points across their surface, in metres.
    pub noise_m: f32,
}

/// Parameters fixed by the settings; `None` for those to be estimated.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Decided {
    pub(crate) edges: Option<Edges>,
    pub(crate) passes: Option<u32>,
}

/// Motion of the sampled points when smoothed with the given number of neighbours.
#[derive(Debug, Clone, Copy)]
struct Motion {
    neighbours: u32,
    /// Mean square motion in m².
    square: f64,
    /// Median squared motion in m².
    median: f64,
    /// Ratio of the mean radius to the root mean square motion.
    ratio: f64,
    /// Mean |cosine| of the angle between the normals of consecutive points.
    coherence: f64,
}

impl CloudEstimate {
    /// The number of neighbours of a first pass.
    pub const FIRST_NEIGHBOURS: u32 = 20;

    /// Estimates the noise and chooses how to smooth a cloud, by smoothing about 2000 of its points with several
    /// numbers of neighbours and both kinds of edge handling. Returns `None` for a cloud of fewer than 160 distinct
    /// points, or if none of the sampled points has enough neighbours.
    pub fn of(cloud: &PointsView<'_>) -> Option<Self> {
        Self::with(cloud, Decided::default())
    }

    /// Same as [`of`](Self::of), with parameters fixed by the settings.
    pub(crate) fn with(cloud: &PointsView<'_>, decided: Decided) -> Option<Self> {
        let mut index = PointIndex::default();
        index.fill(cloud);
        let most = u32::try_from(index.len() / 4).unwrap_or(u32::MAX);
        let geometry = FrameGeometry::of(Frame::Points(*cloud), false, &mut GeometryScratch::default());
        let kernels = Kernels { sensor: Sensor::new(&geometry), level: Level::new() };
        let sample = Sample { index: &index, kernels };
        let mut tried = TRIED.into_iter().take_while(|&neighbours| neighbours <= most);
        // Try more neighbours until neighbourhoods are wider than the noise.
        let least = sample.motion(tried.next()?)?;
        let (mut narrow, mut least_ratio) = (least, least.ratio);
        while narrow.ratio < CLEAR_RATIO && narrow.ratio < CLEAR_RISE * least_ratio {
            let Some(wider) = tried.next().and_then(|neighbours| sample.motion(neighbours)) else { break };
            least_ratio = least_ratio.min(wider.ratio);
            narrow = wider;
        }
        let few = if narrow.neighbours == least.neighbours { sample.of_few(&narrow) } else { None };
        let mut best = few.map_or(narrow, |[_, best]| best);
        // Wider neighbourhoods leave less noise but move points off curved surfaces.
        for wider in tried.take_while(|_| few.is_none()).map_while(|neighbours| sample.motion(neighbours)) {
            if narrow.error_of(&wider) < narrow.error_of(&best) {
                best = wider;
            } else if narrow.error_of(&wider) > 2.0 * narrow.error_of(&best) {
                break;
            }
        }
        let radius_m = least.ratio * least.square.sqrt();
        let noise_m = few.map_or(narrow, |[least, _]| least).noise_m();
        let is_noisy = few.is_none() && radius_m < NOISY * f64::from(noise_m);
        let mut passes_twice = decided.passes.map_or(is_noisy, |passes| passes > 1);
        let off = Way { edges: Edges::Off, neighbours: best.neighbours };
        let first = FirstPass { neighbours: Self::FIRST_NEIGHBOURS, reach_m: REACH * radius_m as f32 };
        let hold_out = |fold| HeldOut::new(&index, kernels, off, passes_twice.then_some(first), fold).ok();
        let held_out = hold_out(0)?;
        // Noise larger than the spacing shifts round surfaces outwards, as keeping edges does.
        let may_have_edges = radius_m > NOISIEST * f64::from(noise_m);
        let edges = decided.edges.or((!may_have_edges).then_some(Edges::Off));
        let mut chosen = Compared { held_out: &held_out, most }.choose(off, passes_twice, edges);
        let held_out_more = |fold| hold_out(fold).map_or(Vec::new(), |held_out| held_out.misses(chosen.way));
        if merges_walls(&chosen.misses, held_out_more) {
            let narrow = Way { edges: Edges::Robust, neighbours: Self::FIRST_NEIGHBOURS };
            let held_out = HeldOut::new(&index, kernels, narrow, None, 0).ok()?;
            chosen = Compared { held_out: &held_out, most }.choose_apart(decided.edges.unwrap_or(Edges::Robust));
            passes_twice = decided.passes.is_some_and(|passes| passes > 1);
        }
        let first_neighbours = passes_twice.then_some(Self::FIRST_NEIGHBOURS);
        let noise_m = chosen.noise_m().unwrap_or(noise_m);
        let Way { mut edges, mut neighbours } = chosen.way;
        if CLEAN * f64::from(noise_m) < radius_m {
            (edges, neighbours) = (decided.edges.unwrap_or(Edges::Robust), FEW[0]);
        }
        Some(Self { neighbours, edges, first_neighbours, noise_m })
    }
}

/// Compares smoothing parameters on held-out points.
struct Compared<'a> {
    held_out: &'a HeldOut,
    /// Maximum number of neighbours to try.
    most: u32,
}

/// Selects the distance to compare.
type Distance = fn(&Miss) -> f64;

/// Smoothing parameters, and the resulting misses at the held-out points.
struct Tried {
    way: Way,
    misses: Vec<Miss>,
}

impl Compared<'_> {
    /// Returns the best smoothing parameters. Unless `edges` is given, edges are kept only if that is clearly better
    /// or, on fine shapes, not clearly worse.
    fn choose(&self, start: Way, is_noisy: bool, edges: Option<Edges>) -> Tried {
        // With too few neighbours, normals follow the noise, which shortens distances along them.
        let whole: Distance = |miss| miss.whole;
        let mut smooth = self.walk(self.try_way(start), &|neighbours| self.below(neighbours), whole);
        if smooth.way == start && is_noisy && edges != Some(Edges::Robust) {
            smooth = self.walk(smooth, &|neighbours| self.above(neighbours, 1), whole);
        }
        if edges == Some(Edges::Off) {
            return smooth;
        }
        // Next to an edge, held-out points have moved along rounded normals, so whole distances favour rounding.
        let along: Distance = |miss| miss.along;
        let robust = |neighbours| Way { edges: Edges::Robust, neighbours };
        let neighbours = smooth.way.neighbours;
        let mut kept = self.try_way(robust(self.above(neighbours, 2)));
        // Next to thin walls and fine detail, fewer neighbours preserve edges better.
        let is_few = neighbours <= TRIED[0];
        let fewer = [neighbours, self.above(neighbours, 1)];
        for neighbours in fewer.into_iter().take(if is_few { 2 } else { 1 }) {
            let fewer = self.try_way(robust(neighbours));
            kept = if fewer.is_better(&kept, along) { fewer } else { kept };
        }
        if is_few && kept.way.neighbours == neighbours {
            kept = self.walk(kept, &|neighbours| self.below(neighbours), whole);
        }
        // Shapes that 40 neighbours distort suffer most from rounding, so it suffices that keeping edges is no worse.
        let is_fine = neighbours < TRIED[0] && !is_noisy;
        let keeps = if is_fine { !smooth.is_better(&kept, along) } else { kept.is_better(&smooth, along) };
        if edges.is_none() && !keeps {
            return smooth;
        }
        self.walk(kept, &|neighbours| self.above(neighbours, 2), along)
    }

    /// Returns parameters that keep the two sides of walls apart: 40 neighbours, or fewer if that makes the misses
    /// much smaller, or as long as the distances of sides that are clearly apart do not look like noise. Fewer
    /// neighbours always make misses slightly smaller, because the fit follows the noise.
    fn choose_apart(&self, edges: Edges) -> Tried {
        let mut tried: Vec<Tried> = TRIED[..1]
            .iter()
            .chain(FEW.iter().rev())
            .map(|&neighbours| self.try_way(Way { edges, neighbours }))
            .collect();
        let mut best = 0;
        for fewer in 1..tried.len() {
            if tried[fewer].mean_whole() < MUCH_LESS * tried[best].mean_whole() {
                best = fewer;
            }
        }
        let flatness = |tried: &Tried| below_gaussian(&finite_squares(&tried.misses));
        if flatness(&tried[0]) > TWO_PEAKS {
            while best + 1 < tried.len() && flatness(&tried[best]) > FLAT {
                best += 1;
            }
        }
        tried.swap_remove(best)
    }

    fn try_way(&self, way: Way) -> Tried {
        Tried { way, misses: self.held_out.misses(way) }
    }

    /// Changes the number of neighbours step by step until two tries in a row do not reduce the error.
    fn walk(&self, mut best: Tried, next: &dyn Fn(u32) -> u32, distance: Distance) -> Tried {
        let mut neighbours = best.way.neighbours;
        let mut worse = 0;
        while worse < 2 && next(neighbours) != neighbours {
            neighbours = next(neighbours);
            let tried = self.try_way(Way { neighbours, ..best.way });
            if tried.gain(&best, distance).0 > 0.0 {
                (best, worse) = (tried, 0);
            } else {
                worse += 1;
            }
        }
        best
    }

    /// Returns the next smaller number of neighbours, or the same number if it is the smallest.
    fn below(&self, neighbours: u32) -> u32 {
        FEW.into_iter().chain(TRIED).take_while(|&tried| tried < neighbours).last().unwrap_or(neighbours)
    }

    /// Returns the number of neighbours `steps` steps up from `neighbours`, at most the largest.
    fn above(&self, neighbours: u32, steps: usize) -> u32 {
        let above = FEW.into_iter().chain(TRIED).filter(|&tried| tried > neighbours && tried <= self.most);
        above.take(steps).last().unwrap_or(neighbours)
    }
}

impl Tried {
    /// Returns true if these misses are smaller than those of `than`, by more than [`SURE`] standard errors.
    fn is_better(&self, than: &Self, distance: Distance) -> bool {
        let (gain, doubt) = self.gain(than, distance);
        gain > SURE * doubt
    }

    /// Returns the mean reduction of the squared misses relative to `than`, and its standard error.
    fn gain(&self, than: &Self, distance: Distance) -> (f64, f64) {
        let pairs = than.misses.iter().zip(&self.misses);
        let gains: Vec<f64> =
            pairs.map(|(than, own)| distance(than) - distance(own)).filter(|gain| gain.is_finite()).collect();
        let count = gains.len().max(1) as f64;
        let mean = gains.iter().sum::<f64>() / count;
        let variance = gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>() / count;
        (mean, (variance / count).sqrt())
    }

    /// Returns the mean of the finite square distances in space, in m².
    fn mean_whole(&self) -> f64 {
        mean_of(self.misses.iter().map(|miss| miss.whole))
    }

    /// Returns the noise in metres that explains the median miss; `None` if no miss is finite.
    fn noise_m(&self) -> Option<f32> {
        let mut squares = finite_squares(&self.misses);
        squares.sort_by(f64::total_cmp);
        squares.get(squares.len() / 2).map(|median| (median / MEDIAN_SQUARE).sqrt() as f32)
    }
}

/// Returns true if the distribution of the misses is flatter than a Gaussian, which indicates that the fitted surface
/// is between the two sides of a wall. In a small cloud where that is possible, more points are held out.
fn merges_walls(misses: &[Miss], more: impl Fn(usize) -> Vec<Miss>) -> bool {
    let mut squares: Vec<f64> = finite_squares(misses);
    if below_gaussian(&squares) > FLAT_IN_FEW {
        for fold in 1..ONE_IN {
            if squares.len() >= ENOUGH {
                break;
            }
            squares.extend(finite_squares(&more(fold)));
        }
    }
    // The standard error of the kurtosis of normal deviates is √(24/count).
    below_gaussian(&squares) > f64::max(FLAT, FLAT_ERRORS * (24.0 / squares.len() as f64).sqrt())
}

fn finite_squares(misses: &[Miss]) -> Vec<f64> {
    misses.iter().map(|miss| miss.along).filter(|square| square.is_finite()).collect()
}

/// Returns how far the kurtosis of deviates with these squares is below a Gaussian's, which is 3.
fn below_gaussian(squares: &[f64]) -> f64 {
    let (sum, squared) = squares.iter().fold((0.0, 0.0), |(sum, squared), x| (sum + x, squared + x * x));
    3.0 - squares.len() as f64 * squared / (sum * sum)
}

/// Returns the mean of the finite values; NaN if there are none.
fn mean_of(values: impl Iterator<Item = f64>) -> f64 {
    let finite = values.filter(|value| value.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

impl Motion {
    /// Returns the ratio of the noise's variance to the part of it that the fit removes.
    fn whole(&self) -> f64 {
        1.0 / (1.0 - COEFFICIENTS / f64::from(self.neighbours))
    }

    /// Returns the mean square error of another smoothing in m² (docs/method.md, (8.2)), assuming that this smoothing
    /// removed the noise and kept the shape.
    fn error_of(&self, other: &Self) -> f64 {
        other.square + LEFT * self.square * self.whole() / f64::from(other.neighbours)
    }

    /// Returns the noise in metres. It uses the median, so outliers and edges do not count as noise.
    fn noise_m(&self) -> f32 {
        (self.median / MEDIAN_SQUARE * self.whole()).sqrt() as f32
    }
}

/// A cloud, and the kernels that smooth a sample of its leaves.
struct Sample<'a> {
    index: &'a PointIndex,
    kernels: Kernels,
}

impl Sample<'_> {
    /// Returns the motions with the fewest neighbours and with the best number below 40, if 40 neighbours distort the
    /// shape by moving points to the other side of a thin wall or off fine detail.
    fn of_few(&self, narrow: &Motion) -> Option<[Motion; 2]> {
        let few = self.motion(CloudEstimate::FIRST_NEIGHBOURS)?;
        let grows = narrow.square > GROWS * few.square && narrow.ratio < 1.0 / LEAST_MOTION;
        if !(grows && few.coherence >= COHERENT) {
            return None;
        }
        let [least, less, _, more] =
            FEW.map(|neighbours| (neighbours != few.neighbours).then(|| self.motion(neighbours)));
        let (least, less, more) = (least??, less??, more??);
        let best = [least, less, few, more, *narrow]
            .into_iter()
            .min_by(|a, b| least.error_of(a).total_cmp(&least.error_of(b)))?;
        (best.neighbours < narrow.neighbours).then_some([least, best])
    }

    /// Returns the motion of the sampled points; `None` if none has enough neighbours.
    fn motion(&self, neighbours: u32) -> Option<Motion> {
        let Self { index, kernels } = *self;
        let leaves = index.leaves();
        let step = (LEAF * leaves).div_ceil(SAMPLE).max(1);
        let is_sampled = |leaf: usize| leaf % step == step / 2;
        let sampled: Vec<_> = (0..leaves).filter(|&leaf| is_sampled(leaf)).collect();
        let smoothed = kernels.smooth(index, Way { edges: Edges::Off, neighbours }, &sampled);
        let motion = |leaf: usize, smoothed: &SmoothedLeaf, k: usize| {
            let (from, to) = (index.point(LEAF * leaf + k), smoothed.on_surface(k)?.point);
            let square: f64 = (0..3).map(|axis| f64::from(to[axis] - from[axis]).powi(2)).sum();
            let normal_of = |k| smoothed.on_surface(k).map(|surface| Vec3::from_array(surface.normal));
            let normal = normal_of(k)?;
            let cosine = normal_of((k + 1) % LEAF).map_or(f64::NAN, |next| f64::from(normal.dot(next).abs()));
            Some([square, f64::from(smoothed.radius_m(k)), cosine])
        };
        let motions: Vec<[f64; 3]> = sampled
            .iter()
            .zip(&smoothed)
            .flat_map(|(&leaf, smoothed)| (0..LEAF).filter_map(move |k| motion(leaf, smoothed, k)))
            .collect();
        let mean = |k: usize| mean_of(motions.iter().map(|motion| motion[k]));
        let mut squares: Vec<f64> = motions.iter().map(|[square, ..]| *square).collect();
        squares.sort_by(f64::total_cmp);
        let median = *squares.get(squares.len() / 2)?;
        Some(Motion { neighbours, square: mean(0), median, ratio: mean(1) / mean(0).sqrt(), coherence: mean(2) })
    }
}
