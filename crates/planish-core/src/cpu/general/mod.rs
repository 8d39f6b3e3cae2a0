//! Smooths unorganized clouds (docs/method.md, section 8) in vectors of nearby points.
//!
//! [`PointIndex`] sorts the points. The neighbours of all points of a vector are gathered once ([`gather`]) and then
//! pass through the same stages as a frame's neighbours. Each point's result is computed independently of the others,
//! in the order of the index, and then moved to the order of the cloud. Results are therefore bit-identical for any
//! number of threads.

mod edges;
mod estimate;
mod first_planes;
mod gather;
mod held_out;
mod kernel;
mod leaves;
mod radius;

use std::sync::Arc;

use fearless_simd::{Level, Select, Simd, SimdBase, SimdMask, dispatch};

use super::Fitting;
use super::output::OutputRows;
use super::plane::{self, Points, Surface};
use super::polynomial::{Source, Terms};
use super::row_tasks::{SplitRows, halve};
use super::sensor::Sensor;
use super::vector::{Mask, splat};
use super::window::Candidates;
use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::neighbours::{LEAF, PointIndex};
use crate::outputs::{Outputs, SmoothedMut};
use crate::params::{Edges, EngineParams, Radius};
use crate::progress::Progress;
use crate::range::{MAX_RANGE_M, RangeRules};
use crate::simd_level::SimdLevel;
use crate::smoothed::Smoothed;
use crate::smoothing_engine::{AdmittedFrame, ImmediateEngine};
use crate::threads::Threads;
pub use estimate::CloudEstimate;
pub(crate) use estimate::Decided;
use first_planes::{FirstPlaneRows, FirstPlanes};
use gather::{Gathered, load};
use kernel::{Kernel, Radii};
use radius::{Density, LeastRadius, RadiusRows};

/// Number of leaves per task, enough to make the overhead of a task negligible.
const LEAVES_PER_TASK: usize = 64;

/// The CPU engine for unorganized clouds, with its buffers.
pub(crate) struct GeneralCpu {
    params: EngineParams,
    level: Level,
    threads: Threads,
    outputs: Outputs,
    index: PointIndex,
    /// Radii in the order of the index, if they differ between points.
    radii: Vec<f32>,
    /// First planes with their radii, if edges are kept.
    first_planes: FirstPlanes,
    sorted: Smoothed,
    progress: Arc<Progress>,
}

impl GeneralCpu {
    pub(crate) fn open(
        params: EngineParams,
        outputs: Outputs,
        threads: Option<usize>,
        simd: Option<SimdLevel>,
    ) -> Result<Self, EngineError> {
        let (level, threads) = (super::level(simd)?, Threads::open(threads)?);
        let (index, radii, first_planes, sorted, progress) = Default::default();
        Ok(Self { params, level, threads, outputs, index, radii, first_planes, sorted, progress })
    }

    fn smooth_points(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) {
        let Frame::Points(view) = frame.frame else { return };
        let Self { params, level, outputs, index, radii, first_planes, sorted, progress, .. } = self;
        let level = *level;
        progress.reset();
        index.fill(&view);
        // Computing radii takes about a tenth of the time of the fits, first planes about half.
        let of_radius = if params.radius.density().is_some() { 1 } else { 0 };
        let of_fit = 9;
        let keeps_edges = params.edges != Edges::Off;
        let of_first_plane = if keeps_edges { 5 } else { 0 };
        progress.begin((of_radius + of_first_plane + of_fit) * index.leaves());
        let sensor = Sensor::new(&frame.geometry);
        let radii = match params.radius {
            Radius::Fixed { radius_m } => Radii::Fixed(radius_m),
            // `Smoother::open` rejects `Radius::Sensor`.
            Radius::Neighbours { count } | Radius::SensorAndDensity { count } => {
                let is_ranged = matches!(params.radius, Radius::SensorAndDensity { .. });
                let least = LeastRadius { sensor, rules: RangeRules::new(params, &frame.geometry) };
                let largest_m = (index.extent_m() / 2.0).min(MAX_RANGE_M);
                let density = Density { half: count as f32 / 2.0, largest_m, least: is_ranged.then_some(least) };
                radii.resize(LEAF * index.leaves(), f32::NAN);
                let solve = |mut rows: RadiusRows<'_>| {
                    if progress.is_stopped() {
                        return;
                    }
                    radius::solve(level, index, density, &mut rows);
                    progress.add(of_radius * rows.count());
                };
                halve(LEAVES_PER_TASK, RadiusRows { first: 0, radii }, &solve);
                Radii::Of(radii)
            }
            Radius::Sensor => return,
        };
        let mut kernel = Kernel {
            fitting: Fitting {
                bandwidth_m: params.bandwidth_m,
                ridge: params.ridge,
                keeps_isolated: !params.remove_isolated,
                least_neighbours: params.least_neighbours(&view) as f32,
            },
            sensor,
            on_ray: frame.geometry.is_on_rays(params.project),
            index,
            radii,
            first_planes: None,
        };
        if keeps_edges {
            let fit = |mut rows: FirstPlaneRows<'_>| {
                if progress.is_stopped() {
                    return;
                }
                fit_first_planes(level, &kernel, &mut rows);
                progress.add(of_first_plane * rows.count());
            };
            halve(LEAVES_PER_TASK, first_planes.rows(index.leaves()), &fit);
            kernel.first_planes = Some(first_planes);
        }
        sorted.prepare(LEAF, index.leaves(), *outputs);
        let smooth = |mut rows: OutputRows<'_>| {
            if progress.is_stopped() {
                return;
            }
            match params.degree {
                1 => smooth_rows::<1>(level, &kernel, &mut rows),
                2 => smooth_rows::<2>(level, &kernel, &mut rows),
                _ => smooth_rows::<3>(level, &kernel, &mut rows),
            }
            progress.add(of_fit * rows.count());
        };
        halve(LEAVES_PER_TASK, OutputRows::of_grid((LEAF, index.leaves()), sorted.as_mut()), &smooth);
        if progress.is_stopped() {
            return;
        }
        let unsort = |mut rows: OutputRows<'_>| rows.take_from(sorted, |i| index.place(i));
        halve(LEAF * LEAVES_PER_TASK, OutputRows::of_grid((1, view.len()), out), &unsort);
    }
}

