//! A received result, in memory written by the device or in an owned buffer.

use crate::error::FrameError;
use crate::outputs::{Outputs, SmoothedMut};
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::timings::FrameTimings;
use crate::xyz::Xyz;

/// The result of a frame that was [submitted](crate::Smoother::submit). Any thread can read it in place or copy it out.
/// A result written by a GPU returns its memory to the smoother when it is dropped.
pub struct SmoothedView {
    result: Storage,
    timings: Option<FrameTimings>,
}

enum Storage {
    Owned(Box<Smoothed>),
    InPlace(Box<dyn ResultInPlace>),
}

/// A result in an engine's memory, which is returned to the engine when this value is dropped.
pub(crate) trait ResultInPlace: Send + Sync {
    fn shape(&self) -> (usize, usize);
    fn points(&self) -> Option<[&[f32]; 3]>;
    fn normals(&self) -> Option<[&[f32]; 3]>;
    fn curvature(&self) -> Option<&[f32]>;
    fn depth_rows(&self) -> Option<Rows<'_, u16>>;
    fn depth_m(&self) -> Option<&[f32]>;
    fn frames(&self) -> Option<&[f32]>;
    fn sigma(&self) -> Option<&[f32]>;
    /// Returns the status of each pixel as its code.
    fn status_rows(&self) -> Option<Rows<'_, u8>>;
    fn neighbours_rows(&self) -> Option<Rows<'_, u8>>;
    fn copy_to(&self, out: &mut Smoothed);
}

/// The rows of an image in an engine's memory, possibly with a gap after each row.
#[derive(Debug, Clone)]
pub struct Rows<'a, T> {
    rows: std::slice::ChunksExact<'a, T>,
    width: usize,
}

impl<'a, T> Rows<'a, T> {
    /// Creates rows of `width` values that begin `stride` values apart.
    pub(crate) fn new(values: &'a [T], width: usize, stride: usize) -> Self {
        Self { rows: values.chunks_exact(stride.max(1)), width }
    }
}

impl<'a, T> Iterator for Rows<'a, T> {
    type Item = &'a [T];

    fn next(&mut self) -> Option<&'a [T]> {
        self.rows.next()?.get(..self.width)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.rows.size_hint()
    }
}

impl<T> ExactSizeIterator for Rows<'_, T> {}

impl std::fmt::Debug for SmoothedView {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let storage = match &self.result {
            Storage::Owned(_) => "owned",
            Storage::InPlace(_) => "in place",
        };
        let mut debug = f.debug_struct("SmoothedView");
        debug.field("shape", &self.shape()).field("storage", &storage).field("timings", &self.timings).finish()
    }
}

impl SmoothedView {
    /// Wraps a result that owns its buffers.
    #[doc(hidden)]
    pub fn owned(smoothed: Smoothed, timings: Option<FrameTimings>) -> Self {
        Self { result: Storage::Owned(Box::new(smoothed)), timings }
    }

    #[cfg_attr(not(feature = "gpu"), allow(dead_code))]
    pub(crate) fn in_place(result: Box<dyn ResultInPlace>, timings: Option<FrameTimings>) -> Self {
        Self { result: Storage::InPlace(result), timings }
    }

