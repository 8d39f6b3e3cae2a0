//! Reads the readback buffer after a run: the results of the points, channel by channel, and their radii by density.

use std::ops::Range;

use super::super::layout::Layout;
use super::super::results::Copies;
use super::parts::Record;
use crate::outputs::{SmoothedMut, VectorsMut};
use crate::status::Status;
use crate::threads::Threads;

/// The results of a cloud, or of a part with its halo.
pub(super) struct GeneralResults<'a> {
    /// Layout of the words. Words with status and neighbours, one per point, follow the other channels.
    pub(super) layout: Layout,
    pub(super) words: &'a [u32],
    /// Radii by density in metres, before they are limited; NaN for holes. Undefined unless requested.
    pub(super) radii: &'a [f32],
}

impl<'a> GeneralResults<'a> {
    fn numbers(&self, words: Range<usize>) -> &'a [f32] {
        bytemuck::cast_slice(&self.words[words])
    }

    /// Copies the results, in the order of the cloud.
    pub(super) fn copy_into(&self, out: SmoothedMut<'_>) {
        let mut copies = Copies::default();
        for (channels, to) in [(self.layout.points(), out.points), (self.layout.normals(), out.normals)] {
            if let (Some(channels), Some(to)) = (channels, to) {
                copies.add_vectors(channels.map(|channel| self.numbers(channel)), to);
            }
        }
        if let (Some(channel), Some(to)) = (self.layout.curvature(), out.curvature) {
            let from = self.numbers(channel);
            copies.add(move || to.copy_from_slice(from));
        }
        let codes = &self.words[self.layout.output_words()..];
        if let Some(to) = out.status {
            copies.add(move || to.iter_mut().zip(codes).for_each(|(to, code)| *to = status(*code)));
        }
        if let Some(to) = out.neighbours {
            copies.add(move || to.iter_mut().zip(codes).for_each(|(to, code)| *to = neighbours(*code)));
        }
        copies.run(&Threads::default());
    }

    /// Copies the results of a part's points, which come first and keep the order of the cloud, to their positions in
    /// the cloud.
    pub(super) fn scatter_into(&self, own: &[Record], out: SmoothedMut<'_>) {
        fn put<T: Send, U: Copy + Sync>(own: &[Record], to: &mut [T], from: &[U], set: impl Fn(&mut T, U) + Sync) {
            put_from(0, own, to, from, &set);
        }
        rayon::scope(|scope| {
            for (channels, to) in [(self.layout.points(), out.points), (self.layout.normals(), out.normals)] {
                let (Some(channels), Some(to)) = (channels, to) else { continue };
                let from = channels.map(|channel| self.numbers(channel));
                match to {
                    VectorsMut::Planes(to) => {
                        for (to, from) in to.into_iter().zip(from) {
                            scope.spawn(move |_| put(own, to, from, |to, value| *to = value));
                        }
                    }
                    VectorsMut::Rows(to) => scope.spawn(move |_| {
                        for (axis, from) in from.into_iter().enumerate() {
                            put(own, to, from, |row, value| row[axis] = value);
                        }
                    }),
                    VectorsMut::Rows4(to) => scope.spawn(move |_| {
                        for (axis, from) in from.into_iter().enumerate() {
                            put(own, to, from, |row, value| row[axis] = value);
                        }
                    }),
                    VectorsMut::Strided(mut to) => scope.spawn(move |_| {
                        let mut rows: Vec<[f32; 3]> = (0..to.len()).map(|i| to.get(i)).collect();
                        for (axis, from) in from.into_iter().enumerate() {
                            put(own, &mut rows, from, |row, value| row[axis] = value);
                        }
                        rows.into_iter().enumerate().for_each(|(i, row)| to.set(i, row));
                    }),
                }
            }
            if let (Some(channel), Some(to)) = (self.layout.curvature(), out.curvature) {
                let from = self.numbers(channel);
                scope.spawn(move |_| put(own, to, from, |to, value| *to = value));
            }
            let codes = &self.words[self.layout.output_words()..];
            if let Some(to) = out.status {
                scope.spawn(move |_| put(own, to, codes, |to, code| *to = status(code)));
            }
            if let Some(to) = out.neighbours {
                scope.spawn(move |_| put(own, to, codes, |to, code| *to = neighbours(code)));
            }
        });
    }
}

/// Copies the results of points to other points at the same position. `pairs` are indices (from, to).
pub(super) fn repeat(out: SmoothedMut<'_>, pairs: &[(u32, u32)]) {
    fn copy<T: Copy>(to: &mut [T], pairs: &[(u32, u32)], set: impl Fn(&mut T, T)) {
        for &(from, number) in pairs {
            let from = to[from as usize];
            set(&mut to[number as usize], from);
        }
    }
    for vectors in [out.points, out.normals].into_iter().flatten() {
        match vectors {
            VectorsMut::Planes(planes) => {
                planes.into_iter().for_each(|plane| copy(plane, pairs, |to, from| *to = from));
            }
            VectorsMut::Rows(rows) => copy(rows, pairs, |to, from| *to = from),
            VectorsMut::Rows4(rows) => copy(rows, pairs, |to, [x, y, z, _]| to[..3].copy_from_slice(&[x, y, z])),
            VectorsMut::Strided(mut vectors) => {
                pairs.iter().for_each(|&(from, to)| vectors.set(to as usize, vectors.get(from as usize)));
            }
        }
    }
    if let Some(curvature) = out.curvature {
        copy(curvature, pairs, |to, from| *to = from);
    }
    if let Some(status) = out.status {
        copy(status, pairs, |to, from| *to = from);
    }
    if let Some(neighbours) = out.neighbours {
        copy(neighbours, pairs, |to, from| *to = from);
    }
}

/// Writes the values of the points `own`, whose indices ascend, in parallel. `to` starts at the point with index
/// `first`.
fn put_from<T: Send, U: Copy + Sync>(
    first: usize,
    own: &[Record],
    to: &mut [T],
    from: &[U],
    set: &(impl Fn(&mut T, U) + Sync),
) {
    /// Number of points per task.
    const TOGETHER: usize = 1 << 14;
    if own.len() <= TOGETHER {
        own.iter().zip(from).for_each(|(record, from)| set(&mut to[record.number as usize - first], *from));
        return;
    }
    let half = own.len() / 2;
    let (own, own_after) = own.split_at(half);
    let (from, from_after) = from.split_at(half);
    // The points' indices ascend, so `to` is split where the second half begins.
    let first_after = own_after.first().map_or(first, |record| record.number as usize);
    let (to, to_after) = to.split_at_mut(first_after - first);
    rayon::join(|| put_from(first, own, to, from, set), || put_from(first_after, own_after, to_after, from_after, set));
}

fn status(code: u32) -> Status {
    Status::of_code(code as u8)
}

fn neighbours(code: u32) -> u32 {
    code >> 8
}
