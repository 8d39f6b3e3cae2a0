//! Holds out points of a cloud to compare smoothing parameters (docs/method.md, section 8): the best surface is the
//! one nearest to points that it was not fitted to.

use glam::Vec3;

use super::leaves::{Kernels, OnSurface, Way, leaves_around};
use crate::error::FrameError;
use crate::frame::PointsView;
use crate::neighbours::{LEAF, PointIndex};
use crate::params::Edges;

/// Interval between held-out points in each sampled leaf: one of eight is held out.
pub(super) const ONE_IN: usize = 8;
/// Number of groups of leaves that are sampled in a large cloud.
const GROUPS: usize = 32;
/// Number of leaves in each group.
const GROUP_LEAVES: usize = 1024 / LEAF;

/// Squared distances, in m², between a measured point and the point on the surface that it was moved to; NaN if it
/// has no surface.
#[derive(Debug, Clone, Copy)]
pub(super) struct Miss {
    /// Squared distance along the surface's normal.
    pub(super) along: f64,
    /// Squared distance in space.
    pub(super) whole: f64,
}

impl Miss {
    fn of(surface: &Option<OnSurface>, measured: [f32; 3]) -> Self {
        let Some(OnSurface { point, normal }) = *surface else { return Self { along: f64::NAN, whole: f64::NAN } };
        let off = Vec3::from_array(measured) - Vec3::from_array(point);
        Self { along: off.dot(Vec3::from_array(normal)).powi(2).into(), whole: off.length_squared().into() }
    }
}

/// Parameters of a first pass, before the surface is fitted.
#[derive(Debug, Clone, Copy)]
pub(super) struct FirstPass {
    pub(super) neighbours: u32,
    /// Distance from the leaves with held-out points, in metres, within which other points are smoothed.
    pub(super) reach_m: f32,
}

/// A cloud with points held out.
pub(super) struct HeldOut {
    /// The points that are not held out, followed by the held-out points.
    index: PointIndex,
    others: usize,
    /// Measured positions of the held-out points.
    measured: Vec<[f32; 3]>,
    kernels: Kernels,
}

impl HeldOut {
    /// Holds out points of a cloud, other ones for each `fold` from 0 to [`ONE_IN`] - 1. They are smoothed with the
    /// parameters `way` before they are compared with a surface; otherwise their noise would determine which surface
    /// they belong to. A first pass, if any, smooths the other points.
    pub(super) fn new(
        cloud: &PointIndex,
        kernels: Kernels,
        way: Way,
        first: Option<FirstPass>,
        fold: usize,
    ) -> Result<Self, FrameError> {
        let is_sampled = sampled_leaves(cloud);
        let is_held_out = |&place: &usize| is_sampled(place / LEAF) && place % ONE_IN == (place / LEAF + fold) % ONE_IN;
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
        let near = leaves_around(self.kernels.level, &self.index, &held_out, &|_| reach_m);
        let smoothed = self.kernels.smooth(&self.index, Way { edges: Edges::Off, neighbours }, &near);
        let mut points: Vec<_> = (0..self.others).map(|place| self.index.point(place)).collect();
        for (leaf, smoothed) in near.iter().zip(&smoothed) {
            for (k, point) in points.iter_mut().skip(LEAF * leaf).take(LEAF).enumerate() {
                *point = smoothed.on_surface(k).map_or(*point, |smoothed| smoothed.point);
            }
        }
        index_of(&points)
    }

    /// Moves the held-out points onto the surface of the other points.
    fn move_held_out(&mut self, way: Way) {
        let onto = |(place, smoothed): (usize, Option<OnSurface>)| {
            smoothed.map_or(self.index.point(place), |smoothed| smoothed.point)
        };
        let points: Vec<_> = (self.others..).zip(self.smoothed(way)).map(onto).collect();
        self.index.append(self.others, &points);
    }

    /// Returns the smoothed held-out points; `None` for each point without a surface.
    fn smoothed(&self, way: Way) -> Vec<Option<OnSurface>> {
        let first = self.others / LEAF;
        let leaves: Vec<_> = (first..self.index.leaves()).collect();
        let smoothed = self.kernels.smooth(&self.index, way, &leaves);
        let places = self.others..self.index.len();
        places.map(|place| smoothed[place / LEAF - first].on_surface(place % LEAF)).collect()
    }

    /// Returns the squared distances between each held-out point, as measured, and its surface, as smoothed with `way`.
    pub(super) fn misses(&self, way: Way) -> Vec<Miss> {
        self.smoothed(way).iter().zip(&self.measured).map(|(surface, measured)| Miss::of(surface, *measured)).collect()
    }
}

fn index_of(points: &[[f32; 3]]) -> Result<PointIndex, FrameError> {
    let mut index = PointIndex::default();
    index.fill(&PointsView::from_rows(points)?);
    Ok(index)
}

/// Returns a predicate for leaves with points to hold out: all leaves of a small cloud, otherwise groups of
/// consecutive leaves.
fn sampled_leaves(index: &PointIndex) -> impl Fn(usize) -> bool {
    let leaves = index.leaves();
    let is_small = leaves <= GROUPS * GROUP_LEAVES;
    // Each group is in the middle of its share of the leaves.
    move |leaf| is_small || (leaf * GROUPS % leaves).abs_diff(leaves / 2) < GROUPS * GROUP_LEAVES / 2
}
