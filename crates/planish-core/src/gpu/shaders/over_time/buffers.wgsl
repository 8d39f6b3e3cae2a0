// The buffers of the passes that smooth a video over time (over_time.rs), and the state of a pixel.
//
// Stage: docs/method.md, section 16. As elsewhere, shaders never compute with NaN: holes have range 0.

// Parameters of a step; begins with the fields of `Batch` (buffers.wgsl).
struct Step {
    width: u32,
    height: u32,
    input_words: u32,
    // Distance between frames of the temporal result.
    output_words: u32,
    // Offset of the state in `memory`, in words.
    state_at: u32,
    // Offset of the previous frame's state in `memory`, in words, if the camera has moved.
    previous_at: u32,
    // Offset of the changes in `memory`, in words.
    changes_at: u32,
    // Offset of the tiles in `memory`, in words.
    tiles_at: u32,
    // 1 for the first frame of a video.
    starts: u32,
    knows_motion: u32,
    averages_inverse: u32,
    most_frames: f32,
    // Coefficients of the standard deviation of depth.
    sigma: vec3<f32>,
    fx: f32,
    // Rotation, by columns, and translation from the frame of the current camera to that of the previous one.
    rotation_x: vec3<f32>,
    fy: f32,
    rotation_y: vec3<f32>,
    cx: f32,
    rotation_z: vec3<f32>,
    cy: f32,
    translation: vec3<f32>,
    padding: f32,
}

@group(0) @binding(0) var<uniform> batch: Step;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;
// The result of smoothing in space.
@group(0) @binding(3) var<storage, read_write> spatial: array<u32>;
// The states of pixels, their changes, and the tiles.
@group(0) @binding(4) var<storage, read_write> memory: array<u32>;

// Minimum range in metres that is smoothed over time; changes of larger ranges fit into f32.
const LEAST_RANGE_M: f32 = 1e-9;

fn tiles_across() -> u32 {
    return (batch.width + TILE - 1u) / TILE;
}

fn tiles() -> u32 {
    return tiles_across() * ((batch.height + TILE - 1u) / TILE);
}

struct Pixel {
    mean: f32,
    frames: f32,
    variance: f32,
    bias: f32,
    // Frames since the last update.
    idle: u32,
}

fn unknown() -> Pixel {
    return Pixel(0.0, 0.0, FIRST_VARIANCE, 0.0, 0u);
}

fn pixel_of(state_at: u32, i: u32) -> Pixel {
    let frames_variance = memory[state_at + pixels() + i];
    let bias_idle = memory[state_at + 2u * pixels() + i];
    return Pixel(
        bitcast<f32>(memory[state_at + i]),
        f32(frames_variance & LOW) / PER_UNIT,
        f32(frames_variance >> 16u) / PER_VARIANCE,
        f32(bias_idle & LOW) / PER_UNIT - MOST_BIAS,
        (bias_idle & ~CARRIED) >> 16u,
    );
}

// Returns the state before this frame.
fn old_pixel(i: u32) -> Pixel {
    if batch.starts == 1u {
        return unknown();
    }
    return pixel_of(batch.state_at, i);
}

fn keep_pixel(i: u32, pixel: Pixel, carried: u32) {
    let frames = u32(pixel.frames * PER_UNIT + 0.5);
    let variance = u32(pixel.variance * PER_VARIANCE + 0.5);
    let bias = u32((pixel.bias + MOST_BIAS) * PER_UNIT + 0.5);
    memory[batch.state_at + i] = bitcast<u32>(pixel.mean);
    memory[batch.state_at + pixels() + i] = frames | (variance << 16u);
    memory[batch.state_at + 2u * pixels() + i] = bias | (pixel.idle << 16u) | carried;
}

// Returns the range of a pixel in metres; 0 for a hole.
fn range_at(i: u32) -> f32 {
    let bits = spatial[SPATIAL_Z * pixels() + i];
    let range = abs(bitcast<f32>(select(0u, bits, is_finite(bits))));
    return select(0.0, range, range >= LEAST_RANGE_M && range < MOST_DEPTH_M);
}

// Returns the averaged quantity of a range (the range or its inverse), and its standard deviation.
fn measured(range: f32) -> vec2<f32> {
    let sigma = batch.sigma;
    if batch.averages_inverse == 1u {
        let inverse = 1.0 / range;
        let noise = fma(fma(sigma.x, inverse, sigma.y), inverse, sigma.z);
        return vec2<f32>(inverse, max(noise, inverse * LEAST_NOISE));
    }
    let noise = fma(fma(sigma.z, range, sigma.y), range, sigma.x);
    return vec2<f32>(range, max(noise, range * LEAST_NOISE));
}

fn range_of_mean(mean: f32) -> f32 {
    return select(mean, 1.0 / mean, batch.averages_inverse == 1u);
}

fn single_deviation(variance: f32) -> f32 {
    return max(sqrt(variance), LEAST_DEVIATION);
}

fn fourth_power(value: f32) -> f32 {
    let square = value * value;
    return square * square;
}
