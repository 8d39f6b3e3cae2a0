// The buffers of the passes that fill holes (fill.rs), the image 1/z, and its steps.
//
// Stage: docs/method.md, section 18.

// Parameters of the passes; begins with the fields of `Batch` (buffers.wgsl).
struct Fill {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
    // Coefficients of the standard deviation of depth.
    sensor_sigma: vec3<f32>,
    // Maximum width of holes to fill, in pixels.
    most_px: u32,
    // Distance between the sensor's two views in metres; 0 if near objects cast no shadows.
    baseline_m: f32,
    // Number of frames.
    frames: u32,
    // Distance between frames in `scratch`, in words.
    scratch_words: u32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> batch: Fill;
@group(0) @binding(1) var<storage, read> input: array<u32>;
// The result, whose holes are filled.
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
// Per frame: the channels listed below, one word per pixel; then one bit per pixel, set for holes.
@group(0) @binding(3) var<storage, read_write> scratch: array<u32>;
// For all frames: the words listed below; then per frame the labels, sizes and tallies, one word per pixel.
@group(0) @binding(4) var<storage, read_write> holes: array<atomic<u32>>;

// Channels of `scratch`. INVERSE is 1/z, 0 for holes; the next six are the patch of a hole pixel.
const INVERSE: u32 = 0u;
const PATCH_INVERSE: u32 = 1u;
const PATCH_SLOPE_X: u32 = 2u;
const PATCH_SLOPE_Y: u32 = 3u;
const PATCH_SIGMA: u32 = 4u;
const PATCH_CURVATURE: u32 = 5u;
const PATCH_SAMPLES: u32 = 6u;
// 1 if a surface was fitted.
const FITTED: u32 = 7u;
// Round in which the pixel was filled, starting with 1; 0 if it was not.
const FILLED: u32 = 8u;

// Words of a frame at the beginning of `holes`, initially 0: the bits of the largest 1/z, those of the smallest 1/z
// subtracted from INFINITE_BITS, and the votes for shadows on the left and on the right of near objects.
const FRAME_WORDS: u32 = 4u;
const LARGEST: u32 = 0u;
const SMALLEST: u32 = 1u;
const VOTES_LEFT: u32 = 2u;
const VOTES_RIGHT: u32 = 3u;
const INFINITE_BITS: u32 = 0x7f800000u;

// Channels of `holes` after these words. LABEL is an earlier pixel of the same hole, or the pixel itself if it is the
// first. SIZE and TALLY describe the hole and are stored at its first pixel: the number of pixels, and the number of
// fitted pixels, with the flag HAS_STEP.
const LABEL: u32 = 0u;
const SIZE: u32 = 1u;
const TALLY: u32 = 2u;
const HAS_STEP: u32 = 0x80000000u;

fn frame_word(frame: u32, word: u32) -> u32 {
    return frame * FRAME_WORDS + word;
}

fn hole_word(frame: u32, channel: u32, i: u32) -> u32 {
    return batch.frames * FRAME_WORDS + (frame * HOLE_CHANNELS + channel) * pixels() + i;
}

fn scratch_word(frame: u32, channel: u32, i: u32) -> u32 {
    return frame * batch.scratch_words + channel * pixels() + i;
}

fn is_in_image(at: vec2<i32>) -> bool {
    return all(at >= vec2<i32>(0)) && at.x < i32(batch.width) && at.y < i32(batch.height);
}

fn index(at: vec2<i32>) -> u32 {
    return u32(at.y) * batch.width + u32(at.x);
}

// Returns 1/z; 0 for a hole.
fn inverse_at(frame: u32, i: u32) -> f32 {
    return bitcast<f32>(scratch[scratch_word(frame, INVERSE, i)]);
}

// Returns the index of the word with the bits of 32 pixels of a row.
fn hole_bits_word(frame: u32, row: u32, word: u32) -> u32 {
    return scratch_word(frame, SCRATCH_CHANNELS, row * ((batch.width + 31u) / 32u) + word);
}

// Returns true if a pixel of the image is a hole. The bits fit into the cache, unlike INVERSE.
fn is_hole(frame: u32, at: vec2<i32>) -> bool {
    let pixel = vec2<u32>(at);
    return extractBits(scratch[hole_bits_word(frame, pixel.y, pixel.x / 32u)], pixel.x % 32u, 1u) != 0u;
}

fn status_at(frame: u32, i: u32) -> u32 {
    let rows_at = CHANNELS * pixels();
    let row_words = (batch.width + 3u) / 4u;
    let column = i % batch.width;
    let word = output[frame * batch.output_words + rows_at + i / batch.width * row_words + column / 4u];
    return extractBits(word, 8u * (column % 4u), 8u);
}

// Returns `deviations` standard deviations of the sensor or a `share` of the range, whichever is larger, as a
// difference of 1/z.
fn limit(inverse: f32, deviations: f32, share: f32) -> f32 {
    let z = 1.0 / inverse;
    let sigma = batch.sensor_sigma;
    let deviation = fma(fma(sigma.z, z, sigma.y), z, sigma.x);
    return max(deviations * deviation, share * z) * inverse * inverse;
}

fn step_limit(inverse: f32) -> f32 {
    return limit(inverse, STEP_DEVIATIONS, STEP_SHARE);
}

fn is_step(a: f32, b: f32) -> bool {
    return abs(a - b) > step_limit(min(a, b));
}

// Returns a ray's x/z for a column, or y/z for a row if the number of columns is added.
fn ray(frame: u32, i: u32) -> f32 {
    return bitcast<f32>(input[frame * batch.input_words + HEADER_WORDS + i]);
}

// Returns the focal lengths in pixels. Along an axis with a single pixel, the focal length does not matter and is 1.
fn focal_lengths(frame: u32) -> vec2<f32> {
    let last = vec2<u32>(batch.width, batch.height) - 1u;
    let spans = vec2<f32>(ray(frame, last.x) - ray(frame, 0u), ray(frame, batch.width + last.y) - ray(frame, batch.width));
    return select(vec2<f32>(1.0), vec2<f32>(last) / spans, spans > vec2<f32>(0.0));
}

// Returns the width of a shadow, in pixels, per difference of 1/z; 0 if near objects cast no shadows.
fn shadow_shift(frame: u32) -> f32 {
    return batch.baseline_m * focal_lengths(frame).x;
}

fn is_shadow(shift: f32, near: f32, far: f32, width_px: u32) -> bool {
    let explained_px = shift * (near - far);
    let least = SHADOW_SHARE_LEAST * explained_px + SHADOW_PX_LEAST;
    let most = SHADOW_SHARE_MOST * explained_px + SHADOW_PX_MOST;
    let width = f32(width_px);
    return near > far && is_step(near, far) && width >= least && width <= most;
}
