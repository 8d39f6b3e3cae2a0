//! The memory layout of uploads and results: the single description from which the shader's constants and the host's
//! reads and writes derive.
//!
//! Units are 32-bit words. A frame of the input consists of its [`FrameHeader`], the rays of its columns and rows,
//! and its samples: raw depth, two pixels per word; depth in metres; or x, y and z, one channel each. A frame of the
//! output consists of its requested f32 channels (points, normals, curvature and so on), then rows of packed codes:
//! status and neighbours, four pixels per word, and depth, two pixels per word. Each packed row starts at a word
//! boundary. Frames of a batch are contiguous. The intermediate data of the passes stays on the device.

use std::fmt::{Display, Write};
use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::camera::SATURATED_DEPTH;
use crate::constants;
use crate::frame::Frame;
use crate::outputs::Outputs;
use crate::range::{MAX_RADIUS_M, MAX_RANGE_M, MIN_GATE_M};
use crate::status::Status;

/// Parameters of a whole frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub(super) struct FrameHeader {
    pub(super) metres_per_unit: f32,
    pub(super) units_per_metre: f32,
    /// Linear coefficient of the radius: at range z, r = max(linear z, radius polynomial).
    pub(super) radius_linear: f32,
    pub(super) radius: [f32; 3],
    /// Linear coefficient of the block gate: at range z, the gate is max(linear z, block polynomial).
    pub(super) block_linear: f32,
    pub(super) block: [f32; 3],
    /// Coefficients of the standard deviation of depth, if edges are kept.
    pub(super) sigma: [f32; 3],
    /// Bandwidth in metres; 0 means the radius.
    pub(super) bandwidth: f32,
    pub(super) ridge: f32,
    /// Sum of the flags [`BY_DISTANCE`] and [`ON_RAY`].
    pub(super) flags: u32,
    /// Position of the sensor in the cloud's frame.
    pub(super) position: [f32; 3],
    /// Unit viewing direction of the sensor in the cloud's frame.
    pub(super) axis: [f32; 3],
}

/// Flag for ranges that are distances from the sensor.
pub(super) const BY_DISTANCE: u32 = 1;
/// Flag for points that move along their rays.
pub(super) const ON_RAY: u32 = 2;

/// Number of channels of the planes that passes keep for later passes (kept.wgsl).
const PLANE_CHANNELS: usize = 22;

/// Returns the number of channels of the points that passes keep for later passes: points and block means; if pixels
/// share cells, also the means of the points on the cells' surfaces.
const fn point_channels(cell: usize) -> usize {
    if cell == 1 { 6 } else { 9 }
}

pub(super) const HEADER_WORDS: usize = size_of::<FrameHeader>() / 4;
const _: () = assert!(size_of::<FrameHeader>() == 88);

/// Contents of the uniform buffer of a dispatch.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct Batch {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) input_words: u32,
    pub(super) output_words: u32,
}

const _: () = assert!(size_of::<Batch>() == 16);

/// The kind of a frame's samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum InputKind {
    /// Raw 16-bit values.
    Depth,
    /// Depth in metres.
    DepthMetres,
    Points,
}

impl InputKind {
    #[cfg(feature = "gpu")]
    pub(super) const ALL: [Self; 3] = [Self::Depth, Self::DepthMetres, Self::Points];

    /// Returns the kind of samples that are uploaded for a frame. Depth from a distorted lens, which has one ray per
    /// pixel, is deprojected by the host and uploaded as points.
    pub(super) fn of(frame: &Frame<'_>) -> Self {
        match frame {
            Frame::Depth(depth) if !depth.camera().distortion.is_none() => Self::Points,
            Frame::Depth(depth) if depth.is_metres() => Self::DepthMetres,
            Frame::Depth(_) => Self::Depth,
            Frame::Points(_) => Self::Points,
        }
    }
}

