// The first pass where blocks are averaged (docs/method.md, section 2).

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn average_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let pixel = origin + local.xy * vec2<u32>(1u, STRIDE);
    load_candidates(frame, origin, thread);
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return;
    }
    let at = pixel.y * batch.width + pixel.x;
    let window = window_origin_of(frame, pixel, local.xy);
    let p = candidate(window, WINDOW, WINDOW);
    var mean = p;
    if p.x != NO_POINT {
        let gate = block_gate(frame, range_of(frame, ray_to(frame, p)));
        mean = block_mean(window, p, gate, vec3<f32>(0.0), 0.0);
    }
    keep_point(frame, KEPT_POINT, at, p);
    keep_point(frame, KEPT_MEAN, at, mean);
}
