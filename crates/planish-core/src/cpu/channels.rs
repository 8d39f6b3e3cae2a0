//! Numbers for each pixel of a frame, from which kernels load a vector of neighbouring pixels at a time.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase};

use super::vector::Vec3;

/// The widest vector of f32 that any SIMD level has.
pub(super) const MAX_LANES: usize = 16;

/// Channels of equal length, one per number.
pub(super) struct Channels<const N: usize> {
    values: [Vec<f32>; N],
    /// The last index from which every level can load a vector.
    last: usize,
}

impl<const N: usize> Channels<N> {
    /// Creates channels of `len` values and [`MAX_LANES`] more, so that a vector can be loaded from each of the `len`.
    pub(super) fn new(len: usize, value: f32) -> Self {
        Self { values: std::array::from_fn(|_| vec![value; len + MAX_LANES]), last: len }
    }

    pub(super) fn bytes(&self) -> usize {
        self.values.iter().map(|values| size_of_val(&values[..])).sum()
    }

    /// Returns part of each channel.
    pub(super) fn range_mut(&mut self, range: Range<usize>) -> [&mut [f32]; N] {
        self.values.each_mut().map(|values| &mut values[range.clone()])
    }

    /// Returns the values of a channel from an index on.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        self.assert_within(at, at);
        // SAFETY: checked above.
        unsafe { self.load_within(simd, channel, at) }
    }

    /// Returns the values of three channels, from the given one on, as vectors.
    ///
    /// One check for all three: the checks of slices would be a fifth of all instructions of a frame.
    #[inline(always)]
    pub(super) fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        self.assert_within(at, at);
        // SAFETY: checked above.
        unsafe { self.vector_within(simd, channel, at) }
    }

    /// Returns one value of a channel.
    pub(super) fn value(&self, channel: usize, at: usize) -> f32 {
        self.values[channel][at]
    }

    /// Panics unless vectors can be loaded from all indices from `first` to `last`.
    #[inline(always)]
    pub(super) fn assert_within(&self, first: usize, last: usize) {
        assert!(first <= last && last <= self.last, "a vector is outside its channel");
    }

    /// Returns the values of three channels, from the given one on, as vectors.
    ///
    /// # Safety
    /// The index must be within limits for which [`assert_within`](Self::assert_within) holds.
    #[inline(always)]
    pub(super) unsafe fn vector_within<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        // SAFETY: the same condition.
        unsafe {
            Vec3::new(
                self.load_within(simd, channel, at),
                self.load_within(simd, channel + 1, at),
                self.load_within(simd, channel + 2, at),
            )
        }
    }

    /// Returns the values of a channel from an index on.
    ///
    /// # Safety
    /// The index must be within limits for which [`assert_within`](Self::assert_within) holds.
    #[inline(always)]
    pub(super) unsafe fn load_within<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        const { assert!(S::f32s::LEN <= MAX_LANES) };
        // SAFETY: every channel has `last` + MAX_LANES values, which never changes, and no vector has more lanes.
        S::f32s::from_slice(simd, unsafe { self.values[channel].get_unchecked(at..at + S::f32s::LEN) })
    }
}