    /// Returns the width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match &self.result {
            Storage::Owned(smoothed) => (smoothed.width, smoothed.height),
            Storage::InPlace(result) => result.shape(),
        }
    }

    /// Returns x, y and z of the points in metres, row by row, NaN for holes; `None` if they were not requested.
    pub fn points(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Storage::Owned(smoothed) if smoothed.points.is_empty() => None,
            Storage::Owned(smoothed) => Some(smoothed.points.as_slices()),
            Storage::InPlace(result) => result.points(),
        }
    }

    /// Returns x, y and z of the unit normals, row by row, NaN for pixels without a normal; `None` if they were not
    /// requested.
    pub fn normals(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.normals.as_ref().map(Xyz::as_slices),
            Storage::InPlace(result) => result.normals(),
        }
    }

    /// Returns the surface variation l0/(l0+l1+l2), row by row, NaN for pixels without a plane; `None` if it was not
    /// requested.
    pub fn curvature(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.curvature.as_deref(),
            Storage::InPlace(result) => result.curvature(),
        }
    }

    /// Returns the rows of raw depth values, 0 for holes; `None` if they were not requested.
    pub fn depth_rows(&self) -> Option<Rows<'_, u16>> {
        match &self.result {
            Storage::Owned(smoothed) => Some(Rows::new(smoothed.depth.as_ref()?, smoothed.width, smoothed.width)),
            Storage::InPlace(result) => result.depth_rows(),
        }
    }

    /// Returns the depth in metres, row by row, NaN for holes; `None` if it was not requested.
    pub fn depth_m(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.depth_m.as_deref(),
            Storage::InPlace(result) => result.depth_m(),
        }
    }

    /// Returns the standard error of each position along its ray in metres, row by row, NaN for holes; `None` if it was
    /// not requested.
    pub fn sigma(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.sigma.as_deref(),
            Storage::InPlace(result) => result.sigma(),
        }
    }

    /// Returns the effective number of frames of a video averaged into each pixel, row by row, 0 for holes; `None` if
    /// it was not requested.
    pub fn frames(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.frames.as_deref(),
            Storage::InPlace(result) => result.frames(),
        }
    }

    /// Returns the status of each pixel, row by row; `None` if it was not requested.
    pub fn status(&self) -> Option<impl Iterator<Item = Status> + '_> {
        let (values, codes) = match &self.result {
            Storage::Owned(smoothed) => (smoothed.status.as_deref()?, Rows::new(&[], 0, 1)),
            Storage::InPlace(result) => (&[][..], result.status_rows()?),
        };
        Some(values.iter().copied().chain(codes.flatten().map(|&code| Status::of_code(code))))
    }

    /// Returns the number of neighbours of each pixel, row by row; `None` if it was not requested.
    pub fn neighbours(&self) -> Option<impl Iterator<Item = u32> + '_> {
        let (values, counts) = match &self.result {
            Storage::Owned(smoothed) => (smoothed.neighbours.as_deref()?, Rows::new(&[], 0, 1)),
            Storage::InPlace(result) => (&[][..], result.neighbours_rows()?),
        };
        Some(values.iter().copied().chain(counts.flatten().map(|&count| u32::from(count))))
    }

    /// Returns the time spent in each stage of this frame, if [`GpuOptions::timestamps`](crate::GpuOptions::timestamps)
    /// is set.
    pub fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Copies the result into the caller's buffers.
    ///
    /// # Errors
    /// If a buffer has the wrong length, or is for an output that the result lacks.
    pub fn copy_into(&self, mut out: SmoothedMut<'_>) -> Result<(), FrameError> {
        fn copy<T: Copy>(to: Option<&mut [T]>, from: Option<impl IntoIterator<Item = T>>) {
            if let (Some(to), Some(from)) = (to, from) {
                to.iter_mut().zip(from).for_each(|(to, from)| *to = from);
            }
        }
        let (width, height) = self.shape();
        out.check(width * height, self.outputs())?;
        for (from, to) in [(self.points(), &mut out.points), (self.normals(), &mut out.normals)] {
            if let (Some([x, y, z]), Some(to)) = (from, to) {
                x.iter().zip(y).zip(z).enumerate().for_each(|(i, ((&x, &y), &z))| to.set(i, [x, y, z]));
            }
        }
        copy(out.curvature, self.curvature().map(|values| values.iter().copied()));
        copy(out.depth, self.depth_rows().map(|rows| rows.flatten().copied()));
        copy(out.depth_m, self.depth_m().map(|values| values.iter().copied()));
        copy(out.frames, self.frames().map(|values| values.iter().copied()));
        copy(out.sigma, self.sigma().map(|values| values.iter().copied()));
        copy(out.status, self.status());
        copy(out.neighbours, self.neighbours());
        Ok(())
    }

    /// Returns the outputs that the result contains.
    fn outputs(&self) -> Outputs {
        Outputs::NONE
            .with_points(self.points().is_some())
            .with_normals(self.normals().is_some())
            .with_curvature(self.curvature().is_some())
            .with_status(self.status().is_some())
            .with_neighbours(self.neighbours().is_some())
            .with_depth(self.depth_rows().is_some())
            .with_depth_m(self.depth_m().is_some())
            .with_frames(self.frames().is_some())
            .with_sigma(self.sigma().is_some())
    }

    /// Copies the whole result into `out`. If the result is in a GPU's memory, the buffers of `out` are reused.
    pub fn copy_to(&self, out: &mut Smoothed) {
        match &self.result {
            Storage::Owned(smoothed) => out.clone_from(smoothed),
            Storage::InPlace(result) => result.copy_to(out),
        }
    }

    /// Returns the result in an owned buffer: the one submitted with the frame, or a copy.
    pub fn into_smoothed(self) -> Smoothed {
        match self.result {
            Storage::Owned(smoothed) => *smoothed,
            Storage::InPlace(result) => {
                let mut smoothed = Smoothed::default();
                result.copy_to(&mut smoothed);
                smoothed
            }
        }
    }
}
