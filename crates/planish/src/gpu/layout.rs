//! What goes up to the device and what comes back: the one description that the shader's constants and the host's reads and
//! writes are both made from.
//!
//! Everything is in 32-bit words. A frame of the input is its [`FrameHeader`], the rays of its columns and rows, and its
//! samples: depth, two pixels a word, or x, y and z, a plane each. A frame of the output is its planes of f32 (points,
//! normals, curvature, of those that are wanted), then rows of packed codes: status and neighbours four pixels a word, depth
//! two. A packed row begins at a whole word. Frames of a batch follow each other. Where edges are kept, the first pass leaves
//! the planes of all pixels on the device for the second.

use std::fmt::Write;
use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::camera::SATURATED_DEPTH;
use crate::smoothed::{GRAZING_COSINE, Outputs, Status};

/// What holds for a whole frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct FrameHeader {
    pub(super) metres_per_unit: f32,
    pub(super) units_per_metre: f32,
    /// r(z) = constant + max(linear |z|, quadratic z²).
    pub(super) radius_constant: f32,
    pub(super) radius_linear: f32,
    pub(super) radius_quadratic: f32,
    /// 0 is the radius.
    pub(super) bandwidth: f32,
    /// The standard deviation of depth at 1 m, where edges are kept.
    pub(super) noise: f32,
}

/// Numbers that are kept of a first plane and its point, where edges are kept (first_planes.wgsl).
const FIRST_NUMBERS: usize = 10;

const HEADER_WORDS: usize = size_of::<FrameHeader>() / 4;
const _: () = assert!(size_of::<FrameHeader>() == 28);

/// The uniform of a dispatch.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Batch {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) input_words: u32,
    pub(super) output_words: u32,
}

const _: () = assert!(size_of::<Batch>() == 16);

/// What the samples of a frame are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum InputKind {
    Depth,
    Points,
}

/// Where everything of one frame is, in words from the frame's beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Layout {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) kind: InputKind,
    pub(super) outputs: Outputs,
    pub(super) keeps_edges: bool,
}

impl Layout {
    pub(super) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Where the rays are: of the columns, then of the rows.
    pub(super) fn rays(&self) -> Range<usize> {
        HEADER_WORDS..HEADER_WORDS + self.width + self.height
    }

    /// Words of a frame of the input.
    pub(super) fn input_words(&self) -> usize {
        let samples = match self.kind {
            InputKind::Depth => self.pixels().div_ceil(2),
            InputKind::Points => 3 * self.pixels(),
        };
        self.rays().end + samples
    }

    /// Where the x, y and z of the points are in the output.
    pub(super) fn points(&self) -> Option<[Range<usize>; 3]> {
        self.outputs.points.then(|| self.three_planes(planes(self.outputs).points))
    }

    pub(super) fn normals(&self) -> Option<[Range<usize>; 3]> {
        self.outputs.normals.then(|| self.three_planes(planes(self.outputs).normals))
    }

    pub(super) fn curvature(&self) -> Option<Range<usize>> {
        self.outputs.curvature.then(|| self.plane(planes(self.outputs).curvature))
    }

    pub(super) fn status(&self) -> Option<Range<usize>> {
        self.packed()[0].clone()
    }

    pub(super) fn neighbours(&self) -> Option<Range<usize>> {
        self.packed()[1].clone()
    }

    pub(super) fn depth(&self) -> Option<Range<usize>> {
        self.packed()[2].clone()
    }

    /// Words of a frame of the output.
    pub(super) fn output_words(&self) -> usize {
        let packed = self.packed().into_iter().flatten().map(|range| range.end).max();
        packed.unwrap_or(planes(self.outputs).count * self.pixels())
    }

    /// Words of the first planes of a frame.
    pub(super) fn first_words(&self) -> usize {
        if self.keeps_edges { FIRST_NUMBERS * self.pixels() } else { 0 }
    }

    /// The uniform of a dispatch over frames of this layout.
    pub(super) fn batch(&self) -> Batch {
        Batch {
            width: self.width as u32,
            height: self.height as u32,
            input_words: self.input_words() as u32,
            output_words: self.output_words() as u32,
        }
    }

    fn plane(&self, plane: usize) -> Range<usize> {
        plane * self.pixels()..(plane + 1) * self.pixels()
    }

    fn three_planes(&self, first: usize) -> [Range<usize>; 3] {
        [first, first + 1, first + 2].map(|plane| self.plane(plane))
    }

    /// Status, neighbours, depth.
    fn packed(&self) -> [Option<Range<usize>>; 3] {
        let mut at = planes(self.outputs).count * self.pixels();
        let Outputs { status, neighbours, depth, .. } = self.outputs;
        [(status, 4), (neighbours, 4), (depth, 2)].map(|(wanted, in_word)| {
            wanted.then(|| {
                let range = at..at + self.height * self.width.div_ceil(in_word);
                at = range.end;
                range
            })
        })
    }
}

