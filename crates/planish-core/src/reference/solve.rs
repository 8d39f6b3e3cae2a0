//! Solves symmetric positive systems by an LDL^T decomposition (docs/method.md, section 6).

/// Solves A c = t for a symmetric positive A with `t.len()` rows. Returns zeros if a pivot is not positive because
/// every weight was too small.
pub(super) fn solve(a: &[Vec<f64>], t: &[f64]) -> Vec<f64> {
    let m = t.len();
    // L below the diagonal, and the pivots D.
    let mut l = vec![vec![0.0; m]; m];
    let mut pivots = vec![0.0; m];
    for j in 0..m {
        let reduce = |i: usize, l: &[Vec<f64>]| a[i][j] - (0..j).map(|k| l[i][k] * l[j][k] * pivots[k]).sum::<f64>();
        let pivot = reduce(j, &l);
        // False for a NaN.
        let is_positive = pivot > 0.0;
        if !is_positive {
            return vec![0.0; m];
        }
        for i in j + 1..m {
            l[i][j] = reduce(i, &l) / pivot;
        }
        pivots[j] = pivot;
    }
    // L y = t, then L^T c = y/D.
    let mut y = vec![0.0; m];
    for j in 0..m {
        y[j] = t[j] - (0..j).map(|k| l[j][k] * y[k]).sum::<f64>();
    }
    let mut c = vec![0.0; m];
    for j in (0..m).rev() {
        c[j] = y[j] / pivots[j] - (j + 1..m).map(|i| l[i][j] * c[i]).sum::<f64>();
    }
    c
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_a_well_conditioned_system() {
        let a = [vec![4.0, 1.0, 0.5], vec![1.0, 3.0, 0.2], vec![0.5, 0.2, 2.0]];
        let truth = [1.0, -2.0, 3.0];
        let t: Vec<f64> = a.iter().map(|row| row.iter().zip(truth).map(|(x, c)| x * c).sum()).collect();
        for (c, expected) in solve(&a, &t).into_iter().zip(truth) {
            assert!((c - expected).abs() < 1e-14);
        }
    }

    #[test]
    fn a_system_without_weights_has_the_plane_for_a_solution() {
        assert_eq!(solve(&[vec![0.0; 3], vec![0.0; 3], vec![0.0; 3]], &[0.0; 3]), [0.0; 3]);
        assert_eq!(solve(&[vec![f64::NAN]], &[1.0]), [0.0]);
    }
}
