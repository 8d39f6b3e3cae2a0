//! A result that was received: in the memory that the device wrote, or a buffer of its own.

use crate::devices::FrameTimings;
use crate::smoothed::{Smoothed, Status};

/// The result of a frame that was [submitted](crate::Smoother::submit). Read it in place, or copy it out; either from any
/// thread. One that a GPU wrote gives its memory back to the smoother when it is dropped.
pub struct SmoothedView {
    result: Result,
    timings: Option<FrameTimings>,
}

enum Result {
    Owned(Box<Smoothed>),
    #[cfg(feature = "gpu")]
    Mapped(Box<crate::gpu::MappedView>),
}

impl SmoothedView {
    pub(crate) fn owned(smoothed: Smoothed, timings: Option<FrameTimings>) -> Self {
        Self { result: Result::Owned(Box::new(smoothed)), timings }
    }

    #[cfg(feature = "gpu")]
    pub(crate) fn mapped(view: crate::gpu::MappedView) -> Self {
        let timings = view.timings();
        Self { result: Result::Mapped(Box::new(view)), timings }
    }

    /// Width and height in pixels.
    pub fn shape(&self) -> (usize, usize) {
        match &self.result {
            Result::Owned(smoothed) => (smoothed.width, smoothed.height),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.shape(),
        }
    }

    /// x, y and z of the points in metres, row by row, NaN for holes; `None` if they were not asked for.
    pub fn points(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Result::Owned(smoothed) if smoothed.points.is_empty() => None,
            Result::Owned(smoothed) => Some([&smoothed.points.x, &smoothed.points.y, &smoothed.points.z]),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.points(0),
        }
    }

    /// x, y and z of the unit normals, NaN where there is none; `None` if they were not asked for.
    pub fn normals(&self) -> Option<[&[f32]; 3]> {
        match &self.result {
            Result::Owned(smoothed) => smoothed.normals.as_ref().map(|n| [&n.x[..], &n.y[..], &n.z[..]]),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.normals(0),
        }
    }

    /// Surface variation, NaN where there is no plane; `None` if it was not asked for.
    pub fn curvature(&self) -> Option<&[f32]> {
        match &self.result {
            Result::Owned(smoothed) => smoothed.curvature.as_deref(),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.curvature(0),
        }
    }

    /// The rows of raw depth values, 0 for holes; `None` if they were not asked for.
    pub fn depth_rows(&self) -> Option<Vec<&[u16]>> {
        match &self.result {
            Result::Owned(smoothed) => Some(smoothed.depth.as_ref()?.chunks_exact(smoothed.width).collect()),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => Some(view.depth_rows(0)?.collect()),
        }
    }

    /// What became of each pixel; `None` if it was not asked for.
    pub fn status(&self) -> Option<Vec<Status>> {
        match &self.result {
            Result::Owned(smoothed) => smoothed.status.clone(),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.status(0),
        }
    }

    /// Where the time of this frame went, if [`GpuOptions::timestamps`](crate::GpuOptions::timestamps) were asked for.
    pub fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Copies the whole result; on a GPU into the buffers that `out` has.
    pub fn copy_to(&self, out: &mut Smoothed) {
        match &self.result {
            Result::Owned(smoothed) => out.clone_from(smoothed),
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => view.copy_to(0, out),
        }
    }

    /// The result in a buffer of its own: the one that was submitted with the frame, or a copy.
    pub fn into_smoothed(self) -> Smoothed {
        match self.result {
            Result::Owned(smoothed) => *smoothed,
            #[cfg(feature = "gpu")]
            Result::Mapped(view) => {
                let mut smoothed = Smoothed::default();
                view.copy_to(0, &mut smoothed);
                smoothed
            }
        }
    }
}
