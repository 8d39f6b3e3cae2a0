// The results that the pass before this one has kept.

struct KeptResult {
    point: vec3<f32>,
    normal: vec3<f32>,
}

fn kept_result(frame: u32, x: i32, y: i32) -> KeptResult {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return KeptResult(vec3<f32>(0.0), vec3<f32>(0.0));
    }
    let at = u32(y) * batch.width + u32(x);
    return KeptResult(plane_vector(frame, RESULT_POINT, at), plane_vector(frame, RESULT_NORMAL, at));
}
