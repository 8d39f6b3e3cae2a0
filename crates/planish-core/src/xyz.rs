//! Vectors as a structure of arrays, and how many of them a frame may have.

use glam::DVec3;
use rayon::prelude::*;

use crate::error::FrameError;

/// Largest number of pixels of a frame; an index fits u32 with room for the window's halo.
pub const MAX_PIXELS: usize = 1 << 28;

/// Refuses a width or height of zero, and more pixels than can be addressed.
pub fn validate_shape(width: usize, height: usize) -> Result<(), FrameError> {
    let pixels = width.checked_mul(height);
    if width == 0 || height == 0 || pixels.is_none_or(|n| n > MAX_PIXELS) {
        return Err(FrameError::BadShape { width, height, allowed: "1 to 2^28 pixels, neither side zero" });
    }
    Ok(())
}

/// Vectors as three arrays of f32: positions in metres or unit normals.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Xyz {
    /// The x components.
    pub x: Vec<f32>,
    /// The y components.
    pub y: Vec<f32>,
    /// The z components.
    pub z: Vec<f32>,
}

impl Xyz {
    /// `len` vectors of the one value.
    pub fn filled(len: usize, value: f32) -> Self {
        Self { x: vec![value; len], y: vec![value; len], z: vec![value; len] }
    }

    /// x, y and z.
    pub fn as_slices(&self) -> [&[f32]; 3] {
        [&self.x, &self.y, &self.z]
    }

    /// So many points after each other at a time, in parallel.
    pub(crate) fn par_chunks(&self, len: usize) -> impl IndexedParallelIterator<Item = [&[f32]; 3]> {
        let [x, y, z] = self.as_slices().map(|axis| axis.par_chunks(len));
        x.zip(y).zip(z).map(|((x, y), z)| [x, y, z])
    }

    /// How many vectors there are.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Vector `i`.
    #[inline]
    pub fn get(&self, i: usize) -> [f32; 3] {
        [self.x[i], self.y[i], self.z[i]]
    }

    /// Vector `i` in f64. Written out, since builds for tests do not inline `map` of arrays.
    #[inline]
    pub fn vector(&self, i: usize) -> DVec3 {
        DVec3::new(self.x[i].into(), self.y[i].into(), self.z[i].into())
    }

    /// Sets vector `i`.
    #[inline]
    pub fn set(&mut self, i: usize, value: [f32; 3]) {
        [self.x[i], self.y[i], self.z[i]] = value;
    }

    /// Whether all components of vector `i` are finite.
    #[inline]
    pub fn is_finite(&self, i: usize) -> bool {
        self.x[i].is_finite() && self.y[i].is_finite() && self.z[i].is_finite()
    }

    /// All vectors in order.
    pub fn iter(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        self.x.iter().zip(&self.y).zip(&self.z).map(|((&x, &y), &z)| [x, y, z])
    }

    /// Refuses arrays of other lengths.
    pub fn check_len(&self, what: &str, expected: usize) -> Result<(), FrameError> {
        for (axis, values) in [("x", &self.x), ("y", &self.y), ("z", &self.z)] {
            if values.len() != expected {
                return Err(FrameError::LengthMismatch { what: format!("{what}.{axis}"), len: values.len(), expected });
            }
        }
        Ok(())
    }
}

impl FromIterator<[f32; 3]> for Xyz {
    fn from_iter<I: IntoIterator<Item = [f32; 3]>>(points: I) -> Self {
        let mut xyz = Self::default();
        for [x, y, z] in points {
            xyz.x.push(x);
            xyz.y.push(y);
            xyz.z.push(z);
        }
        xyz
    }
}
