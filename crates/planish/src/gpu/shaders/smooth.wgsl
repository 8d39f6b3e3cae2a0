// From the plane that each point lies on to its result: sections 5 to 7.

// Of a point with 3 neighbours or more.
fn result_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> PixelResult {
    let n = u32(surface.n);
    if surface.plane.is_degenerate {
        var result = no_result(STATUS_DEGENERATE, n);
        result.point = bitcast<vec3<u32>>(p);
        // Without a normal the depth is the point's own.
        return with_depth(frame, p, 1.0, result);
    }
    let projected = surface_of(frame, window, p, radius, surface);
    let result = PixelResult(
        bitcast<vec3<u32>>(projected.point),
        bitcast<vec3<u32>>(projected.normal),
        bitcast<u32>(surface.plane.curvature),
        NAN_BITS,
        projected.status | (n << 8u),
    );
    return with_depth(frame, p, projected.depth_scale, result);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn smooth_frames(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let pixel = origin + local.xy * vec2<u32>(1u, STRIDE);
    load_candidates(frame, origin, thread);
    let window = window_origin_of(frame, pixel, local.xy);
    let p = centre_of(frame, pixel, window);
    var result = no_result(STATUS_HOLE, 0u);
    if p.x != NO_POINT {
        result = smooth_point(frame, pixel, window, p);
    }
    store(frame, origin, pixel, thread, result);
}
