//! Detection of points that are far from all other points.
//!
//! Both tests visit the leaves of a [`PointIndex`]. For each leaf, the surrounding leaves are gathered once for all of
//! its 16 points. The distances from these points to all gathered points are then computed with SIMD instructions.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

use crate::error::ParamError;
use crate::frame::PointsView;
use crate::neighbours::{Bounds, LEAF, PointIndex};
use crate::range::MAX_RANGE_M;

/// Number of leaves per task.
const LEAVES_PER_TASK: usize = 64;

/// Maximum ratio of a leaf's width to the reach. A wider leaf contains strays, so neighbours are gathered for each of
/// its points separately.
const WIDEST_LEAF: f32 = 4.0;

/// Marks the points whose mean distance to their nearest `neighbours` points exceeds the mean of these distances over
/// all points by more than `deviations` standard deviations. This is the statistical test of PCL and Open3D (Rusu et
/// al., 2008).
///
/// `neighbours` does not count the point itself, as in PCL; Open3D's `nb_neighbors` does.
///
/// # Errors
/// If `neighbours` is not 1 to 1000, `deviations` is not a positive number, or coordinates exceed 10^18 m.
pub fn statistical_outliers(
    points: &PointsView<'_>,
    neighbours: usize,
    deviations: f32,
) -> Result<Vec<bool>, ParamError> {
    if !(1..=1000).contains(&neighbours) {
        return Err(ParamError { field: "neighbours", value: neighbours.to_string(), allowed: "1 to 1000" });
    }
    check_positive("deviations", deviations)?;
    let index = index_of(points)?;
    let level = Level::new();
    let mut means_m = vec![0.0f32; LEAF * index.leaves()];
    means_m.par_chunks_mut(LEAF * LEAVES_PER_TASK).enumerate().for_each(|(task, means_m)| {
        let mut search = Search::new(&index);
        dispatch!(level, simd => search.mean_distances(simd, LEAVES_PER_TASK * task, neighbours, means_m));
    });
    let mean_of = |i: usize| index.place(i).map(|place| f64::from(means_m[place]));
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for mean_m in (0..points.len()).filter_map(mean_of) {
        count += 1.0;
        sum += mean_m;
        squares += mean_m * mean_m;
    }
    let variance: f64 = (squares - sum * sum / f64::max(count, 1.0)) / f64::max(count - 1.0, 1.0);
    let most_m = sum / f64::max(count, 1.0) + f64::from(deviations) * variance.max(0.0).sqrt();
    Ok((0..points.len()).into_par_iter().map(|i| mean_of(i).is_some_and(|mean_m| mean_m > most_m)).collect())
}

/// Marks the points that have fewer than `least` other points within `radius_m`, as PCL and Open3D do.
///
/// # Errors
/// If the radius is not a positive number, `least` is 0, or coordinates exceed 10^18 m.
pub fn radius_outliers(points: &PointsView<'_>, radius_m: f32, least: usize) -> Result<Vec<bool>, ParamError> {
    check_positive("radius", radius_m)?;
    if least == 0 {
        return Err(ParamError { field: "neighbours", value: "0".into(), allowed: "1 or more" });
    }
    let index = index_of(points)?;
    let level = Level::new();
    let mut is_outlier = vec![false; LEAF * index.leaves()];
    is_outlier.par_chunks_mut(LEAF * LEAVES_PER_TASK).enumerate().for_each(|(task, is_outlier)| {
        let mut search = Search::new(&index);
        let first = LEAVES_PER_TASK * task;
        dispatch!(level, simd => search.are_alone(simd, first, radius_m, least, is_outlier));
    });
    Ok((0..points.len()).into_par_iter().map(|i| index.place(i).is_some_and(|place| is_outlier[place])).collect())
}

fn check_positive(field: &'static str, value: f32) -> Result<(), ParamError> {
    if value > 0.0 && value.is_finite() {
        return Ok(());
    }
    Err(ParamError { field, value: value.to_string(), allowed: "a number above 0" })
}

fn index_of(points: &PointsView<'_>) -> Result<PointIndex, ParamError> {
    let mut index = PointIndex::default();
    index.fill(points);
    let largest = index.positions.iter().flatten().fold(0.0f32, |largest, value| largest.max(value.abs()));
    if largest > MAX_RANGE_M {
        let allowed = "coordinates within 10^18 m";
        return Err(ParamError { field: "points", value: format!("{largest:e}"), allowed });
    }
    Ok(index)
}

