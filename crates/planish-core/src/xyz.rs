//! Vectors as a structure of arrays, and the size limit of a frame.

use glam::DVec3;
use rayon::prelude::*;

use crate::error::FrameError;

/// Maximum number of pixels in a frame. Indices fit u32, with room for the window's halo.
pub const MAX_PIXELS: usize = 1 << 28;

/// Refuses a width or height of zero, and more pixels than can be addressed.
pub fn validate_shape(width: usize, height: usize) -> Result<(), FrameError> {
    let pixels = width.checked_mul(height);
    if width == 0 || height == 0 || pixels.is_none_or(|n| n > MAX_PIXELS) {
        return Err(FrameError::BadShape { width, height, allowed: "1 to 2^28 pixels, both sides above 0" });
    }
    Ok(())
}

/// Vectors as three f32 arrays of equal length: positions in metres or unit normals.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Xyz {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
}

impl Xyz {
    /// Creates vectors from the arrays of x, y and z.
    ///
    /// # Errors
    ///
    /// If the arrays differ in length.
    pub fn from_arrays([x, y, z]: [Vec<f32>; 3]) -> Result<Self, FrameError> {
        for (axis, values) in [("y", &y), ("z", &z)] {
            if values.len() != x.len() {
                return Err(FrameError::LengthMismatch { what: axis.into(), len: values.len(), expected: x.len() });
            }
        }
        Ok(Self { x, y, z })
    }

    /// Returns the arrays of x, y and z.
    pub fn into_arrays(self) -> [Vec<f32>; 3] {
        [self.x, self.y, self.z]
    }

    /// Returns `len` vectors whose components are all `value`.
    pub fn filled(len: usize, value: f32) -> Self {
        Self { x: vec![value; len], y: vec![value; len], z: vec![value; len] }
    }

    /// Computes `len` vectors in parallel; vector `i` is `vector(i)`.
    pub fn par_from_fn(len: usize, vector: impl Fn(usize) -> [f32; 3] + Sync) -> Self {
        let mut xyz = Self::filled(len, 0.0);
        let components = xyz.x.par_iter_mut().zip(&mut xyz.y).zip(&mut xyz.z).enumerate();
        components.with_min_len(1 << 12).for_each(|(i, ((x, y), z))| [*x, *y, *z] = vector(i));
        xyz
    }

    /// Returns the x components.
    #[inline]
    pub fn x(&self) -> &[f32] {
        &self.x
    }

    /// Returns the y components.
    #[inline]
    pub fn y(&self) -> &[f32] {
        &self.y
    }

    /// Returns the z components.
    #[inline]
    pub fn z(&self) -> &[f32] {
        &self.z
    }

    /// Returns the components x, y and z.
    pub fn as_slices(&self) -> [&[f32]; 3] {
        [&self.x, &self.y, &self.z]
    }

    /// Returns the components x, y and z as mutable slices.
    pub fn as_mut_slices(&mut self) -> [&mut [f32]; 3] {
        [&mut self.x, &mut self.y, &mut self.z]
    }

    /// Changes the number of vectors. All components of added vectors are `value`.
    pub fn resize(&mut self, len: usize, value: f32) {
        [&mut self.x, &mut self.y, &mut self.z].into_iter().for_each(|axis| axis.resize(len, value));
    }

    /// Removes all vectors but keeps the allocated memory.
    pub fn clear(&mut self) {
        [&mut self.x, &mut self.y, &mut self.z].into_iter().for_each(Vec::clear);
    }

    /// Appends a vector.
    pub fn push(&mut self, [x, y, z]: [f32; 3]) {
        self.x.push(x);
        self.y.push(y);
        self.z.push(z);
    }

    /// Returns the number of vectors that fit without reallocation.
    pub fn capacity(&self) -> usize {
        self.x.capacity().min(self.y.capacity()).min(self.z.capacity())
    }

