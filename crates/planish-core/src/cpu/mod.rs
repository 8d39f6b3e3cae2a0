//! The CPU engine: docs/method.md in f32, a vector of neighbouring pixels at a time, for organized clouds.
//!
//! Stages have the names of the reference, one file each, and are written once for all SIMD levels ([`SimdLevel`]). A
//! frame is copied into a padded one ([`padded`]), and tasks take bands of rows ([`row_tasks`], [`output`]). Each
//! vector of pixels passes through [`window`], [`plane`] with [`eigen`], [`polynomial`], [`solve`] and [`project`]. If
//! blocks are averaged or edges kept, [`blocks`] and [`edges`] run up to three passes before and one after. Coordinates
//! are in the cloud's frame; [`sensor`] supplies everything that depends on the sensor. Each pass reads only results of
//! finished passes, so threads change no bit. Lanes are independent, so a pixel's position in its vector changes none
//! either.

// A condition on constants in a loop written out is always true or always false in each copy.
#![allow(clippy::absurd_extreme_comparisons)]

mod bend;
mod blocks;
mod channels;
mod edges;
mod eigen;
mod general;
mod math;
mod output;
mod padded;
mod plane;
mod polynomial;
mod project;
mod row_tasks;
mod sensor;
mod solve;
#[cfg(test)]
mod tests;
mod unroll;
mod vector;
mod window;

use std::time::Duration;

use fearless_simd::{Level, Select, Simd, SimdBase, SimdFloat, SimdMask, dispatch};

use crate::camera::Rays;
use crate::constants::LEAST_NEIGHBOURS;
use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::outputs::SmoothedMut;
use crate::params::{Edges, EngineParams, edge_shift_px};
use crate::range::{MAX_RADIUS_M, MAX_RANGE_M, MIN_GATE_M, RangeRules};
use crate::simd_level::SimdLevel;
use crate::smoothing_engine::{AdmittedFrame, ImmediateEngine};
use crate::threads::Threads;
use crate::timings::{FrameTimings, Stopwatch};
use edges::{FirstPlanes, FirstRows, SurfaceRows, Surfaces};
pub use general::CloudEstimate;
pub(crate) use general::Decided;
pub(crate) use general::GeneralCpu;
use output::OutputRows;
use padded::{PaddedFrame, PaddedRows};
use plane::{Points, Surface};
use polynomial::{Source, Terms, Weighting};
use project::{Projected, Projection};
use row_tasks::{SplitRows, run_on_rows};
use sensor::Sensor;
use vector::{Mask, Vec3, splat};
use window::{Candidates, Window};

/// Parameters of a kernel.
struct Kernel {
    /// Candidates along a side of the window, 2k + 1.
    side: usize,
    stride: usize,
    /// Half width of the blocks that are averaged, in pixels.
    block_half: usize,
    degree: u32,
    rules: RangeRules,
    sensor: Sensor,
    fitting: Fitting,
    /// Whether points move along their rays.
    on_ray: bool,
}

/// How the surface is fitted over a plane.
#[derive(Clone, Copy)]
struct Fitting {
    bandwidth_m: Option<f32>,
    ridge: f32,
    /// Whether points with too few neighbours are kept unchanged.
    keeps_isolated: bool,
    /// With fewer a point has too few.
    least_neighbours: f32,
}

/// c0 + c1 z + c2 z².
#[inline(always)]
fn polynomial_in_range<S: Simd>(simd: S, [c0, c1, c2]: [f32; 3], range: S::f32s) -> S::f32s {
    (range * splat(simd, c2) + splat(simd, c1)) * range + splat(simd, c0)
}

impl RangeRules {
    #[inline(always)]
    fn radius<S: Simd>(&self, simd: S, range: S::f32s) -> S::f32s {
        let radius = (range * splat(simd, self.linear)).max(polynomial_in_range(simd, self.radius, range));
        // A coordinate of 1e30 would give an infinite radius; values computed from it must stay finite.
        radius.max(splat(simd, MIN_GATE_M)).min(splat(simd, MAX_RADIUS_M))
    }

    /// Returns the maximum distance between a pixel's point and the points of its block.
    #[inline(always)]
    fn block_gate<S: Simd>(&self, simd: S, range: S::f32s) -> S::f32s {
        let gate = (range * splat(simd, self.block_linear)).max(polynomial_in_range(simd, self.block, range));
        gate.max(splat(simd, MIN_GATE_M)).min(splat(simd, MAX_RADIUS_M))
    }
}

