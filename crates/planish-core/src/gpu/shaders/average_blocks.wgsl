// The first pass if blocks are averaged or pixels share cells (docs/method.md, sections 2 and 10).

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn average_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let cell = origin + local.xy * vec2<u32>(1u, ROW_STEP);
    load_candidates(frame, origin, thread);
    if is_outside(cell) {
        return;
    }
    let at = cell_index(cell);
    let window = window_origin_of(frame, cell, local.xy);
    let p = middle_of(window);
    var mean = p;
    if AVERAGES_BLOCKS && p.x != NO_POINT {
        let gate = gate_of(block_gate(frame, range_of(frame, ray_to(frame, p))));
        mean = block_mean(window, p, gate, vec3<f32>(0.0), 0.0);
    }
    keep_point(frame, KEPT_POINT, at, p);
    keep_point(frame, KEPT_MEAN, at, mean);
}