    /// Returns the allocated size in bytes.
    pub fn bytes(&self) -> usize {
        4 * (self.x.capacity() + self.y.capacity() + self.z.capacity())
    }

    /// Appends `len` vectors; component `axis` of the `i`-th of them is `value(axis, i)`.
    #[cfg(feature = "gpu")]
    pub(crate) fn par_extend(&mut self, len: usize, value: impl Fn(usize, usize) -> f32 + Sync) {
        let extend = |to: &mut Vec<f32>, axis: usize| to.par_extend((0..len).into_par_iter().map(|i| value(axis, i)));
        let Self { x, y, z } = self;
        rayon::join(|| extend(x, 0), || rayon::join(|| extend(y, 1), || extend(z, 2)));
    }

    /// Iterates over chunks of `len` vectors in parallel.
    pub(crate) fn par_chunks(&self, len: usize) -> impl IndexedParallelIterator<Item = [&[f32]; 3]> {
        let [x, y, z] = self.as_slices().map(|axis| axis.par_chunks(len));
        x.zip(y).zip(z).map(|((x, y), z)| [x, y, z])
    }

    /// Returns the number of vectors.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Returns true if there are no vectors.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Returns vector `i`.
    #[inline]
    pub fn get(&self, i: usize) -> [f32; 3] {
        [self.x[i], self.y[i], self.z[i]]
    }

    /// Returns vector `i` in f64. Its components are written out because test builds do not inline `map` of arrays.
    #[inline]
    pub fn vector(&self, i: usize) -> DVec3 {
        DVec3::new(self.x[i].into(), self.y[i].into(), self.z[i].into())
    }

    /// Sets vector `i`.
    #[inline]
    pub fn set(&mut self, i: usize, value: [f32; 3]) {
        [self.x[i], self.y[i], self.z[i]] = value;
    }

    /// Returns true if all components of vector `i` are finite.
    #[inline]
    pub fn is_finite(&self, i: usize) -> bool {
        self.x[i].is_finite() && self.y[i].is_finite() && self.z[i].is_finite()
    }

    /// Iterates over all vectors in order.
    pub fn iter(&self) -> XyzIter<'_> {
        XyzIter { x: self.x.iter(), y: self.y.iter(), z: self.z.iter() }
    }

    /// Refuses vectors whose number is not `expected`; `what` names them in the error.
    pub fn check_len(&self, what: &str, expected: usize) -> Result<(), FrameError> {
        match self.len() {
            len if len == expected => Ok(()),
            len => Err(FrameError::LengthMismatch { what: what.to_owned(), len, expected }),
        }
    }
}

impl From<Vec<[f32; 3]>> for Xyz {
    fn from(vectors: Vec<[f32; 3]>) -> Self {
        vectors.into_iter().collect()
    }
}

impl<'a> IntoIterator for &'a Xyz {
    type Item = [f32; 3];
    type IntoIter = XyzIter<'a>;

    fn into_iter(self) -> XyzIter<'a> {
        self.iter()
    }
}

impl FromIterator<[f32; 3]> for Xyz {
    fn from_iter<I: IntoIterator<Item = [f32; 3]>>(points: I) -> Self {
        let mut xyz = Self::default();
        points.into_iter().for_each(|point| xyz.push(point));
        xyz
    }
}

/// An iterator over the vectors of an [`Xyz`], in order.
#[derive(Debug, Clone)]
pub struct XyzIter<'a> {
    x: std::slice::Iter<'a, f32>,
    y: std::slice::Iter<'a, f32>,
    z: std::slice::Iter<'a, f32>,
}

impl Iterator for XyzIter<'_> {
    type Item = [f32; 3];

    #[inline]
    fn next(&mut self) -> Option<[f32; 3]> {
        Some([*self.x.next()?, *self.y.next()?, *self.z.next()?])
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.x.size_hint()
    }
}

impl ExactSizeIterator for XyzIter<'_> {}
