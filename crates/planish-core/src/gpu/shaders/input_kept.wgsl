// The points kept by the first pass, in metres, so that later passes do not read the input again.

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, KEPT_POINT, u32(y) * batch.width + u32(x));
}
