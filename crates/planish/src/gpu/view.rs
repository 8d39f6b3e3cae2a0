//! A result where the device put it: mapped memory, read without a copy.

use std::ops::Range;

use super::device::lock;
use super::layout::Layout;
use super::{Flight, FreeSlots, Slot};
use crate::devices::FrameTimings;
use crate::error::EngineError;
use crate::smoothed::{Smoothed, Status};

/// Status by code; codes that no kernel writes are holes.
const STATUS: [Status; 8] = {
    let [hole, few, line, plane, quadratic, cubic] = Status::ALL;
    [hole, few, line, plane, quadratic, cubic, hole, hole]
};

/// The mapped result of a submission. Dropped, it gives its slot back.
pub(crate) struct MappedView {
    layout: Layout,
    timings: Option<FrameTimings>,
    /// `None` while it is dropped.
    mapped: Option<(wgpu::BufferView, Slot)>,
    free: FreeSlots,
}

impl MappedView {
    pub(super) fn new(flight: Flight) -> Result<Self, EngineError> {
        let Flight { gpu, slot, free, .. } = flight;
        let words = slot.readback.get_mapped_range(..).map_err(|error| gpu.failed(error))?;
        let timings = slot.timings();
        Ok(Self { layout: slot.layout, timings, mapped: Some((words, slot)), free })
    }

    pub(crate) fn shape(&self) -> (usize, usize) {
        (self.layout.width, self.layout.height)
    }

    pub(crate) fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Words of a frame as values of a type with no invalid bits.
    fn values<T: bytemuck::AnyBitPattern>(&self, frame: usize, words: Range<usize>) -> &[T] {
        let first = frame * self.layout.output_words();
        let bytes = self.mapped.as_ref().map_or(&[][..], |(bytes, _)| bytes);
        bytemuck::cast_slice(bytes.get(4 * (first + words.start)..4 * (first + words.end)).unwrap_or_default())
    }

    pub(crate) fn points(&self, frame: usize) -> Option<[&[f32]; 3]> {
        Some(self.layout.points()?.map(|plane| self.values(frame, plane)))
    }

    pub(crate) fn normals(&self, frame: usize) -> Option<[&[f32]; 3]> {
        Some(self.layout.normals()?.map(|plane| self.values(frame, plane)))
    }

    pub(crate) fn curvature(&self, frame: usize) -> Option<&[f32]> {
        Some(self.values(frame, self.layout.curvature()?))
    }

    /// The rows of packed values: each has the image's width, and up to 3 bytes of padding behind it.
    fn rows<T: bytemuck::AnyBitPattern>(&self, frame: usize, words: Range<usize>) -> impl Iterator<Item = &[T]> {
        let values: &[T] = self.values(frame, words);
        let width = self.layout.width;
        values.chunks_exact(values.len() / self.layout.height).map(move |row| &row[..width])
    }

    pub(crate) fn depth_rows(&self, frame: usize) -> Option<impl Iterator<Item = &[u16]>> {
        Some(self.rows(frame, self.layout.depth()?))
    }

    pub(crate) fn status(&self, frame: usize) -> Option<Vec<Status>> {
        let codes = self.rows::<u8>(frame, self.layout.status()?).flatten();
        Some(codes.map(|&code| STATUS[usize::from(code & 7)]).collect())
    }

    /// Copies a frame of the result out, its planes in parallel.
    pub(crate) fn copy_to(&self, frame: usize, out: &mut Smoothed) {
        out.prepare(self.layout.width, self.layout.height, self.layout.outputs);
        let mut copies: Vec<(&mut [f32], &[f32])> = Vec::with_capacity(7);
        if let Some([x, y, z]) = self.points(frame) {
            copies.extend([(&mut out.points.x[..], x), (&mut out.points.y[..], y), (&mut out.points.z[..], z)]);
        }
        if let (Some([x, y, z]), Some(to)) = (self.normals(frame), &mut out.normals) {
            copies.extend([(&mut to.x[..], x), (&mut to.y[..], y), (&mut to.z[..], z)]);
        }
        if let (Some(from), Some(to)) = (self.curvature(frame), &mut out.curvature) {
            copies.push((to, from));
        }
        rayon::scope(|scope| {
            for (to, from) in copies {
                scope.spawn(move |_| to.copy_from_slice(from));
            }
            if let (Some(rows), Some(to)) = (self.depth_rows(frame), &mut out.depth) {
                for (to, from) in to.chunks_exact_mut(self.layout.width).zip(rows) {
                    to.copy_from_slice(from);
                }
            }
            if let (Some(words), Some(to)) = (self.layout.status(), &mut out.status) {
                for (to, &code) in to.iter_mut().zip(self.rows::<u8>(frame, words).flatten()) {
                    *to = STATUS[usize::from(code & 7)];
                }
            }
            if let (Some(words), Some(to)) = (self.layout.neighbours(), &mut out.neighbours) {
                for (to, &count) in to.iter_mut().zip(self.rows::<u8>(frame, words).flatten()) {
                    *to = u32::from(count);
                }
            }
        });
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