/// The numbers of the planes in the output; those of a plane that is not wanted mean nothing.
struct Planes {
    points: usize,
    normals: usize,
    curvature: usize,
    count: usize,
}

fn planes(outputs: Outputs) -> Planes {
    let normals = if outputs.points { 3 } else { 0 };
    let curvature = normals + if outputs.normals { 3 } else { 0 };
    Planes { points: 0, normals, curvature, count: curvature + usize::from(outputs.curvature) }
}

/// The constants of this description in WGSL.
pub(super) fn constants(kind: InputKind, outputs: Outputs) -> String {
    let mut text = String::new();
    let mut constant = |name: &str, wgsl_type: &str, value: String| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "const {name}: {wgsl_type} = {value};");
    };
    let Planes { points, normals, curvature, count } = planes(outputs);
    let words = [
        ("HEADER_WORDS", HEADER_WORDS),
        ("METRES_PER_UNIT", std::mem::offset_of!(FrameHeader, metres_per_unit) / 4),
        ("UNITS_PER_METRE", std::mem::offset_of!(FrameHeader, units_per_metre) / 4),
        ("RADIUS_CONSTANT", std::mem::offset_of!(FrameHeader, radius_constant) / 4),
        ("RADIUS_LINEAR", std::mem::offset_of!(FrameHeader, radius_linear) / 4),
        ("RADIUS_QUADRATIC", std::mem::offset_of!(FrameHeader, radius_quadratic) / 4),
        ("BANDWIDTH", std::mem::offset_of!(FrameHeader, bandwidth) / 4),
        ("NOISE", std::mem::offset_of!(FrameHeader, noise) / 4),
        ("FIRST_NUMBERS", FIRST_NUMBERS),
        ("SATURATED_DEPTH", usize::from(SATURATED_DEPTH)),
        ("POINTS_PLANE", points),
        ("NORMALS_PLANE", normals),
        ("CURVATURE_PLANE", curvature),
        ("PLANES", count),
        ("STATUS_HOLE", Status::Hole as usize),
        ("STATUS_TOO_FEW", Status::TooFew as usize),
        ("STATUS_DEGENERATE", Status::Degenerate as usize),
        ("STATUS_PLANE", Status::Plane as usize),
        ("STATUS_POLYNOMIAL_2", Status::Polynomial2 as usize),
        ("STATUS_POLYNOMIAL_3", Status::Polynomial3 as usize),
    ];
    for (name, value) in words {
        constant(name, "u32", format!("{value}u"));
    }
    let flags = [
        ("IS_DEPTH", kind == InputKind::Depth),
        ("WANTS_POINTS", outputs.points),
        ("WANTS_NORMALS", outputs.normals),
        ("WANTS_CURVATURE", outputs.curvature),
        ("WANTS_STATUS", outputs.status),
        ("WANTS_NEIGHBOURS", outputs.neighbours),
        ("WANTS_DEPTH", outputs.depth),
    ];
    for (name, value) in flags {
        constant(name, "bool", value.to_string());
    }
    constant("GRAZING_COSINE", "f32", format!("{GRAZING_COSINE:?}"));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_laid_out_without_gaps_or_overlaps() {
        for bits in 1..64u32 {
            let wants = |bit: u32| bits & (1 << bit) != 0;
            let outputs = Outputs {
                points: wants(0),
                normals: wants(1),
                curvature: wants(2),
                status: wants(3),
                neighbours: wants(4),
                depth: wants(5),
            };
            let layout = Layout { width: 7, height: 3, kind: InputKind::Depth, outputs, keeps_edges: false };
            let planes = layout.points().into_iter().flatten().chain(layout.normals().into_iter().flatten());
            let packed = [layout.curvature(), layout.status(), layout.neighbours(), layout.depth()];
            let mut at = 0;
            for range in planes.chain(packed.into_iter().flatten()) {
                assert_eq!(range.start, at);
                at = range.end;
            }
            assert_eq!(at, layout.output_words());
        }
    }

    #[test]
    fn only_what_is_asked_for_comes_back() {
        let words = |outputs| {
            Layout { width: 640, height: 480, kind: InputKind::Depth, outputs, keeps_edges: false }.output_words()
        };
        assert_eq!(4 * words(Outputs::POINTS), 12 * 640 * 480);
        assert_eq!(4 * words(Outputs::DEPTH), 2 * 640 * 480);
        let status = Outputs { points: false, status: true, ..Outputs::POINTS };
        assert_eq!(4 * words(status), 640 * 480);
    }
}
