// The frame as the camera gave it: depth or points, one struct of words a frame (layout.rs).
//
// Stage: copy or deproject (docs/method.md, section 1), in metres. What depth becomes is finite, since Camera::validate keeps
// rays and units within bounds.

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    let base = frame * batch.input_words + HEADER_WORDS;
    let pixel = u32(y) * batch.width + u32(x);
    if IS_DEPTH {
        let samples = base + batch.width + batch.height;
        let raw = (input[samples + (pixel >> 1u)] >> ((pixel & 1u) * 16u)) & 0xffffu;
        if raw == 0u || raw == SATURATED_DEPTH {
            return vec3<f32>(NO_POINT);
        }
        let z = f32(raw) * header(frame, METRES_PER_UNIT);
        let ray_x = bitcast<f32>(input[base + u32(x)]);
        let ray_y = bitcast<f32>(input[base + batch.width + u32(y)]);
        return vec3<f32>(ray_x * z, ray_y * z, z);
    }
    let pixels = batch.width * batch.height;
    let samples = base + batch.width + batch.height;
    let bits = vec3<u32>(input[samples + pixel], input[samples + pixels + pixel], input[samples + 2u * pixels + pixel]);
    if is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z) {
        return bitcast<vec3<f32>>(bits);
    }
    return vec3<f32>(NO_POINT);
}
