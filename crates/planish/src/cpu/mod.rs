//! The CPU engine: docs/method.md in f32, a vector of neighbouring pixels at a time, for organized clouds.
//!
//! The stages have the reference's names, one file each, and are written once over the SIMD level; [`SimdLevel`] says which
//! there are. A frame is copied into a padded one ([`padded`]), tasks take bands of its rows ([`row_tasks`], [`output`]), and each
//! vector of pixels goes through [`window`], [`plane`] with [`eigen`], [`polynomial`], [`solve`], [`project`]; where edges are
//! kept, [`edges`] fits the planes of all pixels in a pass of its own before. All of it is in the cloud's frame; what depends on
//! the sensor is asked of [`sensor`]. A pixel's result depends on its window alone, so threads change nothing; lanes are
//! independent, so neither does a pixel's place in its vector.

// A condition on constants in a loop written out is always true or always false in each copy.
#![allow(clippy::absurd_extreme_comparisons)]

mod edges;
mod eigen;
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

use std::time::{Duration, Instant};

use fearless_simd::{Level, Simd, SimdBase, SimdFloat, SimdMask, dispatch};

use crate::camera::Rays;
use crate::engine::{AdmittedFrame, ImmediateEngine};
use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::outputs::SmoothedMut;
use crate::params::SmoothParams;
use crate::range::{MAX_RADIUS_M, MAX_RANGE_M, RangeRules};
use crate::simd_level::SimdLevel;
use crate::threads::Threads;
use crate::timings::FrameTimings;
use edges::{FirstPlanes, FirstRows};
use output::OutputRows;
use padded::PaddedFrame;
use polynomial::{Terms, Weighting};
use row_tasks::{SplitRows, run_on_rows};
use sensor::Sensor;
use vector::{Mask, Vec3, splat};
use window::{Gate, MAX_CANDIDATES, Window};

/// What a kernel needs to know of the parameters.
struct Kernel {
    /// Candidates along a side of the window, 2k + 1.
    side: usize,
    stride: usize,
    degree: u32,
    rules: RangeRules,
    sensor: Sensor,
    bandwidth_m: Option<f32>,
    ridge: f32,
    /// Whether points move along their rays.
    on_ray: bool,
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
        // A coordinate of 1e30 has an infinite radius by this rule; what is computed from it must stay finite.
        radius.min(splat(simd, MAX_RADIUS_M))
    }
}

impl Kernel {
    /// The ranges at the end of rays. Beyond the limit the radius is at its own; the square stays finite.
    #[inline(always)]
    fn range<S: Simd>(&self, simd: S, ray: Vec3<S>) -> S::f32s {
        let range = if self.rules.by_distance { ray.dot(ray).sqrt() } else { self.sensor.depth(simd, ray).abs() };
        range.min(splat(simd, MAX_RANGE_M))
    }
}

/// The CPU engine with its buffers.
pub(crate) struct Cpu {
    params: SmoothParams,
    level: Level,
    /// `None` runs on the calling thread.
    threads: Option<Threads>,
    padded: PaddedFrame,
    /// Where edges are kept.
    first_planes: Option<FirstPlanes>,
    rays: Rays,
    timings: FrameTimings,
}

impl Cpu {
    pub(crate) fn open(
        params: SmoothParams,
        threads: Option<usize>,
        simd: Option<SimdLevel>,
        shape: (usize, usize),
    ) -> Result<Self, EngineError> {
        let machine = Level::new();
        let level = match simd {
            None => machine,
            Some(level) => level.token(machine).ok_or_else(|| EngineError::Unavailable {
                engine: "cpu",
                reason: format!("this machine or build has no {}", level.name()),
            })?,
        };
        let threads = if threads == Some(1) { None } else { Some(Threads::open(threads)?) };
        let padded = PaddedFrame::new(shape.0, shape.1, params.reach_px());
        let first_planes = FirstPlanes::new(&params, &padded);
        let (rays, timings) = (Rays::default(), FrameTimings::default());
        Ok(Self { params, level, threads, padded, first_planes, rays, timings })
    }

    /// Fills the padded frame and smooths all rows, on the threads of the pool that it is called in or on the calling one.
    fn smooth_rows(&mut self, frame: &AdmittedFrame<'_>, kernel: &Kernel, out: SmoothedMut<'_>, parallel: bool) {
        let level = self.level;
        let start = Instant::now();
        self.padded.fill(frame, &self.rays, parallel);
        let filled = Instant::now();
        let padded = &self.padded;
        if let Some(first_planes) = &mut self.first_planes {
            let fit =
                |mut rows: FirstRows<'_>| dispatch!(level, simd => fit_first_planes(simd, padded, kernel, &mut rows));
            run_on_rows(first_planes.rows(frame.frame.shape().1), parallel, &fit);
        }
        let first_planes = self.first_planes.as_ref();
        let smooth = |mut rows: OutputRows<'_>| match kernel.degree {
            1 => dispatch!(level, simd => smooth_rows_simd::<_, 1>(simd, padded, first_planes, kernel, &mut rows)),
            2 => dispatch!(level, simd => smooth_rows_simd::<_, 2>(simd, padded, first_planes, kernel, &mut rows)),
            _ => dispatch!(level, simd => smooth_rows_simd::<_, 3>(simd, padded, first_planes, kernel, &mut rows)),
        };
        run_on_rows(OutputRows::all(frame, out), parallel, &smooth);
        self.timings = FrameTimings { upload: filled - start, kernel: filled.elapsed(), readback: Duration::ZERO };
    }
}

