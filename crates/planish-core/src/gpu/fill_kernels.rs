//! The kernels that fill holes on the device (docs/method.md, section 18). They are independent of wgpu.

use std::fmt::Write;

use super::kernel::moments_struct;
use super::layout::{InputKind, Layout, channels, constants as layout_constants};
use super::layout::{write_constant, write_numbers, write_words};
use super::shader::shader;
use crate::fill::{MOST_PX, constants};
use crate::outputs::Outputs;
use crate::status::Status;

/// Numbers of columns and rows of pixels per workgroup. A row has as many pixels as a word has bits.
const TILE: [usize; 2] = [32, 8];
/// Number of threads per row.
const ROW_THREADS: usize = 128;
/// Maximum width of a frame in pixels: one row's holes must fit into workgroup memory.
pub(super) const WIDEST_PX: usize = 16_384;
/// Number of scratch words per pixel.
const SCRATCH_CHANNELS: usize = 9;
/// Number of words per pixel that describe holes.
const HOLE_CHANNELS: usize = 3;
/// Number of words per frame that describe all its holes.
const FRAME_WORDS: usize = 4;

/// A pass over rows or pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Pass {
    BeginRows,
    JoinRows,
    MeasureHoles,
    FitHoles,
    KeepSolid,
    CloseGaps,
    WriteFilled,
}

/// A pass for one kind of input and these outputs of the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct FillPass {
    pass: Pass,
    kind: InputKind,
    outputs: Outputs,
}

impl FillPass {
    /// Returns the passes, in order.
    pub(super) fn of(kind: InputKind, outputs: Outputs) -> impl Iterator<Item = Self> {
        use Pass::{BeginRows, CloseGaps, FitHoles, JoinRows, KeepSolid, MeasureHoles, WriteFilled};
        let passes = [BeginRows, JoinRows, MeasureHoles, FitHoles, KeepSolid, CloseGaps, WriteFilled];
        passes.into_iter().map(move |pass| match pass {
            // Passes that depend on neither share their kernels.
            Pass::JoinRows | Pass::MeasureHoles | Pass::KeepSolid => {
                Self { pass, kind: InputKind::Depth, outputs: Outputs::POINTS }
            }
            Pass::BeginRows => Self { pass, kind: InputKind::Depth, outputs },
            pass => Self { pass, kind, outputs },
        })
    }

    pub(super) fn entry_point(self) -> &'static str {
        match self.pass {
            Pass::BeginRows => "begin_rows",
            Pass::JoinRows => "join_rows",
            Pass::MeasureHoles => "measure_holes",
            Pass::FitHoles => "fit_holes",
            Pass::KeepSolid => "keep_solid",
            Pass::CloseGaps => "close_gaps",
            Pass::WriteFilled => "write_filled",
        }
    }

    /// Returns the number of workgroups for a frame of the given shape, across and down.
    pub(super) fn workgroups(self, (width, height): (usize, usize)) -> [usize; 2] {
        match self.pass {
            Pass::BeginRows => [height, 1],
            _ => [width.div_ceil(TILE[0]), height.div_ceil(TILE[1])],
        }
    }

    /// Returns the WGSL of the pass's kernel.
    pub(super) fn wgsl(self) -> String {
        let Self { pass, kind, outputs } = self;
        let mut text = layout_constants(kind, outputs, 1);
        text += &fill_constants(outputs);
        text += shader!("shaders/fill/buffers.wgsl");
        text += shader!("shaders/words.wgsl");
        if matches!(pass, Pass::JoinRows | Pass::MeasureHoles | Pass::FitHoles) {
            text += shader!("shaders/fill/labels.wgsl");
        }
        if !matches!(pass, Pass::BeginRows | Pass::WriteFilled) {
            text += shader!("shaders/fill/tile_holes.wgsl");
        }
        if matches!(pass, Pass::FitHoles | Pass::CloseGaps | Pass::WriteFilled) {
            text += shader!("shaders/input.wgsl");
            text += shader!("shaders/pixel_result.wgsl");
            text += shader!("shaders/fill/patch.wgsl");
        }
        if matches!(pass, Pass::CloseGaps | Pass::WriteFilled) {
            text += shader!("shaders/fill/close.wgsl");
        }
        match pass {
            Pass::BeginRows => text += shader!("shaders/fill/begin_rows.wgsl"),
            Pass::JoinRows => text += shader!("shaders/fill/join_rows.wgsl"),
            Pass::MeasureHoles => text += shader!("shaders/fill/measure_holes.wgsl"),
            Pass::FitHoles => {
                text += &moments_struct(2);
                text += shader!("shaders/fill/fit_holes.wgsl");
                text += &solve();
            }
            Pass::KeepSolid => text += shader!("shaders/fill/keep_solid.wgsl"),
            Pass::CloseGaps => text += shader!("shaders/fill/close_gaps.wgsl"),
            Pass::WriteFilled => {
                text += shader!("shaders/result_depth.wgsl");
                text += shader!("shaders/fill/write_filled.wgsl");
            }
        }
        text
    }
}

