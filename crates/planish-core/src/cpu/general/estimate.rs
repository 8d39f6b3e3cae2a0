//! The number of neighbours that suits a cloud, and its noise, from how far a sample of its points moves
//! (docs/method.md, section 8).

use fearless_simd::Level;
use rayon::prelude::*;

use super::kernel::{Kernel, Radii};
use super::radius::{self, Density, RadiusRows};
use super::smooth_rows;
use crate::constants::MAX_RADIUS_RATIO;
use crate::cpu::Fitting;
use crate::cpu::output::OutputRows;
use crate::cpu::sensor::Sensor;
use crate::frame::{Frame, FrameGeometry, GeometryScratch, PointsView};
use crate::neighbours::{LEAF, PointIndex};
use crate::outputs::Outputs;
use crate::params::CloudParams;
use crate::range::MAX_RANGE_M;
use crate::smoothed::Smoothed;

/// The numbers of neighbours that are tried, each about the root of two times the one before.
const TRIED: [u32; 10] = [40, 57, 80, 113, 160, 226, 320, 453, 640, 905];
/// Smaller numbers, for thin walls and fine shapes.
const FEW: [u32; 2] = [20, 28];
/// They are considered if the mean square motion with 40 neighbours exceeds this multiple of that with 20,
const GROWS: f64 = 2.0;
/// and the RMS motion with 40 exceeds this share of the mean radius (less is rounding).
const LEAST_MOTION: f64 = 1e-4;
/// About this many points are smoothed with each of them.
const SAMPLE: usize = 2000;
/// A neighbourhood is wider than the noise if its mean radius is at least this multiple of the RMS motion,
const CLEAR_RATIO: f64 = 3.2;
/// or if that ratio is at least this multiple of the smallest ratio so far.
const CLEAR_RISE: f64 = 1.2;
/// Number of coefficients of the polynomial: with K neighbours, the fit follows 6/K of the noise's variance.
const COEFFICIENTS: f64 = 6.0;
/// With K neighbours, smoothing leaves 12/K of the noise's variance.
const LEFT: f64 = 12.0;

/// The median square of a normal deviate.
const MEDIAN_SQUARE: f64 = 0.4549;

/// The noise of an unorganized cloud, and the number of neighbours that suits it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct CloudEstimate {
    /// The number of neighbours that suits the noise and the shape, 20 to 905.
    pub neighbours: u32,
    /// The standard deviation of the points across their surface, in metres.
    pub noise_m: f32,
}

/// How far points moved with some number of neighbours.
#[derive(Debug, Clone, Copy)]
struct Motion {
    neighbours: u32,
    /// Mean square in m².
    square: f64,
    /// Median square in m².
    median: f64,
    /// Ratio of the mean radius to the root mean square motion.
    ratio: f64,
}

impl CloudEstimate {
    /// Smooths about 2000 points of a cloud with several numbers of neighbours. `None` for a cloud of fewer than 160
    /// distinct points, or if none of the sampled points has enough neighbours.
    pub fn of(cloud: &PointsView<'_>) -> Option<Self> {
        let mut index = PointIndex::default();
        index.fill(cloud);
        let most = u32::try_from(index.len() / 4).unwrap_or(u32::MAX);
        let geometry = FrameGeometry::of(Frame::Points(*cloud), false, &mut GeometryScratch::default());
        let sample = Sample { index: &index, sensor: Sensor::new(&geometry), level: Level::new() };
        let mut tried = TRIED.into_iter().take_while(|&neighbours| neighbours <= most);
        // Widens until neighbourhoods are wider than the noise.
        let mut narrow = sample.motion(tried.next()?)?;
        let mut least_ratio = narrow.ratio;
        while narrow.ratio < CLEAR_RATIO && narrow.ratio < CLEAR_RISE * least_ratio {
            let Some(wider) = tried.next().and_then(|neighbours| sample.motion(neighbours)) else { break };
            least_ratio = least_ratio.min(wider.ratio);
            narrow = wider;
        }
        if narrow.neighbours == TRIED[0]
            && let Some(estimate) = sample.of_few(&narrow)
        {
            return Some(estimate);
        }
        let mut best = narrow;
        // From there on, wider ones leave less noise but move points off a surface that bends.
        for wider in tried.map_while(|neighbours| sample.motion(neighbours)) {
            if narrow.error_of(&wider) < narrow.error_of(&best) {
                best = wider;
            } else if narrow.error_of(&wider) > 2.0 * narrow.error_of(&best) {
                break;
            }
        }
        Some(Self { neighbours: best.neighbours, noise_m: narrow.noise_m() })
    }
}

impl Motion {
    /// Returns the ratio of the noise's variance to the part of it that the fit removes.
    fn whole(&self) -> f64 {
        1.0 / (1.0 - COEFFICIENTS / f64::from(self.neighbours))
    }

