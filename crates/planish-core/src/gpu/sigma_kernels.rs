//! The kernels that estimate standard errors on the device (docs/method.md, section 17). They are independent of
//! wgpu.

use super::layout::{InputKind, Layout, constants as layout_constants, write_numbers, write_words};
use super::shader::shader;
use crate::outputs::Outputs;
use crate::sigma::constants;

/// Numbers of columns and rows of pixels per workgroup.
const TILE: [usize; 2] = [32, 8];
/// Number of scratch words per pixel: residual, smoothed range, step.
const PIXEL_WORDS: usize = 3;
/// Numbers of columns and sampled rows of a segment, whose pairs are summed by one workgroup.
const SEGMENT: [usize; 2] = [128, 4];
/// Number of scratch words per segment: product and mean square for each lag, along rows and columns.
const SEGMENT_WORDS: usize = 4 * constants::MOST_LAG_PX;

/// A pass over pixels, rows or frames. Its kernel depends on the kind of input only if it reads the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum SigmaPass {
    SetResiduals(InputKind),
    CorrelateRows,
    MeasureArea,
    EstimateSigma,
}

impl SigmaPass {
    /// Returns the passes for a kind of input, in order.
    pub(super) fn of(kind: InputKind) -> [Self; 4] {
        [Self::SetResiduals(kind), Self::CorrelateRows, Self::MeasureArea, Self::EstimateSigma]
    }

    pub(super) fn entry_point(self) -> &'static str {
        match self {
            Self::SetResiduals(_) => "set_residuals",
            Self::CorrelateRows => "correlate_rows",
            Self::MeasureArea => "measure_area",
            Self::EstimateSigma => "estimate_sigma",
        }
    }

    /// Returns the number of workgroups for a frame of the given shape, across and down.
    pub(super) fn workgroups(self, (width, height): (usize, usize)) -> [usize; 2] {
        match self {
            Self::SetResiduals(_) | Self::EstimateSigma => [width.div_ceil(TILE[0]), height.div_ceil(TILE[1])],
            Self::CorrelateRows => segments(width, height),
            Self::MeasureArea => [1, 1],
        }
    }

    /// Returns the WGSL of the pass's kernel.
    pub(super) fn wgsl(self) -> String {
        let kind = if let Self::SetResiduals(kind) = self { kind } else { InputKind::Depth };
        let mut text = layout_constants(kind, Outputs::POINTS, 1);
        text += &sigma_constants();
        text += shader!("shaders/sigma/buffers.wgsl");
        text += shader!("shaders/words.wgsl");
        match self {
            Self::SetResiduals(_) => {
                text += shader!("shaders/input.wgsl");
                text += shader!("shaders/sensor.wgsl");
                text += shader!("shaders/sigma/set_residuals.wgsl");
            }
            Self::CorrelateRows => text += shader!("shaders/sigma/correlate_rows.wgsl"),
            Self::MeasureArea => text += shader!("shaders/sigma/measure_area.wgsl"),
            Self::EstimateSigma => {
                text += shader!("shaders/pixel_result.wgsl");
                text += shader!("shaders/sigma/estimate_sigma.wgsl");
            }
        }
        text
    }
}

/// Returns the constants of the passes in WGSL.
fn sigma_constants() -> String {
    let mut text = String::new();
    let words = [
        ("TILE_WIDTH", TILE[0]),
        ("TILE_HEIGHT", TILE[1]),
        ("HALF_PX", constants::HALF_PX),
        ("BIAS_HALF_PX", constants::BIAS_HALF_PX),
        ("NEAR_STEP_PX", constants::NEAR_STEP_PX),
        ("MOST_LAG_PX", constants::MOST_LAG_PX),
        ("ROW_STRIDE_PX", constants::ROW_STRIDE_PX),
        ("SEGMENT_PX", SEGMENT[0]),
        ("SEGMENT_ROWS", SEGMENT[1]),
        ("PIXEL_WORDS", PIXEL_WORDS),
        ("SEGMENT_WORDS", SEGMENT_WORDS),
    ];
    write_words(&mut text, &words);
    let numbers = [
        ("CLIP", constants::CLIP),
        ("LEAST_DEVIATION_M", constants::LEAST_DEVIATION_M),
        ("STEP_DEVIATIONS", constants::STEP_DEVIATIONS),
        ("STEP_SHARE", constants::STEP_SHARE),
        ("LEAST_CORRELATION", constants::LEAST_CORRELATION as f32),
        ("EXPONENT", constants::EXPONENT as f32),
        ("NEAR_STEP_FACTOR", constants::NEAR_STEP_FACTOR),
        ("MOST_SHARE", constants::MOST_SHARE),
        ("BIAS_DEVIATIONS", constants::BIAS_DEVIATIONS),
        ("BIAS_WEIGHT", constants::BIAS_WEIGHT),
    ];
    write_numbers(&mut text, &numbers);
    text
}

/// Returns the number of segments, across and down.
fn segments(width: usize, height: usize) -> [usize; 2] {
    [width.div_ceil(SEGMENT[0]), height.div_ceil(SEGMENT[1] * constants::ROW_STRIDE_PX)]
}

/// Returns the number of scratch words per frame of a layout: for pixels, for segments, and one for the correlation
/// area.
pub(super) fn scratch_words(layout: &Layout) -> usize {
    let [across, down] = segments(layout.width, layout.height);
    PIXEL_WORDS * layout.pixels() + SEGMENT_WORDS * across * down + 1
}