impl Kernel {
    /// Returns the ranges at the end of rays, limited so that squares stay finite; beyond the limit the radius is
    /// constant anyway.
    #[inline(always)]
    fn range<S: Simd>(&self, simd: S, ray: Vec3<S>) -> S::f32s {
        let range = if self.rules.by_distance { ray.dot(ray).sqrt() } else { self.sensor.depth(simd, ray).abs() };
        range.min(splat(simd, MAX_RANGE_M))
    }
}

/// Returns the instruction set to use: the widest of this machine, or the given one.
fn level(simd: Option<SimdLevel>) -> Result<Level, EngineError> {
    let machine = Level::new();
    let Some(level) = simd else { return Ok(machine) };
    let reason = || format!("this machine or build has no {}", level.name());
    level.token(machine).ok_or_else(|| EngineError::Unavailable { engine: "cpu", reason: reason() })
}

/// The CPU engine for frames on a grid, with its buffers.
pub(crate) struct Cpu {
    params: EngineParams,
    level: Level,
    /// `None` runs on the calling thread.
    threads: Option<Threads>,
    padded: PaddedFrame,
    /// Where blocks are averaged.
    means: Option<PaddedFrame>,
    /// First planes and surfaces, if edges are kept.
    planes: Option<(FirstPlanes, Surfaces)>,
    rays: Rays,
    timings: FrameTimings,
}

impl Cpu {
    pub(crate) fn open(
        params: EngineParams,
        threads: Option<usize>,
        simd: Option<SimdLevel>,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let level = level(simd)?;
        let threads = if threads == Some(1) { None } else { Some(Threads::open(threads)?) };
        let border = params.reach_px().max(edge_shift_px(params.reach_px()));
        let padded = PaddedFrame::new(shape.0, shape.1, border);
        let means = params.averages_blocks().then(|| PaddedFrame::new(shape.0, shape.1, border));
        let planes =
            (params.edges == Edges::Robust).then(|| (FirstPlanes::new(&params, &padded), Surfaces::new(&padded)));
        let (rays, timings) = (Rays::default(), FrameTimings::default());
        Ok(Self { params, level, threads, padded, means, planes, rays, timings })
    }

    /// Fills the padded frame and smooths all rows, on the threads of the pool that it is called in or on the calling
    /// one.
    fn smooth_rows(&mut self, frame: &AdmittedFrame<'_>, kernel: &Kernel, out: SmoothedMut<'_>, parallel: bool) {
        let level = self.level;
        let start = Stopwatch::start();
        self.padded.fill(frame, &self.rays, parallel);
        let upload = start.elapsed();
        let measured = &self.padded;
        if let Some(means) = &mut self.means {
            let average =
                |mut rows: PaddedRows<'_>| dispatch!(level, simd => blocks::average(simd, measured, kernel, &mut rows));
            run_on_rows(means.rows(), parallel, &average);
        }
        let out = OutputRows::all(frame, out);
        if let Some((first_planes, surfaces)) = &mut self.planes {
            let height = frame.frame.shape().1;
            let input = Input { measured, samples: self.means.as_ref().unwrap_or(measured) };
            let fit = |mut rows: FirstRows<'_>| dispatch!(level, simd => edges::fit_first_planes(simd, input, kernel, &mut rows));
            run_on_rows(first_planes.rows(height), parallel, &fit);
            let first_planes = &*first_planes;
            let find = |mut rows: SurfaceRows<'_>| dispatch!(level, simd => edges::find_surfaces(simd, measured, first_planes, kernel, &mut rows));
            run_on_rows(surfaces.rows(height, self.means.as_mut().map(PaddedFrame::rows)), parallel, &find);
            let input = Input { measured, samples: self.means.as_ref().unwrap_or(measured) };
            let rows = surfaces.rows(height, None);
            if self.params.averages_surfaces() {
                run_fit(
                    level,
                    kernel,
                    input,
                    Some(first_planes),
                    FitRows { surfaces: Some(rows), out: None },
                    parallel,
                );
                let surfaces = &*surfaces;
                let average = |mut rows: OutputRows<'_>| dispatch!(level, simd => edges::average_surfaces(simd, measured, (first_planes, surfaces), kernel, &mut rows));
                run_on_rows(out, parallel, &average);
            } else {
                let rows = FitRows { surfaces: Some(rows), out: Some(out) };
                run_fit(level, kernel, input, Some(first_planes), rows, parallel);
            }
        } else {
            let input = Input { measured, samples: self.means.as_ref().unwrap_or(measured) };
            run_fit(level, kernel, input, None, FitRows { surfaces: None, out: Some(out) }, parallel);
        }
        self.timings = FrameTimings { upload, kernel: start.elapsed() - upload, readback: Duration::ZERO };
    }
}

