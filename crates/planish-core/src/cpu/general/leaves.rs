//! Smooths some leaves of a cloud, on all threads.

use std::sync::{Mutex, PoisonError};

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::first_planes::{FirstPlane, FirstPlaneRows, FirstPlanes};
use super::kernel::{Kernel, Radii};
use super::radius::{self, Density, RadiusRows};
use super::{fit_first_planes, smooth_rows};
use crate::constants::MAX_RADIUS_RATIO;
use crate::cpu::Fitting;
use crate::cpu::output::OutputRows;
use crate::cpu::sensor::Sensor;
use crate::neighbours::{LEAF, PointIndex};
use crate::outputs::Outputs;
use crate::params::{CloudParams, Edges};
use crate::range::MAX_RANGE_M;
use crate::smoothed::Smoothed;
use crate::threads::ONE_THREAD;
use crate::xyz::Xyz;

/// First planes are fitted in one of this many leaves around the smoothed leaves, which suffices for a comparison.
const ONE_LEAF_IN: usize = 4;
/// Distance within which first planes are fitted, in radii: slightly more than the distance within which planes vote.
const PLANES_REACH: f32 = 2.04;

/// Smoothing parameters to be compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Way {
    pub(super) edges: Edges,
    pub(super) neighbours: u32,
}

/// The kernels' inputs other than the points.
#[derive(Clone, Copy)]
pub(super) struct Kernels {
    pub(super) sensor: Sensor,
    pub(super) level: Level,
}

impl Kernels {
    /// Smooths the points of some leaves. Not inlined, to keep web builds small.
    #[inline(never)]
    pub(super) fn smooth(self, index: &PointIndex, way: Way, leaves: &[usize]) -> Vec<SmoothedLeaf> {
        let Self { sensor, level } = self;
        let largest_m = (index.extent_m() / 2.0).min(MAX_RANGE_M);
        let density = Density { half: way.neighbours as f32 / 2.0, largest_m, least: None };
        let radii_of = |first: usize| {
            let mut radii = [f32::NAN; LEAF];
            radius::solve(level, index, density, &mut RadiusRows { first, radii: &mut radii });
            radii
        };
        // Only the radii of these leaves are read.
        let mut radii = vec![f32::NAN; LEAF * index.leaves()];
        put(&mut radii, leaves, of_leaves(leaves, radii_of));
        let params = CloudParams::default();
        let fitting = Fitting {
            bandwidth_m: params.fit.bandwidth_m,
            ridge: params.fit.ridge,
            keeps_isolated: true,
            least_neighbours: way.neighbours.div_ceil(4) as f32,
        };
        let mut first_planes = None;
        if way.edges == Edges::Robust {
            let widest_m = |leaf: usize| radii[LEAF * leaf..LEAF * (leaf + 1)].iter().copied().fold(0.0, f32::max);
            let mut fitted = leaves_around(level, index, leaves, &|leaf| PLANES_REACH * widest_m(leaf));
            fitted.retain(|leaf| leaf % ONE_LEAF_IN == 0 && leaves.binary_search(leaf).is_err());
            put(&mut radii, &fitted, of_leaves(&fitted, radii_of));
            fitted.extend(leaves);
            let kernel =
                Kernel { fitting, sensor, on_ray: false, index, radii: Radii::Known(&radii), first_planes: None };
            let planes = of_leaves(&fitted, |first| {
                let (mut planes, mut radii) = ([FirstPlane::default(); LEAF], [f32::NAN; LEAF]);
                let mut rows = FirstPlaneRows { first, planes: &mut planes, radii: &mut radii };
                fit_first_planes(level, &kernel, &mut rows);
                planes
            });
            let rows = first_planes.insert(FirstPlanes::default()).rows(index.leaves());
            put(rows.planes, &fitted, planes);
            rows.radii.copy_from_slice(&radii);
        }
        let kernel = Kernel {
            fitting,
            sensor,
            on_ray: false,
            index,
            radii: Radii::Known(&radii),
            first_planes: first_planes.as_ref(),
        };
        of_leaves(leaves, |leaf| {
            let mut smoothed = Smoothed::default();
            smoothed.prepare(LEAF, 1, Outputs::POINTS.with_normals(true).with_status(true));
            let mut rows = OutputRows::of_grid((LEAF, 1), smoothed.as_mut());
            rows.first = leaf;
            smooth_rows::<2>(level, &kernel, &mut rows);
            SmoothedLeaf::new(smoothed, std::array::from_fn(|k| radii[LEAF * leaf + k]))
        })
    }
}