    /// Returns the mean square error after another smoothing, in m², if this one removed the noise and kept the shape.
    fn error_of(&self, other: &Self) -> f64 {
        other.square + LEFT * self.square * self.whole() / f64::from(other.neighbours)
    }

    /// Returns the noise in metres. It uses the median, so outliers and edges do not count as noise.
    fn noise_m(&self) -> f32 {
        (self.median / MEDIAN_SQUARE * self.whole()).sqrt() as f32
    }
}

/// Some leaves of the points of a cloud.
struct Sample<'a> {
    index: &'a PointIndex,
    sensor: Sensor,
    level: Level,
}

impl Sample<'_> {
    /// Returns an estimate with fewer than 40 neighbours if 40 would distort the shape: move points to the other side
    /// of a thin wall, or off fine detail.
    fn of_few(&self, narrow: &Motion) -> Option<CloudEstimate> {
        let [least, more] = FEW.map(|neighbours| self.motion(neighbours));
        let (least, more) = (least?, more?);
        let grows = narrow.square > GROWS * least.square && narrow.ratio < 1.0 / LEAST_MOTION;
        let best = [least, more, *narrow].into_iter().min_by(|a, b| least.error_of(a).total_cmp(&least.error_of(b)))?;
        (grows && best.neighbours < narrow.neighbours)
            .then(|| CloudEstimate { neighbours: best.neighbours, noise_m: least.noise_m() })
    }

    /// Returns how far its points move; `None` if none has enough neighbours.
    fn motion(&self, neighbours: u32) -> Option<Motion> {
        let Self { index, level, .. } = *self;
        let leaves = index.leaves();
        let step = (LEAF * leaves).div_ceil(SAMPLE).max(1);
        let is_sampled = |leaf: usize| leaf % step == step / 2;
        let density = Density { half: neighbours as f32 / 2.0, largest_m: (index.extent_m() / 2.0).min(MAX_RANGE_M) };
        // Only the radii of sampled points are read.
        let mut radii = vec![f32::NAN; LEAF * leaves];
        radii.par_chunks_mut(LEAF).enumerate().filter(|(leaf, _)| is_sampled(*leaf)).for_each(|(first, radii)| {
            let mut rows = RadiusRows { first, radii };
            radius::solve(level, index, density, &mut rows);
        });
        let sampled: Vec<_> = (0..leaves).filter(|&leaf| is_sampled(leaf)).collect();
        // In the same order for any number of threads.
        let motions: Vec<Vec<[f64; 2]>> =
            sampled.into_par_iter().map(|leaf| self.motions_of(leaf, neighbours, &radii)).collect();
        let motions = motions.concat();
        let mean = |k: usize| motions.iter().map(|motion| motion[k]).sum::<f64>() / motions.len() as f64;
        let mut squares: Vec<f64> = motions.iter().map(|[square, _]| *square).collect();
        squares.sort_by(f64::total_cmp);
        let median = *squares.get(squares.len() / 2)?;
        Some(Motion { neighbours, square: mean(0), median, ratio: mean(1) / mean(0).sqrt() })
    }

    /// Returns the squared motions and the radii of those points of a leaf that are smoothed.
    fn motions_of(&self, leaf: usize, neighbours: u32, radii: &[f32]) -> Vec<[f64; 2]> {
        let Self { index, sensor, level } = *self;
        let params = CloudParams::default();
        let fitting = Fitting {
            bandwidth_m: params.fit.bandwidth_m,
            ridge: params.fit.ridge,
            keeps_isolated: true,
            least_neighbours: neighbours.div_ceil(4) as f32,
        };
        let kernel = Kernel { fitting, sensor, index, radii: Radii::Known(radii), first_planes: None };
        let mut smoothed = Smoothed::default();
        smoothed.prepare(LEAF, 1, Outputs::POINTS.with_status(true));
        let mut rows = OutputRows::of_grid((LEAF, 1), smoothed.as_mut());
        rows.first = leaf;
        smooth_rows::<2>(level, &kernel, &mut rows);
        let status = smoothed.status.as_deref().unwrap_or_default();
        let of_point = |k: usize| {
            let (from, to) = (index.point(LEAF * leaf + k), smoothed.points.get(k));
            let square: f64 = (0..3).map(|axis| f64::from(to[axis] - from[axis]).powi(2)).sum();
            [square, f64::from(radii[LEAF * leaf + k])]
        };
        // Strays have wider neighbourhoods than the points beside them: their motion measures no noise.
        let mut sorted: Vec<f32> =
            radii[LEAF * leaf..LEAF * (leaf + 1)].iter().copied().filter(|r| r.is_finite()).collect();
        sorted.sort_by(f32::total_cmp);
        let widest_m = sorted.get(sorted.len() / 2).map_or(f32::INFINITY, |middle| MAX_RADIUS_RATIO * middle);
        let counts = |k: &usize| status[*k].has_normal() && radii[LEAF * leaf + k] <= widest_m;
        (0..LEAF).filter(counts).map(of_point).collect()
    }
}
