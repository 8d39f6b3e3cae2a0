//! The CPU engine: docs/method.md in f32, a vector of neighbouring pixels at a time, for organized clouds.
//!
//! Stages have the names of the reference, one file each, and are written once for all SIMD levels ([`SimdLevel`]). A
//! frame is copied into a padded one ([`padded`]), and tasks take bands of rows ([`row_tasks`], [`output`]). Each
//! vector of pixels passes through [`window`], [`plane`] with [`eigen`], [`polynomial`], [`solve`] and [`project`]. If
//! blocks are averaged or edges kept, [`blocks`] and [`edges`] run up to four passes before the fit and one after.
//! Coordinates are in the cloud's frame; [`sensor`] supplies everything that depends on the sensor. Each pass reads
//! only results of finished passes, so threads change no bit.

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
mod pixels;
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
use crate::params::{Edges, EngineParams};
use crate::range::{MAX_RADIUS_M, MAX_RANGE_M, MIN_GATE_M, RangeRules};
use crate::simd_level::SimdLevel;
use crate::smoothing_engine::{AdmittedFrame, ImmediateEngine};
use crate::threads::Threads;
use crate::timings::{FrameTimings, Stopwatch};
use blocks::BlockPixels;
use edges::{FirstPlanes, FirstRows, SurfaceRows, Surfaces};
pub use general::CloudEstimate;
pub(crate) use general::Decided;
pub(crate) use general::GeneralCpu;
use output::OutputRows;
use padded::{PaddedFrame, PaddedRows};
use pixels::Pixels;
use plane::{Points, Surface};
use polynomial::{Source, Terms, Weighting};
use project::{Projected, Projection};
use row_tasks::{SplitRows, run_on_rows};
use sensor::Sensor;
use vector::{Mask, Vec3, splat};
use window::{Candidates, Offsets, Window};

/// Parameters of a kernel.
struct Kernel {
    /// Distances to the columns and rows of the window.
    offsets: Offsets,
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
    buffers: Buffers,
    rays: Rays,
    timings: FrameTimings,
}

/// Results of the passes of a frame, kept from one pass to the next.
#[expect(clippy::large_enum_variant, reason = "an engine has one")]
enum Buffers {
    /// Every pixel has its own surface.
    Pixels {
        measured: PaddedFrame,
        /// Where blocks are averaged.
        means: Option<PaddedFrame>,
        /// First planes and surfaces, if edges are kept.
        planes: Option<(FirstPlanes, Surfaces)>,
    },
    /// The pixels of a cell share a surface.
    Cells {
        pixels: Pixels,
        /// The points of the cells.
        points: PaddedFrame,
        /// Means of all points of a block, and of its points on the surface, if blocks are averaged.
        means: Option<[PaddedFrame; 2]>,
        planes: (FirstPlanes, Surfaces),
    },
}

impl Buffers {
    fn new(params: &EngineParams, shape: (usize, usize)) -> Self {
        let (width, height) = params.cells_of(shape);
        let frame = || PaddedFrame::new(width, height, params.reach().max(params.edge_shift()));
        let points = frame();
        let planes = || (FirstPlanes::new(params, &points), Surfaces::new(&points));
        if params.cell_px() == 1 {
            let means = params.averages_blocks().then(frame);
            let planes = (params.edges == Edges::Robust).then(planes);
            Self::Pixels { measured: points, means, planes }
        } else {
            let (means, planes) = (params.averages_blocks().then(|| [frame(), frame()]), planes());
            Self::Cells { pixels: Pixels::new(shape, params.block_half_px()), points, means, planes }
        }
    }