/// Fits the surfaces of all rows.
fn run_fit(
    level: Level,
    kernel: &Kernel,
    input: Input<'_>,
    first_planes: Option<&FirstPlanes>,
    rows: FitRows<'_>,
    parallel: bool,
) {
    let fit = |mut rows: FitRows<'_>| match kernel.degree {
        1 => dispatch!(level, simd => fit_rows::<_, 1>(simd, input, first_planes, kernel, &mut rows)),
        2 => dispatch!(level, simd => fit_rows::<_, 2>(simd, input, first_planes, kernel, &mut rows)),
        _ => dispatch!(level, simd => fit_rows::<_, 3>(simd, input, first_planes, kernel, &mut rows)),
    };
    run_on_rows(rows, parallel, &fit);
}

impl ImmediateEngine for Cpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        if let Frame::Depth(depth) = frame.frame {
            self.rays.set(depth.camera());
        }
        let kernel = Kernel {
            side: 2 * self.params.window as usize + 1,
            stride: self.params.stride as usize,
            block_half: self.params.block_half_px(),
            degree: self.params.degree,
            rules: RangeRules::new(&self.params, &frame.geometry),
            sensor: Sensor::new(&frame.geometry),
            fitting: Fitting {
                bandwidth_m: self.params.bandwidth_m,
                ridge: self.params.ridge,
                keeps_isolated: false,
                least_neighbours: LEAST_NEIGHBOURS,
            },
            on_ray: frame.geometry.is_on_rays(self.params.project),
        };
        match self.threads.take() {
            None => self.smooth_rows(frame, &kernel, out, false),
            Some(threads) => {
                threads.install(|| self.smooth_rows(frame, &kernel, out, true));
                self.threads = Some(threads);
            }
        }
        Ok(())
    }

    fn timings(&self) -> Option<FrameTimings> {
        Some(self.timings)
    }

    /// Includes its padded frames and planes.
    fn buffer_bytes(&self) -> u64 {
        let means = self.means.as_ref().map_or(0, PaddedFrame::bytes);
        let planes = self.planes.as_ref().map_or(0, |(first_planes, surfaces)| first_planes.bytes() + surfaces.bytes());
        (self.padded.bytes() + means + planes) as u64
    }
}

/// What the passes read.
#[derive(Clone, Copy)]
struct Input<'a> {
    /// The points as measured.
    measured: &'a PaddedFrame,
    /// Samples of the windows: the points, or their block means.
    samples: &'a PaddedFrame,
}

/// A band of rows of the last fit.
struct FitRows<'a> {
    /// The surfaces over which it fits, if edges are kept.
    surfaces: Option<SurfaceRows<'a>>,
    /// Where results go; `None` keeps them in place of the surfaces.
    out: Option<OutputRows<'a>>,
}

impl SplitRows for FitRows<'_> {
    fn count(&self) -> usize {
        let surfaces = self.surfaces.as_ref().map(SplitRows::count);
        surfaces.or(self.out.as_ref().map(SplitRows::count)).unwrap_or(0)
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let (surfaces, surfaces_after) = self.surfaces.map(|surfaces| surfaces.split_at(rows)).unzip();
        let (out, out_after) = self.out.map(|out| out.split_at(rows)).unzip();
        (Self { surfaces, out }, Self { surfaces: surfaces_after, out: out_after })
    }
}

impl FitRows<'_> {
    /// The first row's number in the image.
    fn first(&self) -> usize {
        let surfaces = self.surfaces.as_ref().map(|surfaces| surfaces.first);
        surfaces.or(self.out.as_ref().map(|out| out.first)).unwrap_or(0)
    }

    fn projection(&self, on_ray: bool) -> Projection {
        // Means of surfaces take everything.
        let all = Projection {
            on_ray,
            needs_normal: true,
            needs_depth: true,
            keeps_isolated: false,
            least_neighbours: LEAST_NEIGHBOURS,
        };
        self.out.as_ref().map_or(all, |out| out.projection(on_ray))
    }
}