/// The points gathered around a leaf, or around one of its points.
struct Search<'a> {
    index: &'a PointIndex,
    positions: [Vec<f32>; 3],
    counts: Vec<f32>,
    /// Whether several points share one of the gathered positions.
    has_repeated: bool,
    squares: Vec<f32>,
    nearest: Vec<f32>,
}

impl<'a> Search<'a> {
    fn new(index: &'a PointIndex) -> Self {
        let (positions, counts, squares, nearest) = Default::default();
        Self { index, positions, counts, has_repeated: false, squares, nearest }
    }

    /// Gathers the leaves that are nearer to a box than `reach_m`. Returns true if these are all leaves.
    #[inline(always)]
    fn gather<S: Simd>(&mut self, simd: S, bounds: &Bounds, reach_m: f32) -> bool {
        let Self { index, positions, counts, .. } = self;
        positions.iter_mut().for_each(Vec::clear);
        counts.clear();
        let wanted = bounds.grown(reach_m);
        let mut leaves = 0;
        index.for_each_leaf(simd, &wanted, |leaf, _| {
            let places = LEAF * leaf..LEAF * (leaf + 1);
            for (values, all) in positions.iter_mut().zip(&index.positions) {
                values.extend_from_slice(&all[places.clone()]);
            }
            counts.extend_from_slice(&index.counts[places]);
            leaves += 1;
        });
        self.has_repeated = self.counts.iter().any(|count| *count > 1.0);
        leaves == index.leaves()
    }

    /// Computes the squared distances from a point to all gathered points; NaN for the padding of leaves.
    #[inline(always)]
    fn measure(&mut self, point: [f32; 3]) {
        let [x, y, z] = &self.positions;
        self.squares.resize(x.len(), 0.0);
        for (((square, x), y), z) in self.squares.iter_mut().zip(x).zip(y).zip(z) {
            let (dx, dy, dz) = (x - point[0], y - point[1], z - point[2]);
            *square = dx * dx + dy * dy + dz * dz;
        }
    }

    /// Returns the positions of a leaf and the boxes to gather around: one for all, or one per position if the leaf has
    /// strays.
    #[inline(always)]
    fn groups(&self, leaf: usize, reach_m: f32) -> impl Iterator<Item = (std::ops::Range<usize>, Bounds)> + use<> {
        let places = LEAF * leaf..(LEAF * (leaf + 1)).min(self.index.len());
        let bounds = self.index.leaf_bounds(leaf);
        let is_wide = (0..3).any(|axis| bounds.high[axis] - bounds.low[axis] > WIDEST_LEAF * reach_m);
        let points: [[f32; 3]; LEAF] =
            std::array::from_fn(|i| self.index.point((places.start + i).min(places.end - 1)));
        let each = if is_wide { 1 } else { LEAF };
        let first = places.start;
        places.clone().step_by(each).map(move |start| {
            let own = if is_wide { Bounds::of_point(points[start - first]) } else { bounds };
            (start..(start + each).min(places.end), own)
        })
    }

    /// Computes the mean distance from each point of some leaves to its `neighbours` nearest points.
    #[inline(always)]
    fn mean_distances<S: Simd>(&mut self, simd: S, first_leaf: usize, neighbours: usize, means_m: &mut [f32]) {
        // The reach of the previous leaf, which is next to this one.
        let mut reach_m = 0.0;
        for (leaf, means_m) in (first_leaf..).zip(means_m.chunks_mut(LEAF)) {
            if reach_m == 0.0 {
                reach_m = self.first_reach_m(leaf, neighbours);
            }
            let mut largest_m = 0.0f32;
            for (places, bounds) in self.groups(leaf, reach_m) {
                let mut reach_m = reach_m;
                let mut has_all = self.gather(simd, &bounds, reach_m);
                for place in places {
                    let farthest_m = loop {
                        match self.mean_of_nearest(place, neighbours, if has_all { f32::INFINITY } else { reach_m }) {
                            Some((mean_m, farthest_m)) => {
                                means_m[place % LEAF] = mean_m;
                                break farthest_m;
                            }
                            None => {
                                reach_m *= 1.5;
                                has_all = self.gather(simd, &bounds, reach_m);
                            }
                        }
                    };
                    largest_m = largest_m.max(farthest_m);
                }
            }
            // The change of the reach is limited, since a stray's reach would gather far too many points for the next
            // leaf.
            reach_m = (1.1 * largest_m).clamp(0.5 * reach_m, 2.0 * reach_m);
        }
    }

