//! The pixels of a frame whose cells of 2x2 pixels share a surface (docs/method.md, section 10). Even and odd columns
//! are stored separately, so pixels at the same position in adjacent cells are adjacent in memory and load as one
//! vector.

use fearless_simd::{Simd, SimdBase, SimdMask};

use super::blocks::BlockPixels;
use super::channels::{Channels, MAX_LANES};
use super::padded::{self, PaddedRows};
use super::row_tasks::{SplitRows, run_on_rows};
use super::valid_points;
use super::vector::{Mask, Vec3};
use crate::camera::Rays;
use crate::smoothing_engine::AdmittedFrame;

/// Width and height of a cell in pixels.
pub(super) const CELL_PX: usize = 2;

/// First of the three channels of even columns.
pub(super) const EVEN: usize = 0;
/// First of the three channels of odd columns.
pub(super) const ODD: usize = 3;

/// Number of points copied at once.
const CHUNK: usize = 128;

/// Rows of pixels as points: x, y and z of even columns, then of odd columns, with a border of NaN.
pub(super) struct Pixels {
    columns: Channels<6>,
    /// Number of values from one row to the next.
    row_len: usize,
    /// Number of rows before the image, and of values before its first column.
    border: usize,
    width: usize,
    height: usize,
}

/// A band of rows of the image.
struct PixelRows<'a> {
    first: usize,
    row_len: usize,
    columns: [&'a mut [f32]; 6],
}

impl SplitRows for PixelRows<'_> {
    fn count(&self) -> usize {
        self.columns[0].len() / self.row_len
    }

    fn split_at(self, rows: usize) -> (Self, Self) {
        let Self { first, row_len, columns } = self;
        let [mut before, mut after] = [(); 2].map(|()| std::array::from_fn(|_| <&mut [f32]>::default()));
        for (k, column) in columns.into_iter().enumerate() {
            (before[k], after[k]) = column.split_at_mut(rows * row_len);
        }
        (Self { first, row_len, columns: before }, Self { first: first + rows, row_len, columns: after })
    }
}

impl Pixels {
    /// Allocates a frame whose blocks extend `block_half` pixels beyond its cells on all sides.
    pub(super) fn new((width, height): (usize, usize), block_half: usize) -> Self {
        let border = block_half + CELL_PX;
        let row_len = border + width.div_ceil(CELL_PX).next_multiple_of(MAX_LANES) + border;
        let columns = Channels::new(row_len * (height + 2 * border), f32::NAN);
        Self { columns, row_len, border, width, height }
    }

    pub(super) fn bytes(&self) -> usize {
        self.columns.bytes()
    }

    /// Returns the index of the pixels in row v of the cells in cell column u.
    #[inline(always)]
    pub(super) fn index(&self, u: usize, v: usize) -> usize {
        (v + self.border) * self.row_len + u + self.border
    }

    /// Returns the vector of points at an index, in the [`EVEN`] or [`ODD`] columns of cells.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, columns: usize, at: usize) -> Vec3<S> {
        self.columns.vector(simd, columns, at)
    }

    /// Copies a frame, which must have this buffer's shape. `rays` must belong to the frame's camera.
    pub(super) fn fill(&mut self, frame: &AdmittedFrame<'_>, rays: &Rays, parallel: bool) {
        let (row_len, border, width) = (self.row_len, self.border, self.width);
        let image = border * row_len..(border + self.height) * row_len;
        let rows = PixelRows { first: 0, row_len, columns: self.columns.range_mut(image) };
        run_on_rows(rows, parallel, &|rows: PixelRows<'_>| {
            let [mut x, mut y, mut z] = [[0.0; CHUNK]; 3];
            for row in 0..rows.count() {
                for first in (0..width).step_by(CHUNK) {
                    let columns = first..width.min(first + CHUNK);
                    let len = columns.len();
                    let chunk = [&mut x[..len], &mut y[..len], &mut z[..len]];
                    padded::points_of_row(frame, rays, rows.first + row, columns, chunk);
                    let at = row * row_len + border + first / CELL_PX;
                    for (k, values) in [&x[..len], &y[..len], &z[..len]].into_iter().enumerate() {
                        let even = rows.columns[EVEN + k][at..].iter_mut();
                        even.zip(values.iter().step_by(CELL_PX)).for_each(|(to, from)| *to = *from);
                        let odd = rows.columns[ODD + k][at..].iter_mut();
                        odd.zip(values[1..].iter().step_by(CELL_PX)).for_each(|(to, from)| *to = *from);
                    }
                }
            }
        });
    }

    /// Copies the first valid point of each cell to `cells`.
    #[inline(always)]
    pub(super) fn represent<S: Simd>(&self, simd: S, cells: &mut PaddedRows<'_>) {
        for row in 0..cells.count() {
            for u in (0..self.width.div_ceil(CELL_PX)).step_by(S::f32s::LEN) {
                let upper = self.index(u, CELL_PX * (cells.first + row));
                let lower = upper + self.row_len;
                let mut p = self.load(simd, EVEN, upper);
                for (columns, at) in [(ODD, upper), (EVEN, lower), (ODD, lower)] {
                    let valid: Mask<S> = valid_points(simd, p);
                    if valid.all_true() {
                        break;
                    }
                    p = p.or(valid, self.load(simd, columns, at));
                }
                cells.store(cells.index(row, u), p);
            }
        }
    }
}

impl BlockPixels for Pixels {
    #[inline(always)]
    fn visit_block<S: Simd>(&self, simd: S, (u, v): (usize, usize), half: usize, mut visit: impl FnMut(Vec3<S>)) {
        let start = self.index(u, CELL_PX * v) - half * self.row_len;
        // From -half to half + 1, even columns extend `less` values to the left and `more` to the right; odd columns
        // extend `more` to the left and `less` to the right.
        let (less, more) = (half / 2, half.div_ceil(2));
        let last = (2 * half + 1) * self.row_len;
        let part = self.columns.part(start - more, start + last + more);
        for row in (start..=start + last).step_by(self.row_len) {
            for even in row - less..=row + more {
                // SAFETY: indices are at most `more` from `row`, and the part extends as far beyond the first and the
                // last row.
                visit(unsafe { part.vector(simd, EVEN, even) });
            }
            for odd in row - more..=row + less {
                // SAFETY: as for even columns.
                visit(unsafe { part.vector(simd, ODD, odd) });
            }
        }
    }
}
