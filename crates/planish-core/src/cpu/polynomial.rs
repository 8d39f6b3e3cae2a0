//! The weighted polynomial over the plane (docs/method.md, section 5): the moments of the normal equations.
//!
//! The weight is g 2^-(a² + b² + f²), with the gate g, and narrower across the surface if edges are kept. a and b are
//! the in-plane coordinates and f the height over the plane, in units of the bandwidth over sqrt(log2 e). The reference
//! divides a and b by h; this unit saves a multiplication, and the ridge is converted. Moments: M_ij = sum w a^i b^j
//! for i + j <= 2 D, and T_ij = sum w f a^i b^j for i + j <= D. They are sums of outer products of the powers of a and
//! b: one fused multiply-add each, and plain additions for j = 0.

use std::ops::Range;

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::bend::Bend;
use super::eigen::tangents;
use super::math::exp2;
use super::plane::Plane;
use super::solve::{Solution, solve};
use super::unroll::unroll;
use super::vector::{Mask, Vec3, rises, splat};
use super::window::{Candidates, Sums};
use crate::constants::{CLOSE, FEWEST_RIDGE, LOW_RIDGE, MAX_OFF_SURFACE, NARROW_WIDTH, SQRT_LOG2_E, coefficient_count};

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
    /// From 0, if planes around the points fit, to 1, if none does; `None` if planes fit everywhere.
    pub(super) no_plane_fits: Option<S::f32s>,
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

/// The polynomial over a plane.
pub(super) struct Polynomial<S: Simd> {
    /// Its height over the foot of p, in metres.
    pub(super) height: S::f32s,
    /// Its slopes there along the axes a and b.
    pub(super) slopes: [S::f32s; 2],
    /// In-plane unit vectors.
    pub(super) a_axis: Vec3<S>,
    pub(super) b_axis: Vec3<S>,
}

/// The moments, and the units that turn coefficients back into metres.
struct Fit<S: Simd> {
    moments: Moments<S>,
    /// The moments of all neighbours, however far they are off the plane, and their sum of w f². `None` if planes fit.
    all: Option<(Moments<S>, S::f32s)>,
    /// In-plane unit vectors.
    u: Vec3<S>,
    v: Vec3<S>,
    /// Metres per unit of a, b and f.
    metres: S::f32s,
    /// (h/metres)²: the square of the extent in units of a and b.
    extent_squared: S::f32s,
}

/// Fits the polynomial of degree D, or of the degree that n neighbours support, over their plane. If no plane fits,
/// the polynomial of all neighbours replaces it, provided that it is close to them.
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
    let Fit { moments, all, u, v, metres, extent_squared } =
        moments::<S, C, D>(simd, source, p, plane, weighting, terms);
    let Solution { mut c, .. } = solve::<S, D>(simd, &moments, extent_squared, splat(simd, ridge), n);
    if let (Some((moments, squares)), Some(no_plane_fits), Some(width)) =
        (&all, weighting.no_plane_fits, weighting.width)
    {
        let fewest: Mask<S> = n.simd_eq(splat(simd, coefficient_count(2) as f32));
        let low_ridge = fewest.select(splat(simd, ridge.min(FEWEST_RIDGE)), splat(simd, ridge.min(LOW_RIDGE)));
        let of_all = solve::<S, D>(simd, moments, extent_squared, low_ridge, n);
        let total = moments.m::<D>(0, 0);
        let per_noise = metres * splat(simd, NARROW_WIDTH) / width;
        let variance = (*squares - of_all.explained) * (per_noise * per_noise) / total;
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
    /// This many candidates, whose offsets and gate weights the first pass left in the terms.
    Kept(usize),
    /// All of these, gated once more.
    Of(C),
}

/// Second pass over the candidates: accumulates the moments of degree D over the plane.
#[inline(always)]
fn moments<S: Simd, C: Candidates<S>, const D: usize>(
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
    let mut all = None;
    match source {
        Source::Kept(len) => {
            terms.turn(simd, len, &frame);
            accumulate_all::<S, D>(simd, &mut moments, terms, len);
        }
        Source::Of(candidates) => {
            let wide = Frame { narrowing: zero, ..frame };
            if weighting.no_plane_fits.is_some() {
                all = Some((Moments { m: [zero; MAX_MOMENTS], t: [zero; MAX_RIGHT_SIDES] }, zero));
            }
            let rows_at_once = (CHUNK / candidates.row_len()).max(1);
            let mut rows = 0..rows_at_once.min(candidates.rows());
            while !rows.is_empty() {
                let len = rows.len() * candidates.row_len();
                if let Some((all, squares)) = &mut all {
                    terms.fill::<C, true, true>(simd, candidates, &p, weighting.radius, rows.clone(), &wide);
                    accumulate_all::<S, D>(simd, all, terms, len);
                    terms.narrow(simd, len, narrowing, squares);
                } else if weighting.width.is_none() {
                    terms.fill::<C, false, false>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                } else if weighting.bend.is_none() {
                    terms.fill::<C, true, false>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                } else {
                    terms.fill::<C, true, true>(simd, candidates, &p, weighting.radius, rows.clone(), &frame);
                }
                accumulate_all::<S, D>(simd, &mut moments, terms, len);
                rows = rows.end..(rows.end + rows_at_once).min(candidates.rows());
            }
        }
    }
    let extent_squared = plane.extent_squared.min(weighting.radius * weighting.radius) * (per_metre * per_metre);
    Fit { moments, all, u, v, metres: splat(simd, 1.0) / per_metre, extent_squared }
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

    /// Lowers the weights of the first `len` terms that are off the surface, and adds sum w f² with the weights before.
    #[inline(never)]
    fn narrow(&mut self, simd: S, len: usize, narrowing: S::f32s, squares: &mut S::f32s) {
        simd.vectorize(
            #[inline(always)]
            || {
                for at in 0..len.min(CHUNK) {
                    let squared = self.f[at] * self.f[at];
                    *squares = self.w[at].mul_add(squared, *squares);
                    self.w[at] *= exp2(simd, -(squared * narrowing).min(splat(simd, MAX_OFF_SURFACE)));
                }
            },
        );
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

/// Adds the first `len` terms to the moments, in groups of rows that fit the registers. Not inlined: several callers
/// share it.
#[inline(never)]
fn accumulate_all<S: Simd, const D: usize>(simd: S, moments: &mut Moments<S>, terms: &Terms<S>, len: usize) {
    simd.vectorize(
        #[inline(always)]
        || {
            if D == 3 {
                accumulate::<S, D, 0, 2, 0, 1>(moments, terms, len);
                accumulate::<S, D, 2, 7, 1, 7>(moments, terms, len);
            } else {
                accumulate::<S, D, 0, 7, 0, 7>(moments, terms, len);
            }
        },
    );
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