    /// Returns a distance in metres that is slightly larger than the distance from the first point of a leaf to its
    /// `neighbours`-th nearest point.
    fn first_reach_m(&self, leaf: usize, neighbours: usize) -> f32 {
        let nearest = self.index.nearest(self.index.point(LEAF * leaf)).take(neighbours + 1);
        1.1 * nearest.last().map_or(0.0, |(square, _)| square).sqrt().max(f32::MIN_POSITIVE.sqrt())
    }

    /// Returns the mean and the largest distance from a point to its nearest points; `None` if too few are within the
    /// reach.
    #[inline(always)]
    fn mean_of_nearest(&mut self, place: usize, neighbours: usize, reach_m: f32) -> Option<(f32, f32)> {
        self.measure(self.index.point(place));
        let most = reach_m * reach_m;
        self.nearest.resize(self.squares.len(), 0.0);
        let mut within = 0;
        for &square in &self.squares {
            self.nearest[within] = square;
            // Also false for NaN.
            within += usize::from(square <= most);
        }
        self.nearest.truncate(within);
        if self.has_repeated {
            // A position shared by several points counts once per point.
            for (&square, &count) in self.squares.iter().zip(&self.counts).filter(|(square, _)| **square <= most) {
                self.nearest.extend(std::iter::repeat_n(square, (count as usize - 1).min(neighbours)));
            }
        }
        // The nearest points include the point itself, at distance 0.
        if self.nearest.len() <= neighbours {
            if reach_m.is_finite() {
                return None;
            }
            let farthest = self.nearest.iter().copied().fold(0.0, f32::max);
            let sum: f64 = self.nearest.iter().map(|&square| f64::from(square).sqrt()).sum();
            return Some(((sum / (self.nearest.len().max(2) - 1) as f64) as f32, farthest.sqrt()));
        }
        let (nearer, &mut farthest, _) = self.nearest.select_nth_unstable_by(neighbours, f32::total_cmp);
        let farthest_m = farthest.sqrt();
        let sum: f64 = nearer.iter().map(|square| f64::from(square.sqrt())).sum();
        Some((((sum + f64::from(farthest_m)) / neighbours as f64) as f32, farthest_m))
    }

    /// Returns true if the points of a leaf have enough neighbours in the leaf and the adjacent ones. This test is
    /// cheap, and most leaves pass it.
    #[inline(always)]
    fn have_company(&self, leaf: usize, most: f32, least: usize) -> bool {
        let [x, y, z] = &self.index.positions;
        let around = LEAF * leaf.saturating_sub(1)..(LEAF * (leaf + 2)).min(x.len());
        let has_company = |place: usize| {
            let squares =
                x[around.clone()].iter().zip(&y[around.clone()]).zip(&z[around.clone()]).map(|((u, v), w)| {
                    let (dx, dy, dz) = (u - x[place], v - y[place], w - z[place]);
                    dx * dx + dy * dy + dz * dz
                });
            let counts = squares.zip(&self.index.counts[around.clone()]);
            let count: f32 = counts.map(|(square, count)| if square <= most { *count } else { 0.0 }).sum();
            count as usize > least
        };
        (LEAF * leaf..(LEAF * (leaf + 1)).min(self.index.len())).all(has_company)
    }

    /// For each point of some leaves, computes whether fewer than `least` other points are within the radius.
    #[inline(always)]
    fn are_alone<S: Simd>(&mut self, simd: S, first_leaf: usize, radius_m: f32, least: usize, is_outlier: &mut [bool]) {
        let most = radius_m * radius_m;
        for (leaf, is_outlier) in (first_leaf..).zip(is_outlier.chunks_mut(LEAF)) {
            if self.have_company(leaf, most, least) {
                continue;
            }
            for (places, bounds) in self.groups(leaf, radius_m) {
                self.gather(simd, &bounds, radius_m);
                for place in places {
                    self.measure(self.index.point(place));
                    let within = self.squares.iter().zip(&self.counts);
                    let count: f32 = within.map(|(square, count)| if *square <= most { *count } else { 0.0 }).sum();
                    is_outlier[place % LEAF] = (count as usize) <= least;
                }
            }
        }
    }
}
