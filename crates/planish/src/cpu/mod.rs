//! The CPU engine: docs/method.md in f32, a vector of neighbouring pixels at a time, for organized clouds.
//!
//! The stages have the reference's names, one file each, and are written once over the SIMD level; [`level`] says which
//! there are. A frame becomes padded planes ([`planes`]), tasks take bands of rows ([`rows`]), and each vector of pixels
//! goes through [`window`], [`plane`] with [`eigen`], [`polynomial`], [`solve`], [`project`]. A pixel's result depends on
//! its window alone, so threads change nothing; lanes are independent, so neither does a pixel's place in its vector.

// A condition on constants in a loop written out is always true or always false in each copy.
#![allow(clippy::absurd_extreme_comparisons)]

mod eigen;
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

use fearless_simd::{Level, Simd, SimdBase, SimdMask, dispatch};

use crate::error::{EngineError, Error};
use crate::frame::Frame;
use crate::params::SmoothParams;
use crate::radius::{MAX_RADIUS_M, RadiusRule};
use crate::smoothed::{Outputs, Smoothed};
use crate::threads::Threads;
use planes::Planes;
use polynomial::Terms;
use rows::Rows;
use vector::{Mask, Vec3, splat};
use window::{MAX_CANDIDATES, Window};

pub use level::SimdLevel;

/// Rows of one task: enough that a task costs nothing beside them, few enough that threads end together.
const ROWS_A_TASK: usize = 8;

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
    pitches: Vec<f64>,
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
        Ok(Self {
            params,
            outputs,
            level,
            threads,
            planes: Planes::new(shape.0, shape.1, params.reach_px()),
            pitches: Vec::new(),
        })
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
        let (planes, level) = (&mut self.planes, self.level);
        match &self.threads {
            None => {
                planes.fill(frame, false);
                smooth_rows(level, planes, &kernel, Rows::all(out));
            }
            Some(threads) => threads.install(|| {
                planes.fill(frame, true);
                smooth_in_parallel(level, planes, &kernel, Rows::all(out));
            }),
        }
        Ok(())
    }
}

/// Halves the rows between threads until they are few.
fn smooth_in_parallel(level: Level, planes: &Planes, kernel: &Kernel, rows: Rows<'_>) {
    if rows.count() <= ROWS_A_TASK {
        smooth_rows(level, planes, kernel, rows);
        return;
    }
    let half = rows.count() / 2;
    let (upper, lower) = rows.split_at(half);
    rayon::join(
        || smooth_in_parallel(level, planes, kernel, upper),
        || smooth_in_parallel(level, planes, kernel, lower),
    );
}

fn smooth_rows(level: Level, planes: &Planes, kernel: &Kernel, mut rows: Rows<'_>) {
    match kernel.degree {
        1 => dispatch!(level, simd => smooth_rows_simd::<_, 1>(simd, planes, kernel, &mut rows)),
        2 => dispatch!(level, simd => smooth_rows_simd::<_, 2>(simd, planes, kernel, &mut rows)),
        _ => dispatch!(level, simd => smooth_rows_simd::<_, 3>(simd, planes, kernel, &mut rows)),
    }
}

#[inline(always)]
fn smooth_rows_simd<S: Simd, const D: usize>(simd: S, planes: &Planes, kernel: &Kernel, rows: &mut Rows<'_>) {
    let mut scratch = Scratch { gates: [0; MAX_CANDIDATES], terms: Terms::new(simd) };
    for row in 0..rows.count() {
        for u in (0..rows.width).step_by(S::f32s::LEN) {
            let window = Window::at(planes, kernel, u, rows.first + row);
            smooth_vector::<S, D>(simd, kernel, &window, &mut scratch, rows, row, u);
        }
    }
}

/// What a task keeps from vector to vector, so that it is not cleared for each.
struct Scratch<S: Simd> {
    /// A bit for each lane of each candidate: whether it is a neighbour.
    gates: [u16; MAX_CANDIDATES],
    terms: Terms<S>,
}

/// Sections 2 to 7 for one vector of pixels.
#[inline(always)]
fn smooth_vector<S: Simd, const D: usize>(
    simd: S,
    kernel: &Kernel,
    window: &Window<'_>,
    scratch: &mut Scratch<S>,
    rows: &mut Rows<'_>,
    row: usize,
    u: usize,
) {
    let p = window.centre(simd);
    let all_holes = {
        // Times 0 is 0 for what is finite, NaN for what is not.
        let zero = splat(simd, 0.0);
        let valid: Mask<S> = p.scale(zero).dot(Vec3::splat(simd, 1.0)).simd_eq(zero);
        !valid.any_true()
    };
    if all_holes {
        rows.store_holes(row, u, S::f32s::LEN);
        return;
    }
    let radius = kernel.radius.at(simd, p.z);
    let sums = window.sums(simd, p, radius, &mut scratch.gates);
    let plane = plane::fit(simd, p, &sums);
    let projected = if D == 1 {
        project::project::<S, D>(simd, p, &plane, None, radius, sums.n, rows.has_normals())
    } else {
        let bandwidth = kernel.bandwidth_m.map_or(
            radius,
            #[inline(always)]
            |bandwidth_m| splat(simd, bandwidth_m),
        );
        let fit = polynomial::moments::<S, D>(simd, window, p, &scratch.gates, &plane, bandwidth, &mut scratch.terms);
        let c = solve::solve::<S, D>(simd, &fit.moments, sums.n);
        project::project::<S, D>(simd, p, &plane, Some((&fit, c)), radius, sums.n, rows.has_normals())
    };
    rows.store(simd, row, u, &projected, &plane, sums.n);
}
