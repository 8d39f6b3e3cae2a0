//! The Hilbert curve along which a cloud is sorted.

use fearless_simd::{Level, Simd, SimdBase, SimdCvtTruncate, dispatch};

use super::middle;

/// Number of bits of a cell's index along each axis; the curve visits 2^16 cells per axis.
const BITS: u32 = 16;
/// Number of points whose keys are computed together: the lanes of the widest vector.
pub(super) const KEYS_AT_ONCE: usize = 16;

/// A Hilbert curve through a box that contains most points.
pub(super) struct Curve {
    low: [f32; 3],
    cells_per_metre: f32,
}

impl Curve {
    /// Creates a curve over the bounding box of a sample of the points, excluding stray points. The box is extended on
    /// each side by half its width. Points outside are moved to the border, which affects only the order. Also returns
    /// the box's diagonal before the extension, in metres.
    pub(super) fn of(raw: &[Vec<f32>; 3]) -> (Self, f64) {
        let middle = raw.each_ref().map(|values| middle(values.len(), |i| f64::from(values[i])).unwrap_or_default());
        let extent_m = middle.iter().map(|[low, high]| (high - low).powi(2)).sum::<f64>().sqrt();
        let range = middle.map(|[low, high]| [low - 0.5 * (high - low), high + 0.5 * (high - low)]);
        let extent = range.iter().map(|[low, high]| high - low).fold(f64::from(f32::MIN_POSITIVE), f64::max);
        let cells_per_metre = (f64::from(1u32 << BITS) / extent).min(f64::from(f32::MAX)) as f32;
        (Self { low: range.map(|[low, _]| low as f32), cells_per_metre }, extent_m)
    }

    /// Creates a curve over the cube with the lowest corner `low`.
    pub(super) fn over(low: [f32; 3], extent_m: f32) -> Self {
        Self { low, cells_per_metre: ((1u32 << BITS) as f32 / extent_m).min(f32::MAX) }
    }

    /// Returns, for each point, the position along the curve of the cell that contains it.
    #[inline(never)]
    pub(super) fn keys(&self, level: Level, points: &[[f32; KEYS_AT_ONCE]; 3]) -> [u64; KEYS_AT_ONCE] {
        dispatch!(level, simd => self.keys_of(simd, points))
    }

    /// Computes keys by Skilling's transposition ("Programming the Hilbert curve", 2004). It uses no branches,
    /// because half of them would be mispredicted.
    #[inline(always)]
    fn keys_of<S: Simd>(&self, simd: S, [x, y, z]: &[[f32; KEYS_AT_ONCE]; 3]) -> [u64; KEYS_AT_ONCE] {
        let mut keys = [0; KEYS_AT_ONCE];
        for at in (0..KEYS_AT_ONCE).step_by(S::f32s::LEN) {
            let lanes = at..at + S::f32s::LEN;
            let mut x = self.cells(simd, 0, &x[lanes.clone()]);
            let mut y = self.cells(simd, 1, &y[lanes.clone()]);
            let mut z = self.cells(simd, 2, &z[lanes.clone()]);
            for bit in (1..BITS).rev() {
                let below = S::u32s::splat(simd, (1 << bit) - 1);
                x ^= inverts(simd, x, bit) & below;
                (x, y) = turned(simd, x, y, bit);
                (x, z) = turned(simd, x, z, bit);
            }
            y ^= x;
            z ^= y;
            // Each bit becomes the parity of the bits above it.
            let mut flips = z >> 1;
            flips ^= flips >> 1;
            flips ^= flips >> 2;
            flips ^= flips >> 4;
            flips ^= flips >> 8;
            let (x, y, z) = (x ^ flips, y ^ flips, z ^ flips);
            let low = (spread(simd, x) << 2) | (spread(simd, y) << 1) | spread(simd, z);
            let high = (spread(simd, x >> 8) << 2) | (spread(simd, y >> 8) << 1) | spread(simd, z >> 8);
            for ((key, &high), &low) in keys[lanes].iter_mut().zip(high.as_slice()).zip(low.as_slice()) {
                *key = (u64::from(high) << 24) | u64::from(low);
            }
        }
        keys
    }

    /// Returns, for each coordinate along an axis, the index of its cell.
    #[inline(always)]
    fn cells<S: Simd>(&self, simd: S, axis: usize, values: &[f32]) -> S::u32s {
        let from_low = S::f32s::from_slice(simd, values) - S::f32s::splat(simd, self.low[axis]);
        let cells = from_low * S::f32s::splat(simd, self.cells_per_metre);
        let largest = S::f32s::splat(simd, ((1 << BITS) - 1) as f32);
        S::u32s::truncate_from(cells.max(S::f32s::splat(simd, 0.0)).min(largest))
    }
}

/// Returns all ones in lanes where bit `bit` of the cell is set, otherwise zero.
#[inline(always)]
fn inverts<S: Simd>(simd: S, cell: S::u32s, bit: u32) -> S::u32s {
    S::u32s::splat(simd, 0) - ((cell >> bit) & S::u32s::splat(simd, 1))
}

/// Returns the cells along two axes after one step of the transposition. If `bit` is set in `other`, the lower bits
/// of `first` are inverted; otherwise `first` and `other` swap their lower bits.
#[inline(always)]
fn turned<S: Simd>(simd: S, first: S::u32s, other: S::u32s, bit: u32) -> (S::u32s, S::u32s) {
    let below = S::u32s::splat(simd, (1 << bit) - 1);
    let inverted = inverts(simd, other, bit) & below;
    let exchanged = (first ^ other) & (inverted ^ below);
    (first ^ exchanged ^ inverted, other ^ exchanged)
}

/// Spreads the low 8 bits, with two zeros between adjacent bits.
#[inline(always)]
fn spread<S: Simd>(simd: S, value: S::u32s) -> S::u32s {
    let value = value & S::u32s::splat(simd, 0xff);
    let value = (value | (value << 8)) & S::u32s::splat(simd, 0x00_f00f);
    let value = (value | (value << 4)) & S::u32s::splat(simd, 0x0c_30c3);
    (value | (value << 2)) & S::u32s::splat(simd, 0x24_9249)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_visits_every_cell_and_takes_single_steps() {
        let curve = Curve { low: [0.0; 3], cells_per_metre: 1.0 };
        let key = |cell: &[i32; 3]| curve.keys(Level::new(), &cell.map(|value| [value as f32; KEYS_AT_ONCE]))[7];
        let mut cells: Vec<[i32; 3]> = (0..16 * 16 * 16).map(|i| [i % 16, i / 16 % 16, i / 256]).collect();
        cells.sort_by_key(key);
        for pair in cells.windows(2) {
            let steps: i32 = (0..3).map(|axis| (pair[0][axis] - pair[1][axis]).abs()).sum();
            assert_eq!(steps, 1, "{pair:?}");
        }
        // The corners of the whole cube, outside of which points are moved to the border.
        let keys =
            |value: f32| curve.keys(Level::new(), &[[value; KEYS_AT_ONCE], [0.0; KEYS_AT_ONCE], [0.0; KEYS_AT_ONCE]]);
        assert_eq!(keys(0.0), [0; KEYS_AT_ONCE]);
        assert_eq!(keys(-1e30), keys(0.0));
        assert_eq!(keys(65535.0), [(1 << 48) - 1; KEYS_AT_ONCE]);
        assert_eq!(keys(1e30), keys(65535.0));
    }
}
