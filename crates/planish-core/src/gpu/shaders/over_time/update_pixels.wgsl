// Updates the state of each pixel by the changes around it, and writes the result over time (equations 16.2, 16.4 and
// 16.7). Each workgroup handles one tile.

const REACH: u32 = 2u;
const SIDE: u32 = TILE + 2u * REACH;

var<workgroup> changes: array<f32, SIDE * SIDE>;
var<workgroup> signs: array<f32, SIDE * SIDE>;

// Loads the changes of a tile and of the two pixels around it on every side.
fn load_changes(origin: vec2<u32>, thread: u32) {
    for (var k = thread; k < SIDE * SIDE; k += TILE * TILE) {
        let at = vec2<i32>(origin) + vec2<i32>(vec2<u32>(k % SIDE, k / SIDE)) - i32(REACH);
        var change = NO_CHANGE;
        var sign = 0.0;
        if all(at >= vec2<i32>(0)) && at.x < i32(batch.width) && at.y < i32(batch.height) {
            let i = u32(at.y) * batch.width + u32(at.x);
            change = bitcast<f32>(memory[batch.changes_at + i]);
            sign = bitcast<f32>(memory[batch.changes_at + pixels() + i]);
        }
        changes[k] = change;
        signs[k] = sign;
    }
    workgroupBarrier();
}

// Returns the mean of the clipped changes in 5x5 pixels.
fn mean_change(local: vec2<u32>) -> f32 {
    var sum = 0.0;
    var count = 0.0;
    for (var row = 0u; row < 5u; row++) {
        for (var column = 0u; column < 5u; column++) {
            let change = changes[(local.y + row) * SIDE + local.x + column];
            if change != NO_CHANGE {
                sum += clamp(change, -CLIP, CLIP);
                count += 1.0;
            }
        }
    }
    return sum / max(count, 1.0);
}

// Returns the sum of the signs of the candidates in 3x3 pixels.
fn support(local: vec2<u32>) -> f32 {
    var sum = 0.0;
    for (var row = 1u; row < 4u; row++) {
        for (var column = 1u; column < 4u; column++) {
            sum += signs[(local.y + row) * SIDE + local.x + column];
        }
    }
    return sum;
}

// A pixel's state after a frame, and its effect on the result.
struct Updated {
    pixel: Pixel,
    // Range smoothed over time; 0 to keep the range of the frame.
    range: f32,
    waits: bool,
}

fn updated(i: u32, local: vec2<u32>, tile_weight: f32) -> Updated {
    let range = range_at(i);
    let old = old_pixel(i);
    let here = (local.y + REACH) * SIDE + local.x + REACH;
    let is_both = changes[here] != NO_CHANGE;
    let is_candidate = signs[here] != 0.0;
    var after = old;
    if is_both && !is_candidate {
        let change = changes[here];
        let mean = mean_change(local);
        let value = measured(range).x;
        let deviation = sqrt(old.variance);
        let from_bias = min(abs(mean - old.bias), 3.0 * deviation);
        after.bias = fma(LEAK, mean - old.bias, old.bias);
        let by_change = fourth_power(mean / (CHANGE * deviation));
        let by_bias = fourth_power(after.bias / (BIAS * deviation));
        let by_own = fourth_power(change / (OWN_CHANGE * single_deviation(old.variance)));
        let weight = tile_weight / ((1.0 + by_change + by_bias) * (1.0 + by_own));
        after.frames = min(fma(old.frames, weight, 1.0), batch.most_frames);
        after.mean = old.mean + (value - old.mean) / after.frames;
        let learnt = LEARNT * from_bias * from_bias - old.variance;
        let learns = old.frames * (LEARN / batch.most_frames);
        after.variance = clamp(fma(learns, learnt, old.variance), LEAST_VARIANCE, MOST_VARIANCE);
        after.idle = 0u;
        return Updated(after, range_of_mean(after.mean), false);
    }
    if is_candidate {
        let is_large = abs(changes[here]) > AT_ONCE * single_deviation(old.variance);
        let is_supported = signs[here] * support(local) >= SUPPORT;
        let may_wait = old.idle == 0u && old.frames >= FRAMES_TO_WAIT;
        if may_wait && !(is_supported && is_large) {
            after.idle = 1u;
            return Updated(after, range_of_mean(after.mean), true);
        }
        after.variance = min(old.variance, FIRST_VARIANCE);
    }
    if range > 0.0 {
        // A pixel that was not known before, or a new surface: start again.
        after.mean = measured(range).x;
        after.frames = 1.0;
        after.bias = 0.0;
        after.idle = 0u;
        return Updated(after, 0.0, false);
    }
    after.idle = old.idle + 1u;
    if f32(after.idle) > MEMORY {
        after.frames = 0.0;
        after.idle = 0u;
    }
    return Updated(after, 0.0, false);
}

