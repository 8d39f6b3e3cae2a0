//! Tests of the kernels' primitives at every SIMD level, against f64, on random and extreme inputs.

use fearless_simd::{Level, Simd, dispatch};
use glam::{DMat3, DVec3};

use super::eigen::{Symmetric, smallest_eigenvector, tangents};
use super::math::{cos_third_acos, exp2_neg};
use super::moments::Moments;
use super::solve::solve;
use super::vector::{Vec3, splat};
use crate::simd_level::SimdLevel;
use crate::testing::Random;

/// Runs the same test at every SIMD level that this machine supports.
macro_rules! at_every_level {
    ($test:ident) => {
        for level in SimdLevel::available() {
            let token = level.token(Level::new()).unwrap();
            dispatch!(token, simd => $test(simd, level.name()));
        }
    };
}

/// Copies one value to every lane through memory, so that nothing is computed at compile time.
fn lanes<S: Simd>(simd: S, value: f64) -> S::f32s {
    splat(simd, std::hint::black_box(value as f32))
}

#[test]
fn exp2_neg_keeps_its_error() {
    fn test<S: Simd>(simd: S, level: &str) {
        let mut worst = 0f64;
        for i in 0..=252_000 {
            let x = -f64::from(i) * 5e-4;
            let x = f64::from(x as f32);
            let found = f64::from(exp2_neg(simd, lanes(simd, -x))[0]);
            worst = worst.max((found / x.exp2() - 1.0).abs());
        }
        assert!(worst < 4e-6, "{level}: {worst:e}");
        for x in [-127.0, -1e3, -1e30, f64::NEG_INFINITY] {
            let found = exp2_neg(simd, lanes(simd, -x))[0];
            assert!((0.0..=1.2e-38).contains(&found), "{level}: 2^{x} = {found:e}");
        }
        let of_nan = exp2_neg(simd, lanes(simd, f64::NAN))[0];
        assert!(of_nan.is_finite() || !cfg!(target_arch = "x86_64"), "{level}");
    }
    at_every_level!(test);
}

#[test]
fn the_cosine_of_a_third_of_the_arc_cosine_keeps_its_error() {
    fn test<S: Simd>(simd: S, level: &str) {
        let mut worst = 0f64;
        for i in -100_000..=100_000 {
            let x = f64::from((f64::from(i) * 1e-5) as f32);
            let found = f64::from(cos_third_acos(simd, lanes(simd, x))[0]);
            worst = worst.max((found - (x.clamp(-1.0, 1.0).acos() / 3.0).cos()).abs());
        }
        assert!(worst < 5e-7, "{level}: {worst:e}");
    }
    at_every_level!(test);
}

/// Returns R diag(values) R^T for a random rotation R, and the first column of R.
fn with_eigenvalues(random: &mut Random, values: [f64; 3]) -> (DMat3, DVec3) {
    let n = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
    let u = n.any_orthonormal_vector();
    let v = n.cross(u);
    let rotation = DMat3::from_cols(n, u, v);
    (rotation * DMat3::from_diagonal(DVec3::from_array(values)) * rotation.transpose(), n)
}

fn symmetric<S: Simd>(simd: S, m: DMat3) -> Symmetric<S> {
    let at = |column: usize, row: usize| lanes(simd, m.col(column)[row]);
    Symmetric { xx: at(0, 0), xy: at(0, 1), xz: at(0, 2), yy: at(1, 1), yz: at(1, 2), zz: at(2, 2) }
}

#[test]
fn the_smallest_eigenvector_is_as_good_as_f32_allows() {
    fn test<S: Simd>(simd: S, level: &str) {
        let mut random = Random::new(11, 1);
        for case in 0..20_000 {
            // Planes, lines, balls and shapes in between, at the scales of a window.
            let l2 = 10f64.powf(random.between(-10.0, 0.0));
            let l1 = l2 * 10f64.powf(random.between(-3.0, 0.0));
            let l0 = l1 * if case % 5 == 0 { 0.0 } else { random.between(0.0, 0.9) };
            let (matrix, n) = with_eigenvalues(&mut random, [l0, l1, l2]);
            let found = smallest_eigenvector(simd, &symmetric(simd, matrix));
            let vector = DVec3::new(found.vector.x[0].into(), found.vector.y[0].into(), found.vector.z[0].into());
            let what = format!("{level}: {l0:e} {l1:e} {l2:e} {vector}");
            assert!((vector.length() - 1.0).abs() < 1e-6, "{what}");
            // Rounding the matrix to f32 limits the accuracy of its eigenvector.
            let off = n.cross(vector).length();
            assert!(off < 2e-6 * l2 / (l1 - l0) + 1e-6, "{what}: off by {off:e}");
            for (value, expected) in found.values.iter().zip([l0, l1, l2]) {
                // Two equal eigenvalues are each determined only to the square root of a rounding error.
                let tolerance = if l2 - l1 < 0.01 * l2 { 1e-3 } else { 1e-5 };
                assert!((f64::from(value[0]) - expected).abs() < tolerance * l2, "{what}: {} {expected:e}", value[0]);
            }
        }
    }
    at_every_level!(test);
}