/// The shape and contents of one frame, from which its offsets in words are derived.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Layout {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) kind: InputKind,
    pub(super) outputs: Outputs,
    /// True if passes keep points for later passes.
    pub(super) keeps_points: bool,
    /// True if passes keep planes for later passes.
    pub(super) keeps_planes: bool,
    /// Width in pixels of the cells that the kept points and planes belong to.
    pub(super) cell: usize,
}

impl Layout {
    pub(super) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Returns the range of the rays: those of the columns, then those of the rows.
    pub(super) fn rays(&self) -> Range<usize> {
        HEADER_WORDS..HEADER_WORDS + self.width + self.height
    }

    /// Returns the number of input words per frame.
    pub(super) fn input_words(&self) -> usize {
        let samples = match self.kind {
            InputKind::Depth => self.pixels().div_ceil(2),
            InputKind::DepthMetres => self.pixels(),
            InputKind::Points => 3 * self.pixels(),
        };
        self.rays().end + samples
    }

    /// Returns the ranges of the points' x, y and z in the output.
    pub(super) fn points(&self) -> Option<[Range<usize>; 3]> {
        self.outputs.points.then(|| self.three_channels(channels(self.outputs).points))
    }

    pub(super) fn normals(&self) -> Option<[Range<usize>; 3]> {
        self.outputs.normals.then(|| self.three_channels(channels(self.outputs).normals))
    }

    pub(super) fn curvature(&self) -> Option<Range<usize>> {
        self.outputs.curvature.then(|| self.channel(channels(self.outputs).curvature))
    }

    pub(super) fn depth_m(&self) -> Option<Range<usize>> {
        self.outputs.depth_m.then(|| self.channel(channels(self.outputs).depth_m))
    }

    pub(super) fn frames(&self) -> Option<Range<usize>> {
        self.outputs.frames.then(|| self.channel(channels(self.outputs).frames))
    }

