//! The CPU engine: docs/method.md in f32, a vector of neighbouring pixels at a time, for organized clouds.
//!
//! The stages have the reference's names, one file each, and are written once over the SIMD level; [`level`] says which
//! there are. A frame becomes padded planes ([`planes`]), tasks take bands of rows ([`rows`]), and each vector of pixels
//! goes through [`window`], [`plane`] with [`eigen`], [`polynomial`], [`solve`], [`project`]; where edges are kept, [`edges`]
//! fits the planes of all pixels in a pass of its own before. A pixel's result depends on
//! its window alone, so threads change nothing; lanes are independent, so neither does a pixel's place in its vector.

// A condition on constants in a loop written out is always true or always false in each copy.
#![allow(clippy::absurd_extreme_comparisons)]

mod edges;
mod eigen;
mod halves;
mod level;
mod math;
mod plane;
mod planes;
mod polynomial;
mod project;
mod rows;
mod solve;
#[cfg(test)]
mod tests;
mod unroll;
mod vector;
mod window;

use std::time::{Duration, Instant};

use fearless_simd::{Level, Simd, SimdBase, SimdMask, dispatch};

use crate::devices::FrameTimings;
use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::params::SmoothParams;
use crate::radius::{MAX_RADIUS_M, RadiusRule};
use crate::smoothed::{Outputs, Smoothed};
use crate::threads::Threads;
use edges::{FirstPlanes, FirstRows};
use halves::{Halves, over};
use planes::Planes;
use polynomial::{Terms, Weighting};
use rows::Rows;
use vector::{Mask, Vec3, splat};
use window::{Gate, MAX_CANDIDATES, Window};

pub use level::SimdLevel;

/// What a kernel needs to know of the parameters.
struct Kernel {
    /// Candidates along a side of the window, 2k + 1.
    side: usize,
    stride: usize,
    degree: u32,
    radius: RadiusRule,
    bandwidth_m: Option<f32>,
}

impl RadiusRule {
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, z: S::f32s) -> S::f32s {
        let grown = (z.abs() * splat(simd, self.linear)).max(z * z * splat(simd, self.quadratic));
        // A coordinate of 1e30 has an infinite radius by this rule; what is computed from it must stay finite.
        (splat(simd, self.constant) + grown).min(splat(simd, MAX_RADIUS_M))
    }
}

/// The CPU engine with its buffers.
pub(crate) struct Cpu {
    params: SmoothParams,
    outputs: Outputs,
    level: Level,
    /// `None` runs on the calling thread.
    threads: Option<Threads>,
    planes: Planes,
    /// Where edges are kept.
    first_planes: Option<FirstPlanes>,
    pitches: Vec<f64>,
    timings: FrameTimings,
}

impl Cpu {
    pub(crate) fn open(
        params: SmoothParams,
        outputs: Outputs,
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
        let planes = Planes::new(shape.0, shape.1, params.reach_px());
        let first_planes = FirstPlanes::new(&params, &planes);
        Ok(Self {
            params,
            outputs,
            level,
            threads,
            planes,
            first_planes,
            pitches: Vec::new(),
            timings: FrameTimings::default(),
        })
    }

    /// Bytes of its planes.
    pub(crate) fn buffer_bytes(&self) -> u64 {
        (self.planes.bytes() + self.first_planes.as_ref().map_or(0, FirstPlanes::bytes)) as u64
    }

    /// Where the time of the last frame went.
    pub(crate) fn timings(&self) -> FrameTimings {
        self.timings
    }

    pub(crate) fn smooth(&mut self, frame: Frame<'_>, out: &mut Smoothed) -> Result<(), Error> {
        let (width, height) = frame.shape();
        out.prepare(width, height, self.outputs);
        let kernel = Kernel {
            side: 2 * self.params.window as usize + 1,
            stride: self.params.stride as usize,
            degree: self.params.degree,
            radius: RadiusRule::new(&self.params, frame, &mut self.pitches),
            bandwidth_m: self.params.bandwidth_m,
        };
        let rows = Rows::all(out);
        match self.threads.take() {
            None => self.smooth_rows_of(frame, &kernel, rows, false),
            Some(threads) => {
                threads.install(|| self.smooth_rows_of(frame, &kernel, rows, true));
                self.threads = Some(threads);
            }
        }
        Ok(())
    }

