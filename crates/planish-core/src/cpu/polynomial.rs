//! The weighted polynomial over the plane (docs/method.md, section 5).
//!
//! The weight is g 2^-(a² + b² + f²), with the gate g, and narrower across the surface if edges are kept. a and b are
//! the in-plane coordinates and f the height over the plane, in units of the bandwidth over sqrt(log2 e). The reference
//! divides a and b by h; this unit saves a multiplication, and the ridge is converted to it.
//! [`moments`](super::moments) sums the normal equations.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::bend::Bend;
use super::eigen::tangents;
use super::math::exp2_neg;
use super::moments::{Moments, Term, sum_terms};
use super::plane::Plane;
use super::solve::{Solution, solve};
use super::vector::{Mask, Vec3, rises, splat};
use super::window::{Candidates, Sums};
use crate::constants::{CLOSE, FEWEST_RIDGE, LOW_RIDGE, MAX_OFF_SURFACE, NARROW_WIDTH, SQRT_LOG2_E, coefficient_count};

/// The coordinate frame of a fit: a = e·a_axis, b = e·b_axis, f = e·f_axis - f_offset.
struct Frame<S: Simd> {
    a_axis: Vec3<S>,
    b_axis: Vec3<S>,
    f_axis: Vec3<S>,
    f_offset: S::f32s,
    /// Extra factor of f² in the weight's exponent; 0 without [`edges`](super::edges).
    narrowing: S::f32s,
    /// Half the bend, in the units of a, b and f. Its paraboloid is subtracted from f. 0 without edges.
    half_bend: Bend<S>,
}

/// Selection and weights of neighbours.
pub(super) struct Weighting<S: Simd> {
    pub(super) radius: S::f32s,
    pub(super) bandwidth: S::f32s,
    /// Maximum distance of a neighbour from the plane; `None` for no limit.
    pub(super) width: Option<S::f32s>,
    /// Bend along the plane's tangents; `None` for a flat surface.
    pub(super) bend: Option<Bend<S>>,
    /// Degree to which no plane around a point fits, from 0 to 1: L of (10.17) in docs/method.md. `None` if it is 0
    /// in every lane.
    pub(super) no_plane_fits: Option<S::f32s>,
}

/// Maximum number of candidates whose terms are stored at once. Terms have four vectors each and fit in the L1 cache.
const CHUNK: usize = 64;

/// The terms of candidates, and their moments.
///
/// Computing all terms first and summing them in a second loop is a third faster than one loop: with so many
/// operations per candidate, the processor cannot overlap two candidates and stalls on the dependency chain of
/// exponential and powers.
pub(super) struct Terms<S: Simd> {
    terms: [Term<S>; CHUNK],
    /// Moments of the neighbours, or of those on the surface if edges are kept.
    moments: Moments<S>,
    /// Moments of all neighbours, whatever their distance from the plane.
    of_all: Moments<S>,
}

/// The polynomial over a plane.
pub(super) struct Polynomial<S: Simd> {
    /// Height over the foot of p, in metres.
    pub(super) height: S::f32s,
    /// Slopes at the foot of p along the axes a and b.
    pub(super) slopes: [S::f32s; 2],
    /// In-plane unit vector of a.
    pub(super) a_axis: Vec3<S>,
    /// In-plane unit vector of b.
    pub(super) b_axis: Vec3<S>,
}

/// Results of [`sum_moments`] other than the moments, which are in [`Terms`].
struct Fit<S: Simd> {
    /// Sum of w f² over all neighbours, whose moments are [`Terms::of_all`]; `None` if planes fit everywhere.
    squares_of_all: Option<S::f32s>,
    /// In-plane unit vector of a.
    u: Vec3<S>,
    /// In-plane unit vector of b.
    v: Vec3<S>,
    /// Metres per unit of a, b and f.
    metres: S::f32s,
    /// (h/metres)²: the square of the extent in units of a and b.
    extent_squared: S::f32s,
}

/// Fits the polynomial of degree D over the plane, or of the highest degree that n neighbours support. Where no plane
/// fits, it is replaced by the polynomial of all neighbours, if that is close to them.
#[inline(always)]
pub(super) fn fit<S: Simd, C: Candidates<S>, const D: usize>(
    simd: S,
    source: Source<C>,
    p: Vec3<S>,
    (plane, n): (&Plane<S>, S::f32s),
    weighting: &Weighting<S>,
    ridge: f32,
    terms: &mut Terms<S>,
) -> Polynomial<S> {
    let Fit { squares_of_all, u, v, metres, extent_squared } =
        sum_moments::<S, C, D>(simd, source, p, plane, weighting, terms);
    let Solution { mut c, .. } = solve::<S, D>(simd, &terms.moments, extent_squared, splat(simd, ridge), n);
    if let (Some(squares), Some(no_plane_fits), Some(width)) =
        (squares_of_all, weighting.no_plane_fits, weighting.width)
    {
        let moments = &terms.of_all;
        let fewest: Mask<S> = n.simd_eq(splat(simd, coefficient_count(2) as f32));
        let low_ridge = fewest.select(splat(simd, ridge.min(FEWEST_RIDGE)), splat(simd, ridge.min(LOW_RIDGE)));
        let of_all = solve::<S, D>(simd, moments, extent_squared, low_ridge, n);
        let total = moments.m::<D>(0, 0);
        let per_noise = metres * splat(simd, NARROW_WIDTH) / width;
        let variance = (squares - of_all.explained) * (per_noise * per_noise) / total;
        let close = splat(simd, 1.0) - rises(simd, variance, CLOSE);
        let counts: Mask<S> = no_plane_fits.simd_gt(splat(simd, 0.0)) & total.simd_gt(splat(simd, 0.0));
        for (c, of_all) in c.iter_mut().zip(of_all.c) {
            *c = counts.select((no_plane_fits * close).mul_add(of_all - *c, *c), *c);
        }
    }
    Polynomial { height: c[0] * metres, slopes: [c[1], c[2]], a_axis: u, b_axis: v }
}

