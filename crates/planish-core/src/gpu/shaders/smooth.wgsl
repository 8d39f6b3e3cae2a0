// Computes the results of a tile of pixels or cells.

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn smooth_frames(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let cell = origin + local.xy * vec2<u32>(1u, ROW_STEP);
    load_candidates(frame, origin, thread);
    let window = window_origin_of(frame, cell, local.xy);
    let p = centre_of(frame, cell, window);
    var result = no_result(STATUS_HOLE, 0u);
    if p.x != NO_POINT {
        result = smooth_point(frame, cell, window, p);
    }
    store(frame, origin, cell, thread, result);
}
