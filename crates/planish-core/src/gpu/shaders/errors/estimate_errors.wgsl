// The standard error of each pixel (equations 17.2 and 17.4). A workgroup is a tile.

const SIDE: u32 = 2u * HALF + 1u;
const BLOCK_WIDTH_PX: u32 = TILE_WIDTH + 2u * HALF;
const BLOCK_HEIGHT_PX: u32 = TILE_HEIGHT + 2u * HALF;

var<workgroup> residuals: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;
var<workgroup> steps: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;
// Over the rows of a window: the sum of squares and their number, the sum of values and their number in the small
// window; whether there is a step.
var<workgroup> sums: array<vec4<f32>, BLOCK_WIDTH_PX * TILE_HEIGHT>;
var<workgroup> near: array<f32, BLOCK_WIDTH_PX * TILE_HEIGHT>;

// Loads a tile and the pixels of the windows around it.
fn load_block(frame: u32, origin: vec2<u32>, thread: u32) {
    for (var k = thread; k < BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX; k += TILE_WIDTH * TILE_HEIGHT) {
        let at = vec2<i32>(origin) + vec2<i32>(vec2<u32>(k % BLOCK_WIDTH_PX, k / BLOCK_WIDTH_PX)) - i32(HALF);
        var residual = NO_RESIDUAL;
        var step = 0.0;
        if all(at >= vec2<i32>(0)) && at.x < i32(batch.width) && at.y < i32(batch.height) {
            let i = u32(at.y) * batch.width + u32(at.x);
            residual = kept_at(frame, i);
            step = kept_at(frame, i + 2u * pixels());
        }
        residuals[k] = residual;
        steps[k] = step;
    }
    workgroupBarrier();
}

// Whether a row or column of the window is within a smaller one.
fn is_within(i: u32, half_width: u32) -> bool {
    return i >= HALF - half_width && i <= HALF + half_width;
}

fn add_rows(thread: u32) {
    for (var k = thread; k < BLOCK_WIDTH_PX * TILE_HEIGHT; k += TILE_WIDTH * TILE_HEIGHT) {
        var sum = vec4<f32>(0.0);
        var step = 0.0;
        for (var row = 0u; row < SIDE; row++) {
            let residual = residuals[k + row * BLOCK_WIDTH_PX];
            let counts = residual != NO_RESIDUAL;
            let pair = select(vec2<f32>(0.0), vec2<f32>(residual, 1.0), counts);
            sum += vec4<f32>(pair.x * pair.x, pair.y, select(vec2<f32>(0.0), pair, is_within(row, BIAS_HALF)));
            step = max(step, select(0.0, steps[k + row * BLOCK_WIDTH_PX], is_within(row, NEAR_STEP)));
        }
        sums[k] = sum;
        near[k] = step;
    }
    workgroupBarrier();
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn estimate_errors(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = group.xy * vec2<u32>(TILE_WIDTH, TILE_HEIGHT);
    let at = origin + local.xy;
    load_block(frame, origin, thread);
    add_rows(thread);
    if at.x >= batch.width || at.y >= batch.height {
        return;
    }
    var sum = vec4<f32>(0.0);
    var step = 0.0;
    for (var column = 0u; column < SIDE; column++) {
        let k = local.y * BLOCK_WIDTH_PX + local.x + column;
        sum += vec4<f32>(sums[k].xy, select(vec2<f32>(0.0), sums[k].zw, is_within(column, BIAS_HALF)));
        step = max(step, select(0.0, near[k], is_within(column, NEAR_STEP)));
    }
    let i = at.y * batch.width + at.x;
    let range = kept_at(frame, i + pixels());
    let status = code(frame, batch.status_at, at);
    let area = memory[area_at(frame)];
    let variance = max(select(1.0, sum.x / max(sum.y, 1.0), sum.y > 0.0), batch.least_variance);
    let mean = sum.z / max(sum.w, 1.0);
    let unit = deviation(range);
    let raw = sqrt(variance) * unit;
    let neighbours = max(f32(code(frame, batch.neighbours_at, at)), 1.0);
    let share = min(batch.gain * pow(area, EXPONENT) / sqrt(neighbours), MOST_SHARE);
    let noise = raw * share * select(1.0, NEAR_STEP_FACTOR, step > 0.0);
    let variance_of_mean = min(area / f32((2u * BIAS_HALF + 1u) * (2u * BIAS_HALF + 1u)), 1.0);
    let beyond = max(abs(mean) - BIAS_DEVIATIONS * sqrt(variance_of_mean * variance), 0.0);
    let bias = BIAS_WEIGHT * beyond * unit;
    let error = select(raw, sqrt(fma(noise, noise, bias * bias)), is_on_surface(status));
    let has_point = range >= 0.0 && status >= STATUS_DEGENERATE;
    let bits = select(NAN_BITS, bitcast<u32>(error), has_point);
    output[frame * batch.output_words + batch.sigma_at + i] = bits;
}
