//! Vectors in the caller's memory with gaps between them, as in structs of other libraries.

use std::marker::PhantomData;
use std::ptr::NonNull;

/// Vectors of three values that begin every `stride` values; values between them are left unchanged.
#[derive(Debug)]
pub struct StridedMut<'a> {
    first: NonNull<f32>,
    stride: usize,
    len: usize,
    lifetime: PhantomData<&'a mut [f32]>,
    /// Makes the type uninhabited on WebAssembly, so that no code is generated for it.
    #[cfg(target_family = "wasm")]
    #[allow(dead_code)]
    never: std::convert::Infallible,
}

// SAFETY: the type is an exclusive borrow of the values of its vectors, like a mutable slice.
unsafe impl Send for StridedMut<'_> {}
// SAFETY: a shared reference allows only reading.
unsafe impl Sync for StridedMut<'_> {}

impl<'a> StridedMut<'a> {
    /// Borrows a buffer whose vectors begin at 0, `stride`, 2 `stride` and so on. The buffer may end with the last
    /// vector's values. `None` if the stride is less than 3, or the buffer ends within a vector.
    #[cfg(not(target_family = "wasm"))]
    pub fn new(values: &'a mut [f32], stride: usize) -> Option<Self> {
        let len = if stride < 3 { return None } else { values.len().div_ceil(stride) };
        let rest = values.len() % stride;
        let first = NonNull::from(values).cast();
        (rest == 0 || rest >= 3).then_some(Self { first, stride, len, lifetime: PhantomData })
    }

    /// Borrows `len` vectors that begin at `first` and every `stride` values (at least 3) after it.
    ///
    /// # Safety
    /// The three values of each vector must be valid for reads and writes, and accessed by nothing else, for `'a`.
    /// Values between them may be in use.
    #[cfg(not(target_family = "wasm"))]
    pub unsafe fn from_raw(first: NonNull<f32>, stride: usize, len: usize) -> Self {
        Self { first, stride, len, lifetime: PhantomData }
    }

    /// The number of vectors.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns true if there are no vectors.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    #[inline(always)]
    fn at(&self, i: usize) -> NonNull<[f32; 3]> {
        assert!(i < self.len, "vector {i} of {}", self.len);
        // SAFETY: vector i is within the buffer.
        unsafe { self.first.add(i * self.stride).cast() }
    }

    /// Returns vector `i`.
    ///
    /// # Panics
    /// If `i` is not less than [`len`](Self::len).
    #[inline(always)]
    pub fn get(&self, i: usize) -> [f32; 3] {
        // SAFETY: the vector is valid for reads, and nothing else writes it.
        unsafe { self.at(i).read() }
    }

    /// Sets vector `i`.
    ///
    /// # Panics
    /// If `i` is not less than [`len`](Self::len).
    #[inline(always)]
    pub fn set(&mut self, i: usize, value: [f32; 3]) {
        // SAFETY: the vector is valid for writes, and nothing else accesses it.
        unsafe { self.at(i).write(value) }
    }

    pub(crate) fn reborrow(&mut self) -> StridedMut<'_> {
        StridedMut { lifetime: PhantomData, ..*self }
    }

    /// Splits into the first `at` vectors and the rest.
    pub(crate) fn split_at(self, at: usize) -> (Self, Self) {
        assert!(at <= self.len, "{at} of {}", self.len);
        // An empty rest may keep the address of the first vector.
        let rest = if at == self.len { self.first } else { self.at(at).cast() };
        (Self { len: at, ..self }, Self { first: rest, len: self.len - at, ..self })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_left_and_parts_are_apart() {
        let mut buffer: Vec<f32> = (0..19).map(|i| i as f32).collect();
        let before = buffer.clone();
        let vectors = StridedMut::new(&mut buffer, 8).unwrap();
        assert_eq!(vectors.len(), 3);
        let (mut first, mut rest) = vectors.split_at(1);
        first.set(0, [-1.0; 3]);
        rest.set(1, [-2.0; 3]);
        assert_eq!((rest.get(0), rest.get(1)), ([8.0, 9.0, 10.0], [-2.0; 3]));
        let (_, none) = rest.split_at(2);
        assert!(none.is_empty());
        let expected = (0..19).map(|i| match i {
            0..3 => -1.0,
            16..19 => -2.0,
            i => before[i],
        });
        assert_eq!(buffer, expected.collect::<Vec<f32>>());
    }

    #[test]
    fn buffers_that_end_within_a_vector_are_refused() {
        assert!(StridedMut::new(&mut [0.0; 18], 8).is_none());
        assert!(StridedMut::new(&mut [0.0; 16], 2).is_none());
        assert_eq!(StridedMut::new(&mut [0.0; 16], 8).unwrap().len(), 2);
        assert_eq!(StridedMut::new(&mut [], 3).unwrap().len(), 0);
    }

    #[test]
    #[should_panic(expected = "vector 2 of 2")]
    fn a_vector_beyond_the_last_is_a_panic() {
        StridedMut::new(&mut [0.0; 16], 8).unwrap().set(2, [0.0; 3]);
    }
}
