//! Moments of the normal equations: sums over the terms of neighbours (docs/method.md, section 5).
//!
//! M_ij = sum w a^i b^j for i + j <= 2 D, and T_ij = sum w f a^i b^j for i + j <= D. They are sums of outer products of
//! the powers of a and b: one fused multiply-add each, and plain additions for j = 0.

use fearless_simd::{Simd, SimdBase, SimdFloat};

use super::unroll::unroll;
use super::vector::splat;

/// Maximum number of moments M_ij, for degree 3.
const MAX_MOMENTS: usize = 28;
const MAX_RIGHT_SIDES: usize = 10;

/// Contribution of a candidate: its weight w (0 outside the gate) and its coordinates a, b and f. Between the two
/// passes, a, b and f contain the candidate's offset from p.
pub(super) struct Term<S: Simd> {
    pub(super) w: S::f32s,
    pub(super) a: S::f32s,
    pub(super) b: S::f32s,
    pub(super) f: S::f32s,
}

impl<S: Simd> Clone for Term<S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Term<S> {}

pub(super) struct Moments<S: Simd> {
    m: [S::f32s; MAX_MOMENTS],
    t: [S::f32s; MAX_RIGHT_SIDES],
}

impl<S: Simd> Clone for Moments<S> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Moments<S> {}

/// Returns the index of M_ij among those with i + j <= `degree`, stored as one run over j for each i.
#[inline(always)]
const fn place(degree: usize, i: usize, j: usize) -> usize {
    i * (2 * degree + 3 - i) / 2 + j
}

impl<S: Simd> Moments<S> {
    #[inline(always)]
    pub(super) fn zero(simd: S) -> Self {
        let zero = splat(simd, 0.0);
        Self { m: [zero; MAX_MOMENTS], t: [zero; MAX_RIGHT_SIDES] }
    }

    /// Creates moments from M_ij and T_ij.
    #[cfg(test)]
    pub(super) fn from_fn<const D: usize>(
        simd: S,
        m: impl Fn(usize, usize) -> S::f32s,
        t: impl Fn(usize, usize) -> S::f32s,
    ) -> Self {
        let mut moments = Self::zero(simd);
        for (i, j) in (0..=2 * D).flat_map(|i| (0..=2 * D - i).map(move |j| (i, j))) {
            moments.m[place(2 * D, i, j)] = m(i, j);
            if i + j <= D {
                moments.t[place(D, i, j)] = t(i, j);
            }
        }
        moments
    }

    #[inline(always)]
    pub(super) fn add(&mut self, other: &Self) {
        self.m.iter_mut().zip(other.m).for_each(|(m, other)| *m += other);
        self.t.iter_mut().zip(other.t).for_each(|(t, other)| *t += other);
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

/// Returns true if moments are summed in few groups: AVX-512 and NEON have 32 registers, and fewer groups make web
/// builds smaller.
const fn in_few_groups<S: Simd>() -> bool {
    <S::f32s as SimdBase<S>>::LEN > 8 || cfg!(any(target_arch = "aarch64", target_family = "wasm"))
}

/// Sums the moments of terms in groups that fit in the registers. With 16 registers, degree 3 takes 85 instructions
/// per term; in two groups it took 140 because registers were spilled. Not inlined, so that callers share one copy.
#[inline(never)]
pub(super) fn sum_terms<S: Simd, const D: usize>(simd: S, terms: &[Term<S>], moments: &mut Moments<S>) {
    simd.vectorize(
        #[inline(always)]
        || {
            if const { in_few_groups::<S>() } {
                if D == 3 {
                    sum_group::<S, D, 0b11, 0b1>(simd, terms, moments);
                    sum_group::<S, D, 0b1111100, 0b1110>(simd, terms, moments);
                } else {
                    sum_group::<S, D, 0b11111, 0b111>(simd, terms, moments);
                }
            } else {
                sum_group::<S, D, 0b1, 0b1>(simd, terms, moments);
                if D == 3 {
                    sum_group::<S, D, 0b10, 0b10>(simd, terms, moments);
                    sum_group::<S, D, 0b100, 0b1100>(simd, terms, moments);
                    sum_group::<S, D, 0b1111000, 0>(simd, terms, moments);
                } else {
                    sum_group::<S, D, 0b10, 0b10>(simd, terms, moments);
                    sum_group::<S, D, 0b11100, 0b100>(simd, terms, moments);
                }
            }
        },
    );
}

/// Sums the moments M_ij for which bit i of `M` is set, and T_ij for which bit i of `T` is set. The bits of `T` must
/// be consecutive.
#[inline(always)]
fn sum_group<S: Simd, const D: usize, const M: u32, const T: u32>(
    simd: S,
    terms: &[Term<S>],
    moments: &mut Moments<S>,
) {
    let Moments { mut m, mut t } = Moments::zero(simd);
    for &Term { w, a, b, f } in terms {
        let (a2, b2) = (a * a, b * b);
        let (wa, wa2, b3, b4) = (w * a, w * a2, b2 * b, b2 * b2);
        let b_powers = [b, b, b2, b3, b4, b4 * b, b3 * b3];
        let wa3 = wa * a2;
        let wa4 = wa3 * a;
        let wa_powers = [w, wa, wa2, wa3, wa4, wa4 * a, wa4 * a2];
        let mut wf = wa_powers[T.trailing_zeros() as usize % 7] * f;
        unroll!(I in 7 {
            if M & (1 << I) != 0 && I <= 2 * D {
                m[place(2 * D, I, 0)] += wa_powers[I];
                unroll!(J in 7 {
                    if J > 0 && I + J <= 2 * D {
                        m[place(2 * D, I, J)] = wa_powers[I].mul_add(b_powers[J], m[place(2 * D, I, J)]);
                    }
                });
            }
            if T & (1 << I) != 0 && I <= D {
                t[place(D, I, 0)] += wf;
                unroll!(J in 7 {
                    if J > 0 && I + J <= D {
                        t[place(D, I, J)] = wf.mul_add(b_powers[J], t[place(D, I, J)]);
                    }
                });
                wf *= a;
            }
        });
    }
    unroll!(I in 7 {
        unroll!(J in 7 {
            if M & (1 << I) != 0 && I + J <= 2 * D {
                moments.m[place(2 * D, I, J)] = m[place(2 * D, I, J)];
            }
            if T & (1 << I) != 0 && I + J <= D {
                moments.t[place(D, I, J)] = t[place(D, I, J)];
            }
        });
    });
}
