// The input frame: depth or points (layout.rs).
//
// Stage: copy or deproject (docs/method.md, section 1), in metres, in the cloud's frame. Deprojected depth is finite,
// since Camera::validate bounds rays and units.

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    let base = frame * batch.input_words + HEADER_WORDS;
    let pixel = u32(y) * batch.width + u32(x);
    let samples = base + batch.width + batch.height;
    if IS_RAW_DEPTH || IS_DEPTH_METRES {
        return deproject(frame, base, x, y, depth_at(frame, samples, pixel));
    }
    let pixels = batch.width * batch.height;
    let bits = vec3<u32>(input[samples + pixel], input[samples + pixels + pixel], input[samples + 2u * pixels + pixel]);
    if !(is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z)) {
        return vec3<f32>(NO_POINT);
    }
    return bitcast<vec3<f32>>(bits);
}

// Returns the depth in metres; 0 for a hole.
fn depth_at(frame: u32, samples: u32, pixel: u32) -> f32 {
    if IS_RAW_DEPTH {
        let raw = (input[samples + (pixel >> 1u)] >> ((pixel & 1u) * 16u)) & 0xffffu;
        return select(f32(raw) * header(frame, METRES_PER_UNIT), 0.0, raw == 0u || raw == SATURATED_DEPTH);
    }
    let bits = input[samples + pixel];
    return select(0.0, bitcast<f32>(bits), is_finite(bits));
}

fn deproject(frame: u32, base: u32, x: i32, y: i32, z: f32) -> vec3<f32> {
    if z <= 0.0 {
        return vec3<f32>(NO_POINT);
    }
    let ray_x = bitcast<f32>(input[base + u32(x)]);
    let ray_y = bitcast<f32>(input[base + batch.width + u32(y)]);
    let point = vec3<f32>(ray_x * z, ray_y * z, z);
    // Depth given in metres may be near the limit of f32, so the product may overflow.
    let is_point = is_finite(bitcast<u32>(point.x)) && is_finite(bitcast<u32>(point.y));
    return select(vec3<f32>(NO_POINT), point, is_point);
}
