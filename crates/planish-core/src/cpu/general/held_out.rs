//! Points of a cloud that are held out, to compare ways to smooth it (docs/method.md, section 8): the best surface is
//! the one that is nearest to points that it was not fitted to.

use fearless_simd::Level;
use rayon::prelude::*;

use super::first_planes::{FirstPlaneRows, FirstPlanes};
use super::kernel::{Kernel, Radii};
use super::radius::{self, Density, RadiusRows};
use super::{fit_first_planes, smooth_rows};
use crate::constants::MAX_RADIUS_RATIO;
use crate::cpu::Fitting;
use crate::cpu::output::OutputRows;
use crate::cpu::sensor::Sensor;
use crate::error::FrameError;
use crate::frame::PointsView;
use crate::neighbours::{LEAF, PointIndex};
use crate::outputs::Outputs;
use crate::params::{CloudParams, Edges};
use crate::range::MAX_RANGE_M;
use crate::smoothed::Smoothed;
use crate::xyz::Xyz;

/// One point in this many is held out, of some groups of points that lie together.
const ONE_IN: usize = 8;
/// The number of groups in a large cloud, and of leaves in each.
const GROUPS: usize = 32;
const GROUP_LEAVES: usize = 1024 / LEAF;
/// First planes are fitted in one leaf of this many, besides those of held-out points: enough for a comparison.
const ONE_LEAF_IN: usize = 4;
/// Planes within twice the radius decide on a surface; this is a little more.
const PLANES_REACH: f32 = 2.04;

/// A way to smooth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Way {
    pub(super) edges: Edges,
    pub(super) neighbours: u32,
}

/// A pass over all points before the surface is sought.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstPass {
    pub(super) neighbours: u32,
    /// Points farther from those that are held out do not matter.
    pub(super) reach_m: f32,
}

/// A cloud with points held out.
pub(super) struct HeldOut {
    /// The others, and behind them those that are held out.
    index: PointIndex,
    others: usize,
    /// Where the held-out points were measured.
    measured: Vec<[f32; 3]>,
    sensor: Sensor,
    level: Level,
}

impl HeldOut {
    /// Holds out points of a cloud. They are smoothed in this way before they are compared with a surface: otherwise
    /// their noise would decide which surface is theirs. If there is a first pass, it smooths the others.
    pub(super) fn new(
        cloud: &PointIndex,
        sensor: Sensor,
        level: Level,
        way: Way,
        first: Option<FirstPass>,
    ) -> Result<Self, FrameError> {
        let is_sampled = sampled_leaves(cloud);
        let is_held_out = |&place: &usize| is_sampled(place / LEAF) && place % ONE_IN == place / LEAF % ONE_IN;
        let (held_out, others): (Vec<usize>, Vec<usize>) = (0..cloud.len()).partition(is_held_out);
        let measured: Vec<_> = held_out.iter().map(|&place| cloud.point(place)).collect();
        let index = index_of(others.iter().map(|&place| cloud.point(place)))?;
        let mut apart = Self { others: index.len(), index, measured, sensor, level };
        apart.index.append(apart.others, &apart.measured);
        apart.move_held_out(way);
        if let Some(first) = first {
            let held_out: Vec<_> = (apart.others..apart.index.len()).map(|place| apart.index.point(place)).collect();
            apart.index = apart.smooth_others(first)?;
            apart.others = apart.index.len();
            apart.index.append(apart.others, &held_out);
            apart.move_held_out(way);
        }
        Ok(apart)
    }