impl ImmediateEngine for Cpu {
    fn smooth(&mut self, frame: &AdmittedFrame<'_>, out: SmoothedMut<'_>) -> Result<(), Error> {
        if let Frame::Depth(depth) = frame.frame {
            self.rays.set(depth.camera());
        }
        let kernel = Kernel {
            side: 2 * self.params.window as usize + 1,
            stride: self.params.stride as usize,
            degree: self.params.degree,
            rules: RangeRules::new(&self.params, &frame.geometry),
            sensor: Sensor::new(&frame.geometry),
            bandwidth_m: self.params.bandwidth_m,
            ridge: self.params.ridge,
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

    /// Of its padded frame and first planes.
    fn buffer_bytes(&self) -> u64 {
        (self.padded.bytes() + self.first_planes.as_ref().map_or(0, FirstPlanes::bytes)) as u64
    }
}

/// The first planes of some rows, where edges are kept.
#[inline(always)]
fn fit_first_planes<S: Simd>(simd: S, padded: &PaddedFrame, kernel: &Kernel, rows: &mut FirstRows<'_>) {
    let mut gates = [0; MAX_CANDIDATES];
    for row in 0..rows.count() {
        for u in (0..padded.width).step_by(S::f32s::LEN) {
            let window = Window::at(padded, kernel, u, rows.first + row);
            let p = window.centre(simd);
            // What is kept for a hole is not looked at.
            if valid_points(simd, p).any_true() {
                let ray = kernel.sensor.ray(simd, p);
                let range = kernel.range(simd, ray);
                let radius = kernel.rules.radius(simd, range);
                let noise = edges::noise(simd, &kernel.rules, range, radius);
                let sums = window.sums::<S, false>(simd, p, radius, &mut gates);
                rows.store(simd, rows.index(row, u), ray, noise, &plane::fit(simd, ray, &sums), sums.n);
            }
        }
    }
}

#[inline(always)]
fn smooth_rows_simd<S: Simd, const D: usize>(
    simd: S,
    padded: &PaddedFrame,
    first_planes: Option<&FirstPlanes>,
    kernel: &Kernel,
    rows: &mut OutputRows<'_>,
) {
    let mut scratch = Scratch { gates: [0; MAX_CANDIDATES], terms: Terms::new(simd) };
    for row in 0..rows.count() {
        for u in (0..rows.width).step_by(S::f32s::LEN) {
            let window = Window::at(padded, kernel, u, rows.first + row);
            smooth_vector::<S, D>(simd, kernel, &window, first_planes, &mut scratch, rows, row, u);
        }
    }
}

/// Which lanes are no holes: times 0 is 0 for what is finite, NaN for what is not.
#[inline(always)]
fn valid_points<S: Simd>(simd: S, p: Vec3<S>) -> Mask<S> {
    let zero = splat(simd, 0.0);
    p.scale(zero).dot(Vec3::splat(simd, 1.0)).simd_eq(zero)
}

/// What a task keeps from vector to vector, so that it is not cleared for each.
struct Scratch<S: Simd> {
    /// A bit for each lane of each candidate: whether it is a neighbour.
    gates: [u16; MAX_CANDIDATES],
    terms: Terms<S>,
}

/// Sections 2 to 7 and 10 for one vector of pixels.
#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn smooth_vector<S: Simd, const D: usize>(
    simd: S,
    kernel: &Kernel,
    window: &Window<'_>,
    first_planes: Option<&FirstPlanes>,
    scratch: &mut Scratch<S>,
    rows: &mut OutputRows<'_>,
    row: usize,
    u: usize,
) {
    let p = window.centre(simd);
    let valid = valid_points(simd, p);
    if !valid.any_true() {
        rows.store_holes(row, u, S::f32s::LEN);
        return;
    }
    let ray = kernel.sensor.ray(simd, p);
    let range = kernel.range(simd, ray);
    let radius = kernel.rules.radius(simd, range);
    let (plane, n, gate, width) = match first_planes {
        None => {
            let sums = window.sums::<S, true>(simd, p, radius, &mut scratch.gates);
            (plane::fit(simd, ray, &sums), sums.n, Gate::Known(&scratch.gates), None)
        }
        Some(first_planes) => {
            let noise = edges::noise(simd, &kernel.rules, range, radius);
            let surface = first_planes.surface(simd, window, p, ray, valid, radius, noise);
            (surface.plane, surface.n, Gate::Radius(radius), Some(surface.width))
        }
    };
    let projection = rows.projection(kernel.on_ray);
    let projected = if D == 1 {
        project::project::<S, D>(simd, p, ray, &plane, None, radius, n, projection)
    } else {
        let bandwidth = kernel.bandwidth_m.map_or(
            radius,
            #[inline(always)]
            |bandwidth_m| splat(simd, bandwidth_m),
        );
        let weighting = Weighting { gate, radius, bandwidth, width };
        let fit = polynomial::moments::<S, D>(simd, window, p, &plane, &weighting, &mut scratch.terms);
        let c = solve::solve::<S, D>(simd, &fit.moments, fit.extent_squared, kernel.ridge, n);
        project::project::<S, D>(simd, p, ray, &plane, Some((&fit, c)), radius, n, projection)
    };
    rows.store(row, u, kernel.sensor.depth(simd, ray), &projected, &plane, n);
}
