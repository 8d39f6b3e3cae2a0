// Keeps the result in channels for the next pass.

fn store(frame: u32, origin: vec2<u32>, cell: vec2<u32>, thread: u32, result: PixelResult) {
    if is_outside(cell) {
        return;
    }
    let at = cell_index(cell);
    let status = result.codes & 0xffu;
    var normal = vec3<f32>(0.0);
    var point = vec3<f32>(0.0);
    if status >= STATUS_PLANE {
        normal = bitcast<vec3<f32>>(result.normal);
        // Sums over points must stay finite.
        point = clamp(bitcast<vec3<f32>>(result.point), vec3<f32>(-MAX_RANGE_M), vec3<f32>(MAX_RANGE_M));
    }
    keep_vector(frame, RESULT_NORMAL, at, normal);
    keep_vector(frame, RESULT_POINT, at, point);
    planes[plane_word(frame, RESULT_STATUS, at)] = f32(status);
}
