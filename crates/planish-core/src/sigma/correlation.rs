//! Measures the correlation of the residuals of neighbouring pixels.

use rayon::prelude::*;

use super::constants::{LEAST_CORRELATION, MOST_LAG_PX, ROW_STRIDE_PX};

/// Number of partial sums. It is fixed, so that results are the same for every instruction set.
const PARTS: usize = 16;

/// For each lag along rows and columns, the sum of the products and the sum of the mean squares of the residuals in
/// pairs of pixels.
type Sums = [[[f64; 2]; MOST_LAG_PX]; 2];

/// Returns the correlation area in pixels, A of (17.3) in docs/method.md: the number of pixels whose correlated noise
/// counts as that of one pixel.
pub(super) fn area(values: &[f32], counts: &[f32], (width, height): (usize, usize)) -> f64 {
    let of_row = |v: usize| -> Sums {
        let row = |v: usize| [&values[v * width..(v + 1) * width], &counts[v * width..(v + 1) * width]];
        let here = row(v);
        let along_row = |lag: usize| match width > MOST_LAG_PX {
            true => {
                sums(here.map(|row| &row[..width - MOST_LAG_PX]), here.map(|row| &row[lag..][..width - MOST_LAG_PX]))
            }
            false => [0.0; 2],
        };
        let along_column = |lag: usize| if v + MOST_LAG_PX < height { sums(here, row(v + lag)) } else { [0.0; 2] };
        [std::array::from_fn(|k| along_row(k + 1)), std::array::from_fn(|k| along_column(k + 1))]
    };
    // Rows are added in order, so that the result is the same for every number of threads.
    let of_rows: Vec<Sums> = (0..height).into_par_iter().step_by(ROW_STRIDE_PX).map(of_row).collect();
    let along = |axis: usize| {
        let correlation = |lag: usize| {
            let [product, square] = [0, 1].map(|k| of_rows.iter().map(|row| row[axis][lag][k]).sum::<f64>());
            if square > 0.0 { product / square } else { 0.0 }
        };
        let correlations =
            (0..MOST_LAG_PX).map(correlation).take_while(|correlation| *correlation >= LEAST_CORRELATION);
        1.0 + 2.0 * correlations.sum::<f64>()
    };
    along(0) * along(1)
}

/// Returns the sum of the products of two rows' values, and the sum of their mean squares over the pixels that count in
/// both rows.
fn sums([a, a_counts]: [&[f32]; 2], [b, b_counts]: [&[f32]; 2]) -> [f64; 2] {
    let (mut products, mut squares) = ([0.0f32; PARTS], [0.0f32; PARTS]);
    let mut add = |k: usize, (a, b): (f32, f32), counts: f32| {
        // Values are 0 where they do not count.
        products[k] += a * b;
        squares[k] += 0.5 * (a * a + b * b) * counts;
    };
    let whole = a.len() / PARTS * PARTS;
    for at in (0..whole).step_by(PARTS) {
        let [a, b, a_counts, b_counts] = [a, b, a_counts, b_counts].map(|row| &row[at..at + PARTS]);
        (0..PARTS).for_each(|k| add(k, (a[k], b[k]), a_counts[k] * b_counts[k]));
    }
    (whole..a.len()).for_each(|i| add(i - whole, (a[i], b[i]), a_counts[i] * b_counts[i]));
    [products, squares].map(|parts| parts.iter().map(|part| f64::from(*part)).sum())
}
