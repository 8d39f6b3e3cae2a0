// Adds up the sizes of holes, and flags those with two surfaces at their rim.

// Returns true if points near a pixel belong to two surfaces.
fn has_step_near(frame: u32, at: vec2<i32>) -> bool {
    var least = FAR_BEYOND;
    var most = 0.0;
    for (var y = -RIM_PX; y <= RIM_PX; y++) {
        for (var x = -RIM_PX; x <= RIM_PX; x++) {
            let near = at + vec2<i32>(x, y);
            if is_in_image(near) {
                let inverse = inverse_at(frame, index(near));
                least = min(least, select(FAR_BEYOND, inverse, inverse > 0.0));
                most = max(most, inverse);
            }
        }
    }
    return least < most && is_step(least, most);
}

fn is_point(frame: u32, at: vec2<i32>) -> bool {
    return is_in_image(at) && !is_hole(frame, at);
}

// Returns true at the ends of runs, and next to points above or below.
fn is_rim(frame: u32, at: vec2<i32>) -> bool {
    let is_end = at.x == 0 || at.x + 1 == i32(batch.width) || is_point(frame, at - vec2<i32>(1, 0))
        || is_point(frame, at + vec2<i32>(1, 0));
    return is_end || is_point(frame, at - vec2<i32>(0, 1)) || is_point(frame, at + vec2<i32>(0, 1));
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn measure_holes(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    if thread >= list_holes(frame, group.xy, thread) {
        return;
    }
    let at = listed_hole(group.xy, thread);
    let i = index(at);
    let hole = first_pixel(frame, i);
    if hole != i {
        atomicStore(&holes[hole_word(frame, LABEL, i)], hole);
        // The size of a run that is not the hole's first run.
        let length = atomicLoad(&holes[hole_word(frame, SIZE, i)]);
        if length > 0u {
            atomicAdd(&holes[hole_word(frame, SIZE, hole)], length);
        }
    }
    if is_rim(frame, at) && has_step_near(frame, at) {
        atomicOr(&holes[hole_word(frame, TALLY, hole)], HAS_STEP);
    }
}