#[test]
fn nasty_matrices_give_unit_vectors() {
    fn test<S: Simd>(simd: S, level: &str) {
        let diagonal = |x: f64, y: f64, z: f64| DMat3::from_diagonal(DVec3::new(x, y, z));
        let ones = DMat3::from_cols(DVec3::ONE, DVec3::ONE, DVec3::ONE);
        let nasty = [
            DMat3::ZERO,
            DMat3::IDENTITY,
            diagonal(1.0, 0.0, 0.0),
            diagonal(0.0, 1.0, 1.0),
            diagonal(1.0, 1.0, 0.0),
            diagonal(1e-30, 1e-30, 1e-36),
            diagonal(1e12, 1e12, 1e3),
            ones,
            ones * 1e-8,
            diagonal(1.0, 1e-9, 2e-9),
        ];
        for matrix in nasty {
            let found = smallest_eigenvector(simd, &symmetric(simd, matrix));
            let length = found.vector.dot(found.vector)[0];
            assert!((length - 1.0).abs() < 1e-5, "{level}: {matrix}: {length}");
            assert!(found.values.iter().all(|value| value[0].is_finite()), "{level}: {matrix}");
        }
    }
    at_every_level!(test);
}

#[test]
fn tangents_are_the_references() {
    fn test<S: Simd>(simd: S, level: &str) {
        let mut random = Random::new(12, 1);
        for _ in 0..1000 {
            let n = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
            let (u, v) = tangents(simd, Vec3::new(lanes(simd, n.x), lanes(simd, n.y), lanes(simd, n.z)));
            // The formula of Duff et al. (docs/method.md, section 5).
            let sign = 1f64.copysign(n.z);
            let c = -1.0 / (sign + n.z);
            let d = n.x * n.y * c;
            let expected = [1.0 + sign * n.x * n.x * c, sign * d, -sign * n.x, d, sign + n.y * n.y * c, -n.y];
            for (found, expected) in [u.x, u.y, u.z, v.x, v.y, v.z].iter().zip(expected) {
                assert!((f64::from(found[0]) - expected).abs() < 1e-6, "{level}: {n}");
            }
        }
    }
    at_every_level!(test);
}

/// Returns the moments of points (a, b, f) with unit weights, as the second pass sums them.
fn moments_of<S: Simd, const D: usize>(simd: S, points: &[(f64, f64, f64)]) -> Moments<S> {
    let sum = |i: usize, j: usize, heights: bool| {
        let term = |&(a, b, f): &(f64, f64, f64)| a.powi(i as i32) * b.powi(j as i32) * if heights { f } else { 1.0 };
        lanes(simd, points.iter().map(term).sum::<f64>())
    };
    Moments::from_fn::<D>(simd, |i, j| sum(i, j, false), |i, j| sum(i, j, true))
}

#[test]
fn the_solver_finds_the_polynomial_and_damps_what_is_not_supported() {
    fn test<S: Simd>(simd: S, level: &str) {
        // Small enough to be negligible.
        const RIDGE: f32 = 1e-7;
        let one = lanes(simd, 1.0);
        let mut random = Random::new(13, 1);
        let height =
            |a: f64, b: f64| 0.3 - 0.2 * a + 0.5 * b + 0.7 * a * a - 0.4 * a * b + 0.1 * b * b + 0.6 * a * a * b;
        let spread: Vec<_> = (0..49)
            .map(|_| (random.between(-1.0, 1.0), random.between(-1.0, 1.0)))
            .map(|(a, b)| (a, b, height(a, b)))
            .collect();
        // All on the line b = 0.
        let line: Vec<_> =
            (0..20).map(|i| f64::from(i) / 10.0 - 1.0).map(|a| (a, 0.0, 0.3 - 0.2 * a + 0.7 * a * a)).collect();
        let nine: Vec<_> = (0..9)
            .map(|i| (f64::from(i % 3) - 1.0, f64::from(i / 3) - 1.0))
            .map(|(a, b)| (a, b, height(a, b)))
            .collect();

        // The cases run in a loop, because each call of the solver is inlined at every level.
        let cases = [(&spread[..], RIDGE), (&line, RIDGE), (&nine, RIDGE), (&spread, 1e4), (&[], RIDGE)];
        let mut found = [[0.0; 3]; 5];
        for (found, (points, ridge)) in found.iter_mut().zip(cases) {
            let count = lanes(simd, points.len() as f64);
            let [value, slope_a, slope_b] =
                solve::<S, 3>(simd, &moments_of::<S, 3>(simd, points), one, splat(simd, ridge), count).c;
            *found = [value[0], slope_a[0], slope_b[0]];
        }
        let [of_spread, of_line, of_nine, stiff, of_nothing] = found;

        for (found, expected) in of_spread.iter().zip([0.3, -0.2, 0.5]) {
            assert!((found - expected).abs() < 1e-4, "{level}: {found} {expected}");
        }
        // Terms with b are 0; the others are exact.
        let [value, slope_a, slope_b] = of_line;
        assert!((value - 0.3).abs() < 1e-4 && (slope_a + 0.2).abs() < 1e-3, "{level}: {value} {slope_a}");
        assert_eq!(slope_b, 0.0, "{level}");
        // 9 neighbours do not determine a cubic: the result is that of degree 2.
        let quadratic =
            solve::<S, 2>(simd, &moments_of::<S, 2>(simd, &nine), one, splat(simd, RIDGE), lanes(simd, 9.0)).c;
        for (cubic, quadratic) in of_nine.iter().zip(quadratic) {
            assert!((cubic - quadratic[0]).abs() < 1e-6, "{level}: {cubic} {}", quadratic[0]);
        }
        // A large ridge suppresses the slopes and leaves only the height.
        assert!(stiff[1].abs() < 1e-3 && stiff[2].abs() < 1e-3, "{level}");
        // Without any weight, all coefficients are 0 rather than NaN.
        assert_eq!(of_nothing, [0.0; 3], "{level}");
    }
    at_every_level!(test);
}
