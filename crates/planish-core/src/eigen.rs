//! Eigenvalues and eigenvectors of a symmetric 3x3 matrix, by cyclic Jacobi rotations: slow, simple, accurate.

use glam::{DMat3, DVec3};

/// Eigenvalues in ascending order with their unit eigenvectors.
pub fn symmetric_eigen(matrix: DMat3) -> ([f64; 3], [DVec3; 3]) {
    const SWEEPS: usize = 32;
    let mut a = matrix.to_cols_array_2d();
    let mut vectors = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..SWEEPS {
        let off_diagonal = a[0][1].abs() + a[0][2].abs() + a[1][2].abs();
        if off_diagonal == 0.0 {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
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
                let (row_p, row_q) = (DVec3::from_array(rows[p]), DVec3::from_array(rows[q]));
                rows[p] = (c * row_p - s * row_q).to_array();
                rows[q] = (s * row_p + c * row_q).to_array();
            }
            (a[p][q], a[q][p]) = (0.0, 0.0);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[i][i].total_cmp(&a[j][j]));
    (order.map(|i| a[i][i]), order.map(|i| DVec3::from_array(vectors[i]).normalize()))
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
}
