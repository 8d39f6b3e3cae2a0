// Closes gaps between filled pixels.

// Returns the mean of the surfaces of the neighbours that were filled by a round; a patch without samples unless enough
// neighbours are on one surface.
fn close(frame: u32, i: u32, at: vec2<i32>, last_round: u32) -> Patch {
    var least = FAR_BEYOND;
    var most = 0.0;
    var neighbours = 0u;
    // The neighbours that were filled, as bits.
    var filled = 0u;
    // The order of the directions determines which neighbour is the first.
    var steps = array<vec2<i32>, 8>(
        vec2<i32>(1, 0), vec2<i32>(-1, 0), vec2<i32>(0, 1), vec2<i32>(0, -1),
        vec2<i32>(1, 1), vec2<i32>(-1, -1), vec2<i32>(1, -1), vec2<i32>(-1, 1),
    );
    for (var k = 0u; k < 8u; k++) {
        let is_inside = is_in_image(at + steps[k]);
        let j = index(select(at, at + steps[k], is_inside));
        let near = inverse_at(frame, j);
        let in_round = scratch[scratch_word(frame, FILLED, j)];
        if is_inside && near != 0.0 {
            neighbours += 1u;
            least = min(least, near);
            most = max(most, near);
        } else if is_inside && in_round != 0u && in_round <= last_round {
            filled |= 1u << k;
        }
    }
    let patches = countOneBits(filled);
    if neighbours + patches < LEAST_NEIGHBOURS || patches < LEAST_FILLED {
        return no_patch();
    }
    var inverse = 0.0;
    var slopes = vec2<f32>(0.0);
    var found = no_patch();
    for (var k = 0u; k < 8u; k++) {
        if extractBits(filled, k, 1u) == 0u {
            continue;
        }
        let patch_there = patch_at(frame, index(at + steps[k]));
        inverse += patch_there.inverse - dot(vec2<f32>(steps[k]), patch_there.slopes);
        slopes += patch_there.slopes;
        least = min(least, patch_there.inverse);
        most = max(most, patch_there.inverse);
        found.sigma_m = max(found.sigma_m, patch_there.sigma_m);
        if k == firstTrailingBit(filled) {
            found.curvature = patch_there.curvature;
            found.samples = patch_there.samples;
        }
    }
    if is_step(least, most) {
        return no_patch();
    }
    found.inverse = inverse / f32(patches);
    found.slopes = slopes / f32(patches);
    if !is_possible(frame, i, found.inverse) {
        return no_patch();
    }
    return found;
}