    /// Returns the others after a first pass, as far as they matter.
    fn smooth_others(&self, FirstPass { neighbours, reach_m }: FirstPass) -> Result<PointIndex, FrameError> {
        let is_near = self.around_held_out(|_| reach_m);
        let near: Vec<_> = (0..self.index.leaves()).filter(|&leaf| is_near[leaf]).collect();
        let smoothed = self.smooth(Way { edges: Edges::Off, neighbours }, &near);
        let mut points: Vec<_> = (0..self.others).map(|place| self.index.point(place)).collect();
        for (leaf, smoothed) in near.iter().zip(&smoothed) {
            for (k, point) in points.iter_mut().skip(LEAF * leaf).take(LEAF).enumerate() {
                *point = smoothed.point(k).unwrap_or(*point);
            }
        }
        index_of(points.into_iter())
    }

    /// Moves the held-out points onto the surface of the others.
    fn move_held_out(&mut self, way: Way) {
        let moved = self.of_held_out(way, |smoothed, k, _| smoothed.point(k));
        let points = (self.others..self.index.len()).zip(moved);
        let points: Vec<_> = points.map(|(place, moved)| moved.unwrap_or(self.index.point(place))).collect();
        self.index.append(self.others, &points);
    }

    /// Smooths the held-out points, each of which `of` gets: with its number in a leaf, and where it was measured.
    fn of_held_out<T>(&self, way: Way, of: impl Fn(&SmoothedLeaf, usize, [f32; 3]) -> T) -> Vec<T> {
        let first = self.others / LEAF;
        let leaves: Vec<_> = (first..self.index.leaves()).collect();
        let smoothed = self.smooth(way, &leaves);
        let points = (self.others..self.index.len()).zip(&self.measured);
        points.map(|(place, &measured)| of(&smoothed[place / LEAF - first], place % LEAF, measured)).collect()
    }

    /// Returns which leaves are within reach of the leaves with held-out points.
    fn around_held_out(&self, reach_m: impl Fn(usize) -> f32) -> Vec<bool> {
        let mut is_near = vec![false; self.index.leaves()];
        for leaf in self.others / LEAF..self.index.leaves() {
            let around = self.index.leaf_bounds(leaf).grown(reach_m(leaf));
            self.index.for_each_leaf(|bounds| bounds.overlaps(&around), |leaf, _| is_near[leaf] = true);
        }
        is_near
    }

    /// Returns the squared distances of the held-out points from the surface, NaN for those without one, in m².
    pub(super) fn errors(&self, way: Way) -> Vec<f64> {
        self.of_held_out(way, SmoothedLeaf::error)
    }

    /// Smooths the points of some leaves: those with held-out points, if edges are kept.
    fn smooth(&self, way: Way, leaves: &[usize]) -> Vec<SmoothedLeaf> {
        let Self { index, sensor, level, .. } = self;
        let density =
            Density { half: way.neighbours as f32 / 2.0, largest_m: (index.extent_m() / 2.0).min(MAX_RANGE_M) };
        let mut radii = vec![f32::NAN; LEAF * index.leaves()];
        let mut is_wanted = vec![false; index.leaves()];
        leaves.iter().for_each(|&leaf| is_wanted[leaf] = true);
        solve(*level, index, density, &mut radii, &is_wanted);
        let params = CloudParams::default();
        let fitting = Fitting {
            bandwidth_m: params.fit.bandwidth_m,
            ridge: params.fit.ridge,
            keeps_isolated: true,
            least_neighbours: way.neighbours.div_ceil(4) as f32,
        };
        let mut planes = FirstPlanes::default();
        if way.edges == Edges::Robust {
            let of_leaf = |leaf: usize| &radii[LEAF * leaf..LEAF * (leaf + 1)];
            let is_near = self.around_held_out(|leaf| PLANES_REACH * of_leaf(leaf).iter().copied().fold(0.0, f32::max));
            let is_new: Vec<_> =
                (0..index.leaves()).map(|leaf| is_near[leaf] && !is_wanted[leaf] && leaf % ONE_LEAF_IN == 0).collect();
            solve(*level, index, density, &mut radii, &is_new);
            let kernel = Kernel { fitting, sensor: *sensor, index, radii: Radii::Known(&radii), first_planes: None };
            let FirstPlaneRows { planes: of_points, radii: taken, .. } = planes.rows(index.leaves());
            let rows = of_points.par_chunks_mut(LEAF).zip(taken.par_chunks_mut(LEAF)).enumerate();
            rows.filter(|(leaf, _)| is_wanted[*leaf] || is_new[*leaf]).for_each(|(first, (planes, radii))| {
                fit_first_planes(*level, &kernel, &mut FirstPlaneRows { first, planes, radii });
            });
        }
        let first_planes = (way.edges == Edges::Robust).then_some(&planes);
        let kernel = Kernel { fitting, sensor: *sensor, index, radii: Radii::Known(&radii), first_planes };
        let of_leaf = |&leaf: &usize| {
            let mut of = Smoothed::default();
            of.prepare(LEAF, 1, Outputs::POINTS.with_normals(true).with_status(true));
            let mut rows = OutputRows::of_grid((LEAF, 1), of.as_mut());
            rows.first = leaf;
            smooth_rows::<2>(*level, &kernel, &mut rows);
            SmoothedLeaf::new(of, &radii[LEAF * leaf..LEAF * (leaf + 1)])
        };
        leaves.par_iter().map(of_leaf).collect()
    }
}