/// Returns the constants of the passes in WGSL.
fn fill_constants(outputs: Outputs) -> String {
    let mut text = String::new();
    let words = [
        ("TILE_WIDTH", TILE[0]),
        ("TILE_HEIGHT", TILE[1]),
        ("ROW_THREADS", ROW_THREADS),
        ("WIDEST_PX", WIDEST_PX),
        ("WIDEST_HOLE_PX", MOST_PX as usize),
        ("SCRATCH_CHANNELS", SCRATCH_CHANNELS),
        ("HOLE_CHANNELS", HOLE_CHANNELS),
        ("SIGMA_CHANNEL", channels(outputs).sigma),
        ("STATUS_FILLED", Status::Filled as usize),
        ("LEAST_NEIGHBOURS", constants::LEAST_NEIGHBOURS),
        ("LEAST_FILLED", constants::LEAST_FILLED),
    ];
    write_words(&mut text, &words);
    let signed = [
        ("RIM_PX", constants::RIM_PX),
        ("REACH", constants::REACH),
        ("SAMPLES", constants::SAMPLES),
        ("SPACING_PX", constants::SPACING_PX.unsigned_abs()),
        ("SHADOW_SAMPLES", constants::SHADOW_SAMPLES),
        ("SHADOW_SPACING_PX", constants::SHADOW_SPACING_PX.unsigned_abs()),
        ("LEAST_STRIPE_PX", constants::LEAST_STRIPE_PX),
    ];
    for (name, value) in signed {
        write_constant(&mut text, name, "i32", value);
    }
    let numbers = [
        // Larger than every 1/z and every distance.
        ("FAR_BEYOND", 1e38),
        ("STEP_DEVIATIONS", constants::STEP_DEVIATIONS as f32),
        ("STEP_SHARE", constants::STEP_SHARE as f32),
        ("RIM_DEVIATIONS", constants::RIM_DEVIATIONS as f32),
        ("RIM_SHARE", constants::RIM_SHARE as f32),
        ("SHADOW_SHARE_LEAST", constants::SHADOW_SHARES[0]),
        ("SHADOW_SHARE_MOST", constants::SHADOW_SHARES[1]),
        ("SHADOW_PX_LEAST", constants::SHADOW_PX[0]),
        ("SHADOW_PX_MOST", constants::SHADOW_PX[1]),
        ("SHADOW_MARGIN_PX", constants::SHADOW_MARGIN_PX),
        ("SHADOW_CHANGE", constants::SHADOW_CHANGE),
        ("GROWTH_AT_RIM", constants::GROWTH[0] as f32),
        ("GROWTH_PER_PX", constants::GROWTH[1] as f32),
        ("LEAST_SHARE", constants::LEAST_SHARE as f32),
    ];
    write_numbers(&mut text, &numbers);
    write_constant(&mut text, "WANTS_SIGMA", "bool", outputs.sigma);
    text
}

/// Generates `fn solve`, which solves the normal equations by an LDL^T decomposition. z is L^-1 times the first unit
/// vector; the first entry of the inverse matrix, and so the leverage, follows from it.
fn solve() -> String {
    /// Exponents of the terms 1, x, y, x², xy and y².
    const TERMS: [(usize, usize); 6] = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];
    let entry = |i: usize, j: usize| format!("s.m{}{}", TERMS[i].0 + TERMS[j].0, TERMS[i].1 + TERMS[j].1);
    let mut text = String::from("fn solve(s: Moments, origin: f32, scale_px: f32, samples: u32) -> Surface {\n");
    for (j, (a, b)) in TERMS.into_iter().enumerate() {
        let (diagonal, ridge) = (entry(j, j), constants::RIDGES[j] as f32);
        let first = if j == 0 { 1.0 } else { 0.0 };
        let _ = writeln!(text, "var pivot{j} = fma(s.m00, {ridge:?}, {diagonal});");
        let _ = writeln!(text, "var y{j} = s.t{a}{b};\nvar z{j} = {first:?};");
        for k in 0..j {
            let _ = writeln!(text, "pivot{j} = fma(-l{j}_{k}, d{j}_{k}, pivot{j});");
            let _ = writeln!(text, "y{j} = fma(-l{j}_{k}, y{k}, y{j});\nz{j} = fma(-l{j}_{k}, z{k}, z{j});");
        }
        let _ = writeln!(text, "let inverse{j} = 1.0 / pivot{j};");
        // Column j of L, and of L times its pivots.
        for i in j + 1..TERMS.len() {
            let _ = writeln!(text, "var d{i}_{j} = {};", entry(i, j));
            for k in 0..j {
                let _ = writeln!(text, "d{i}_{j} = fma(-l{i}_{k}, d{j}_{k}, d{i}_{j});");
            }
            let _ = writeln!(text, "let l{i}_{j} = d{i}_{j} * inverse{j};");
        }
    }
    for j in (0..TERMS.len()).rev() {
        let _ = writeln!(text, "var c{j} = y{j} * inverse{j};");
        for i in j + 1..TERMS.len() {
            let _ = writeln!(text, "c{j} = fma(-l{i}_{j}, c{i}, c{j});");
        }
    }
    let squares = (0..TERMS.len()).map(|j| format!("z{j} * z{j} * inverse{j}")).collect::<Vec<_>>().join(" + ");
    let _ = writeln!(text, "let leverage = s.m00 * ({squares});");
    text + "return Surface(c0, c1, c2, c3, c4, c5, origin, scale_px, leverage, samples);\n}\n"
}

/// Returns the number of scratch words per frame: channels of words, and one bit per pixel.
pub(super) fn scratch_words(layout: &Layout) -> usize {
    SCRATCH_CHANNELS * layout.pixels() + layout.height * layout.width.div_ceil(32)
}

/// Returns the number of words that describe the holes of `frames` frames, and how many of them must initially be 0.
pub(super) fn hole_words(layout: &Layout, frames: usize) -> [usize; 2] {
    [frames * (FRAME_WORDS + HOLE_CHANNELS * layout.pixels()), frames * FRAME_WORDS]
}
