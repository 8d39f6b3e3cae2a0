//! A result in mapped device memory, read without a copy.

use std::ops::Range;

use super::device::lock;
use super::layout::Layout;
use super::{Flight, FreeSlots, Slot};
use crate::error::EngineError;
use crate::outputs::{SmoothedMut, VectorsMut};
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::timings::FrameTimings;
use crate::view::ResultInPlace;

/// The mapped result of a submission. Returns its slot when dropped.
pub(super) struct MappedView {
    layout: Layout,
    timings: Option<FrameTimings>,
    /// `None` only while dropping.
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

    pub(super) fn timings(&self) -> Option<FrameTimings> {
        self.timings
    }

    /// Returns words of a frame as values of a plain type.
    fn values<T: bytemuck::AnyBitPattern>(&self, frame: usize, words: Range<usize>) -> &[T] {
        let first = frame * self.layout.output_words();
        let bytes = self.mapped.as_ref().map_or(&[][..], |(bytes, _)| bytes);
        bytemuck::cast_slice(bytes.get(4 * (first + words.start)..4 * (first + words.end)).unwrap_or_default())
    }

    fn points_of(&self, frame: usize) -> Option<[&[f32]; 3]> {
        Some(self.layout.points()?.map(|channel| self.values(frame, channel)))
    }

    fn normals_of(&self, frame: usize) -> Option<[&[f32]; 3]> {
        Some(self.layout.normals()?.map(|channel| self.values(frame, channel)))
    }

    /// Returns rows of packed values, each of the image's width without the padding of up to 3 bytes after it.
    fn rows<T: bytemuck::AnyBitPattern>(&self, frame: usize, words: Range<usize>) -> impl Iterator<Item = &[T]> {
        let values: &[T] = self.values(frame, words);
        let width = self.layout.width;
        values.chunks_exact(values.len() / self.layout.height).map(move |row| &row[..width])
    }

    fn codes(&self, frame: usize, words: Range<usize>) -> impl Iterator<Item = u8> {
        self.rows::<u8>(frame, words).flatten().copied()
    }

    /// Copies a frame of the result into a `Smoothed`.
    pub(super) fn copy_frame_to(&self, frame: usize, out: &mut Smoothed) {
        out.prepare(self.layout.width, self.layout.height, self.layout.outputs);
        self.copy_frame_into(frame, out.as_mut());
    }

    /// Copies a frame of the result into the given buffers, channels in parallel.
    pub(super) fn copy_frame_into(&self, frame: usize, out: SmoothedMut<'_>) {
        rayon::scope(|scope| {
            for (from, to) in [(self.points_of(frame), out.points), (self.normals_of(frame), out.normals)] {
                if let (Some(from), Some(to)) = (from, to) {
                    spawn_copying(scope, from, to);
                }
            }
            let numbers = [(self.layout.curvature(), out.curvature), (self.layout.depth_m(), out.depth_m)];
            for (words, to) in numbers {
                let (Some(words), Some(to)) = (words, to) else { continue };
                let from = self.values(frame, words);
                scope.spawn(move |_| to.copy_from_slice(from));
            }
            if let (Some(words), Some(to)) = (self.layout.depth(), out.depth) {
                for (to, from) in to.chunks_exact_mut(self.layout.width).zip(self.rows(frame, words)) {
                    to.copy_from_slice(from);
                }
            }
            if let (Some(words), Some(to)) = (self.layout.status(), out.status) {
                to.iter_mut().zip(self.codes(frame, words)).for_each(|(to, code)| *to = Status::of_code(code));
            }
            if let (Some(words), Some(to)) = (self.layout.neighbours(), out.neighbours) {
                to.iter_mut().zip(self.codes(frame, words)).for_each(|(to, count)| *to = u32::from(count));
            }
        });
    }
}

/// Vectors interleaved per task.
const VECTORS_PER_TASK: usize = 1 << 16;

/// Copies vectors, channels in parallel.
pub(super) fn spawn_copying<'s>(scope: &rayon::Scope<'s>, from: [&'s [f32]; 3], to: VectorsMut<'s>) {
    match to {
        VectorsMut::Planes(to) => {
            for (from, to) in from.into_iter().zip(to) {
                scope.spawn(move |_| to.copy_from_slice(from));
            }
        }
        VectorsMut::Rows(to) => spawn_interleaving(scope, from, to, |row, xyz| *row = xyz),
        VectorsMut::Rows4(to) => spawn_interleaving(scope, from, to, |row, xyz| row[..3].copy_from_slice(&xyz)),
    }
}

fn spawn_interleaving<'s, T: Send>(
    scope: &rayon::Scope<'s>,
    [x, y, z]: [&'s [f32]; 3],
    to: &'s mut [T],
    set: fn(&mut T, [f32; 3]),
) {
    let from = x.chunks(VECTORS_PER_TASK).zip(y.chunks(VECTORS_PER_TASK)).zip(z.chunks(VECTORS_PER_TASK));
    for (to, ((x, y), z)) in to.chunks_mut(VECTORS_PER_TASK).zip(from) {
        scope.spawn(move |_| {
            for (to, ((&x, &y), &z)) in to.iter_mut().zip(x.iter().zip(y).zip(z)) {
                set(to, [x, y, z]);
            }
        });
    }
}

impl ResultInPlace for MappedView {
    fn shape(&self) -> (usize, usize) {
        (self.layout.width, self.layout.height)
    }

    fn points(&self) -> Option<[&[f32]; 3]> {
        self.points_of(0)
    }

    fn normals(&self) -> Option<[&[f32]; 3]> {
        self.normals_of(0)
    }

    fn curvature(&self) -> Option<&[f32]> {
        Some(self.values(0, self.layout.curvature()?))
    }

    fn depth_rows(&self) -> Option<Vec<&[u16]>> {
        Some(self.rows(0, self.layout.depth()?).collect())
    }

    fn depth_m(&self) -> Option<&[f32]> {
        Some(self.values(0, self.layout.depth_m()?))
    }

    fn status(&self) -> Option<Vec<Status>> {
        Some(self.codes(0, self.layout.status()?).map(Status::of_code).collect())
    }

    fn neighbours(&self) -> Option<Vec<u32>> {
        Some(self.codes(0, self.layout.neighbours()?).map(u32::from).collect())
    }

    fn copy_to(&self, out: &mut Smoothed) {
        self.copy_frame_to(0, out);
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
