// The result in channels for the pass after this one.

fn store(frame: u32, origin: vec2<u32>, pixel: vec2<u32>, thread: u32, result: PixelResult) {
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return;
    }
    let at = pixel.y * batch.width + pixel.x;
    let status = result.codes & 0xffu;
    var normal = vec3<f32>(0.0);
    var point = vec3<f32>(0.0);
    if status >= STATUS_PLANE {
        normal = bitcast<vec3<f32>>(result.normal);
        // Sums over points must stay finite.
        point = clamp(bitcast<vec3<f32>>(result.point), vec3<f32>(-MAX_RANGE_M), vec3<f32>(MAX_RANGE_M));
        planes[plane_word(frame, RESULT_DEPTH, at)] = bitcast<f32>(result.depth_m);
    }
    keep_vector(frame, RESULT_NORMAL, at, normal);
    keep_vector(frame, RESULT_POINT, at, point);
    planes[plane_word(frame, RESULT_STATUS, at)] = f32(status);
}
