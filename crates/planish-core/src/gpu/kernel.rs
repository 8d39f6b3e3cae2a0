//! Generates a kernel's WGSL: the shader files with their constants, and the sums and the solver, unrolled for a
//! degree.
//!
//! Compilers would keep an indexed array of moments in memory instead of registers. Each moment is therefore a
//! variable, and the statements over them are generated here (docs/method.md, sections 5 and 6), as `unroll!` does for
//! the CPU engine.

use std::fmt::Write;

use super::layout::{InputKind, constants};
use super::shader::shader;
use crate::constants::{MONOMIALS, RIDGE_WEIGHTS, coefficient_count};
use crate::outputs::Outputs;
use crate::params::{Edges, EngineParams};

/// The kernels of a frame (docs/method.md, sections 2 and 10).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Pass {
    /// Computes the points of cells, and the means of blocks.
    Blocks,
    /// Fits the first planes, if edges are kept.
    FirstPlanes,
    /// Finds the surfaces from the first planes, and the means of the points on these surfaces.
    Surfaces,
    /// Computes the results, each on its own surface.
    Smooth,
    /// Derives the results of pixels from the results of the cells around them, if pixels share cells.
    Pixels,
}

impl Pass {
    /// Returns the passes of a frame, in order.
    pub(super) fn of(params: &EngineParams) -> &'static [Self] {
        match (params.edges, params.cell_px()) {
            (Edges::Off, _) if params.averages_blocks() => &[Self::Blocks, Self::Smooth],
            (Edges::Off, _) => &[Self::Smooth],
            (Edges::Robust, 1) => &[Self::FirstPlanes, Self::Surfaces, Self::Smooth],
            (Edges::Robust, _) => &[Self::Blocks, Self::FirstPlanes, Self::Surfaces, Self::Smooth, Self::Pixels],
        }
    }

    /// Returns the entry point of the pass's kernel.
    pub(super) fn entry_point(self) -> &'static str {
        match self {
            Self::Blocks => "average_blocks",
            Self::FirstPlanes => "fit_first_planes",
            Self::Surfaces => "find_surfaces",
            Self::Smooth => "smooth_frames",
            Self::Pixels => "results_of_pixels",
        }
    }
}

/// The parameters that are compiled into a kernel; all others may vary from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct KernelKey {
    pub(super) window: u32,
    pub(super) stride: u32,
    pub(super) degree: u32,
    /// Width in pixels of the cells that share a surface.
    cell: u32,
    /// Distance to the surrounding planes that are considered, in cells.
    edge_shift: u32,
    pub(super) pass: Pass,
    /// True if the kernel moves points to surfaces found by earlier passes.
    keeps_edges: bool,
    averages_blocks: bool,
    /// True if the kernel keeps results for [`Pass::Pixels`].
    keeps_results: bool,
    /// True if the kernel's windows read samples kept by an earlier pass: block means or points of cells.
    reads_means: bool,
    /// True if the kernel reads the input, not only data kept by earlier passes.
    reads_input: bool,
    pub(super) kind: InputKind,
    pub(super) outputs: Outputs,
    /// True if every memory access is bounds-checked.
    pub(super) bounds_checks: bool,
    /// True if the candidates of a tile fit in workgroup memory.
    pub(super) tiled: bool,
}

/// Returns the numbers of columns and rows of pixels per workgroup; each thread computes one pixel. With 32 columns,
/// each store fills a line of 128 bytes; narrower stores over the bus lower the throughput by a tenth. Degree 3,
/// whose moments fill the registers, gets half as many threads.
const fn tile_of(degree: u32) -> [usize; 2] {
    if degree == 3 { [32, 4] } else { [32, 8] }
}