/// Returns the leaves within reach of the given leaves; `reach_m` returns the reach of each.
pub(super) fn leaves_around(
    level: Level,
    index: &PointIndex,
    leaves: &[usize],
    reach_m: &dyn Fn(usize) -> f32,
) -> Vec<usize> {
    let mut is_near = vec![false; index.leaves()];
    for &leaf in leaves {
        let around = index.leaf_bounds(leaf).grown(reach_m(leaf));
        dispatch!(level, simd => index.for_each_leaf(simd, &around, |leaf, _| is_near[leaf] = true));
    }
    (0..index.leaves()).filter(|&leaf| is_near[leaf]).collect()
}

/// Copies values of the points of some leaves to the places of these points.
fn put<T: Copy>(values: &mut [T], leaves: &[usize], of_leaves: Vec<[T; LEAF]>) {
    for (&leaf, of_leaf) in leaves.iter().zip(of_leaves) {
        values[LEAF * leaf..LEAF * (leaf + 1)].copy_from_slice(&of_leaf);
    }
}

/// Applies `of` to each leaf, in parallel, and returns the results in the order of the leaves.
fn of_leaves<T: Send>(leaves: &[usize], of: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let results: Vec<Mutex<Option<T>>> = leaves.iter().map(|_| Mutex::new(None)).collect();
    for_each(leaves.len(), &|i| {
        *results[i].lock().unwrap_or_else(PoisonError::into_inner) = Some(of(leaves[i]));
    });
    results.into_iter().filter_map(|result| result.into_inner().unwrap_or_else(PoisonError::into_inner)).collect()
}

/// Calls `work` for each index, in parallel. Not generic, so that the large task runner is compiled only once.
fn for_each(count: usize, work: &(dyn Fn(usize) + Sync)) {
    if ONE_THREAD { (0..count).for_each(work) } else { (0..count).into_par_iter().for_each(work) }
}

/// A smoothed point.
#[derive(Debug, Clone, Copy)]
pub(super) struct OnSurface {
    pub(super) point: [f32; 3],
    pub(super) normal: [f32; 3],
}

/// The smoothed points of a leaf.
pub(super) struct SmoothedLeaf {
    points: Xyz,
    normals: Xyz,
    radii_m: [f32; LEAF],
    /// False for points without a surface and for stray points, whose neighbourhoods are much wider than the leaf's
    /// median.
    counts: [bool; LEAF],
}

impl SmoothedLeaf {
    fn new(smoothed: Smoothed, radii_m: [f32; LEAF]) -> Self {
        let mut sorted: Vec<f64> =
            radii_m.iter().filter(|radius| radius.is_finite()).map(|&radius| f64::from(radius)).collect();
        sorted.sort_by(f64::total_cmp);
        let widest_m = sorted.get(sorted.len() / 2).map_or(f32::INFINITY, |&middle| MAX_RADIUS_RATIO * middle as f32);
        let status = smoothed.status.unwrap_or_default();
        let counts = std::array::from_fn(|k| status[k].has_normal() && radii_m[k] <= widest_m);
        Self { points: smoothed.points, normals: smoothed.normals.unwrap_or_default(), radii_m, counts }
    }

    /// Returns point `k`; `None` for a point without a surface or a stray point.
    pub(super) fn on_surface(&self, k: usize) -> Option<OnSurface> {
        self.counts[k].then(|| OnSurface { point: self.points.get(k), normal: self.normals.get(k) })
    }

    /// Returns the radius of point `k`'s neighbourhood, in metres.
    pub(super) fn radius_m(&self, k: usize) -> f32 {
        self.radii_m[k]
    }
}
