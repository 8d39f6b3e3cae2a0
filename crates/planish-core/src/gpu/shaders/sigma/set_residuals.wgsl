// Computes residuals in standard deviations of the sensor (equation 17.1), smoothed ranges, and steps.

fn range_of(frame: u32, p: vec3<f32>) -> f32 {
    if p.x == NO_POINT {
        return NO_RANGE;
    }
    let ray = ray_to(frame, p);
    if (header_bits(frame, FLAGS) & BY_DISTANCE) != 0u {
        return length(ray);
    }
    return abs(depth_of(frame, ray));
}

fn measured_range(frame: u32, at: vec2<u32>) -> f32 {
    if IS_RAW_DEPTH || IS_DEPTH_METRES {
        let samples = frame * batch.input_words + HEADER_WORDS + batch.width + batch.height;
        let z = depth_at(frame, samples, at.y * batch.width + at.x);
        return select(NO_RANGE, z, z > 0.0);
    }
    return range_of(frame, point_at(frame, i32(at.x), i32(at.y)));
}

fn smoothed_range(frame: u32, at: vec2<u32>) -> f32 {
    let i = frame * batch.output_words + at.y * batch.width + at.x;
    let bits = vec3<u32>(output[i], output[i + pixels()], output[i + 2u * pixels()]);
    if !(is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z)) {
        return NO_RANGE;
    }
    return range_of(frame, bitcast<vec3<f32>>(bits));
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn set_residuals(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = id.xy;
    let frame = id.z;
    if at.x >= batch.width || at.y >= batch.height {
        return;
    }
    let range = smoothed_range(frame, at);
    var residual = NO_RESIDUAL;
    var is_step = false;
    if range >= 0.0 {
        let deviation_m = deviation(range);
        let measured = measured_range(frame, at);
        if measured >= 0.0 && is_on_surface(code(frame, batch.status_at, at)) {
            residual = clamp((measured - range) / deviation_m, -CLIP, CLIP);
        }
        let limit = max(STEP_DEVIATIONS * deviation_m, STEP_SHARE * range);
        let right = smoothed_range(frame, vec2<u32>(min(at.x + 1u, batch.width - 1u), at.y));
        let below = smoothed_range(frame, vec2<u32>(at.x, min(at.y + 1u, batch.height - 1u)));
        is_step = (right >= 0.0 && abs(range - right) > limit) || (below >= 0.0 && abs(range - below) > limit);
    }
    let i = frame * batch.scratch_words + at.y * batch.width + at.x;
    scratch[i] = residual;
    scratch[i + pixels()] = range;
    scratch[i + 2u * pixels()] = select(0.0, 1.0, is_step);
}
