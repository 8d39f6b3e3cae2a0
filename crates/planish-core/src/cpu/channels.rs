//! Values for each pixel of a frame, from which kernels load a vector of adjacent pixels at a time.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase};

use super::vector::Vec3;

/// Number of lanes of the widest f32 vector of any SIMD level.
pub(super) const MAX_LANES: usize = 16;

/// Channels of equal length, one for each value of a pixel.
pub(super) struct Channels<const N: usize> {
    values: [Vec<f32>; N],
    /// The last index at which a vector of any SIMD level can be loaded.
    last: usize,
}

impl<const N: usize> Channels<N> {
    /// Creates channels of `len` values and [`MAX_LANES`] more, so that a vector can be loaded at each of the first
    /// `len` indices.
    pub(super) fn new(len: usize, value: f32) -> Self {
        Self { values: std::array::from_fn(|_| vec![value; len + MAX_LANES]), last: len }
    }

    pub(super) fn bytes(&self) -> usize {
        self.values.iter().map(|values| size_of_val(&values[..])).sum()
    }

    /// Returns a range of each channel.
    pub(super) fn range_mut(&mut self, range: Range<usize>) -> [&mut [f32]; N] {
        self.values.each_mut().map(|values| &mut values[range.clone()])
    }

    /// Returns the vector of a channel's values that starts at an index.
    #[inline(always)]
    pub(super) fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        // SAFETY: `at` is the only index of the part.
        unsafe { self.part(at, at).load(simd, channel, at) }
    }

    /// Returns the vectors of values that start at an index in three consecutive channels, beginning with the given
    /// channel.
    ///
    /// One bounds check covers all three. Separate checks would account for a fifth of a frame's instructions.
    #[inline(always)]
    pub(super) fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        // SAFETY: `at` is the only index of the part.
        unsafe { self.part(at, at).vector(simd, channel, at) }
    }

    /// Returns one value of a channel.
    pub(super) fn value(&self, channel: usize, at: usize) -> f32 {
        self.values[channel][at]
    }

    /// Returns the part for loading vectors at indices `first` to `last`. Panics unless all of these vectors are
    /// within the channels.
    #[inline(always)]
    pub(super) fn part(&self, first: usize, last: usize) -> Part<'_, N> {
        assert!(first <= last && last <= self.last, "a vector is outside its channel");
        Part { channels: self.values.each_ref().map(Vec::as_slice), first, last }
    }
}

/// A range of indices of some channels. Unlike [`Channels`], it stays in registers during a loop.
#[derive(Clone, Copy)]
pub(super) struct Part<'a, const N: usize> {
    channels: [&'a [f32]; N],
    first: usize,
    last: usize,
}

impl<const N: usize> Part<'_, N> {
    /// Returns the vector of a channel's values that starts at an index.
    ///
    /// # Safety
    /// `at` must be in the range from the part's first to its last index, both inclusive.
    #[inline(always)]
    pub(super) unsafe fn load<S: Simd>(&self, simd: S, channel: usize, at: usize) -> S::f32s {
        const { assert!(S::f32s::LEN <= MAX_LANES) };
        debug_assert!((self.first..=self.last).contains(&at));
        // SAFETY: channels have MAX_LANES or more values from every index of a part on, and no vector has more lanes.
        S::f32s::from_slice(simd, unsafe { self.channels[channel].get_unchecked(at..at + S::f32s::LEN) })
    }

    /// Returns the vectors of values that start at an index in three consecutive channels, beginning with the given
    /// channel.
    ///
    /// # Safety
    /// `at` must be in the range from the part's first to its last index, both inclusive.
    #[inline(always)]
    pub(super) unsafe fn vector<S: Simd>(&self, simd: S, channel: usize, at: usize) -> Vec3<S> {
        // SAFETY: the caller guarantees the same condition.
        unsafe {
            Vec3::new(self.load(simd, channel, at), self.load(simd, channel + 1, at), self.load(simd, channel + 2, at))
        }
    }
}