impl KernelKey {
    /// Returns the key of a pass's kernel for the given parameters and amount of workgroup memory.
    pub(super) fn new(
        params: &EngineParams,
        pass: Pass,
        kind: InputKind,
        outputs: Outputs,
        bounds_checks: bool,
        workgroup_bytes: usize,
    ) -> Self {
        let EngineParams { degree, .. } = *params;
        let keeps_edges = pass == Pass::Smooth && params.edges != Edges::Off;
        let cell = params.cell_px() as u32;
        let averages_blocks = params.averages_blocks();
        // The windows of these passes are the blocks.
        let of_blocks = matches!(pass, Pass::Blocks | Pass::Surfaces);
        let (window, stride) = match pass {
            Pass::Blocks | Pass::Surfaces if averages_blocks => (params.block_half_px() as u32, 1),
            Pass::Blocks | Pass::Surfaces | Pass::Pixels => (0, 1),
            Pass::FirstPlanes | Pass::Smooth => (params.window, params.stride),
        };
        let reads_means = matches!(pass, Pass::FirstPlanes | Pass::Smooth) && (averages_blocks || cell > 1);
        let keeps_results = pass == Pass::Smooth && cell > 1;
        let of_pixels = pass == Pass::Pixels || (cell > 1 && of_blocks);
        let reads_input = pass == Pass::of(params)[0] || of_pixels;
        // Fields that the kernel does not depend on are normalized, so that settings that differ only in these fields
        // share the kernel.
        let kind = match kind {
            InputKind::DepthMetres if !reads_input => InputKind::Depth,
            kind => kind,
        };
        let outputs = match pass {
            Pass::Smooth if keeps_results => Outputs { normals: true, ..Outputs::POINTS },
            Pass::Smooth | Pass::Pixels => outputs,
            _ => Outputs::POINTS,
        };
        let degree = if pass == Pass::Smooth { degree } else { 1 };
        let edge_shift = if pass == Pass::Surfaces { params.edge_shift() as u32 } else { 0 };
        let [tile_width, tile_height] = tile_of(degree);
        let block = 2 * window as usize;
        let tile_area = match (cell, of_blocks) {
            (1, _) => (tile_width + block * stride as usize) * (tile_height + block),
            (_, true) => (tile_width * cell as usize + block) * (tile_height * cell as usize + block),
            (_, false) => (tile_width + 2 * params.reach()) * (tile_height + 2 * params.reach()),
        };
        // Size of the workgroup memory in which results are packed.
        let codes_bytes = if of_blocks || pass == Pass::FirstPlanes { 0 } else { 4 * tile_width * tile_height };
        // [`Pass::Pixels`] reads no samples.
        let tiled = pass != Pass::Pixels && 12 * tile_area + codes_bytes <= workgroup_bytes;
        Self {
            window,
            stride,
            degree,
            cell,
            edge_shift,
            pass,
            keeps_edges,
            averages_blocks,
            keeps_results,
            reads_means,
            reads_input,
            kind,
            outputs,
            bounds_checks,
            tiled,
        }
    }

    /// Returns the distance between the rows of a workgroup: a stride, so that its windows share rows of samples, or
    /// one row of cells.
    fn row_step(&self) -> u32 {
        if self.cell > 1 { 1 } else { self.stride }
    }

    /// Returns the number of workgroups for a frame of the given shape, across and down. Each workgroup handles the
    /// rows of a tile.
    pub(super) fn workgroups(&self, (width, height): (usize, usize)) -> [usize; 2] {
        let [tile_width, tile_height] = tile_of(self.degree);
        let cell = if self.pass == Pass::Pixels { 1 } else { self.cell as usize };
        let step = self.row_step() as usize;
        let (width, height) = (width.div_ceil(cell), height.div_ceil(cell));
        [width.div_ceil(tile_width), height.div_ceil(tile_height * step) * step]
    }

