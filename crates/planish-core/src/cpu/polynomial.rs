//! The weighted polynomial over the plane (docs/method.md, section 5): the moments of the normal equations.
//!
//! The weight is g 2^-(a² + b² + f²), with the gate g, and narrower across the surface if edges are kept. a and b are
//! the in-plane coordinates and f the height over the plane, in units of the bandwidth over sqrt(log2 e). The reference
//! divides a and b by h; this unit saves a multiplication, and the ridge is converted. Moments: M_ij = sum w a^i b^j
//! for i + j <= 2 D, and T_ij = sum w f a^i b^j for i + j <= D. They are sums of outer products of the powers of a and
//! b: one fused multiply-add each, and plain additions for j = 0.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase, SimdFloat};

use super::bend::Bend;
use super::eigen::tangents;
use super::math::exp2;
use super::plane::Plane;
use super::unroll::unroll;
use super::vector::{Vec3, splat};
use super::window::{Candidates, Sums};
use crate::constants::{MAX_OFF_SURFACE, SQRT_LOG2_E};

/// Number of moments for degree 3, the most.
const MAX_MOMENTS: usize = 28;
const MAX_RIGHT_SIDES: usize = 10;

/// The frame of a fit. a = e·a_axis, b = e·b_axis, f = e·f_axis - f_offset.
struct Frame<S: Simd> {
    a_axis: Vec3<S>,
    b_axis: Vec3<S>,
    f_axis: Vec3<S>,
    f_offset: S::f32s,
    /// Extra factor of f² in the weight; 0 without [`edges`](super::edges).
    narrowing: S::f32s,
    /// Half the bend in units of a, b and f, subtracted from f; 0 without edges.
    half_bend: Bend<S>,
}

/// Selection and weights of neighbours.
pub(super) struct Weighting<S: Simd> {
    pub(super) radius: S::f32s,
    pub(super) bandwidth: S::f32s,
    /// Maximum distance of a neighbour from the plane; `None` for no limit.
    pub(super) width: Option<S::f32s>,
    /// How the plane bends along its tangents; `None` for not at all.
    pub(super) bend: Option<Bend<S>>,
}

/// Number of candidates whose terms are stored at once; their four values each fit the first-level cache.
const CHUNK: usize = 64;

/// Contribution of each candidate: its coordinates, and its weight (0 for candidates outside the gate).
///
/// Computing all terms first and summing them in a second loop is a third faster than one loop: with so many operations
/// per candidate the scheduler cannot overlap two of them, and stalls on the chain of exponential and powers.
pub(super) struct Terms<S: Simd> {
    w: [S::f32s; CHUNK],
    a: [S::f32s; CHUNK],
    b: [S::f32s; CHUNK],
    f: [S::f32s; CHUNK],
}

pub(super) struct Moments<S: Simd> {
    m: [S::f32s; MAX_MOMENTS],
    t: [S::f32s; MAX_RIGHT_SIDES],
}

/// Index of M_ij for i + j up to `degree`: for every i a run over j.
#[inline(always)]
const fn place(degree: usize, i: usize, j: usize) -> usize {
    i * (2 * degree + 3 - i) / 2 + j
}

impl<S: Simd> Moments<S> {
    /// Creates moments from M_ij and T_ij.
    #[cfg(test)]
    pub(super) fn from_fn<const D: usize>(
        simd: S,
        m: impl Fn(usize, usize) -> S::f32s,
        t: impl Fn(usize, usize) -> S::f32s,
    ) -> Self {
        let zero = splat(simd, 0.0);
        let mut moments = Self { m: [zero; MAX_MOMENTS], t: [zero; MAX_RIGHT_SIDES] };
        for (i, j) in (0..=2 * D).flat_map(|i| (0..=2 * D - i).map(move |j| (i, j))) {
            moments.m[place(2 * D, i, j)] = m(i, j);
            if i + j <= D {
                moments.t[place(D, i, j)] = t(i, j);
            }
        }
        moments
    }

