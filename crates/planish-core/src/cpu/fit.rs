//! The final fit, in bands of rows (docs/method.md, sections 5 to 7). Its surfaces come from earlier passes, or are the
//! planes of the pixels' own windows.

use fearless_simd::{Select, Simd, SimdBase, SimdMask};

use super::edges::{FirstPlanes, SurfaceRows};
use super::output::OutputRows;
use super::plane::{self, Points, Surface};
use super::polynomial::{self, Source, Terms, Weighting};
use super::project::{self, Projected, Projection};
use super::row_tasks::SplitRows;
use super::vector::splat;
use super::window::{Candidates, Window};
use super::{Input, Kernel, valid_points};
use crate::constants::LEAST_NEIGHBOURS;

/// Parameters of the fit over a plane.
#[derive(Clone, Copy)]
pub(super) struct Fitting {
    pub(super) bandwidth_m: Option<f32>,
    pub(super) ridge: f32,
    /// True if points with too few neighbours are kept unchanged.
    pub(super) keeps_isolated: bool,
    /// Minimum number of neighbours of a smoothed point.
    pub(super) least_neighbours: f32,
}

/// A band of rows of the final fit.
#[expect(clippy::large_enum_variant, reason = "the larger one is the usual one")]
pub(super) enum FitRows<'a> {
    /// The surfaces are the planes of the pixels' own windows; the results are written to the output.
    Own(OutputRows<'a>),
    /// The surfaces come from an earlier pass; the results are written to the output.
    Kept(SurfaceRows<'a>, OutputRows<'a>),
    /// The surfaces of cells come from an earlier pass; the results replace them.
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
    /// Returns the index of the band's first row in the image.
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
pub(super) fn fit_rows<S: Simd, const D: usize>(
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

/// Smooths one vector of pixels (docs/method.md, sections 2 to 7 and 10). The terms are reused between vectors, to
/// avoid clearing them.
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
    /// Fits the polynomials over the points' surfaces, and moves the points onto them (docs/method.md, sections 5 to
    /// 7).
    #[inline(always)]
    pub(super) fn fit<S: Simd, C: Candidates<S>, const D: usize>(
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
