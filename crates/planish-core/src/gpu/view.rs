//! A result in mapped device memory, read without a copy.

use super::device::lock;
use super::flight::{Flight, FreeSlots};
use super::layout::Layout;
use super::results::Results;
use super::slot::Slot;
use crate::error::EngineError;
use crate::outputs::SmoothedMut;
use crate::smoothed::Smoothed;
use crate::threads::Threads;
use crate::timings::FrameTimings;
use crate::view::{ResultInPlace, Rows};

/// The mapped result of a submission. Dropping it frees its slot.
pub(super) struct MappedView {
    layout: Layout,
    timings: Option<FrameTimings>,
    /// `None` only while dropping.
    mapped: Option<(wgpu::BufferView, Slot)>,
    free: FreeSlots,
}

impl MappedView {
    /// Waits for the result of a submission.
    pub(super) fn of(flight: Flight) -> Result<Self, EngineError> {
        flight.wait()?;
        let Flight { slot, free, .. } = flight;
        let words = slot.readback.get_mapped_range(..).map_err(|error| slot.gpu.failed(error))?;
        let timings = slot.timings();
        Ok(Self { layout: slot.used_for.results, timings, mapped: Some((words, slot)), free })
    }

    pub(super) fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Returns the results of one frame of the batch.
    fn results(&self, frame: usize) -> Results<'_> {
        Results::of_frame(&self.layout, self.mapped.as_ref().map_or(&[][..], |(bytes, _)| bytes), frame)
    }

    /// Copies a frame of the result into a `Smoothed`.
    pub(super) fn copy_frame_to(&self, frame: usize, out: &mut Smoothed, threads: &Threads) {
        self.results(frame).copy_to(out, threads);
    }

    /// Copies the first frame of the result into the given buffers.
    pub(super) fn copy_into(&self, out: SmoothedMut<'_>) {
        self.results(0).copy_into(out, &Threads::default());
    }
}

impl ResultInPlace for MappedView {
    fn shape(&self) -> (usize, usize) {
        (self.layout.width, self.layout.height)
    }

    fn points(&self) -> Option<[&[f32]; 3]> {
        self.results(0).points()
    }

    fn normals(&self) -> Option<[&[f32]; 3]> {
        self.results(0).normals()
    }

    fn curvature(&self) -> Option<&[f32]> {
        self.results(0).curvature()
    }

    fn depth_rows(&self) -> Option<Rows<'_, u16>> {
        self.results(0).depth_rows()
    }

    fn depth_m(&self) -> Option<&[f32]> {
        self.results(0).depth_m()
    }

    fn frames(&self) -> Option<&[f32]> {
        self.results(0).frames()
    }

    fn sigma(&self) -> Option<&[f32]> {
        self.results(0).sigma()
    }

    fn status_rows(&self) -> Option<Rows<'_, u8>> {
        self.results(0).status_rows()
    }

    fn neighbours_rows(&self) -> Option<Rows<'_, u8>> {
        self.results(0).neighbours_rows()
    }

    fn copy_to(&self, out: &mut Smoothed) {
        self.copy_frame_to(0, out, &Threads::default());
    }
}

impl Drop for MappedView {
    fn drop(&mut self) {
        if let Some((words, slot)) = self.mapped.take() {
            drop(words);
            slot.readback.unmap();
            lock(&self.free).push(slot);
        }
    }
}
