// Computes the result of a point from its plane: sections 5 to 7 of docs/method.md.

// Returns the result of a point with at least 3 neighbours.
fn result_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> PixelResult {
    let n = u32(surface.n);
    if surface.plane.is_degenerate {
        var result = no_result(STATUS_DEGENERATE, n);
        result.point = bitcast<vec3<u32>>(p);
        // Without a normal, the depth is the point's own.
        return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
    }
    let projected = surface_of(frame, window, p, radius, surface);
    let result = PixelResult(
        bitcast<vec3<u32>>(projected.point),
        bitcast<vec3<u32>>(projected.normal),
        bitcast<u32>(surface.plane.curvature),
        NAN_BITS,
        projected.status | (n << 8u),
    );
    return with_depth(frame, depth_of(frame, ray_to(frame, p)) * projected.depth_scale, result);
}
