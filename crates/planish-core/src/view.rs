//! A result that was received: in the memory that the device wrote, or a buffer of its own.

use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::timings::FrameTimings;

/// The result of a frame that was [submitted](crate::Smoother::submit). Read it in place, or copy it out; either from any
/// thread. One that a GPU wrote gives its memory back to the smoother when it is dropped.
pub struct SmoothedView {
    result: Storage,
    timings: Option<FrameTimings>,
}

enum Storage {
    Owned(Box<Smoothed>),
    InPlace(Box<dyn ResultInPlace>),
}

/// A result in memory that an engine wrote, and takes back when this is dropped.
pub(crate) trait ResultInPlace: Send + Sync {
    fn shape(&self) -> (usize, usize);
    fn points(&self) -> Option<[&[f32]; 3]>;
    fn normals(&self) -> Option<[&[f32]; 3]>;
    fn curvature(&self) -> Option<&[f32]>;
    fn depth_rows(&self) -> Option<Vec<&[u16]>>;
    fn depth_m(&self) -> Option<&[f32]>;
    fn status(&self) -> Option<Vec<Status>>;
    fn neighbours(&self) -> Option<Vec<u32>>;
    fn copy_to(&self, out: &mut Smoothed);
}

impl SmoothedView {
    /// Wraps a result in buffers of its own.
    #[doc(hidden)]
    pub fn owned(smoothed: Smoothed, timings: Option<FrameTimings>) -> Self {
        Self { result: Storage::Owned(Box::new(smoothed)), timings }
    }

    #[cfg_attr(not(feature = "gpu"), allow(dead_code))]
    pub(crate) fn in_place(result: Box<dyn ResultInPlace>, timings: Option<FrameTimings>) -> Self {
        Self { result: Storage::InPlace(result), timings }
    }

    /// Width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match &self.result {
            Storage::Owned(smoothed) => (smoothed.width, smoothed.height),
            Storage::InPlace(result) => result.shape(),
        }
    }

    /// x, y and z of the points in metres, row by row, NaN for holes; `None` if they were not asked for.
    pub fn points(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Storage::Owned(smoothed) if smoothed.points.is_empty() => None,
            Storage::Owned(smoothed) => Some(smoothed.points.as_slices()),
            Storage::InPlace(result) => result.points(),
        }
    }

    /// x, y and z of the unit normals, NaN where there is none; `None` if they were not asked for.
    pub fn normals(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.normals.as_ref().map(|n| [&n.x[..], &n.y[..], &n.z[..]]),
            Storage::InPlace(result) => result.normals(),
        }
    }

    /// Surface variation, NaN where there is no plane; `None` if it was not asked for.
    pub fn curvature(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.curvature.as_deref(),
            Storage::InPlace(result) => result.curvature(),
        }
    }

    /// The rows of raw depth values, 0 for holes; `None` if they were not asked for.
    pub fn depth_rows(&self) -> Option<Vec<&[u16]>> {
        match &self.result {
            Storage::Owned(smoothed) => Some(smoothed.depth.as_ref()?.chunks_exact(smoothed.width).collect()),
            Storage::InPlace(result) => result.depth_rows(),
        }
    }

    /// Depth in metres, row by row, NaN for holes; `None` if it was not asked for.
    pub fn depth_m(&self) -> Option<&[f32]> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.depth_m.as_deref(),
            Storage::InPlace(result) => result.depth_m(),
        }
    }

    /// What became of each pixel; `None` if it was not asked for.
    pub fn status(&self) -> Option<Vec<Status>> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.status.clone(),
            Storage::InPlace(result) => result.status(),
        }
    }

    /// How many points each fit used; `None` if it was not asked for.
    pub fn neighbours(&self) -> Option<Vec<u32>> {
        match &self.result {
            Storage::Owned(smoothed) => smoothed.neighbours.clone(),
            Storage::InPlace(result) => result.neighbours(),
        }
    }

    /// Where the time of this frame went, if [`GpuOptions::timestamps`](crate::GpuOptions::timestamps) were asked for.
    pub fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Copies the whole result; on a GPU into the buffers that `out` has.
    pub fn copy_to(&self, out: &mut Smoothed) {
        match &self.result {
            Storage::Owned(smoothed) => out.clone_from(smoothed),
            Storage::InPlace(result) => result.copy_to(out),
        }
    }

    /// The result in a buffer of its own: the one that was submitted with the frame, or a copy.
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