    /// Returns the WGSL of this kernel.
    pub(super) fn wgsl(&self) -> String {
        let mut text = constants(self.kind, self.outputs, self.cell);
        let Self { window, stride, degree, .. } = self;
        let [tile_width, tile_height] = tile_of(*degree);
        let _ = writeln!(text, "const TILE_WIDTH: u32 = {tile_width}u;");
        let _ = writeln!(text, "const TILE_HEIGHT: u32 = {tile_height}u;");
        let _ = writeln!(text, "const WINDOW: u32 = {window}u;");
        // A block is as wide as its cell plus the window on both sides.
        let of_blocks = matches!(self.pass, Pass::Blocks | Pass::Surfaces);
        let side = 2 * window + if of_blocks { self.cell } else { 1 };
        let _ = writeln!(text, "const SIDE: u32 = {side}u;");
        let _ = writeln!(text, "const STRIDE: u32 = {stride}u;");
        let _ = writeln!(text, "const ROW_STEP: u32 = {}u;", self.row_step());
        let _ = writeln!(text, "const DEGREE: u32 = {degree}u;");
        let _ = writeln!(text, "const EDGE_SHIFT: u32 = {}u;", self.edge_shift);
        let _ = writeln!(text, "const KEEPS_EDGES: bool = {};", self.keeps_edges);
        let _ = writeln!(text, "const KEEPS_RESULTS: bool = {};", self.keeps_results);
        let _ = writeln!(text, "const BENDS: bool = {};", self.keeps_edges);
        let _ = writeln!(text, "const READS_MEANS: bool = {};", self.reads_means);
        let _ = writeln!(text, "const AVERAGES_BLOCKS: bool = {};", self.averages_blocks);
        let samples = if self.keeps_results { "KEPT_SURFACE_MEAN" } else { "KEPT_MEAN" };
        let _ = writeln!(text, "const SAMPLES: u32 = {samples};");
        if self.pass == Pass::FirstPlanes {
            let _ = writeln!(text, "const MIDDLE_SHARE: f32 = {:?};", self.middle_share());
        }
        text += shader!("shaders/buffers.wgsl");
        text += shader!("shaders/words.wgsl");
        text += shader!("shaders/kept.wgsl");
        text += if self.reads_input { shader!("shaders/input.wgsl") } else { shader!("shaders/input_kept.wgsl") };
        text += if self.reads_means {
            shader!("shaders/samples_means.wgsl")
        } else {
            shader!("shaders/samples_measured.wgsl")
        };
        text += match (self.cell, of_blocks, self.tiled) {
            (1, _, true) => shader!("shaders/window_tiled.wgsl"),
            (1, _, false) => shader!("shaders/window_untiled.wgsl"),
            (_, true, true) => shader!("shaders/blocks_tiled.wgsl"),
            (_, true, false) => shader!("shaders/blocks_untiled.wgsl"),
            (_, false, true) => shader!("shaders/cells_tiled.wgsl"),
            (_, false, false) => shader!("shaders/cells_untiled.wgsl"),
        };
        text += shader!("shaders/cell_offsets.wgsl");
        text += shader!("shaders/gate.wgsl");
        text += shader!("shaders/window.wgsl");
        text += shader!("shaders/eigen.wgsl");
        text += shader!("shaders/sensor.wgsl");
        if of_blocks {
            text += shader!("shaders/blocks.wgsl");
            if self.pass == Pass::Blocks {
                text += shader!("shaders/average_blocks.wgsl");
            } else {
                text += shader!("shaders/bend.wgsl");
                text += shader!("shaders/find_surfaces.wgsl");
            }
            return text;
        }
        text += shader!("shaders/plane.wgsl");
        if self.pass == Pass::FirstPlanes {
            text += shader!("shaders/window_bend.wgsl");
            text += shader!("shaders/fit_first_planes.wgsl");
            return text;
        }
        if self.pass == Pass::Pixels {
            text += shader!("shaders/blocks.wgsl");
            text += shader!("shaders/project_plane.wgsl");
            text += shader!("shaders/pixel_result.wgsl");
            text += shader!("shaders/result_depth.wgsl");
            text += shader!("shaders/output.wgsl");
            text += shader!("shaders/cell_results.wgsl");
            text += shader!("shaders/results_of_pixels.wgsl");
            return text;
        }
        text += if self.keeps_edges { shader!("shaders/own_surface.wgsl") } else { shader!("shaders/own_plane.wgsl") };
        text += &surface(self.degree as usize, WINDOW_LOOP);
        text += shader!("shaders/pixel_result.wgsl");
        text += shader!("shaders/result_depth.wgsl");
        text += shader!("shaders/result.wgsl");
        text += if self.keeps_results { shader!("shaders/keep_result.wgsl") } else { shader!("shaders/output.wgsl") };
        text += shader!("shaders/smooth.wgsl");
        text
    }
}

impl KernelKey {
    /// Returns the mean squared distance from the centre of a window to the columns in its inner half, divided by
    /// that to all its columns.
    fn middle_share(&self) -> f32 {
        let mean_square = |half: u32| {
            let squares = (1..=half).map(|i| 2 * (i * self.stride).div_ceil(self.cell).pow(2)).sum::<u32>();
            squares as f32 / (2 * half + 1) as f32
        };
        mean_square(self.window / 2) / mean_square(self.window)
    }
}

/// The WGSL loop over the candidates of a window: the text before its body, and the text after it.
const WINDOW_LOOP: [&str; 2] = [
    "for (var row = 0u; row < SIDE; row++) { for (var column = 0u; column < SIDE; column++) {
        let e = candidate(window, column, row) - p;
        let count = 1.0;",
    "} }",
];

/// Generates the function that returns the point on the surface, for a degree and a loop over the candidates.
pub(super) fn surface(degree: usize, [before, after]: [&str; 2]) -> String {
    let mut text = shader!("shaders/project_plane.wgsl").to_owned();
    if degree == 1 {
        return text + shader!("shaders/surface_plane.wgsl");
    }
    text += &moments_struct(degree);
    text += &shader!("shaders/polynomial.wgsl")
        .replace("FOR_EACH_CANDIDATE", before)
        .replace("END_OF_CANDIDATES", after)
        .replace("SUM_MOMENTS", &moment_sums(degree));
    text += &solve(degree);
    text + shader!("shaders/project_polynomial.wgsl")
}

/// Returns the pairs of exponents with i + j <= degree.
fn exponents(degree: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..=degree).flat_map(move |i| (0..=degree - i).map(move |j| (i, j)))
}