    /// Returns M_ij of a fit of degree D.
    #[inline(always)]
    pub(super) fn m<const D: usize>(&self, i: usize, j: usize) -> S::f32s {
        self.m[place(2 * D, i, j)]
    }

    /// Returns T_ij of a fit of degree D.
    #[inline(always)]
    pub(super) fn t<const D: usize>(&self, i: usize, j: usize) -> S::f32s {
        self.t[place(D, i, j)]
    }
}

/// The moments, and the units that turn coefficients back into metres.
pub(super) struct Fit<S: Simd> {
    pub(super) moments: Moments<S>,
    /// In-plane axes, unit vectors in units of a metre.
    pub(super) a_axis: Vec3<S>,
    pub(super) b_axis: Vec3<S>,
    /// Metres per unit of a, b and f.
    pub(super) metres: S::f32s,
    /// (h/metres)²: the square of the extent in units of a and b.
    pub(super) extent_squared: S::f32s,
}

/// Source of the second pass's candidates.
#[derive(Clone, Copy)]
pub(super) enum Source<C> {
    /// This many candidates, whose offsets and gate weights the first pass left in the terms.
    Kept(usize),
    /// All of these, gated once more.
    Of(C),
}

/// Second pass over the candidates: accumulates the moments of degree D over the plane.
#[inline(always)]
pub(super) fn moments<S: Simd, C: Candidates<S>, const D: usize>(
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
    let mut moments = Moments { m: [zero; MAX_MOMENTS], t: [zero; MAX_RIGHT_SIDES] };
    match source {
        Source::Kept(len) => {
            terms.turn(simd, len, &frame);
            accumulate_all::<S, D>(&mut moments, terms, len);
        }
        Source::Of(candidates) => {
            let rows_at_once = (CHUNK / candidates.row_len()).max(1);
            let mut rows = 0..rows_at_once.min(candidates.rows());
            while !rows.is_empty() {
                let len = rows.len() * candidates.row_len();
                if weighting.width.is_none() {
                    terms.fill::<C, false, false>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                } else if weighting.bend.is_none() {
                    terms.fill::<C, true, false>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                } else {
                    terms.fill::<C, true, true>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                }
                accumulate_all::<S, D>(&mut moments, terms, len);
                rows = rows.end..(rows.end + rows_at_once).min(candidates.rows());
            }
        }
    }
    let extent_squared = plane.extent_squared.min(weighting.radius * weighting.radius) * (per_metre * per_metre);
    Fit { moments, a_axis: frame.a_axis, b_axis: frame.b_axis, metres: splat(simd, 1.0) / per_metre, extent_squared }
}

