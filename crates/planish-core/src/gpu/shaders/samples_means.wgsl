// The samples of the windows are the block means that a pass before this one has left.

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, KEPT_MEAN, u32(y) * batch.width + u32(x));
}

// The measured point of a pixel.
fn centre_of(frame: u32, pixel: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, KEPT_POINT, pixel.y * batch.width + pixel.x);
}
