//! The elementary functions that fearless_simd lacks, on vectors of f32. Errors are stated for the ranges that are
//! used.

use fearless_simd::{Bytes, Select, Simd, SimdBase, SimdFloat};

use super::vector::splat;

/// Returns 2^-x for x >= 0 with a relative error below 4e-6, which suffices for weights: the error changes a point by
/// that share of its residual. Above 126, the limit of f32, the result is at most 2^-126. On x86, NaN gives a finite
/// number.
#[inline(always)]
pub(super) fn exp2_neg<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    // Adding 1.5 * 2^23 rounds to whole numbers and leaves them in the low bits.
    let shift = splat(simd, 12_582_912.0);
    let x = x.min(splat(simd, 126.0));
    let rounded = shift - x;
    let f = (shift - rounded) - x;
    // Minimax polynomial on [-1/2, 1/2].
    let p = splat(simd, 9.570_102e-3);
    let p = p.mul_add(f, splat(simd, 5.591_786e-2));
    let p = p.mul_add(f, splat(simd, 2.402_474_4e-1));
    let p = p.mul_add(f, splat(simd, 6.931_218e-1));
    let p = p.mul_add(f, splat(simd, 9.999_993e-1));
    let exponent = rounded.bitcast::<S::i32s>() << 23;
    (p.bitcast::<S::i32s>() + exponent).bitcast()
}

/// Returns cos(acos(x)/3) for x in [-1, 1], as needed by the trigonometric solution of a cubic. Absolute error below
/// 5e-7. The result increases from 1/2 at -1 to 1 at 1.
#[inline(always)]
pub(super) fn cos_third_acos<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    // acos(|x|) = sqrt(1 - |x|) p(|x|): Abramowitz & Stegun 4.4.46.
    let magnitude = x.abs();
    let p = splat(simd, -0.001_262_491_1);
    let p = p.mul_add(magnitude, splat(simd, 0.006_670_09));
    let p = p.mul_add(magnitude, splat(simd, -0.017_088_126));
    let p = p.mul_add(magnitude, splat(simd, 0.030_891_88));
    let p = p.mul_add(magnitude, splat(simd, -0.050_174_303));
    let p = p.mul_add(magnitude, splat(simd, 0.088_978_99));
    let p = p.mul_add(magnitude, splat(simd, -0.214_598_8));
    let p = p.mul_add(magnitude, splat(simd, std::f32::consts::FRAC_PI_2));
    let acute = (splat(simd, 1.0) - magnitude).max(splat(simd, 0.0)).sqrt() * p;
    let angle = x.simd_lt(splat(simd, 0.0)).select(splat(simd, std::f32::consts::PI) - acute, acute);
    // cos on [0, pi/3] by its series in the square: the next term is below 2e-8.
    let s = (angle * splat(simd, 1.0 / 3.0)) * (angle * splat(simd, 1.0 / 3.0));
    let c = splat(simd, 2.480_158_7e-5);
    let c = c.mul_add(s, splat(simd, -1.388_888_9e-3));
    let c = c.mul_add(s, splat(simd, 4.166_666_7e-2));
    let c = c.mul_add(s, splat(simd, -0.5));
    c.mul_add(s, splat(simd, 1.0))
}
