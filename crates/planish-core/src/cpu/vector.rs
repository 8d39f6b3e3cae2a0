//! Points in space, one for each lane.
//!
//! Kernels spell out operations on each of a few vectors, because iterator adapters (`array::map`, `zip` of arrays)
//! are not compiled with the instructions of a SIMD level: nothing is inlined into them, and every vector passes
//! through memory, which costs a third of a frame's time.

use fearless_simd::{Select, Simd, SimdBase, SimdFloat};

/// Mask type of a SIMD level's f32 vector.
pub(crate) type Mask<S> = <<S as Simd>::f32s as SimdBase<S>>::Mask;

/// Copies one value to every lane.
#[inline(always)]
pub(crate) fn splat<S: Simd>(simd: S, value: f32) -> S::f32s {
    S::f32s::splat(simd, value)
}

/// Clamps values to the range 0 to 1.
#[inline(always)]
pub(super) fn share<S: Simd>(simd: S, value: S::f32s) -> S::f32s {
    value.max(splat(simd, 0.0)).min(splat(simd, 1.0))
}

/// Returns the position of each value between two limits: 0 up to `from`, 1 from `to` on, and linear in between.
#[inline(always)]
pub(super) fn rises<S: Simd>(simd: S, value: S::f32s, [from, to]: [f32; 2]) -> S::f32s {
    share(simd, (value - splat(simd, from)) * splat(simd, 1.0 / (to - from)))
}

/// A vector in space for each lane.
pub(super) struct Vec3<S: Simd> {
    pub(super) x: S::f32s,
    pub(super) y: S::f32s,
    pub(super) z: S::f32s,
}

impl<S: Simd> Clone for Vec3<S> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd> Copy for Vec3<S> {}

impl<S: Simd> Vec3<S> {
    #[inline(always)]
    pub(super) fn new(x: S::f32s, y: S::f32s, z: S::f32s) -> Self {
        Self { x, y, z }
    }

    #[inline(always)]
    pub(crate) fn splat(simd: S, value: f32) -> Self {
        let value = splat(simd, value);
        Self::new(value, value, value)
    }

    #[inline(always)]
    pub(super) fn dot(self, other: Self) -> S::f32s {
        self.x.mul_add(other.x, self.y.mul_add(other.y, self.z * other.z))
    }

    #[inline(always)]
    pub(super) fn length_squared(self) -> S::f32s {
        self.dot(self)
    }

    #[inline(always)]
    pub(super) fn cross(self, other: Self) -> Self {
        Self::new(
            self.y.mul_add(other.z, -(self.z * other.y)),
            self.z.mul_add(other.x, -(self.x * other.z)),
            self.x.mul_add(other.y, -(self.y * other.x)),
        )
    }

    #[inline(always)]
    pub(super) fn scale(self, factor: S::f32s) -> Self {
        Self::new(self.x * factor, self.y * factor, self.z * factor)
    }

    #[inline(always)]
    pub(super) fn add(self, other: Self) -> Self {
        Self::new(self.x + other.x, self.y + other.y, self.z + other.z)
    }

    #[inline(always)]
    pub(super) fn sub(self, other: Self) -> Self {
        Self::new(self.x - other.x, self.y - other.y, self.z - other.z)
    }

    /// Interleaves the lanes of two vectors, and returns the two halves of the result.
    #[inline(always)]
    pub(super) fn interleave(even: Self, odd: Self) -> [Self; 2] {
        let (x, x_after) = even.x.interleave(odd.x);
        let (y, y_after) = even.y.interleave(odd.y);
        let (z, z_after) = even.z.interleave(odd.z);
        [Self { x, y, z }, Self { x: x_after, y: y_after, z: z_after }]
    }

    /// Returns self + factor * other.
    #[inline(always)]
    pub(super) fn add_scaled(self, factor: S::f32s, other: Self) -> Self {
        Self::new(factor.mul_add(other.x, self.x), factor.mul_add(other.y, self.y), factor.mul_add(other.z, self.z))
    }

    /// Selects `self` where the mask is true, `other` elsewhere.
    #[inline(always)]
    pub(super) fn or(self, mask: Mask<S>, other: Self) -> Self {
        Self::new(mask.select(self.x, other.x), mask.select(self.y, other.y), mask.select(self.z, other.z))
    }
}