/// Computes the radii of the points of some leaves.
fn solve(level: Level, index: &PointIndex, density: Density, radii: &mut [f32], is_wanted: &[bool]) {
    let leaves = radii.par_chunks_mut(LEAF).enumerate().filter(|(leaf, _)| is_wanted[*leaf]);
    leaves.for_each(|(first, radii)| radius::solve(level, index, density, &mut RadiusRows { first, radii }));
}

fn index_of(points: impl Iterator<Item = [f32; 3]>) -> Result<PointIndex, FrameError> {
    let mut index = PointIndex::default();
    index.fill(&PointsView::from_rows(&points.collect::<Vec<_>>())?);
    Ok(index)
}

/// Returns which leaves have points to hold out: all of a small cloud, or groups of leaves that lie together.
fn sampled_leaves(index: &PointIndex) -> impl Fn(usize) -> bool {
    let leaves = index.leaves();
    let is_small = leaves <= GROUPS * GROUP_LEAVES;
    // Each group is in the middle of its share of the leaves.
    move |leaf| is_small || (leaf * GROUPS % leaves).abs_diff(leaves / 2) < GROUPS * GROUP_LEAVES / 2
}

/// The smoothed points of a leaf.
struct SmoothedLeaf {
    points: Xyz,
    normals: Xyz,
    /// Those that have a surface, and are no strays: these have wider neighbourhoods than the points beside them.
    counts: [bool; LEAF],
}

impl SmoothedLeaf {
    fn new(smoothed: Smoothed, radii: &[f32]) -> Self {
        let mut sorted: Vec<f32> = radii.iter().copied().filter(|radius| radius.is_finite()).collect();
        sorted.sort_by(f32::total_cmp);
        let widest_m = sorted.get(sorted.len() / 2).map_or(f32::INFINITY, |middle| MAX_RADIUS_RATIO * middle);
        let status = smoothed.status.unwrap_or_default();
        let counts = std::array::from_fn(|k| status[k].has_normal() && radii[k] <= widest_m);
        Self { points: smoothed.points, normals: smoothed.normals.unwrap_or_default(), counts }
    }

    /// Returns point `k` if it counts.
    fn point(&self, k: usize) -> Option<[f32; 3]> {
        self.counts[k].then(|| self.points.get(k))
    }

    /// Returns the squared distance of a place from the surface at point `k`; NaN if that does not count.
    fn error(&self, k: usize, [x, y, z]: [f32; 3]) -> f64 {
        let Some([a, b, c]) = self.point(k) else { return f64::NAN };
        let [u, v, w] = self.normals.get(k);
        f64::from((x - a) * u + (y - b) * v + (z - c) * w).powi(2)
    }
}
