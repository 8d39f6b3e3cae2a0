//! Symmetric positive systems by LDL^T, dropping unknowns that the data do not support (docs/method.md, section 6).

/// A pivot at or below this share of its own diagonal entry is not supported.
const PIVOT_RATIO: f64 = 3e-2;

/// Solves A c = t for a symmetric A of `t.len()` rows, given row by row. Unknowns whose pivot is too small are dropped and get
/// 0; those before them do not change.
pub(super) fn solve(a: &[Vec<f64>], t: &[f64]) -> Vec<f64> {
    let m = t.len();
    // L below the diagonal and the pivots D; None marks a dropped unknown.
    let mut l = vec![vec![0.0; m]; m];
    let mut pivots = vec![None; m];
    for j in 0..m {
        let reduce = |i: usize, l: &[Vec<f64>], pivots: &[Option<f64>]| {
            a[i][j] - (0..j).filter_map(|k| pivots[k].map(|d| l[i][k] * l[j][k] * d)).sum::<f64>()
        };
        let pivot = reduce(j, &l, &pivots);
        // A NaN is not supported either.
        let supported = pivot > PIVOT_RATIO * a[j][j];
        if !supported {
            continue;
        }
        for i in j + 1..m {
            l[i][j] = reduce(i, &l, &pivots) / pivot;
        }
        pivots[j] = Some(pivot);
    }
    // L y = t, then L^T c = y/D, over the kept unknowns.
    let mut y = vec![0.0; m];
    for j in 0..m {
        if pivots[j].is_some() {
            y[j] = t[j] - (0..j).map(|k| l[j][k] * y[k]).sum::<f64>();
        }
    }
    let mut c = vec![0.0; m];
    for j in (0..m).rev() {
        if let Some(pivot) = pivots[j] {
            c[j] = y[j] / pivot - (j + 1..m).map(|i| l[i][j] * c[i]).sum::<f64>();
        }
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
    fn drops_what_is_not_supported_and_harms_nothing_before_it() {
        // The third unknown repeats the second: its pivot is zero.
        let a = [vec![2.0, 1.0, 1.0], vec![1.0, 3.0, 3.0], vec![1.0, 3.0, 3.0]];
        let c = solve(&a, &[1.0, 2.0, 2.0]);
        let smaller = solve(&[a[0][..2].to_vec(), a[1][..2].to_vec()], &[1.0, 2.0]);
        assert_eq!(c[2], 0.0);
        assert_eq!(c[..2], smaller[..]);
    }
}