/// Source of the second pass's candidates.
#[derive(Clone, Copy)]
pub(super) enum Source<C> {
    /// The number of candidates whose offsets and gate weights the first pass left in the terms.
    Kept(usize),
    /// Candidates to which the gate is applied again.
    Of(C),
}

/// Second pass over the candidates: sums the moments of degree D over the plane into [`Terms::moments`] and
/// [`Terms::of_all`].
#[inline(always)]
fn sum_moments<S: Simd, C: Candidates<S>, const D: usize>(
    simd: S,
    source: Source<C>,
    p: Vec3<S>,
    plane: &Plane<S>,
    weighting: &Weighting<S>,
    terms: &mut Terms<S>,
) -> Fit<S> {
    let zero = splat(simd, 0.0);
    let (u, v) = tangents(simd, plane.normal);
    let per_metre = splat(simd, SQRT_LOG2_E) / weighting.bandwidth;
    let narrowing = match weighting.width {
        None => zero,
        Some(width) => (weighting.bandwidth / width) * (weighting.bandwidth / width),
    };
    let frame = Frame {
        a_axis: u.scale(per_metre),
        b_axis: v.scale(per_metre),
        f_axis: plane.normal.scale(per_metre),
        f_offset: plane.height * per_metre,
        narrowing,
        half_bend: weighting.bend.map_or(
            Bend::none(simd),
            #[inline(always)]
            |bend| bend.scale(splat(simd, 0.5) / per_metre),
        ),
    };
    let mut squares_of_all = None;
    match source {
        Source::Kept(len) => {
            terms.turn(simd, len, &frame);
            sum_terms::<S, D>(simd, &terms.terms[..len], &mut terms.moments);
        }
        Source::Of(candidates) => {
            let rows_at_once = (CHUNK / candidates.row_len()).max(1);
            let mut rows = 0..rows_at_once.min(candidates.rows());
            while !rows.is_empty() {
                let before = (rows.start > 0).then_some((terms.moments, squares_of_all.map(|_| terms.of_all)));
                let squares = terms.sum_rows::<C, D>(simd, candidates, p, rows.clone(), weighting, &frame);
                if let Some((moments, of_all)) = before {
                    terms.moments.add(&moments);
                    of_all.iter().for_each(|of_all| terms.of_all.add(of_all));
                }
                squares_of_all =
                    squares_of_all.zip(squares).map_or(squares, |(before, squares)| Some(before + squares));
                rows = rows.end..(rows.end + rows_at_once).min(candidates.rows());
            }
        }
    }
    let extent_squared = plane.extent_squared.min(weighting.radius * weighting.radius) * (per_metre * per_metre);
    Fit { squares_of_all, u, v, metres: splat(simd, 1.0) / per_metre, extent_squared }
}

impl<S: Simd> Term<S> {
    /// Returns the term of a candidate at offset e with gate weight `weight`.
    #[inline(always)]
    fn of<const NARROW: bool, const BENT: bool>(simd: S, e: Vec3<S>, weight: S::f32s, frame: &Frame<S>) -> Self {
        let a = e.dot(frame.a_axis);
        let b = e.dot(frame.b_axis);
        let f = e.z.mul_add(frame.f_axis.z, e.y.mul_add(frame.f_axis.y, e.x.mul_add(frame.f_axis.x, -frame.f_offset)));
        let mut exponent = a.mul_add(a, b.mul_add(b, f * f));
        let f = if BENT { f - frame.half_bend.of(a, b) } else { f };
        if NARROW {
            exponent += (f * f * frame.narrowing).min(splat(simd, MAX_OFF_SURFACE));
        }
        Self { w: weight * exp2_neg(simd, exponent), a, b, f }
    }
}