impl<S: Simd> Terms<S> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        let zeros = [splat(simd, 0.0); CHUNK];
        Self { w: zeros, a: zeros, b: zeros, f: zeros }
    }

    /// Computes the terms of the candidates in the given rows.
    ///
    /// Not inlined: the sums, kept in registers before and after it, would be spilled in its loop.
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
                let mut at = 0;
                candidates.neighbours(
                    simd,
                    p,
                    radius,
                    rows,
                    #[inline(always)]
                    |e, weight, _| {
                        self.set::<NARROW, BENT>(simd, at, e, weight, frame);
                        at += 1;
                    },
                );
            },
        );
    }

    /// Turns the first `len` candidates that [`keep`](Self::keep) left into terms. Not inlined, as
    /// [`fill`](Self::fill).
    #[inline(never)]
    fn turn(&mut self, simd: S, len: usize, frame: &Frame<S>) {
        simd.vectorize(
            #[inline(always)]
            || {
                for at in 0..len.min(CHUNK) {
                    let e = Vec3::new(self.a[at], self.b[at], self.f[at]);
                    self.set::<false, false>(simd, at, e, self.w[at], frame);
                }
            },
        );
    }

    /// Sets a term from a candidate at offset e with gate weight `weight`.
    #[inline(always)]
    fn set<const NARROW: bool, const BENT: bool>(
        &mut self,
        simd: S,
        at: usize,
        e: Vec3<S>,
        weight: S::f32s,
        frame: &Frame<S>,
    ) {
        let a = e.dot(frame.a_axis);
        let b = e.dot(frame.b_axis);
        let f = e.dot(frame.f_axis) - frame.f_offset;
        let mut exponent = a.mul_add(a, b.mul_add(b, f * f));
        let f = if BENT { f - frame.half_bend.of(a, b) } else { f };
        if NARROW {
            exponent += (f * f * frame.narrowing).min(splat(simd, MAX_OFF_SURFACE));
        }
        self.w[at] = weight * exp2(simd, -exponent);
        (self.a[at], self.b[at], self.f[at]) = (a, b, f);
    }

    /// First pass: computes the sums over the candidates, and keeps the candidates for the second pass if they fit.
    #[inline(always)]
    pub(super) fn keep<C: Candidates<S>>(
        &mut self,
        simd: S,
        candidates: C,
        p: Vec3<S>,
        radius: S::f32s,
    ) -> (Sums<S>, Source<C>) {
        let len = candidates.rows() * candidates.row_len();
        if len > CHUNK {
            return (candidates.sums(simd, p, radius), Source::Of(candidates));
        }
        let mut sums = Sums::zero(simd);
        let mut at = 0;
        candidates.neighbours(
            simd,
            p,
            radius,
            0..candidates.rows(),
            #[inline(always)]
            |e, weight, count| {
                sums.add(e, weight, count);
                (self.w[at], self.a[at], self.b[at], self.f[at]) = (weight, e.x, e.y, e.z);
                at += 1;
            },
        );
        (sums, Source::Kept(len))
    }
}

/// Adds the first `len` terms to the moments, in groups of rows that fit the registers.
#[inline(always)]
fn accumulate_all<S: Simd, const D: usize>(moments: &mut Moments<S>, terms: &Terms<S>, len: usize) {
    if D == 3 {
        accumulate::<S, D, 0, 2, 0, 1>(moments, terms, len);
        accumulate::<S, D, 2, 7, 1, 7>(moments, terms, len);
    } else {
        accumulate::<S, D, 0, 7, 0, 7>(moments, terms, len);
    }
}

/// Adds the first `len` terms to the moments M_ij with M0 <= i < M1 and T_ij with T0 <= i < T1.
#[inline(always)]
fn accumulate<S: Simd, const D: usize, const M0: usize, const M1: usize, const T0: usize, const T1: usize>(
    moments: &mut Moments<S>,
    terms: &Terms<S>,
    len: usize,
) {
    // Local copies keep the sums in registers throughout the loop.
    let (mut m, mut t) = (moments.m, moments.t);
    let (w, a, b, f) = (&terms.w[..len], &terms.a[..len], &terms.b[..len], &terms.f[..len]);
    for k in 0..len {
        let (w, a, b, f) = (w[k], a[k], b[k], f[k]);
        let (a2, b2) = (a * a, b * b);
        let (wa, wa2, b3, b4) = (w * a, w * a2, b2 * b, b2 * b2);
        let b_powers = [b, b, b2, b3, b4, b4 * b, b3 * b3];
        let wa_powers = [w, wa, wa2, wa * a2, wa2 * a2, wa * a2 * a2, wa2 * a2 * a2];
        unroll!(I in 7 {
            if M0 <= I && I < M1 && I <= 2 * D {
                m[place(2 * D, I, 0)] += wa_powers[I];
                unroll!(J in 7 {
                    if J > 0 && I + J <= 2 * D {
                        m[place(2 * D, I, J)] = wa_powers[I].mul_add(b_powers[J], m[place(2 * D, I, J)]);
                    }
                });
            }
            if T0 <= I && I < T1 && I <= D {
                let wf = wa_powers[I] * f;
                t[place(D, I, 0)] += wf;
                unroll!(J in 7 {
                    if J > 0 && I + J <= D {
                        t[place(D, I, J)] = wf.mul_add(b_powers[J], t[place(D, I, J)]);
                    }
                });
            }
        });
    }
    (moments.m, moments.t) = (m, t);
}
