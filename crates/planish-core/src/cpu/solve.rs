//! Solves the normal equations with their ridge, by an LDL^T decomposition (docs/method.md, section 6).
//!
//! Lanes with too few neighbours for degree 3 omit the cubic unknowns. Since unknowns are ordered by degree, the
//! solution of degree 2 remains.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

use super::moments::Moments;
use super::unroll::unroll;
use super::vector::{Mask, splat};
use crate::constants::{MONOMIALS, RIDGE_WEIGHTS, coefficient_count};

/// The solution, in the units of the moments.
pub(super) struct Solution<S: Simd> {
    /// c_00, c_10 and c_01.
    pub(super) c: [S::f32s; 3],
    /// Amount by which the polynomial lowers the objective, (6.1) in docs/method.md, from sum(w f²) to its minimum.
    pub(super) explained: S::f32s,
}

/// Solves the normal equations. `extent_squared` is the square of the neighbourhood's extent in the units of the
/// moments.
// Unrolled copies whose conditions are false assign values that are never read.
#[allow(unused_assignments)]
// Not inlined in web builds, which makes them smaller.
#[cfg_attr(target_family = "wasm", inline(never))]
#[cfg_attr(not(target_family = "wasm"), inline(always))]
pub(super) fn solve<S: Simd, const D: usize>(
    simd: S,
    moments: &Moments<S>,
    extent_squared: S::f32s,
    ridge: S::f32s,
    n: S::f32s,
) -> Solution<S> {
    let zero = splat(simd, 0.0);
    // lambda sum(w) h^(2 (i + j)), by i + j.
    let linear = moments.m::<D>(0, 0) * ridge * extent_squared;
    let quadratic = linear * extent_squared;
    let ridges = [zero, linear, quadratic, quadratic * extent_squared];
    let count = coefficient_count(D);
    let carries_cubic: Mask<S> = n.simd_ge(splat(simd, coefficient_count(3) as f32));
    // L below the diagonal, and the inverse pivots; zeros for omitted unknowns.
    let mut l = [[zero; 10]; 10];
    let mut inverse = [zero; 10];
    // The decomposition runs row by row, so that most of a row stays in registers. Column by column took 12 % more
    // instructions.
    unroll!(I in 10 {
        if I < count {
            let (a, b) = MONOMIALS[I];
            let mut row = [zero; 10];
            unroll!(J in 10 {
                if J <= I {
                    row[J] = entry::<S, D>(moments, I, J);
                }
            });
            row[I] = ridges[a + b].mul_add(splat(simd, RIDGE_WEIGHTS[I]), row[I]);
            unroll!(J in 10 {
                if J < I {
                    unroll!(K in 10 {
                        if J < K && K < I {
                            row[K] = (-row[J]).mul_add(l[K][J], row[K]);
                        }
                    });
                    l[I][J] = row[J] * inverse[J];
                    row[I] = (-row[J]).mul_add(l[I][J], row[I]);
                }
            });
            // Without any weight, all pivots are 0; otherwise the ridge keeps them positive.
            let mut supported: Mask<S> = row[I].simd_gt(zero);
            if a + b == 3 {
                supported &= carries_cubic;
            }
            inverse[I] = supported.select(splat(simd, 1.0) / row[I], zero);
        }
    });
    let mut y = [zero; 10];
    unroll!(J in 10 {
        if J < count {
            y[J] = moments.t::<D>(MONOMIALS[J].0, MONOMIALS[J].1);
        }
    });
    unroll!(J in 10 {
        unroll!(K in 10 {
            if J < K && K < count {
                y[K] = (-y[J]).mul_add(l[K][J], y[K]);
            }
        });
    });
    let mut c = [zero; 10];
    unroll!(R in 10 {
        const J: usize = 9 - R;
        if J < count {
            c[J] = y[J] * inverse[J];
            // The most recent c comes last, so that as few operations as possible wait for it.
            unroll!(Q in 10 {
                const I: usize = 9 - Q;
                if I > J && I < count {
                    c[J] = (-l[I][J]).mul_add(c[I], c[J]);
                }
            });
        }
    });
    let mut explained = zero;
    unroll!(J in 10 {
        if J < count {
            explained = y[J].mul_add(y[J] * inverse[J], explained);
        }
    });
    Solution { c: [c[0], c[1], c[2]], explained }
}

/// Returns entry (i, j) of the normal matrix.
#[inline(always)]
fn entry<S: Simd, const D: usize>(moments: &Moments<S>, i: usize, j: usize) -> S::f32s {
    let ((ai, bi), (aj, bj)) = (MONOMIALS[i], MONOMIALS[j]);
    moments.m::<D>(ai + aj, bi + bj)
}
