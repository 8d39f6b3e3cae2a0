// Keeps the fitted pixels of holes that could be filled almost whole, except narrow stripes.

// Returns true if enough of a fitted pixel's hole was fitted, or the hole has two surfaces at its rim.
fn is_of_whole_hole(frame: u32, i: u32) -> bool {
    let hole = atomicLoad(&holes[hole_word(frame, LABEL, i)]);
    let tally = atomicLoad(&holes[hole_word(frame, TALLY, hole)]);
    let size = atomicLoad(&holes[hole_word(frame, SIZE, hole)]);
    return (tally & HAS_STEP) != 0u || f32(tally) >= LEAST_SHARE * f32(size);
}

fn is_there(frame: u32, at: vec2<i32>) -> bool {
    if !is_in_image(at) {
        return false;
    }
    let i = index(at);
    return !is_hole(frame, at) || (scratch[scratch_word(frame, FITTED, i)] == 1u && is_of_whole_hole(frame, i));
}

// Returns the number of pixels in a row that are not holes, up to LEAST_STRIPE_PX - 1, from a pixel in a direction.
fn run_px(frame: u32, at: vec2<i32>, step: vec2<i32>) -> i32 {
    var count = 0;
    while count + 1 < LEAST_STRIPE_PX && is_there(frame, at + (count + 1) * step) {
        count++;
    }
    return count;
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn keep_solid(@builtin(global_invocation_id) id: vec3<u32>) {
    let frame = id.z;
    let i = id.y * batch.width + id.x;
    if id.x >= batch.width || id.y >= batch.height || !is_hole(frame, vec2<i32>(id.xy)) {
        return;
    }
    if scratch[scratch_word(frame, FITTED, i)] != 1u || !is_of_whole_hole(frame, i) {
        return;
    }
    let at = vec2<i32>(id.xy);
    let across = 1 + run_px(frame, at, vec2<i32>(1, 0)) + run_px(frame, at, vec2<i32>(-1, 0));
    let down = 1 + run_px(frame, at, vec2<i32>(0, 1)) + run_px(frame, at, vec2<i32>(0, -1));
    if across >= LEAST_STRIPE_PX && down >= LEAST_STRIPE_PX {
        scratch[scratch_word(frame, FILLED, i)] = 1u;
    }
}