impl ImmediateEngine for GeneralCpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        let threads = self.threads.clone();
        threads.install(|| self.smooth_points(frame, out));
        Ok(self.progress.check()?)
    }

    fn progress(&self) -> Option<Arc<Progress>> {
        Some(Arc::clone(&self.progress))
    }

    fn own_radius_m(&self, i: usize) -> Option<f32> {
        let place = self.index.place(i)?;
        self.params.radius.density().map(|_| self.radii[place])
    }

    /// Returns the size in bytes of the index, the radii, the first planes and the sorted results.
    fn buffer_bytes(&self) -> u64 {
        (self.index.bytes() + 4 * self.radii.capacity() + self.first_planes.bytes() + self.sorted.bytes()) as u64
    }
}

/// Fits the first planes of some leaves. Not inlined, so that the engine and the estimate share one copy of this
/// large kernel.
#[inline(never)]
fn fit_first_planes(level: Level, kernel: &Kernel<'_>, rows: &mut FirstPlaneRows<'_>) {
    dispatch!(level, simd => edges::fit_first_planes(simd, kernel, rows));
}

#[inline(never)]
fn smooth_rows<const D: usize>(level: Level, kernel: &Kernel<'_>, rows: &mut OutputRows<'_>) {
    dispatch!(level, simd => smooth_leaves::<_, D>(simd, kernel, rows));
}

#[inline(always)]
fn smooth_leaves<S: Simd, const D: usize>(simd: S, kernel: &Kernel<'_>, rows: &mut OutputRows<'_>) {
    let mut terms = Terms::new(simd);
    let mut gathered = Gathered::default();
    for row in 0..rows.count() {
        for u in (0..LEAF).step_by(S::f32s::LEN) {
            smooth_vector::<S, D>(simd, kernel, &mut gathered, &mut terms, rows, row, u);
        }
    }
}

#[inline(always)]
fn smooth_vector<S: Simd, const D: usize>(
    simd: S,
    kernel: &Kernel<'_>,
    gathered: &mut Gathered,
    terms: &mut Terms<S>,
    rows: &mut OutputRows<'_>,
    row: usize,
    u: usize,
) {
    let place = LEAF * (rows.first + row) + u;
    let p = load(simd, kernel.index, place);
    let valid: Mask<S> = p.x.simd_eq(p.x);
    if !valid.any_true() {
        rows.store_holes(row, u, S::f32s::LEN);
        return;
    }
    let (surface, radius) = match kernel.first_planes {
        None => {
            let radius = kernel.gather(simd, gathered, p, valid, place);
            let sums = (&*gathered).sums(simd, p, radius);
            (
                Surface {
                    plane: plane::fit(simd, kernel.sensor.ray(simd, p), &sums),
                    n: sums.n,
                    width: None,
                    bend: None,
                    no_plane_fits: None,
                },
                radius,
            )
        }
        Some(first_planes) => {
            let surface = edges::find_surfaces(simd, kernel, first_planes, gathered, p, valid, place);
            let radii = Radii::Known(first_planes.radii());
            let radius = Kernel { radii, ..*kernel }.gather(simd, gathered, p, valid, place);
            (surface, radius)
        }
    };
    // Points at distances whose squares overflow count as having one neighbour.
    let is_far = p.x.abs().max(p.y.abs()).max(p.z.abs()).simd_gt(splat(simd, MAX_RANGE_M));
    let n = valid.select(is_far.select(splat(simd, 1.0), surface.n), splat(simd, 0.0));
    let surface = Surface { n, ..surface };
    let points = Points { p, ray: kernel.sensor.ray(simd, p), radius, valid };
    let projection = rows.projection(kernel.on_ray);
    let source = Source::Of(&*gathered);
    let projected = kernel.fitting.fit::<S, _, D>(simd, source, points, &surface, projection, terms);
    rows.store(row, u, &projected, [splat(simd, 0.0), surface.plane.curvature, surface.n]);
}
