// The buffers of the passes that estimate standard errors (errors.rs).
//
// Stage: docs/method.md, section 17.

// Begins with the fields of a batch (buffers.wgsl).
struct Errors {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    // Coefficients of the standard deviation of depth.
    sigma: vec3<f32>,
    // Distance between frames in `memory`.
    memory_words: u32,
    gain: f32,
    least_area: f32,
    least_variance: f32,
    // Places in a result, in words.
    sigma_at: u32,
    status_at: u32,
    neighbours_at: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> batch: Errors;
@group(0) @binding(1) var<storage, read> input: array<u32>;
// The result, with a channel for the errors.
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
// The residuals, the smoothed ranges, 1 for pixels with a step to the next one; sums of rows; the area of correlation.
@group(0) @binding(3) var<storage, read_write> memory: array<f32>;

// A pixel without a range, and one without a residual: beyond all clamped ones.
const NO_RANGE: f32 = -1.0;
const NO_RESIDUAL: f32 = 100.0;
// Sums of a row: products and mean squares of pairs, for each lag along rows and columns.
const SUMS: u32 = 4u * MOST_LAG;

fn pixels() -> u32 {
    return batch.width * batch.height;
}

// A word of a frame: a residual, or with offsets of `pixels()` a range or a step.
fn kept_at(frame: u32, i: u32) -> f32 {
    return memory[frame * batch.memory_words + i];
}

// The place of the sums of row k * ROW_STEP.
fn sums_at(frame: u32, k: u32) -> u32 {
    return frame * batch.memory_words + 3u * pixels() + k * SUMS;
}

fn rows() -> u32 {
    return (batch.height + ROW_STEP - 1u) / ROW_STEP;
}

fn area_at(frame: u32) -> u32 {
    return sums_at(frame, rows());
}

fn deviation(range: f32) -> f32 {
    let sigma = batch.sigma;
    return max(fma(fma(sigma.z, range, sigma.y), range, sigma.x), LEAST_DEVIATION_M);
}

fn code(frame: u32, rows_at: u32, pixel: vec2<u32>) -> u32 {
    let row_words = (batch.width + 3u) / 4u;
    let word = output[frame * batch.output_words + rows_at + pixel.y * row_words + pixel.x / 4u];
    return extractBits(word, 8u * (pixel.x % 4u), 8u);
}

fn is_on_surface(status: u32) -> bool {
    return status == STATUS_PLANE || status == STATUS_POLYNOMIAL_2 || status == STATUS_POLYNOMIAL_3;
}
