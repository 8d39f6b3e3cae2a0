//! The weighted polynomial over the plane (docs/method.md, section 5): the moments of the normal equations.
//!
//! With a, b the in-plane coordinates over h and f the height over the plane: M_ij = sum w a^i b^j for i + j <= 2 D, and
//! T_ij = sum w f a^i b^j for i + j <= D. They are sums of outer products of the powers of a and b: one fused
//! multiply-add each, and plain additions for j = 0.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::eigen::tangents;
use super::math::exp2;
use super::plane::Plane;
use super::unroll::unroll;
use super::vector::{Vec3, splat};
use super::window::{MAX_CANDIDATES, Window};

/// Moments of degree 3 + 3: more than are used for smaller degrees.
const MAX_MOMENTS: usize = 28;
const MAX_RIGHT_SIDES: usize = 10;

/// The frame of a fit. a = e·a_axis, b = e·b_axis, f = e·f_axis - f_offset.
struct Frame<S: Simd> {
    a_axis: Vec3<S>,
    b_axis: Vec3<S>,
    f_axis: Vec3<S>,
    f_offset: S::f32s,
    /// The weight is 2^-(in_plane (a² + b²) + f²).
    in_plane: S::f32s,
}

pub(super) struct Moments<S: Simd> {
    m: [S::f32s; MAX_MOMENTS],
    t: [S::f32s; MAX_RIGHT_SIDES],
}

/// Where M_ij stands when i + j goes up to `degree`: for every i a run over j.
const fn place(degree: usize, i: usize, j: usize) -> usize {
    i * (2 * degree + 3 - i) / 2 + j
}

impl<S: Simd> Moments<S> {
    /// M_ij of a fit of degree D.
    #[inline(always)]
    pub(super) fn m<const D: usize>(&self, i: usize, j: usize) -> S::f32s {
        self.m[place(2 * D, i, j)]
    }

    /// T_ij of a fit of degree D.
    #[inline(always)]
    pub(super) fn t<const D: usize>(&self, i: usize, j: usize) -> S::f32s {
        self.t[place(D, i, j)]
    }
}

/// The moments, and what turns coefficients back to metres.
pub(super) struct Fit<S: Simd> {
    pub(super) moments: Moments<S>,
    /// In-plane axes, unit vectors over h.
    pub(super) a_axis: Vec3<S>,
    pub(super) b_axis: Vec3<S>,
    /// Metres in a unit of f.
    pub(super) metres: S::f32s,
}

/// Second pass over the window: accumulates the moments of degree D.
#[inline(always)]
pub(super) fn moments<S: Simd, const D: usize>(
    simd: S,
    window: &Window<'_>,
    p: Vec3<S>,
    gates: &[u16; MAX_CANDIDATES],
    plane: &Plane<S>,
    radius: S::f32s,
    bandwidth: S::f32s,
) -> Fit<S> {
    let (zero, one) = (splat(simd, 0.0), splat(simd, 1.0));
    let (u, v) = tangents(simd, plane.normal);
    let extent = plane.largest_variance.max(zero).sqrt();
    let h = radius.min(extent + extent).max(splat(simd, f32::MIN_POSITIVE));
    let inverse_h = one / h;
    // f is measured in units in which f² is its share of the exponent: exp(-x²) = 2^(-x² log2 e).
    const SQRT_LOG2_E: f32 = 1.201_122_4;
    let per_metre = splat(simd, SQRT_LOG2_E) / bandwidth;
    let h_scaled = h * per_metre;
    let frame = Frame {
        a_axis: u.scale(inverse_h),
        b_axis: v.scale(inverse_h),
        f_axis: plane.normal.scale(per_metre),
        f_offset: plane.height * per_metre,
        in_plane: h_scaled * h_scaled,
    };
    let mut moments = Moments { m: [zero; MAX_MOMENTS], t: [zero; MAX_RIGHT_SIDES] };
    window.neighbours(
        simd,
        p,
        gates,
        #[inline(always)]
        |e, gate| {
            let a = e.dot(frame.a_axis);
            let b = e.dot(frame.b_axis);
            let f = e.dot(frame.f_axis) - frame.f_offset;
            let (a2, b2) = (a * a, b * b);
            let exponent = (a2 + b2).mul_add(frame.in_plane, f * f);
            let w = gate.select(exp2(simd, -exponent), zero);
            accumulate::<S, D>(&mut moments, w, a, [one, b, b2, b2 * b, b2 * b2, b2 * b2 * b, b2 * b * (b2 * b)], f);
        },
    );
    Fit { moments, a_axis: frame.a_axis, b_axis: frame.b_axis, metres: one / per_metre }
}

#[inline(always)]
fn accumulate<S: Simd, const D: usize>(moments: &mut Moments<S>, w: S::f32s, a: S::f32s, b: [S::f32s; 7], f: S::f32s) {
    let mut wa = w;
    unroll!(I in 7 {
        if I <= 2 * D {
            let m = &mut moments.m;
            m[place(2 * D, I, 0)] += wa;
            unroll!(J in 7 {
                if J > 0 && I + J <= 2 * D {
                    m[place(2 * D, I, J)] = wa.mul_add(b[J], m[place(2 * D, I, J)]);
                }
            });
        }
        if I <= D {
            let wf = wa * f;
            let t = &mut moments.t;
            t[place(D, I, 0)] += wf;
            unroll!(J in 7 {
                if J > 0 && I + J <= D {
                    t[place(D, I, J)] = wf.mul_add(b[J], t[place(D, I, J)]);
                }
            });
        }
        wa = wa * a;
    });
}