/// Generates `struct Moments`, with a field for each m_ij and t_ij.
pub(super) fn moments_struct(degree: usize) -> String {
    let m = exponents(2 * degree).map(|(i, j)| format!("    m{i}{j}: f32,\n"));
    let t = exponents(degree).map(|(i, j)| format!("    t{i}{j}: f32,\n"));
    format!("struct Moments {{\n{}}}\n", m.chain(t).collect::<String>())
}

/// Generates the statements that add one candidate, given by w, a, b and f, to the moments s.
fn moment_sums(degree: usize) -> String {
    let mut text = String::from("let wa0 = w;\nlet wa1 = w * a;\nlet a2 = a * a;\nlet b1 = b;\nlet b2 = b * b;\n");
    for i in 2..2 * degree {
        let _ = writeln!(text, "let wa{i} = wa{} * a2;", i - 2);
    }
    for j in 3..=2 * degree {
        let _ = writeln!(text, "let b{j} = b{} * b{};", j / 2, j - j / 2);
    }
    for (i, j) in exponents(2 * degree) {
        let _ = match j {
            0 if i == 2 * degree => writeln!(text, "s.m{i}0 = fma(wa{}, a2, s.m{i}0);", i - 2),
            0 => writeln!(text, "s.m{i}0 += wa{i};"),
            _ => writeln!(text, "s.m{i}{j} = fma(wa{i}, b{j}, s.m{i}{j});"),
        };
    }
    for (i, j) in exponents(degree) {
        let _ = match j {
            0 if i == degree => writeln!(text, "s.t{i}0 = fma(wa{i}, f, s.t{i}0);"),
            0 => writeln!(text, "let wf{i} = wa{i} * f;\ns.t{i}0 += wf{i};"),
            _ => writeln!(text, "s.t{i}{j} = fma(wf{i}, b{j}, s.t{i}{j});"),
        };
    }
    text
}

/// Generates `fn solve`. It returns c_00, c_10 and c_01, computed from an LDL^T decomposition of the normal equations
/// with the ridge, and the amount by which the polynomial lowers the objective (6.1), from sum(w f²) to its minimum.
///
/// With too few neighbours for degree 3, the cubic unknowns are omitted. Since unknowns are ordered by degree, the
/// solution of degree 2 remains.
pub(super) fn solve(degree: usize) -> String {
    let count = coefficient_count(degree);
    let entry =
        |i: usize, j: usize| format!("s.m{}{}", MONOMIALS[i].0 + MONOMIALS[j].0, MONOMIALS[i].1 + MONOMIALS[j].1);
    let mut text = String::from("fn solve(s: Moments, ridge: f32, extent_squared: f32, n: f32) -> vec4<f32> {\n");
    text += "let ridge0 = 0.0;\nlet ridge1 = s.m00 * ridge * extent_squared;\n";
    text += "let ridge2 = ridge1 * extent_squared;\nlet ridge3 = ridge2 * extent_squared;\n";
    for (j, (a, b)) in MONOMIALS.into_iter().enumerate().take(count) {
        let (diagonal, weight) = (entry(j, j), RIDGE_WEIGHTS[j]);
        let _ = writeln!(text, "var pivot{j} = fma(ridge{}, {weight:?}, {diagonal});\nvar y{j} = s.t{a}{b};", a + b);
        for k in 0..j {
            let _ = writeln!(text, "pivot{j} = fma(-l{j}_{k}, d{j}_{k}, pivot{j});");
            let _ = writeln!(text, "y{j} = fma(-l{j}_{k}, y{k}, y{j});");
        }
        // If all weights are 0, so are the pivots, and the solution is 0.
        let carried = if j >= coefficient_count(2) { " && n >= 10.0" } else { "" };
        let _ = writeln!(text, "let inverse{j} = select(0.0, 1.0 / pivot{j}, pivot{j} > 0.0{carried});");
        // Column j of L, and of L times its pivots.
        for i in j + 1..count {
            let _ = writeln!(text, "var d{i}_{j} = {};", entry(i, j));
            for k in 0..j {
                let _ = writeln!(text, "d{i}_{j} = fma(-l{i}_{k}, d{j}_{k}, d{i}_{j});");
            }
            let _ = writeln!(text, "let l{i}_{j} = d{i}_{j} * inverse{j};");
        }
    }
    for j in (0..count).rev() {
        let _ = writeln!(text, "var c{j} = y{j} * inverse{j};");
        for i in (j + 1..count).rev() {
            let _ = writeln!(text, "c{j} = fma(-l{i}_{j}, c{i}, c{j});");
        }
    }
    let explained = (0..count).map(|j| format!("y{j} * (y{j} * inverse{j})")).collect::<Vec<_>>().join(" + ");
    let _ = writeln!(text, "return vec4<f32>(c0, c1, c2, {explained});\n}}");
    text
}