    /// Fills the planes and smooths all rows, on the threads of the pool that it is called in or on the calling one.
    fn smooth_rows_of(&mut self, frame: Frame<'_>, kernel: &Kernel, rows: Rows<'_>, parallel: bool) {
        let level = self.level;
        let start = Instant::now();
        self.planes.fill(frame, parallel);
        let filled = Instant::now();
        let planes = &self.planes;
        if let Some(first_planes) = &mut self.first_planes {
            let fit =
                |mut rows: FirstRows<'_>| dispatch!(level, simd => first_planes_simd(simd, planes, kernel, &mut rows));
            over(first_planes.rows(frame.shape().1), parallel, &fit);
        }
        let first_planes = self.first_planes.as_ref();
        let smooth = |mut rows: Rows<'_>| match kernel.degree {
            1 => dispatch!(level, simd => smooth_rows_simd::<_, 1>(simd, planes, first_planes, kernel, &mut rows)),
            2 => dispatch!(level, simd => smooth_rows_simd::<_, 2>(simd, planes, first_planes, kernel, &mut rows)),
            _ => dispatch!(level, simd => smooth_rows_simd::<_, 3>(simd, planes, first_planes, kernel, &mut rows)),
        };
        over(rows, parallel, &smooth);
        self.timings = FrameTimings { upload: filled - start, kernel: filled.elapsed(), readback: Duration::ZERO };
    }
}

/// The first planes of some rows, where edges are kept.
#[inline(always)]
fn first_planes_simd<S: Simd>(simd: S, planes: &Planes, kernel: &Kernel, rows: &mut FirstRows<'_>) {
    let mut gates = [0; MAX_CANDIDATES];
    for row in 0..rows.count() {
        for u in (0..planes.width).step_by(S::f32s::LEN) {
            let window = Window::at(planes, kernel, u, rows.first + row);
            let p = window.centre(simd);
            // What is kept for a hole is not looked at.
            if valid_points(simd, p).any_true() {
                let radius = kernel.radius.at(simd, p.z);
                let sums = window.sums(simd, p, radius, &mut gates);
                rows.store(simd, rows.index(row, u), p, radius, &plane::fit(simd, p, &sums), sums.n);
            }
        }
    }
}

#[inline(always)]
fn smooth_rows_simd<S: Simd, const D: usize>(
    simd: S,
    planes: &Planes,
    first_planes: Option<&FirstPlanes>,
    kernel: &Kernel,
    rows: &mut Rows<'_>,
) {
    let mut scratch = Scratch { gates: [0; MAX_CANDIDATES], terms: Terms::new(simd) };
    for row in 0..rows.count() {
        for u in (0..rows.width).step_by(S::f32s::LEN) {
            let window = Window::at(planes, kernel, u, rows.first + row);
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
    rows: &mut Rows<'_>,
    row: usize,
    u: usize,
) {
    let p = window.centre(simd);
    let valid = valid_points(simd, p);
    if !valid.any_true() {
        rows.store_holes(row, u, S::f32s::LEN);
        return;
    }
    let radius = kernel.radius.at(simd, p.z);
    let (plane, n, gate, width) = match first_planes {
        None => {
            let sums = window.sums(simd, p, radius, &mut scratch.gates);
            (plane::fit(simd, p, &sums), sums.n, Gate::Known(&scratch.gates), None)
        }
        Some(first_planes) => {
            let surface = first_planes.surface(simd, window, p, valid, radius);
            (surface.plane, surface.n, Gate::Radius(radius), Some(surface.width))
        }
    };
    let projected = if D == 1 {
        project::project::<S, D>(simd, p, &plane, None, radius, n, rows.has_normals())
    } else {
        let bandwidth = kernel.bandwidth_m.map_or(
            radius,
            #[inline(always)]
            |bandwidth_m| splat(simd, bandwidth_m),
        );
        let weighting = Weighting { gate, bandwidth, width };
        let fit = polynomial::moments::<S, D>(simd, window, p, &plane, &weighting, &mut scratch.terms);
        let c = solve::solve::<S, D>(simd, &fit.moments, n);
        project::project::<S, D>(simd, p, &plane, Some((&fit, c)), radius, n, rows.has_normals())
    };
    rows.store(row, u, &projected, &plane, n);
}