impl<S: Simd> Terms<S> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        let none = Moments::zero(simd);
        Self { terms: [Term { w: zero, a: zero, b: zero, f: zero }; CHUNK], moments: none, of_all: none }
    }

    /// Computes the terms of the candidates in the given rows.
    ///
    /// Not inlined, because the sums, which are in registers before and after the call, would be spilled in its loop.
    #[inline(never)]
    fn fill<C: Candidates<S>, const NARROW: bool, const BENT: bool>(
        &mut self,
        simd: S,
        candidates: C,
        p: &Vec3<S>,
        radius: S::f32s,
        rows: Range<usize>,
        frame: &Frame<S>,
    ) {
        simd.vectorize(
            #[inline(always)]
            || {
                let p = *p;
                let terms = &mut self.terms[..rows.len() * candidates.row_len()];
                candidates.neighbours(
                    simd,
                    p,
                    radius,
                    rows,
                    terms,
                    #[inline(always)]
                    |term, e, weight, _| *term = Term::of::<NARROW, BENT>(simd, e, weight, frame),
                );
            },
        );
    }

    /// Converts the first `len` candidates stored by [`keep`](Self::keep) to terms. Not inlined, for the same reason
    /// as [`fill`](Self::fill).
    #[inline(never)]
    fn turn(&mut self, simd: S, len: usize, frame: &Frame<S>) {
        simd.vectorize(
            #[inline(always)]
            || {
                for term in &mut self.terms[..len] {
                    let Term { w, a, b, f } = *term;
                    *term = Term::of::<false, false>(simd, Vec3::new(a, b, f), w, frame);
                }
            },
        );
    }

    /// Sums the moments of the candidates in the given rows. Returns [`Fit::squares_of_all`].
    #[inline(always)]
    fn sum_rows<C: Candidates<S>, const D: usize>(
        &mut self,
        simd: S,
        candidates: C,
        p: Vec3<S>,
        rows: Range<usize>,
        weighting: &Weighting<S>,
        frame: &Frame<S>,
    ) -> Option<S::f32s> {
        let len = rows.len() * candidates.row_len();
        let radius = weighting.radius;
        let mut squares = None;
        if weighting.no_plane_fits.is_some() {
            let wide = Frame { narrowing: splat(simd, 0.0), ..*frame };
            self.fill::<C, true, true>(simd, candidates, &p, radius, rows, &wide);
            sum_terms::<S, D>(simd, &self.terms[..len], &mut self.of_all);
            squares = Some(self.narrow(simd, len, frame.narrowing));
        } else if weighting.width.is_none() {
            self.fill::<C, false, false>(simd, candidates, &p, radius, rows, frame);
        } else if weighting.bend.is_none() {
            self.fill::<C, true, false>(simd, candidates, &p, radius, rows, frame);
        } else {
            self.fill::<C, true, true>(simd, candidates, &p, radius, rows, frame);
        }
        sum_terms::<S, D>(simd, &self.terms[..len], &mut self.moments);
        squares
    }

    /// Lowers the weights of those of the first `len` terms that are off the surface. Returns the sum of w f² with
    /// the original weights.
    #[inline(never)]
    fn narrow(&mut self, simd: S, len: usize, narrowing: S::f32s) -> S::f32s {
        simd.vectorize(
            #[inline(always)]
            || {
                let mut squares = splat(simd, 0.0);
                for Term { w, f, .. } in &mut self.terms[..len] {
                    let squared = *f * *f;
                    squares = w.mul_add(squared, squares);
                    *w *= exp2_neg(simd, (squared * narrowing).min(splat(simd, MAX_OFF_SURFACE)));
                }
                squares
            },
        )
    }

    /// First pass: computes the sums over the candidates, and keeps the candidates for the second pass if there are
    /// at most [`CHUNK`].
    #[inline(always)]
    pub(super) fn keep<C: Candidates<S>>(
        &mut self,
        simd: S,
        candidates: C,
        p: Vec3<S>,
        radius: S::f32s,
    ) -> (Sums<S>, Source<C>) {
        let len = candidates.rows() * candidates.row_len();
        // Web builds omit the path that keeps candidates, which makes them smaller.
        if len > CHUNK || cfg!(target_family = "wasm") {
            return (candidates.sums(simd, p, radius), Source::Of(candidates));
        }
        let n = self.gather(simd, candidates, &p, radius);
        // The sums have their own loop, because together with the gate they need too many registers.
        let mut sums = Sums { n, ..Sums::zero(simd) };
        for &Term { w, a, b, f } in &self.terms[..len] {
            sums.add(Vec3::new(a, b, f), w, splat(simd, 0.0));
        }
        (sums, Source::Kept(len))
    }

    /// Sets terms to the gate weights and offsets of the candidates, and returns the number of neighbours. Not
    /// inlined, for the same reason as [`fill`](Self::fill).
    #[inline(never)]
    fn gather<C: Candidates<S>>(&mut self, simd: S, candidates: C, p: &Vec3<S>, radius: S::f32s) -> S::f32s {
        simd.vectorize(
            #[inline(always)]
            || {
                let (p, rows) = (*p, 0..candidates.rows());
                let mut n = splat(simd, 0.0);
                candidates.neighbours(
                    simd,
                    p,
                    radius,
                    rows,
                    &mut self.terms[..candidates.rows() * candidates.row_len()],
                    #[inline(always)]
                    |term, e, weight, count| {
                        n += count;
                        *term = Term { w: weight, a: e.x, b: e.y, f: e.z };
                    },
                );
                n
            },
        )
    }
}
