// The standard error of each pixel (equations 17.2 and 17.4). A workgroup is a tile.

const SIDE: u32 = 2u * HALF + 1u;
const BLOCK_WIDTH_PX: u32 = TILE_WIDTH + 2u * HALF;
const BLOCK_HEIGHT_PX: u32 = TILE_HEIGHT + 2u * HALF;

var<workgroup> residuals: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;
var<workgroup> steps: array<f32, BLOCK_WIDTH_PX * BLOCK_HEIGHT_PX>;

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

// Whether a place in the window is within a smaller one.
fn is_within(column: u32, row: u32, half: u32) -> bool {
    let margin = HALF - half;
    return min(column, row) >= margin && max(column, row) < SIDE - margin;
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
    if at.x >= batch.width || at.y >= batch.height {
        return;
    }
    // Of all residuals in the window: squares and their number; of those in the small window: values and their number.
    var sums = vec4<f32>(0.0);
    var near = 0.0;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = 0u; column < SIDE; column++) {
            let k = (local.y + row) * BLOCK_WIDTH_PX + local.x + column;
            let residual = residuals[k];
            if residual != NO_RESIDUAL {
                sums += vec4<f32>(residual * residual, 1.0, 0.0, 0.0);
                if is_within(column, row, BIAS_HALF) {
                    sums += vec4<f32>(0.0, 0.0, residual, 1.0);
                }
            }
            if is_within(column, row, NEAR_STEP) {
                near = max(near, steps[k]);
            }
        }
    }
    let i = at.y * batch.width + at.x;
    let range = kept_at(frame, i + pixels());
    let status = code(frame, batch.status_at, at);
    let area = memory[area_at(frame)];
    let variance = max(select(1.0, sums.x / max(sums.y, 1.0), sums.y > 0.0), batch.least_variance);
    let mean = sums.z / max(sums.w, 1.0);
    let unit = deviation(range);
    let raw = sqrt(variance) * unit;
    let neighbours = max(f32(code(frame, batch.neighbours_at, at)), 1.0);
    let share = min(batch.gain * pow(area, EXPONENT) / sqrt(neighbours), MOST_SHARE);
    let noise = raw * share * select(1.0, NEAR_STEP_FACTOR, near > 0.0);
    let variance_of_mean = min(area / f32((2u * BIAS_HALF + 1u) * (2u * BIAS_HALF + 1u)), 1.0);
    let beyond = max(abs(mean) - BIAS_DEVIATIONS * sqrt(variance_of_mean * variance), 0.0);
    let bias = BIAS_WEIGHT * beyond * unit;
    let error = select(raw, sqrt(fma(noise, noise, bias * bias)), is_on_surface(status));
    let has_point = range >= 0.0 && status >= STATUS_DEGENERATE;
    let bits = select(NAN_BITS, bitcast<u32>(error), has_point);
    output[frame * batch.output_words + batch.sigma_at + i] = bits;
}
