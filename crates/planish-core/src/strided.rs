//! Vectors in the caller's memory with gaps between them, as in structs of other libraries.

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ptr::NonNull;

/// Vectors of three f32 values whose starts are `stride` values apart. Values between vectors are left unchanged, or
/// copied from another buffer ([`with_gaps_from`](Self::with_gaps_from)).
#[derive(Debug)]
pub struct StridedMut<'a> {
    first: NonNull<f32>,
    stride: usize,
    /// The first vector of a buffer from which the values between vectors are copied.
    gaps: Option<NonNull<f32>>,
    len: usize,
    lifetime: PhantomData<&'a mut [f32]>,
    /// Makes the type uninhabited on WebAssembly, so that no code is generated for it.
    #[cfg(target_family = "wasm")]
    #[allow(dead_code)]
    never: std::convert::Infallible,
}

// SAFETY: the type is an exclusive borrow of the values of its vectors, like a mutable slice, and a shared borrow of
// `gaps`.
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
        (rest == 0 || rest >= 3).then_some(Self { first, stride, gaps: None, len, lifetime: PhantomData })
    }

    /// Borrows `len` vectors that begin at `first` and every `stride` values (at least 3) after it.
    ///
    /// # Safety
    /// The three values of each vector must be valid for reads and writes, and accessed by nothing else, for `'a`.
    /// The values between vectors may be in use.
    #[cfg(not(target_family = "wasm"))]
    pub unsafe fn from_raw(first: NonNull<f32>, stride: usize, len: usize) -> Self {
        Self { first, stride, gaps: None, len, lifetime: PhantomData }
    }

    /// Whenever a vector is set, copies the values between it and the next vector from another buffer. This preserves
    /// the other members of structs, and costs less than copying whole structs beforehand.
    ///
    /// # Safety
    /// `first` must be the first vector of a buffer with the same stride and number of vectors. In both buffers, all
    /// values from the first vector to `stride` values after the start of the last one must be valid, and accessed by
    /// nothing else for `'a`, except that the other buffer may be read.
    #[cfg(not(target_family = "wasm"))]
    pub unsafe fn with_gaps_from(self, first: NonNull<f32>) -> Self {
        Self { gaps: Some(first), ..self }
    }

    /// Returns the number of vectors.
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
        let to = self.at(i);
        if let Some(gaps) = self.gaps {
            // SAFETY: in both buffers, `stride` valid values begin at this vector.
            unsafe { copy_values(gaps.add(i * self.stride), to.cast(), self.stride) };
        }
        // SAFETY: the vector is valid for writes, and nothing else accesses it.
        unsafe { to.write(value) }
    }

    pub(crate) fn reborrow(&mut self) -> StridedMut<'_> {
        StridedMut { lifetime: PhantomData, ..*self }
    }

    /// Splits into the first `at` vectors and the rest.
    pub(crate) fn split_at(self, at: usize) -> (Self, Self) {
        assert!(at <= self.len, "{at} of {}", self.len);
        // An empty rest may keep the address of the first vector.
        let is_whole = at == self.len;
        let rest = if is_whole { self.first } else { self.at(at).cast() };
        // SAFETY: vector `at` is within the other buffer too.
        let gaps = self.gaps.map(|gaps| if is_whole { gaps } else { unsafe { gaps.add(at * self.stride) } });
        (Self { len: at, ..self }, Self { first: rest, gaps, len: self.len - at, ..self })
    }
}

/// Copies values that need not be initialized. Copies are inlined for the sizes of common structs.
///
/// # Safety
/// `count` values must be valid for reads at `from` and for writes at `to`, and the two must not overlap.
#[inline(always)]
unsafe fn copy_values(from: NonNull<f32>, to: NonNull<f32>, count: usize) {
    /// # Safety
    /// `N` values must be valid for reads at `from` and for writes at `to`, and the two must not overlap.
    #[inline(always)]
    unsafe fn copy<const N: usize>(from: NonNull<f32>, to: NonNull<f32>) {
        // SAFETY: the caller upholds this function's contract.
        unsafe { to.cast::<[MaybeUninit<f32>; N]>().write(from.cast().read()) }
    }
    // SAFETY: the caller upholds this function's contract.
    unsafe {
        match count {
            4 => copy::<4>(from, to),
            8 => copy::<8>(from, to),
            12 => copy::<12>(from, to),
            _ => std::ptr::copy_nonoverlapping(from.as_ptr().cast::<MaybeUninit<f32>>(), to.as_ptr().cast(), count),
        }
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
    fn gaps_are_copied_from_another_buffer() {
        for stride in [3, 4, 5, 8, 12, 13] {
            let other: Vec<f32> = (0..4 * stride).map(|i| i as f32).collect();
            let mut buffer = vec![-1.0; 4 * stride];
            let vectors = StridedMut::new(&mut buffer, stride).unwrap();
            // SAFETY: both buffers have four whole structs.
            let vectors = unsafe { vectors.with_gaps_from(NonNull::from(other.as_slice()).cast()) };
            let (mut first, mut rest) = vectors.split_at(2);
            first.set(1, [-2.0; 3]);
            rest.reborrow().set(1, [-3.0; 3]);
            let expected = (0..4 * stride).map(|k| match (k / stride, k % stride) {
                (1, 0..3) => -2.0,
                (3, 0..3) => -3.0,
                (1 | 3, _) => k as f32,
                _ => -1.0,
            });
            assert_eq!(buffer, expected.collect::<Vec<f32>>());
        }
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
