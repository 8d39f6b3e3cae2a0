//! The CPU engine for organized clouds: the method of docs/method.md in f32, on vectors of adjacent pixels.
//! [`general`] smooths unorganized clouds.
//!
//! Each stage has its own file, named as in the reference, and is written once for all SIMD levels ([`SimdLevel`]). The
//! frame is copied into a padded buffer ([`padded`]), and each task processes a band of rows ([`row_tasks`],
//! [`output`]). [`fit`] takes each vector of pixels through [`window`], [`plane`] with [`eigen`], [`polynomial`],
//! [`solve`] and [`project`]. If blocks are averaged or edges kept, there are further passes of [`pixels`], [`blocks`]
//! and [`edges`]: up to four before the fit and one after it. Coordinates are in the cloud's frame; [`sensor`] supplies
//! everything that depends on the sensor. A pass reads only the results of earlier passes, so results are bit-identical
//! for any number of threads.

// In unrolled loops, conditions on constants are always true or always false in each copy.
#![allow(clippy::absurd_extreme_comparisons)]

mod bend;
mod blocks;
mod channels;
mod edges;
mod eigen;
mod fit;
mod general;
mod math;
mod moments;
mod output;
mod padded;
mod pixels;
mod plane;
mod polynomial;
mod project;
pub(crate) mod row_tasks;
mod sensor;
mod solve;
#[cfg(test)]
mod tests;
mod unroll;
pub(crate) mod vector;
mod window;

use std::time::Duration;

use fearless_simd::{Level, Simd, SimdBase, SimdFloat, dispatch};

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
use fit::{FitRows, Fitting, fit_rows};
pub use general::CloudEstimate;
pub(crate) use general::Decided;
pub(crate) use general::GeneralCpu;
use output::OutputRows;
use padded::{PaddedFrame, PaddedRows};
use pixels::Pixels;
use row_tasks::run_on_rows;
use sensor::Sensor;
use vector::{Mask, Vec3, splat};
use window::Offsets;

/// Parameters of all passes over a frame.
struct Kernel {
    /// Offsets of the window's columns and rows from its centre.
    offsets: Offsets,
    /// Half width of the blocks that are averaged, in pixels.
    block_half: usize,
    degree: u32,
    rules: RangeRules,
    sensor: Sensor,
    fitting: Fitting,
    /// True if points move along their rays.
    on_ray: bool,
}

/// Returns c0 + c1 z + c2 z², where z is the range.
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
    /// Returns the range at the end of each ray, limited so that its square stays finite. Beyond the limit, the
    /// radius is constant.
    #[inline(always)]
    fn range<S: Simd>(&self, simd: S, ray: Vec3<S>) -> S::f32s {
        let range = if self.rules.by_distance { ray.dot(ray).sqrt() } else { self.sensor.depth(simd, ray).abs() };
        range.min(splat(simd, MAX_RANGE_M))
    }
}

/// Returns the SIMD level to use: the given one, or by default the widest that this machine supports.
fn level(simd: Option<SimdLevel>) -> Result<Level, EngineError> {
    let machine = Level::new();
    let Some(level) = simd else { return Ok(machine) };
    let reason = || format!("{} is not available on this machine or in this build", level.name());
    level.token(machine).ok_or_else(|| EngineError::Unavailable { engine: "cpu", reason: reason() })
}

/// The CPU engine for frames on a grid, with its buffers.
pub(crate) struct Cpu {
    params: EngineParams,
    level: Level,
    /// The thread pool; `None` to run on the calling thread.
    threads: Option<Threads>,
    buffers: Buffers,
    rays: Rays,
    timings: FrameTimings,
}

/// Results that the passes over a frame keep for later passes.
#[expect(clippy::large_enum_variant, reason = "an engine has one")]
enum Buffers {
    /// Every pixel has its own surface.
    Pixels {
        measured: PaddedFrame,
        /// Block means, if blocks are averaged.
        means: Option<PaddedFrame>,
        /// First planes and surfaces, if edges are kept.
        planes: Option<(FirstPlanes, Surfaces)>,
    },
    /// The pixels of a cell share a surface.
    Cells {
        pixels: Pixels,
        /// The points of the cells.
        points: PaddedFrame,
        /// Means of all points of each block, and of each block's points on the surface; `None` if blocks are not
        /// averaged.
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

    /// Copies the frame and smooths all rows: on the current thread pool if `parallel`, otherwise on the calling
    /// thread.
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

/// Settings shared by all passes.
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

    /// Finds the surfaces of all points. With `blocks`, also computes the mean of each block's points on its surface.
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

    /// Returns the size of the padded frames and planes in bytes.
    fn buffer_bytes(&self) -> u64 {
        self.buffers.bytes() as u64
    }
}

/// Input of the passes.
#[derive(Clone, Copy)]
struct Input<'a> {
    /// The points as measured.
    measured: &'a PaddedFrame,
    /// Samples of the windows: the points, or their block means.
    samples: &'a PaddedFrame,
}

/// Returns the mask of lanes that are not holes: x * 0 is 0 only for finite x.
#[inline(always)]
fn valid_points<S: Simd>(simd: S, p: Vec3<S>) -> Mask<S> {
    let zero = splat(simd, 0.0);
    p.scale(zero).dot(Vec3::splat(simd, 1.0)).simd_eq(zero)
}
