//! The state of each pixel, in 12 bytes.

use fearless_simd::{Simd, SimdBase, SimdCvtFloat, SimdCvtTruncate};

use super::constants::{CARRIED, FIRST_VARIANCE, LOW, MOST_BIAS, PER_UNIT, PER_VARIANCE};
use crate::cpu::vector::splat;

/// The state of all pixels, row by row of `pitch` pixels.
#[derive(Debug, Default)]
pub(super) struct State {
    /// The mean of inverse depth (1/m) or depth (m).
    pub(super) mean: Vec<f32>,
    /// Effective number of frames in the low half, variance in the high half.
    pub(super) frames_variance: Vec<u32>,
    /// Bias in the low half; number of frames since the last update, and the bit [`CARRIED`], in the high half.
    pub(super) bias_idle: Vec<u32>,
}

/// The state of a pixel, unpacked.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pixel {
    pub(super) mean: f32,
    pub(super) frames: f32,
    pub(super) variance: f32,
    pub(super) bias: f32,
    /// Number of frames since the last update.
    pub(super) idle: u32,
}

/// The state of the pixels of a vector, unpacked.
pub(super) struct Unpacked<S: Simd> {
    pub(super) mean: S::f32s,
    pub(super) frames: S::f32s,
    pub(super) variance: S::f32s,
    pub(super) bias: S::f32s,
    /// Number of frames since the last update.
    pub(super) idle: S::f32s,
}

impl State {
    /// Makes room for `len` pixels and sets all of them to unknown.
    pub(super) fn reset(&mut self, len: usize) {
        self.mean.clear();
        self.mean.resize(len, 0.0);
        self.frames_variance.clear();
        self.frames_variance.resize(len, ((FIRST_VARIANCE * PER_VARIANCE) as u32) << 16);
        self.bias_idle.clear();
        self.bias_idle.resize(len, (MOST_BIAS * PER_UNIT) as u32);
    }

    /// Returns the effective number of frames of a pixel; 0 if the pixel has no value in the last frame.
    pub(super) fn frames(&self, i: usize) -> f32 {
        let has_value = self.bias_idle[i] >> 16 == 0 || self.is_carried(i);
        if has_value { self.remembered_frames(i) } else { 0.0 }
    }

    /// Returns the state of a pixel.
    #[inline(always)]
    pub(super) fn pixel(&self, i: usize) -> Pixel {
        Pixel {
            mean: self.mean[i],
            frames: self.remembered_frames(i),
            variance: (self.frames_variance[i] >> 16) as f32 / PER_VARIANCE,
            bias: (self.bias_idle[i] & LOW) as f32 / PER_UNIT - MOST_BIAS,
            idle: self.idle(i),
        }
    }

    /// Returns the number of frames since the last update of a pixel.
    pub(super) fn idle(&self, i: usize) -> u32 {
        (self.bias_idle[i] & !CARRIED) >> 16
    }

    /// Returns true if any pixel of a range has a carried value.
    pub(super) fn has_carried(&self, pixels: std::ops::Range<usize>) -> bool {
        self.bias_idle[pixels].iter().fold(0, |all, word| all | word) & CARRIED != 0
    }

    pub(super) fn is_carried(&self, i: usize) -> bool {
        self.bias_idle[i] & CARRIED != 0
    }

    pub(super) fn set_carried(&mut self, i: usize) {
        self.bias_idle[i] |= CARRIED;
    }

    /// Returns the effective number of frames that a pixel had when it was last seen.
    pub(super) fn remembered_frames(&self, i: usize) -> f32 {
        (self.frames_variance[i] & LOW) as f32 / PER_UNIT
    }
}

impl Pixel {
    /// A pixel without a known value.
    pub(super) const UNKNOWN: Self = Self { mean: 0.0, frames: 0.0, variance: FIRST_VARIANCE, bias: 0.0, idle: 0 };

    /// Returns the pixel in the packed form of [`State`]: mean, frames and variance, bias and idle frames.
    #[inline(always)]
    pub(super) fn packed(self) -> (f32, u32, u32) {
        let steps = |value: f32, per_unit: f32| (value * per_unit + 0.5) as u32;
        let frames_variance = steps(self.frames, PER_UNIT) | (steps(self.variance, PER_VARIANCE) << 16);
        (self.mean, frames_variance, steps(self.bias + MOST_BIAS, PER_UNIT) | (self.idle << 16))
    }
}

impl<S: Simd> Unpacked<S> {
    #[inline(always)]
    pub(super) fn load(simd: S, mean: &[f32], frames_variance: &[u32], bias_idle: &[u32]) -> Self {
        let low = S::u32s::splat(simd, LOW);
        let frames_variance = S::u32s::from_slice(simd, frames_variance);
        let bias_idle = S::u32s::from_slice(simd, bias_idle);
        let number = |value: S::u32s, per_unit: f32| S::f32s::float_from(value) * splat(simd, 1.0 / per_unit);
        Self {
            mean: S::f32s::from_slice(simd, mean),
            frames: number(frames_variance & low, PER_UNIT),
            variance: number(frames_variance >> 16, PER_VARIANCE),
            bias: number(bias_idle & low, PER_UNIT) - splat(simd, MOST_BIAS),
            idle: number((bias_idle & S::u32s::splat(simd, !CARRIED)) >> 16, 1.0),
        }
    }

    /// Stores the pixels in the packed form of [`State`]; `carried` is [`CARRIED`] or 0 for each pixel.
    #[inline(always)]
    pub(super) fn store(
        &self,
        simd: S,
        carried: S::u32s,
        mean: &mut [f32],
        frames_variance: &mut [u32],
        bias_idle: &mut [u32],
    ) {
        let half = splat(simd, 0.5);
        let steps = |value: S::f32s, per_unit: f32| S::u32s::truncate_from(value * splat(simd, per_unit) + half);
        self.mean.store_slice(mean);
        let variance = steps(self.variance, PER_VARIANCE);
        (steps(self.frames, PER_UNIT) | (variance << 16)).store_slice(frames_variance);
        let bias = steps(self.bias + splat(simd, MOST_BIAS), PER_UNIT);
        (bias | (steps(self.idle, 1.0) << 16) | carried).store_slice(bias_idle);
    }

    /// Returns the bit [`CARRIED`] in every lane.
    #[inline(always)]
    pub(super) fn carried_bit(simd: S) -> S::u32s {
        S::u32s::splat(simd, CARRIED)
    }
}