#[inline(always)]
fn fit_rows<S: Simd, const D: usize>(
    simd: S,
    input: Input<'_>,
    first_planes: Option<&FirstPlanes>,
    kernel: &Kernel,
    rows: &mut FitRows<'_>,
) {
    let mut terms = Terms::new(simd);
    for row in 0..rows.count() {
        for u in (0..input.measured.width).step_by(S::f32s::LEN) {
            fit_vector::<S, D>(simd, kernel, input, first_planes, &mut terms, rows, (u, row));
        }
    }
}

/// Returns the lanes that are no holes: x * 0 is 0 only for finite x.
#[inline(always)]
fn valid_points<S: Simd>(simd: S, p: Vec3<S>) -> Mask<S> {
    let zero = splat(simd, 0.0);
    p.scale(zero).dot(Vec3::splat(simd, 1.0)).simd_eq(zero)
}

/// Applies sections 2 to 7 and 10 to one vector of pixels. The terms are reused between vectors, to avoid clearing
/// them.
#[inline(always)]
fn fit_vector<S: Simd, const D: usize>(
    simd: S,
    kernel: &Kernel,
    input: Input<'_>,
    first_planes: Option<&FirstPlanes>,
    terms: &mut Terms<S>,
    rows: &mut FitRows<'_>,
    (u, row): (usize, usize),
) {
    let v = rows.first() + row;
    let here = input.measured.index(u, v);
    let p = input.measured.load(simd, here);
    let valid = valid_points(simd, p);
    if !valid.any_true() {
        match rows {
            FitRows { out: Some(out), .. } => out.store_holes(row, u, S::f32s::LEN),
            FitRows { surfaces, .. } => surfaces.iter_mut().for_each(|surfaces| surfaces.keep_holes(simd, (u, row))),
        }
        return;
    }
    let ray = kernel.sensor.ray(simd, p);
    let range = kernel.range(simd, ray);
    let radius = kernel.rules.radius(simd, range);
    let window = Window::at(input.samples, kernel, u, v);
    let (surface, source) = match (first_planes, &rows.surfaces) {
        (Some(first_planes), Some(surfaces)) => {
            let surface = surfaces.surface(simd, first_planes, (u, row), here);
            let n = valid.select(surface.n, splat(simd, 0.0));
            (Surface { n, ..surface }, Source::Of(window))
        }
        _ => {
            let (sums, source) = terms.keep(simd, window, p, radius);
            let plane = plane::fit(simd, ray, &sums);
            (Surface { plane, n: sums.n, width: None, bend: None, no_plane_fits: None }, source)
        }
    };
    let projection = rows.projection(kernel.on_ray);
    let fitting = &kernel.fitting;
    let points = Points { p, ray, radius, valid };
    let projected = fitting.fit::<S, _, D>(simd, source, points, &surface, projection, terms);
    match rows {
        FitRows { out: Some(out), .. } => out.store(row, u, kernel.sensor.depth(simd, ray), &projected, &surface),
        FitRows { surfaces, .. } => surfaces.iter_mut().for_each(|surfaces| surfaces.keep(simd, (u, row), &projected)),
    }
}

impl Fitting {
    /// Sections 5 to 7 for points over their surfaces.
    #[inline(always)]
    fn fit<S: Simd, C: Candidates<S>, const D: usize>(
        &self,
        simd: S,
        source: Source<C>,
        points: Points<S>,
        surface: &Surface<S>,
        projection: Projection,
        terms: &mut Terms<S>,
    ) -> Projected<S> {
        let Points { p, radius, .. } = points;
        let Surface { plane, n, width, bend, no_plane_fits } = surface;
        let Self { keeps_isolated, least_neighbours, .. } = *self;
        let projection = Projection { keeps_isolated, least_neighbours, ..projection };
        if D == 1 {
            return project::project::<S, D>(simd, points, surface, None, projection);
        }
        let bandwidth = self.bandwidth_m.map_or(
            radius,
            #[inline(always)]
            |bandwidth_m| splat(simd, bandwidth_m),
        );
        let weighting = Weighting { radius, bandwidth, width: *width, bend: *bend, no_plane_fits: *no_plane_fits };
        let polynomial = polynomial::fit::<S, C, D>(simd, source, p, (plane, *n), &weighting, self.ridge, terms);
        project::project::<S, D>(simd, points, surface, Some(&polynomial), projection)
    }
}