    pub(super) fn sigma(&self) -> Option<Range<usize>> {
        self.outputs.sigma.then(|| self.channel(channels(self.outputs).sigma))
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

    /// Returns the range of each output, in the order of the result.
    #[cfg(feature = "gpu")]
    pub(super) fn parts(&self) -> [Option<Range<usize>>; 9] {
        let of_vectors = |channels: Option<[Range<usize>; 3]>| channels.map(|[x, _, z]| x.start..z.end);
        let [status, neighbours, depth] = self.packed();
        [
            of_vectors(self.points()),
            of_vectors(self.normals()),
            self.curvature(),
            self.depth_m(),
            self.frames(),
            self.sigma(),
            status,
            neighbours,
            depth,
        ]
    }

    /// Returns the number of output words per frame.
    pub(super) fn output_words(&self) -> usize {
        let packed = self.packed().into_iter().flatten().map(|range| range.end).max();
        packed.unwrap_or(channels(self.outputs).count * self.pixels())
    }

    /// Returns the numbers of words per frame for the points and for the planes that passes keep for later passes.
    pub(super) fn kept_words(&self) -> [usize; 2] {
        let cells = self.width.div_ceil(self.cell) * self.height.div_ceil(self.cell);
        let [points, planes] = [(self.keeps_points, point_channels(self.cell)), (self.keeps_planes, PLANE_CHANNELS)]
            .map(|(keeps, channels)| if keeps { channels * cells } else { 0 });
        [points, planes]
    }

    /// Returns the uniform of a dispatch over frames of this layout.
    pub(super) fn batch(&self) -> Batch {
        Batch {
            width: self.width as u32,
            height: self.height as u32,
            input_words: self.input_words() as u32,
            output_words: self.output_words() as u32,
        }
    }

    fn channel(&self, channel: usize) -> Range<usize> {
        channel * self.pixels()..(channel + 1) * self.pixels()
    }

    fn three_channels(&self, first: usize) -> [Range<usize>; 3] {
        [first, first + 1, first + 2].map(|channel| self.channel(channel))
    }

    /// Returns the ranges of status, neighbours and depth in the output.
    fn packed(&self) -> [Option<Range<usize>>; 3] {
        let mut at = channels(self.outputs).count * self.pixels();
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

/// Index of the first channel of each output, undefined for outputs that were not requested, and the number of
/// channels.
pub(super) struct Channels {
    points: usize,
    pub(super) normals: usize,
    pub(super) curvature: usize,
    pub(super) depth_m: usize,
    pub(super) frames: usize,
    pub(super) sigma: usize,
    pub(super) count: usize,
}

pub(super) fn channels(outputs: Outputs) -> Channels {
    let normals = if outputs.points { 3 } else { 0 };
    let curvature = normals + if outputs.normals { 3 } else { 0 };
    let depth_m = curvature + usize::from(outputs.curvature);
    let frames = depth_m + usize::from(outputs.depth_m);
    let sigma = frames + usize::from(outputs.frames);
    Channels { points: 0, normals, curvature, depth_m, frames, sigma, count: sigma + usize::from(outputs.sigma) }
}

/// Writes a constant in WGSL.
pub(super) fn write_constant(text: &mut String, name: &str, wgsl_type: &str, value: impl Display) {
    // Writing to a string does not fail.
    let _ = writeln!(text, "const {name}: {wgsl_type} = {value};");
}

/// Writes constants of the type u32 in WGSL.
pub(super) fn write_words(text: &mut String, words: &[(&str, usize)]) {
    for (name, value) in words {
        write_constant(text, name, "u32", format_args!("{value}u"));
    }
}

/// Writes constants of the type f32 in WGSL.
pub(super) fn write_numbers(text: &mut String, numbers: &[(&str, f32)]) {
    for (name, value) in numbers {
        write_constant(text, name, "f32", format_args!("{value:?}"));
    }
}

/// Returns the WGSL constants for writing results (`output.wgsl`, `result_depth.wgsl`).
pub(super) fn result_constants(outputs: Outputs) -> String {
    let mut text = String::new();
    let Channels { points, normals, curvature, depth_m, count, .. } = channels(outputs);
    let words = [
        ("UNITS_PER_METRE", std::mem::offset_of!(FrameHeader, units_per_metre) / 4),
        ("SATURATED_DEPTH", usize::from(SATURATED_DEPTH)),
        ("POINTS_CHANNEL", points),
        ("NORMALS_CHANNEL", normals),
        ("CURVATURE_CHANNEL", curvature),
        ("DEPTH_M_CHANNEL", depth_m),
        ("CHANNELS", count),
        ("STATUS_HOLE", Status::Hole as usize),
        ("STATUS_TOO_FEW", Status::TooFew as usize),
        ("STATUS_DEGENERATE", Status::Degenerate as usize),
        ("STATUS_PLANE", Status::Plane as usize),
        ("STATUS_POLYNOMIAL_2", Status::Polynomial2 as usize),
        ("STATUS_POLYNOMIAL_3", Status::Polynomial3 as usize),
        ("STATUS_ISOLATED", Status::Isolated as usize),
    ];
    write_words(&mut text, &words);
    let flags = [
        ("WANTS_POINTS", outputs.points),
        ("WANTS_NORMALS", outputs.normals),
        ("WANTS_CURVATURE", outputs.curvature),
        ("WANTS_STATUS", outputs.status),
        ("WANTS_NEIGHBOURS", outputs.neighbours),
        ("WANTS_DEPTH", outputs.depth),
        ("WANTS_DEPTH_M", outputs.depth_m),
    ];
    for (name, value) in flags {
        write_constant(&mut text, name, "bool", value);
    }
    text
}

/// Returns the WGSL constants of a layout whose cells are `cell` pixels wide.
pub(super) fn constants(kind: InputKind, outputs: Outputs, cell: u32) -> String {
    let mut text = result_constants(outputs);
    let words = [
        ("HEADER_WORDS", HEADER_WORDS),
        ("METRES_PER_UNIT", std::mem::offset_of!(FrameHeader, metres_per_unit) / 4),
        ("RADIUS_LINEAR", std::mem::offset_of!(FrameHeader, radius_linear) / 4),
        ("RADIUS", std::mem::offset_of!(FrameHeader, radius) / 4),
        ("SIGMA", std::mem::offset_of!(FrameHeader, sigma) / 4),
        ("BANDWIDTH", std::mem::offset_of!(FrameHeader, bandwidth) / 4),
        ("RIDGE", std::mem::offset_of!(FrameHeader, ridge) / 4),
        ("FLAGS", std::mem::offset_of!(FrameHeader, flags) / 4),
        ("POSITION", std::mem::offset_of!(FrameHeader, position) / 4),
        ("AXIS", std::mem::offset_of!(FrameHeader, axis) / 4),
        ("BY_DISTANCE", BY_DISTANCE as usize),
        ("ON_RAY", ON_RAY as usize),
        ("BLOCK_LINEAR", std::mem::offset_of!(FrameHeader, block_linear) / 4),
        ("BLOCK", std::mem::offset_of!(FrameHeader, block) / 4),
        ("CELL", cell as usize),
        ("POINT_CHANNELS", point_channels(cell as usize)),
        ("PLANE_CHANNELS", PLANE_CHANNELS),
    ];
    write_words(&mut text, &words);
    let flags = [
        ("IS_RAW_DEPTH", kind == InputKind::Depth),
        ("IS_DEPTH_METRES", kind == InputKind::DepthMetres),
        ("IS_POINTS", kind == InputKind::Points),
    ];
    for (name, value) in flags {
        write_constant(&mut text, name, "bool", value);
    }
    let numbers = [
        ("MIN_POSITIVE", f32::MIN_POSITIVE),
        ("GRAZING_COSINE", constants::GRAZING_COSINE),
        ("MAX_ALONG", constants::MAX_ALONG),
        ("MAX_RADIUS_M", MAX_RADIUS_M),
        ("MAX_RANGE_M", MAX_RANGE_M),
        ("DEGENERATE_RATIO", constants::DEGENERATE_RATIO),
        ("MAX_DOUBT", constants::MAX_DOUBT),
        ("MIN_TOTAL", constants::MIN_TOTAL),
        ("COSINE_FADE", constants::COSINE_FADE),
        ("GENERAL_MEAN_REACH", constants::GENERAL_MEAN_REACH),
        ("GENERAL_DISTANCE_WEIGHT", constants::GENERAL_DISTANCE_WEIGHT),
        ("FACING_COSINE", constants::FACING_COSINE),
        ("STAY_WEIGHT", constants::STAY_WEIGHT),
        ("OWN_NORMAL_WEIGHT", constants::OWN_NORMAL_WEIGHT),
        ("MIN_NOISE", constants::MIN_NOISE),
        ("MIN_GATE_M", MIN_GATE_M),
        ("MAX_RADIUS_RATIO", constants::MAX_RADIUS_RATIO),
        ("GATE_FADE", constants::GATE_FADE),
        ("PLANE_REACH", constants::PLANE_REACH),
        ("BLOCK_WIDTH", constants::BLOCK_WIDTH),
        ("MIN_BLOCK_WEIGHT", constants::MIN_BLOCK_WEIGHT),
        ("DISTANCE_WEIGHT", constants::DISTANCE_WEIGHT),
        ("NARROW_WIDTH", constants::NARROW_WIDTH),
        ("DOUBT_WEIGHT", constants::DOUBT_WEIGHT),
        ("FITTING_LEAST", constants::FITTING[0]),
        ("FITTING_ENOUGH", constants::FITTING[1]),
        ("NEAR_ENOUGH", constants::NEAR_ENOUGH),
        ("MISSING_PLANE", constants::MISSING_PLANE),
        ("TURNING_FLAT", constants::TURNING[0]),
        ("TURNING_ROUND", constants::TURNING[1]),
        ("LOW_RIDGE", constants::LOW_RIDGE),
        ("FEWEST_RIDGE", constants::FEWEST_RIDGE),
        ("CLOSE_FROM", constants::CLOSE[0]),
        ("CLOSE_TO", constants::CLOSE[1]),
        ("MEAN_WIDTH", constants::MEAN_WIDTH),
        ("ALIKE_FROM", constants::ALIKE[0]),
        ("ALIKE_TO", constants::ALIKE[1]),
        ("AROUND_FROM", constants::AROUND[0]),
        ("AROUND_TO", constants::AROUND[1]),
        ("LEAST_SURFACE_WEIGHT", constants::LEAST_SURFACE_WEIGHT),
        ("LEAST_CERTAINTY", constants::LEAST_CERTAINTY),
        ("AGREEING", constants::AGREEING),
        ("LEAST_MEANS", constants::LEAST_MEANS),
        ("LEAST_NORMAL", constants::LEAST_NORMAL),
        ("MEAN_STAY", constants::MEAN_STAY),
        ("LEAST_RAY_M", constants::LEAST_RAY_M),
        ("LEAST_SIDE", constants::LEAST_SIDE),
        ("SIDE_COSINE", constants::SIDE_COSINE),
        ("LEAST_SPREAD", constants::LEAST_SPREAD),
        ("MOST_WINDOW_BEND", constants::MOST_WINDOW_BEND),
        ("BEND_DAMPING", constants::BEND_DAMPING),
        ("LEAST_BEND_WEIGHT", constants::LEAST_BEND_WEIGHT),
        ("LEAST_TURN", constants::LEAST_TURN),
        ("BEND_EXPLAINED_FROM", constants::BEND_EXPLAINED[0]),
        ("BEND_EXPLAINED_TO", constants::BEND_EXPLAINED[1]),
        ("BEND_SHARED_FROM", constants::BEND_SHARED[0]),
        ("BEND_SHARED_TO", constants::BEND_SHARED[1]),
        ("MOST_BEND", constants::MOST_BEND),
        ("MIN_INCIDENCE_COSINE", constants::MIN_INCIDENCE_COSINE),
        ("SQRT_LOG2_E", constants::SQRT_LOG2_E),
        ("MAX_OFF_SURFACE", constants::MAX_OFF_SURFACE),
    ];
    write_numbers(&mut text, &numbers);
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_laid_out_without_gaps_or_overlaps() {
        for bits in 1..256u32 {
            let wants = |bit: u32| bits & (1 << bit) != 0;
            let outputs = Outputs {
                points: wants(0),
                normals: wants(1),
                curvature: wants(2),
                status: wants(3),
                neighbours: wants(4),
                depth: wants(5),
                depth_m: wants(6),
                frames: wants(7),
                sigma: false,
            };
            let layout = Layout {
                width: 7,
                height: 3,
                kind: InputKind::Depth,
                outputs,
                keeps_points: false,
                keeps_planes: false,
                cell: 1,
            };
            let planes = layout.points().into_iter().flatten().chain(layout.normals().into_iter().flatten());
            let channels = [layout.curvature(), layout.depth_m(), layout.frames()];
            let packed = [layout.status(), layout.neighbours(), layout.depth()];
            let mut at = 0;
            for range in planes.chain(channels.into_iter().chain(packed).flatten()) {
                assert_eq!(range.start, at);
                at = range.end;
            }
            assert_eq!(at, layout.output_words());
        }
    }

    #[test]
    fn only_what_is_asked_for_comes_back() {
        let words = |outputs| {
            Layout {
                width: 640,
                height: 480,
                kind: InputKind::Depth,
                outputs,
                keeps_points: false,
                keeps_planes: false,
                cell: 1,
            }
            .output_words()
        };
        assert_eq!(4 * words(Outputs::POINTS), 12 * 640 * 480);
        assert_eq!(4 * words(Outputs::DEPTH), 2 * 640 * 480);
        let status = Outputs { points: false, status: true, ..Outputs::POINTS };
        assert_eq!(4 * words(status), 640 * 480);
    }
}
