// The buffers of the passes that estimate standard errors (sigma.rs).
//
// Stage: docs/method.md, section 17.

// Parameters of the passes; begins with the fields of `Batch` (buffers.wgsl).
struct Sigma {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    // Coefficients of the standard deviation of depth.
    sensor_sigma: vec3<f32>,
    // Distance between frames in `scratch`, in words.
    scratch_words: u32,
    gain: f32,
    least_area: f32,
    least_variance: f32,
    // Offset of the standard errors in a result, in words.
    sigma_at: u32,
    // Offset of the statuses in a result, in words.
    status_at: u32,
    // Offset of the numbers of neighbours in a result, in words.
    neighbours_at: u32,
    padding: vec2<u32>,
}

@group(0) @binding(0) var<uniform> batch: Sigma;
@group(0) @binding(1) var<storage, read> input: array<u32>;
// The result, with a channel for the standard errors.
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
// Per frame: residuals, smoothed ranges, steps (1 if the pixel to the right or below is across one), the sums of
// the segments, and the area of correlation.
@group(0) @binding(3) var<storage, read_write> scratch: array<f32>;

// Marker of a missing range.
const NO_RANGE: f32 = -1.0;
// Marker of a missing residual, larger than CLIP.
const NO_RESIDUAL: f32 = 100.0;

// Returns the residual of pixel i; with i + pixels() its range, with i + 2 pixels() its step.
fn scratch_at(frame: u32, i: u32) -> f32 {
    return scratch[frame * batch.scratch_words + i];
}

// Returns the index of the sums of segment k.
fn sums_at(frame: u32, k: u32) -> u32 {
    return frame * batch.scratch_words + PIXEL_WORDS * pixels() + k * SEGMENT_WORDS;
}

// Returns the number of segments, across and down.
fn segments() -> vec2<u32> {
    let size_px = vec2<u32>(SEGMENT_PX, SEGMENT_ROWS * ROW_STRIDE_PX);
    return (vec2<u32>(batch.width, batch.height) + size_px - 1u) / size_px;
}

fn area_at(frame: u32) -> u32 {
    return sums_at(frame, segments().x * segments().y);
}

fn deviation(range: f32) -> f32 {
    let sigma = batch.sensor_sigma;
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
