//! Intrinsics stored as a matrix, in row-major or column-major order.

/// Focal lengths [fx, fy] and principal point [cx, cy], in pixels.
pub(crate) type Intrinsics = ([f64; 2], [f64; 2]);

/// Returns the intrinsics in a 3x3, 3x4 or 4x4 matrix; `None` if it is not the matrix of a camera without skew. The
/// positions of its zeros determine whether it is stored in row-major or column-major order.
pub(crate) fn intrinsics_of(numbers: &[f64]) -> Option<Intrinsics> {
    let columns = match numbers.len() {
        9 => 3,
        12 | 16 => 4,
        _ => return None,
    };
    let by_rows = |row: usize, column: usize| numbers[row * columns + column];
    let by_columns = |row: usize, column: usize| numbers[column * 3 + row];
    let square = |row: usize, column: usize| numbers[column * columns + row];
    of_entries(by_rows).or_else(|| match numbers.len() {
        12 => of_entries(by_columns),
        _ => of_entries(square),
    })
}

fn of_entries(at: impl Fn(usize, usize) -> f64) -> Option<Intrinsics> {
    let is_camera = [at(0, 1), at(1, 0), at(2, 0), at(2, 1), at(2, 2)] == [0.0, 0.0, 0.0, 0.0, 1.0];
    is_camera.then(|| ([at(0, 0), at(1, 1)], [at(0, 2), at(1, 2)]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_is_read_by_rows_and_by_columns() {
        let expected = Some(([525.0, 526.0], [319.5, 239.5]));
        let rows = [525.0, 0.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0];
        let columns = [525.0, 0.0, 0.0, 0.0, 526.0, 0.0, 319.5, 239.5, 1.0];
        let projection = [525.0, 0.0, 319.5, 0.0, 0.0, 526.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0];
        let four = [525.0, 0.0, 319.5, 0.0, 0.0, 526.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        for numbers in [&rows[..], &columns, &projection, &four] {
            assert_eq!(intrinsics_of(numbers), expected, "{numbers:?}");
        }
        assert_eq!(intrinsics_of(&[525.0, 1.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0]), None);
        assert_eq!(intrinsics_of(&rows[..8]), None);
    }
}
