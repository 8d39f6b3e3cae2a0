// Keeps the fitted pixels of holes that could be filled almost whole, except narrow stripes.

// Returns true if enough of a fitted pixel's hole was fitted, or the hole has two surfaces at its rim.
fn is_of_whole_hole(frame: u32, i: u32) -> bool {
    let hole = atomicLoad(&holes[hole_word(frame, LABEL, i)]);
    let tally = atomicLoad(&holes[hole_word(frame, TALLY, hole)]);
    let size = atomicLoad(&holes[hole_word(frame, SIZE, hole)]);
    return (tally & HAS_STEP) != 0u || f32(tally) >= LEAST_SHARE * f32(size);
}

// The block of pixels that decide about a tile, and for each of them whether it is a point or may be filled.
const BESIDE: i32 = LEAST_STRIPE_PX - 1;
const WIDE_WIDTH: i32 = i32(TILE_WIDTH) + 2 * BESIDE;
const WIDE_HEIGHT: i32 = i32(TILE_HEIGHT) + 2 * BESIDE;

var<workgroup> there: array<u32, WIDE_WIDTH * WIDE_HEIGHT>;

fn is_there(frame: u32, at: vec2<i32>) -> bool {
    if !is_in_image(at) {
        return false;
    }
    let i = index(at);
    return !is_hole(frame, at) || (scratch[scratch_word(frame, FITTED, i)] == 1u && is_of_whole_hole(frame, i));
}

// Counts the pixels after pixel k of the block, in one direction, until one is not `there`; at most BESIDE.
fn run_px(k: i32, step: i32) -> i32 {
    var count = 0;
    while count < BESIDE && there[k + (count + 1) * step] != 0u {
        count++;
    }
    return count;
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn keep_solid(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    let count = list_holes(frame, group.xy, thread);
    if count == 0u {
        return;
    }
    let origin = vec2<i32>(group.xy * vec2<u32>(TILE_WIDTH, TILE_HEIGHT)) - BESIDE;
    for (var k = i32(thread); k < WIDE_WIDTH * WIDE_HEIGHT; k += i32(TILE_WIDTH * TILE_HEIGHT)) {
        let at = origin + vec2<i32>(k % WIDE_WIDTH, k / WIDE_WIDTH);
        there[k] = select(0u, 1u, is_there(frame, at));
    }
    workgroupBarrier();
    if thread >= count {
        return;
    }
    let at = listed_hole(group.xy, thread);
    let k = (at.y - origin.y) * WIDE_WIDTH + at.x - origin.x;
    if there[k] == 0u {
        return;
    }
    let across = 1 + run_px(k, 1) + run_px(k, -1);
    let down = 1 + run_px(k, WIDE_WIDTH) + run_px(k, -WIDE_WIDTH);
    if min(across, down) >= LEAST_STRIPE_PX {
        scratch[scratch_word(frame, FILLED, index(at))] = 1u;
    }
}
