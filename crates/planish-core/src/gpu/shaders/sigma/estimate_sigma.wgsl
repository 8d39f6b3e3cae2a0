// Estimates the standard error of each pixel (equations 17.2 and 17.4). Each workgroup handles one tile.

const SIDE: u32 = 2u * HALF_PX + 1u;
const BLOCK_WIDTH_PX: u32 = TILE_WIDTH + 2u * HALF_PX;
const BLOCK_HEIGHT_PX: u32 = TILE_HEIGHT + 2u * HALF_PX;

var<workgroup> residuals: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;
var<workgroup> steps: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;
// Sums over each column of the window: x and y are the squares and their number, z and w the residuals and their number
// in the small window.
var<workgroup> sums: array<vec4<f32>, BLOCK_WIDTH_PX * TILE_HEIGHT>;
// For each column of the window: 1 if a step is within NEAR_STEP_PX rows, otherwise 0.
var<workgroup> near: array<f32, BLOCK_WIDTH_PX * TILE_HEIGHT>;

// Loads the pixels of a tile and of the windows around it.
fn load_block(frame: u32, origin: vec2<u32>, thread: u32) {
    for (var k = thread; k < BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX; k += TILE_WIDTH * TILE_HEIGHT) {
        let at = vec2<i32>(origin) + vec2<i32>(vec2<u32>(k % BLOCK_WIDTH_PX, k / BLOCK_WIDTH_PX)) - i32(HALF_PX);
        var residual = NO_RESIDUAL;
        var step = 0.0;
        if all(at >= vec2<i32>(0)) && at.x < i32(batch.width) && at.y < i32(batch.height) {
            let i = u32(at.y) * batch.width + u32(at.x);
            residual = scratch_at(frame, i);
            step = scratch_at(frame, i + 2u * pixels());
        }
        residuals[k] = residual;
        steps[k] = step;
    }
    workgroupBarrier();
}

// Returns whether a row or column of the window is within a smaller one.
fn is_within(i: u32, half_width: u32) -> bool {
    return i >= HALF_PX - half_width && i <= HALF_PX + half_width;
}

fn add_columns(thread: u32) {
    for (var k = thread; k < BLOCK_WIDTH_PX * TILE_HEIGHT; k += TILE_WIDTH * TILE_HEIGHT) {
        var sum = vec4<f32>(0.0);
        var step = 0.0;
        for (var row = 0u; row < SIDE; row++) {
            let residual = residuals[k + row * BLOCK_WIDTH_PX];
            let counted = select(vec2<f32>(0.0), vec2<f32>(residual, 1.0), residual != NO_RESIDUAL);
            let small = select(vec2<f32>(0.0), counted, is_within(row, BIAS_HALF_PX));
            sum += vec4<f32>(counted.x * counted.x, counted.y, small);
            step = max(step, select(0.0, steps[k + row * BLOCK_WIDTH_PX], is_within(row, NEAR_STEP_PX)));
        }
        sums[k] = sum;
        near[k] = step;
    }
    workgroupBarrier();
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn estimate_sigma(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = group.xy * vec2<u32>(TILE_WIDTH, TILE_HEIGHT);
    let at = origin + local.xy;
    load_block(frame, origin, thread);
    add_columns(thread);
    if at.x >= batch.width || at.y >= batch.height {
        return;
    }
    var sum = vec4<f32>(0.0);
    var step = 0.0;
    for (var column = 0u; column < SIDE; column++) {
        let k = local.y * BLOCK_WIDTH_PX + local.x + column;
        sum += vec4<f32>(sums[k].xy, select(vec2<f32>(0.0), sums[k].zw, is_within(column, BIAS_HALF_PX)));
        step = max(step, select(0.0, near[k], is_within(column, NEAR_STEP_PX)));
    }
    let i = at.y * batch.width + at.x;
    let range = scratch_at(frame, i + pixels());
    let status = code(frame, batch.status_at, at);
    let area = scratch[area_at(frame)];
    let variance = max(select(1.0, sum.x / max(sum.y, 1.0), sum.y > 0.0), batch.least_variance);
    let mean = sum.z / max(sum.w, 1.0);
    let deviation_m = deviation(range);
    let raw = sqrt(variance) * deviation_m;
    let neighbours = max(f32(code(frame, batch.neighbours_at, at)), 1.0);
    let share = min(batch.gain * pow(area, EXPONENT) / sqrt(neighbours), MOST_SHARE);
    let noise = raw * share * select(1.0, NEAR_STEP_FACTOR, step > 0.0);
    let variance_of_mean = min(area / f32((2u * BIAS_HALF_PX + 1u) * (2u * BIAS_HALF_PX + 1u)), 1.0);
    let beyond = max(abs(mean) - BIAS_DEVIATIONS * sqrt(variance_of_mean * variance), 0.0);
    let bias = BIAS_WEIGHT * beyond * deviation_m;
    let error = select(raw, sqrt(fma(noise, noise, bias * bias)), is_on_surface(status));
    let has_point = range >= 0.0 && status >= STATUS_DEGENERATE;
    let bits = select(NAN_BITS, bitcast<u32>(error), has_point);
    output[frame * batch.output_words + batch.sigma_at + i] = bits;
}
