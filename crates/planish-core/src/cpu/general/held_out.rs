//! Points of a cloud that are held out, to compare ways to smooth it (docs/method.md, section 8): the best surface is
//! the one that is nearest to points that it was not fitted to.

use super::leaves::{Kernels, Miss, SmoothedLeaf, Way, leaves_around};
use crate::error::FrameError;
use crate::frame::PointsView;
use crate::neighbours::{LEAF, PointIndex};
use crate::params::Edges;

/// One point in this many is held out, of some groups of points that lie together.
const ONE_IN: usize = 8;
/// The number of groups in a large cloud, and of leaves in each.
const GROUPS: usize = 32;
const GROUP_LEAVES: usize = 1024 / LEAF;

/// A pass over all points before the surface is sought.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstPass {
    pub(super) neighbours: u32,
    /// How far around the leaves with held-out points it goes.
    pub(super) reach_m: f32,
}

/// A cloud with points held out.
pub(super) struct HeldOut {
    /// The other points, followed by the held-out ones.
    index: PointIndex,
    others: usize,
    /// Measured positions of the held-out points.
    measured: Vec<[f32; 3]>,
    kernels: Kernels,
}

impl HeldOut {
    /// Holds out points of a cloud. They are smoothed in this way before they are compared with a surface: otherwise
    /// their noise would decide which surface is theirs. If there is a first pass, it smooths the others.
    pub(super) fn new(
        cloud: &PointIndex,
        kernels: Kernels,
        way: Way,
        first: Option<FirstPass>,
    ) -> Result<Self, FrameError> {
        let is_sampled = sampled_leaves(cloud);
        let is_held_out = |&place: &usize| is_sampled(place / LEAF) && place % ONE_IN == place / LEAF % ONE_IN;
        let (held_out, others): (Vec<usize>, Vec<usize>) = (0..cloud.len()).partition(is_held_out);
        let measured: Vec<_> = held_out.iter().map(|&place| cloud.point(place)).collect();
        let others: Vec<_> = others.iter().map(|&place| cloud.point(place)).collect();
        let index = index_of(&others)?;
        let mut apart = Self { others: index.len(), index, measured, kernels };
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

    /// Returns the other points after a first pass around the held-out ones.
    fn smooth_others(&self, FirstPass { neighbours, reach_m }: FirstPass) -> Result<PointIndex, FrameError> {
        let held_out: Vec<_> = (self.others / LEAF..self.index.leaves()).collect();
        let near = leaves_around(&self.index, &held_out, &|_| reach_m);
        let smoothed = self.kernels.smooth(&self.index, Way { edges: Edges::Off, neighbours }, &near);
        let mut points: Vec<_> = (0..self.others).map(|place| self.index.point(place)).collect();
        for (leaf, smoothed) in near.iter().zip(&smoothed) {
            for (k, point) in points.iter_mut().skip(LEAF * leaf).take(LEAF).enumerate() {
                *point = smoothed.point(k).unwrap_or(*point);
            }
        }
        index_of(&points)
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
        let smoothed = self.kernels.smooth(&self.index, way, &leaves);
        let points = (self.others..self.index.len()).zip(&self.measured);
        points.map(|(place, &measured)| of(&smoothed[place / LEAF - first], place % LEAF, measured)).collect()
    }

    /// Returns how far each held-out point was measured from the surface.
    pub(super) fn misses(&self, way: Way) -> Vec<Miss> {
        self.of_held_out(way, SmoothedLeaf::miss)
    }
}

fn index_of(points: &[[f32; 3]]) -> Result<PointIndex, FrameError> {
    let mut index = PointIndex::default();
    index.fill(&PointsView::from_rows(points)?);
    Ok(index)
}

/// Returns which leaves have points to hold out: all of a small cloud, or groups of leaves that lie together.
fn sampled_leaves(index: &PointIndex) -> impl Fn(usize) -> bool {
    let leaves = index.leaves();
    let is_small = leaves <= GROUPS * GROUP_LEAVES;
    // Each group is in the middle of its share of the leaves.
    move |leaf| is_small || (leaf * GROUPS % leaves).abs_diff(leaves / 2) < GROUPS * GROUP_LEAVES / 2
}
