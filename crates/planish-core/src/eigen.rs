//! Eigenvalues and eigenvectors of small symmetric matrices, by cyclic Jacobi rotations: slow, simple, accurate.

use glam::{DMat3, DVec3};

/// Returns the eigenvalues of a 3x3 matrix in ascending order with their unit eigenvectors.
pub fn symmetric_eigen(matrix: DMat3) -> ([f64; 3], [DVec3; 3]) {
    let (values, vectors) = symmetric_eigen_of(matrix.to_cols_array_2d());
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| values[i].total_cmp(&values[j]));
    (order.map(|i| values[i]), order.map(|i| DVec3::from_array(vectors[i]).normalize()))
}

/// Returns the eigenvalues of a symmetric matrix with their unit eigenvectors, in no particular order.
pub fn symmetric_eigen_of<const N: usize>(mut a: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    const SWEEPS: usize = 32;
    // Row k is the k-th eigenvector.
    let mut vectors: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    let pairs = || (0..N).flat_map(|p| (p + 1..N).map(move |q| (p, q)));
    for _ in 0..SWEEPS {
        if pairs().all(|(p, q)| a[p][q] == 0.0) {
            break;
        }
        for (p, q) in pairs() {
            if a[p][q] == 0.0 {
                continue;
            }
            // The rotation that makes a[p][q] zero (Golub & Van Loan, section 8.5).
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
            let c = 1.0 / t.hypot(1.0);
            let s = t * c;
            for row in &mut a {
                (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
            }
            for rows in [&mut a, &mut vectors] {
                let (row_p, row_q) = (rows[p], rows[q]);
                rows[p] = std::array::from_fn(|k| c * row_p[k] - s * row_q[k]);
                rows[q] = std::array::from_fn(|k| s * row_p[k] + c * row_q[k]);
            }
            (a[p][q], a[q][p]) = (0.0, 0.0);
        }
    }
    (std::array::from_fn(|i| a[i][i]), vectors)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reconstructs_random_and_nasty_matrices() {
        let mut rng = crate::testing::Random::new(7, 0);
        let mut matrices: Vec<DMat3> = (0..1000)
            .map(|i| {
                let scale = 10f64.powi(i % 21 - 10);
                let mut v = || (rng.uniform() - 0.5) * scale;
                let (xx, yy, zz, xy, xz, yz) = (v(), v(), v(), v(), v(), v());
                DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
            })
            .collect();
        matrices.push(DMat3::ZERO);
        matrices.push(DMat3::IDENTITY);
        matrices.push(DMat3::from_cols(DVec3::ONE, DVec3::ONE, DVec3::ONE));
        for matrix in matrices {
            let (values, vectors) = symmetric_eigen(matrix);
            let scale = matrix.to_cols_array().iter().fold(f64::MIN_POSITIVE, |m, x| m.max(x.abs()));
            assert!(values[0] <= values[1] && values[1] <= values[2]);
            for (value, vector) in values.into_iter().zip(vectors) {
                assert!((matrix * vector - value * vector).length() <= 1e-14 * scale);
            }
            assert!((vectors[0].dot(vectors[1])).abs() < 1e-14);
            assert!((vectors[0].cross(vectors[1]).dot(vectors[2]).abs() - 1.0).abs() < 1e-14);
        }
    }

    #[test]
    fn larger_matrices_are_diagonalised_too() {
        let matrix: [[f64; 6]; 6] = std::array::from_fn(|i| {
            std::array::from_fn(|j| 1.0 / (1.0 + (i + j) as f64) + f64::from(u8::from(i == j)))
        });
        let (values, vectors) = symmetric_eigen_of(matrix);
        for (value, vector) in values.iter().zip(&vectors) {
            for (row, entry) in matrix.iter().zip(vector) {
                let product: f64 = row.iter().zip(vector).map(|(a, b)| a * b).sum();
                assert!((product - value * entry).abs() < 1e-12);
            }
        }
    }
}