    fn bytes(&self) -> usize {
        let of_planes = |(first_planes, surfaces): &(FirstPlanes, Surfaces)| first_planes.bytes() + surfaces.bytes();
        match self {
            Self::Pixels { measured, means, planes } => {
                let means = means.as_ref().map_or(0, PaddedFrame::bytes);
                measured.bytes() + means + planes.as_ref().map_or(0, of_planes)
            }
            Self::Cells { pixels, points, means, planes } => {
                let means = means.iter().flatten().map(PaddedFrame::bytes).sum::<usize>();
                pixels.bytes() + points.bytes() + means + of_planes(planes)
            }
        }
    }
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
        let buffers = Buffers::new(&params, shape);
        let (rays, timings) = (Rays::default(), FrameTimings::default());
        Ok(Self { params, level, threads, buffers, rays, timings })
    }

    /// Copies the frame and smooths all rows, on the threads of the pool that it is called in or on the calling one.
    fn smooth_rows(&mut self, frame: &AdmittedFrame<'_>, kernel: &Kernel, out: SmoothedMut<'_>, parallel: bool) {
        let level = self.level;
        let start = Stopwatch::start();
        match &mut self.buffers {
            Buffers::Pixels { measured, .. } => measured.fill(frame, &self.rays, parallel),
            Buffers::Cells { pixels, .. } => pixels.fill(frame, &self.rays, parallel),
        }
        let upload = start.elapsed();
        let run = Run { level, kernel, parallel };
        let out = OutputRows::all(frame, out);
        match &mut self.buffers {
            Buffers::Pixels { measured, means, planes } => {
                let measured = &*measured;
                if let Some(means) = means {
                    run.average(measured, measured, means);
                }
                let input = Input { measured, samples: means.as_ref().unwrap_or(measured) };
                match planes {
                    None => run.fit(input, None, FitRows::Own(out)),
                    Some((first_planes, surfaces)) => {
                        run.find_surfaces(input, None, first_planes, (surfaces, None));
                        run.fit(input, Some(first_planes), FitRows::Kept(surfaces.rows(measured.height, None), out));
                    }
                }
            }
            Buffers::Cells { pixels, points, means, planes: (first_planes, surfaces) } => {
                let pixels = &*pixels;
                let represent = |mut rows: PaddedRows<'_>| dispatch!(level, simd => pixels.represent(simd, &mut rows));
                run_on_rows(points.rows(), parallel, &represent);
                let points = &*points;
                let (means, on_surfaces) = match means {
                    None => (None, None),
                    Some([means, on_surfaces]) => {
                        run.average(pixels, points, means);
                        (Some(&*means), Some(on_surfaces))
                    }
                };
                let input = Input { measured: points, samples: means.unwrap_or(points) };
                let blocks = means.map(|means| edges::Blocks { pixels, means });
                let mut on_surfaces = on_surfaces;
                run.find_surfaces(input, blocks, first_planes, (surfaces, on_surfaces.as_deref_mut()));
                let samples = on_surfaces.as_deref().unwrap_or(points);
                let rows = FitRows::Cells(surfaces.rows(points.height, None));
                run.fit(Input { measured: points, samples }, Some(first_planes), rows);
                let found = edges::Found { pixels, cells: points, means, surfaces };
                let write = |mut rows: OutputRows<'_>| dispatch!(level, simd => edges::results_of_pixels(simd, found, kernel, &mut rows));
                run_on_rows(out, parallel, &write);
            }
        }
        self.timings = FrameTimings { upload, kernel: start.elapsed() - upload, readback: Duration::ZERO };
    }
}

/// How passes run.
#[derive(Clone, Copy)]
struct Run<'a> {
    level: Level,
    kernel: &'a Kernel,
    parallel: bool,
}

impl Run<'_> {
    /// Averages the blocks around points.
    fn average(self, pixels: &(impl BlockPixels + Sync), points: &PaddedFrame, means: &mut PaddedFrame) {
        let Self { level, kernel, parallel } = self;
        let average = |mut rows: PaddedRows<'_>| dispatch!(level, simd => blocks::average(simd, pixels, points, kernel, &mut rows));
        run_on_rows(means.rows(), parallel, &average);
    }

    /// Finds the surfaces of all points, and the means of their blocks on them if there are any.
    fn find_surfaces(
        self,
        input: Input<'_>,
        blocks: Option<edges::Blocks<'_>>,
        first_planes: &mut FirstPlanes,
        (surfaces, means): (&mut Surfaces, Option<&mut PaddedFrame>),
    ) {
        let Self { level, kernel, parallel } = self;
        let height = input.measured.height;
        let fit =
            |mut rows: FirstRows<'_>| dispatch!(level, simd => edges::fit_first_planes(simd, input, kernel, &mut rows));
        run_on_rows(first_planes.rows(height), parallel, &fit);
        let first_planes = &*first_planes;
        let find = |mut rows: SurfaceRows<'_>| dispatch!(level, simd => edges::find_surfaces(simd, input.measured, blocks, first_planes, kernel, &mut rows));
        run_on_rows(surfaces.rows(height, means.map(PaddedFrame::rows)), parallel, &find);
    }

    /// Fits the surfaces of all rows.
    fn fit(self, input: Input<'_>, first_planes: Option<&FirstPlanes>, rows: FitRows<'_>) {
        let Self { level, kernel, parallel } = self;
        let fit = |mut rows: FitRows<'_>| match kernel.degree {
            1 => dispatch!(level, simd => fit_rows::<_, 1>(simd, input, first_planes, kernel, &mut rows)),
            2 => dispatch!(level, simd => fit_rows::<_, 2>(simd, input, first_planes, kernel, &mut rows)),
            _ => dispatch!(level, simd => fit_rows::<_, 3>(simd, input, first_planes, kernel, &mut rows)),
        };
        run_on_rows(rows, parallel, &fit);
    }
}

