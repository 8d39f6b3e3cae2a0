// Closes gaps between filled pixels for the first time. Other threads may see FILLED of this pixel as 0 or 2; either
// way, they do not count the pixel as filled.

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn close_gaps(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let frame = group.z;
    if thread >= list_holes(frame, group.xy, thread) {
        return;
    }
    let at = listed_hole(group.xy, thread);
    let i = index(at);
    if scratch[scratch_word(frame, FILLED, i)] != 0u {
        return;
    }
    let found = close(frame, i, at, 1u);
    if found.samples > 0u {
        store_patch(frame, i, found);
        scratch[scratch_word(frame, FILLED, i)] = 2u;
    }
}
