//! Reads the words of a result (layout.rs) as typed values.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use super::layout::Layout;
use crate::outputs::{SmoothedMut, VectorsMut};
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::threads::Threads;
use crate::view::Rows;

/// One frame of a result, in the bytes written by the device.
#[derive(Clone, Copy)]
pub(super) struct Results<'a> {
    layout: &'a Layout,
    bytes: &'a [u8],
}

impl<'a> Results<'a> {
    /// Selects a frame of a batch. An empty `batch` yields a frame without values.
    pub(super) fn of_frame(layout: &'a Layout, batch: &'a [u8], frame: usize) -> Self {
        let bytes = 4 * layout.output_words();
        Self { layout, bytes: batch.get(frame * bytes..(frame + 1) * bytes).unwrap_or_default() }
    }

    /// Returns words as values of a plain type.
    fn values<T: bytemuck::AnyBitPattern>(self, words: Range<usize>) -> &'a [T] {
        bytemuck::cast_slice(self.bytes.get(4 * words.start..4 * words.end).unwrap_or_default())
    }

    pub(super) fn points(self) -> Option<[&'a [f32]; 3]> {
        Some(self.layout.points()?.map(|channel| self.values(channel)))
    }

    pub(super) fn normals(self) -> Option<[&'a [f32]; 3]> {
        Some(self.layout.normals()?.map(|channel| self.values(channel)))
    }

    pub(super) fn curvature(self) -> Option<&'a [f32]> {
        Some(self.values(self.layout.curvature()?))
    }

    pub(super) fn depth_m(self) -> Option<&'a [f32]> {
        Some(self.values(self.layout.depth_m()?))
    }

    pub(super) fn frames(self) -> Option<&'a [f32]> {
        Some(self.values(self.layout.frames()?))
    }

    pub(super) fn sigma(self) -> Option<&'a [f32]> {
        Some(self.values(self.layout.sigma()?))
    }

    pub(super) fn depth_rows(self) -> Option<Rows<'a, u16>> {
        Some(self.rows(self.layout.depth()?))
    }

    /// Returns the rows of status codes.
    pub(super) fn status_rows(self) -> Option<Rows<'a, u8>> {
        Some(self.rows(self.layout.status()?))
    }

    /// Returns the rows of neighbour counts.
    pub(super) fn neighbours_rows(self) -> Option<Rows<'a, u8>> {
        Some(self.rows(self.layout.neighbours()?))
    }

    /// Returns rows of packed values, each as wide as the image, without the padding of up to 3 bytes.
    fn rows<T: bytemuck::AnyBitPattern>(self, words: Range<usize>) -> Rows<'a, T> {
        let values: &[T] = self.values(words);
        Rows::new(values, self.layout.width, values.len() / self.layout.height)
    }

    /// Decodes rows of codes into `to`.
    fn copy_rows<T>(self, rows: impl Iterator<Item = &'a [u8]>, to: &mut [T], value: impl Fn(u8) -> T) {
        for (to, row) in to.chunks_exact_mut(self.layout.width).zip(rows) {
            for (to, &code) in to.iter_mut().zip(row) {
                *to = value(code);
            }
        }
    }

    /// Copies the result into a `Smoothed`.
    pub(super) fn copy_to(self, out: &mut Smoothed, threads: &Threads) {
        out.prepare(self.layout.width, self.layout.height, self.layout.outputs);
        self.copy_into(out.as_mut(), threads);
    }

    /// Copies the result into the given buffers, on the calling thread and on others.
    pub(super) fn copy_into(self, out: SmoothedMut<'_>, threads: &Threads) {
        let mut copies = Copies::default();
        for (from, to) in [(self.points(), out.points), (self.normals(), out.normals)] {
            if let (Some(from), Some(to)) = (from, to) {
                copies.add_vectors(from, to);
            }
        }
        let channels = [
            (self.curvature(), out.curvature),
            (self.depth_m(), out.depth_m),
            (self.frames(), out.frames),
            (self.sigma(), out.sigma),
        ];
        for (from, to) in channels {
            let (Some(from), Some(to)) = (from, to) else { continue };
            copies.add(move || to.copy_from_slice(from));
        }
        if let (Some(rows), Some(to)) = (self.depth_rows(), out.depth) {
            let to_rows = to.chunks_exact_mut(self.layout.width);
            copies.add(move || to_rows.zip(rows).for_each(|(to, from)| to.copy_from_slice(from)));
        }
        if let (Some(rows), Some(to)) = (self.status_rows(), out.status) {
            copies.add(move || self.copy_rows(rows, to, Status::of_code));
        }
        if let (Some(rows), Some(to)) = (self.neighbours_rows(), out.neighbours) {
            copies.add(move || self.copy_rows(rows, to, u32::from));
        }
        copies.run(threads);
    }
}

/// Number of vectors copied per task.
const VECTORS_PER_TASK: usize = 1 << 15;

/// Copies of parts of a result, in any order and on any thread.
#[derive(Default)]
pub(super) struct Copies<'a>(Vec<Box<dyn FnOnce() + Send + 'a>>);

impl<'a> Copies<'a> {
    pub(super) fn add(&mut self, copy: impl FnOnce() + Send + 'a) {
        self.0.push(Box::new(copy));
    }

    /// Adds the copies of vectors, in parts.
    pub(super) fn add_vectors(&mut self, from: [&'a [f32]; 3], mut to: VectorsMut<'a>) {
        let mut begin = 0;
        while begin < from[0].len() {
            let end = from[0].len().min(begin + VECTORS_PER_TASK);
            let (part, rest) = to.split_at(end - begin);
            let from = from.map(|channel| &channel[begin..end]);
            self.add(move || copy_vectors(from, part));
            (to, begin) = (rest, end);
        }
    }

    /// Copies on the calling thread too, so that copying starts before the other threads have woken up.
    pub(super) fn run(self, threads: &Threads) {
        let helpers = self.0.len().saturating_sub(1);
        let copies = Mutex::new(self.0);
        threads.beside_several(helpers, &|| {
            let next = || copies.lock().unwrap_or_else(PoisonError::into_inner).pop();
            std::iter::from_fn(next).for_each(|copy| copy());
        });
    }
}

fn copy_vectors([x, y, z]: [&[f32]; 3], to: VectorsMut<'_>) {
    fn interleave<T>([x, y, z]: [&[f32]; 3], to: &mut [T], set: impl Fn(&mut T, [f32; 3])) {
        for (to, ((&x, &y), &z)) in to.iter_mut().zip(x.iter().zip(y).zip(z)) {
            set(to, [x, y, z]);
        }
    }
    match to {
        VectorsMut::Planes(to) => {
            for (from, to) in [x, y, z].into_iter().zip(to) {
                to.copy_from_slice(from);
            }
        }
        VectorsMut::Rows(to) => interleave([x, y, z], to, |row, xyz| *row = xyz),
        VectorsMut::Rows4(to) => interleave([x, y, z], to, |row, xyz| row[..3].copy_from_slice(&xyz)),
        VectorsMut::Strided(mut to) => (0..to.len()).for_each(|i| to.set(i, [x[i], y[i], z[i]])),
    }
}