impl ImmediateEngine for Cpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        if let Frame::Depth(depth) = frame.frame {
            self.rays.set(depth.camera());
        }
        let kernel = Kernel {
            offsets: Offsets::new(&self.params),
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
        self.buffers.bytes() as u64
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
#[expect(clippy::large_enum_variant, reason = "the larger one is the usual one")]
enum FitRows<'a> {
    /// Surfaces are the planes of windows; results are written.
    Own(OutputRows<'a>),
    /// Surfaces have been found; results are written.
    Kept(SurfaceRows<'a>, OutputRows<'a>),
    /// Surfaces of cells have been found; results replace them.
    Cells(SurfaceRows<'a>),
}

impl SplitRows for FitRows<'_> {
    fn count(&self) -> usize {
        match self {
            Self::Own(out) => out.count(),
            Self::Kept(surfaces, _) | Self::Cells(surfaces) => surfaces.count(),
        }
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        match self {
            Self::Own(out) => {
                let (before, after) = out.split_at(rows);
                (Self::Own(before), Self::Own(after))
            }
            Self::Kept(surfaces, out) => {
                let ((surfaces, surfaces_after), (out, out_after)) = (surfaces.split_at(rows), out.split_at(rows));
                (Self::Kept(surfaces, out), Self::Kept(surfaces_after, out_after))
            }
            Self::Cells(surfaces) => {
                let (before, after) = surfaces.split_at(rows);
                (Self::Cells(before), Self::Cells(after))
            }
        }
    }
}

impl<'a> FitRows<'a> {
    /// The first row's number in the image.
    fn first(&self) -> usize {
        match self {
            Self::Own(out) => out.first,
            Self::Kept(surfaces, _) | Self::Cells(surfaces) => surfaces.first,
        }
    }

    fn surfaces(&self) -> Option<&SurfaceRows<'a>> {
        match self {
            Self::Own(_) => None,
            Self::Kept(surfaces, _) | Self::Cells(surfaces) => Some(surfaces),
        }
    }

    fn projection(&self, on_ray: bool) -> Projection {
        match self {
            Self::Own(out) | Self::Kept(_, out) => out.projection(on_ray),
            // The points of cells move along the normals of their planes.
            Self::Cells(_) => Projection {
                on_ray: false,
                needs_normal: true,
                needs_depth: false,
                keeps_isolated: false,
                least_neighbours: LEAST_NEIGHBOURS,
            },
        }
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
            FitRows::Own(out) | FitRows::Kept(_, out) => out.store_holes(row, u, S::f32s::LEN),
            FitRows::Cells(surfaces) => surfaces.keep_holes(simd, (u, row)),
        }
        return;
    }
    let ray = kernel.sensor.ray(simd, p);
    let range = kernel.range(simd, ray);
    let radius = kernel.rules.radius(simd, range);
    let window = Window::at(input.samples, kernel, u, v);
    let (surface, source) = match (first_planes, rows.surfaces()) {
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
        FitRows::Own(out) | FitRows::Kept(_, out) => {
            out.store(row, u, &projected, [kernel.sensor.depth(simd, ray), surface.plane.curvature, surface.n]);
        }
        FitRows::Cells(surfaces) => surfaces.keep(simd, (u, row), &projected, &surface),
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