fn spatial_channel(channel: u32, i: u32) -> u32 {
    return spatial[channel * pixels() + i];
}

// Returns a byte of the packed rows after the channels; the first packed rows contain the statuses.
fn spatial_code(rows: u32, pixel: vec2<u32>) -> u32 {
    let row_words = (batch.width + 3u) / 4u;
    let rows_at = SPATIAL_CHANNELS * pixels() + rows * batch.height * row_words;
    return extractBits(spatial[rows_at + pixel.y * row_words + pixel.x / 4u], 8u * (pixel.x % 4u), 8u);
}

fn scaled(bits: u32, ratio: f32) -> u32 {
    return select(bits, bitcast<u32>(bitcast<f32>(select(0u, bits, is_finite(bits))) * ratio), is_finite(bits));
}

@compute @workgroup_size(TILE, TILE)
fn update_pixels(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let origin = group.xy * TILE;
    let pixel = origin + local.xy;
    load_changes(origin, thread);
    var result = no_result(STATUS_HOLE, 0u);
    if pixel.x < batch.width && pixel.y < batch.height {
        let i = pixel.y * batch.width + pixel.x;
        let weight = bitcast<f32>(memory[batch.tiles_at + 4u * tiles() + group.y * tiles_across() + group.x]);
        let now = updated(i, local.xy, weight);
        var status = spatial_code(0u, pixel);
        // A status of Carried would hide a missing normal, so such a point stays as measured.
        let is_carried = now.waits && status >= STATUS_PLANE && status != STATUS_ISOLATED;
        let is_moved = now.range > 0.0 && (is_carried || !now.waits);
        let ratio = select(1.0, now.range / max(range_at(i), LEAST_RANGE_M), is_moved);
        keep_pixel(i, now.pixel, select(0u, CARRIED, now.waits));
        result.point = vec3<u32>(
            scaled(spatial_channel(0u, i), ratio),
            scaled(spatial_channel(1u, i), ratio),
            scaled(spatial_channel(2u, i), ratio),
        );
        if WANTS_NORMALS {
            result.normal = vec3<u32>(
                spatial_channel(SPATIAL_NORMALS, i),
                spatial_channel(SPATIAL_NORMALS + 1u, i),
                spatial_channel(SPATIAL_NORMALS + 2u, i),
            );
        }
        if WANTS_CURVATURE {
            result.curvature = spatial_channel(SPATIAL_CURVATURE, i);
        }
        var neighbours = 0u;
        if WANTS_NEIGHBOURS {
            neighbours = spatial_code(1u, pixel);
        }
        result.codes = select(status, STATUS_CARRIED, is_carried) | (neighbours << 8u);
        if WANTS_DEPTH || WANTS_DEPTH_M {
            let depth = spatial_channel(SPATIAL_DEPTH_M, i);
            if is_finite(depth) {
                result = with_depth(0u, bitcast<f32>(depth) * ratio, result);
            }
        }
        if WANTS_FRAMES {
            let has_point = status >= STATUS_DEGENERATE;
            // Rounded as in the stored state.
            let kept = floor(now.pixel.frames * PER_UNIT + 0.5) / PER_UNIT;
            let frames = select(1.0, max(kept, 1.0), is_moved);
            store_word(0u, FRAMES_CHANNEL, i, bitcast<u32>(select(0.0, frames, has_point)));
        }
    }
    store(0u, origin, pixel, thread, result);
}
