// Closes gaps between filled pixels.

// Returns the mean of the surfaces of the neighbours that were filled by a round; a patch without samples unless enough
// neighbours are on one surface.
fn close(frame: u32, i: u32, at: vec2<i32>, last_round: u32) -> Patch {
    var neighbours = 0u;
    var filled = 0u;
    var least = FAR_BEYOND;
    var most = 0.0;
    var inverse = 0.0;
    var slopes = vec2<f32>(0.0);
    var found = no_patch();
    // The order of the directions determines which neighbour is the first.
    var steps = array<vec2<i32>, 8>(
        vec2<i32>(1, 0), vec2<i32>(-1, 0), vec2<i32>(0, 1), vec2<i32>(0, -1),
        vec2<i32>(1, 1), vec2<i32>(-1, -1), vec2<i32>(1, -1), vec2<i32>(-1, 1),
    );
    for (var k = 0u; k < 8u; k++) {
        let step = steps[k];
        if !is_in_image(at + step) {
            continue;
        }
        let j = index(at + step);
        var near = inverse_at(frame, j);
        if near == 0.0 {
            let in_round = scratch[scratch_word(frame, FILLED, j)];
            if in_round == 0u || in_round > last_round {
                continue;
            }
            let patch_there = patch_at(frame, j);
            near = patch_there.inverse;
            inverse += near - dot(vec2<f32>(step), patch_there.slopes);
            slopes += patch_there.slopes;
            found.sigma_m = max(found.sigma_m, patch_there.sigma_m);
            if filled == 0u {
                found.curvature = patch_there.curvature;
                found.samples = patch_there.samples;
            }
            filled += 1u;
        }
        neighbours += 1u;
        least = min(least, near);
        most = max(most, near);
    }
    if neighbours < LEAST_NEIGHBOURS || filled < LEAST_FILLED || is_step(least, most) {
        return no_patch();
    }
    found.inverse = inverse / f32(filled);
    found.slopes = slopes / f32(filled);
    if !is_possible(frame, i, found.inverse) {
        return no_patch();
    }
    return found;
}
