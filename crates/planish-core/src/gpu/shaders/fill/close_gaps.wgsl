// Closes gaps between filled pixels for the first time. Other threads may see FILLED of this pixel as 0 or 2; either
// way, they do not count the pixel as filled.

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn close_gaps(@builtin(global_invocation_id) id: vec3<u32>) {
    let frame = id.z;
    let i = id.y * batch.width + id.x;
    if id.x >= batch.width || id.y >= batch.height || !is_hole(frame, vec2<i32>(id.xy)) {
        return;
    }
    if scratch[scratch_word(frame, FILLED, i)] != 0u {
        return;
    }
    let found = close(frame, i, vec2<i32>(id.xy), 1u);
    if found.samples > 0u {
        store_patch(frame, i, found);
        scratch[scratch_word(frame, FILLED, i)] = 2u;
    }
}
