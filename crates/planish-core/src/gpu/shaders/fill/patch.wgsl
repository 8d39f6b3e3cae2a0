// The surface at a filled pixel.

struct Patch {
    inverse: f32,
    // Differences of 1/z from column to column and from row to row.
    slopes: vec2<f32>,
    sigma_m: f32,
    // Bits of the curvature.
    curvature: u32,
    // Number of points that the surface was fitted to; 0 if the pixel stays a hole.
    samples: u32,
}

fn no_patch() -> Patch {
    return Patch(0.0, vec2<f32>(0.0), 0.0, NAN_BITS, 0u);
}

fn patch_at(frame: u32, i: u32) -> Patch {
    return Patch(
        bitcast<f32>(scratch[scratch_word(frame, PATCH_INVERSE, i)]),
        vec2<f32>(
            bitcast<f32>(scratch[scratch_word(frame, PATCH_SLOPE_X, i)]),
            bitcast<f32>(scratch[scratch_word(frame, PATCH_SLOPE_Y, i)]),
        ),
        bitcast<f32>(scratch[scratch_word(frame, PATCH_SIGMA, i)]),
        scratch[scratch_word(frame, PATCH_CURVATURE, i)],
        scratch[scratch_word(frame, PATCH_SAMPLES, i)],
    );
}

fn store_patch(frame: u32, i: u32, found: Patch) {
    scratch[scratch_word(frame, PATCH_INVERSE, i)] = bitcast<u32>(found.inverse);
    scratch[scratch_word(frame, PATCH_SLOPE_X, i)] = bitcast<u32>(found.slopes.x);
    scratch[scratch_word(frame, PATCH_SLOPE_Y, i)] = bitcast<u32>(found.slopes.y);
    scratch[scratch_word(frame, PATCH_SIGMA, i)] = bitcast<u32>(found.sigma_m);
    scratch[scratch_word(frame, PATCH_CURVATURE, i)] = found.curvature;
    scratch[scratch_word(frame, PATCH_SAMPLES, i)] = found.samples;
}

// Returns true if a value of 1/z is within the frame's extent and contradicts no measurement that was lost in
// smoothing.
fn is_possible(frame: u32, i: u32, inverse: f32) -> bool {
    let most = bitcast<f32>(atomicLoad(&holes[frame_word(frame, LARGEST)]));
    let least = bitcast<f32>(INFINITE_BITS - atomicLoad(&holes[frame_word(frame, SMALLEST)]));
    if !(inverse >= (1.0 - RIM_SHARE) * least && inverse <= (1.0 + RIM_SHARE) * most) {
        return false;
    }
    if status_at(frame, i) != STATUS_TOO_FEW {
        return true;
    }
    let samples = frame * batch.input_words + HEADER_WORDS + batch.width + batch.height;
    let measured = depth_at(frame, samples, i);
    return measured <= 0.0 || !is_step(1.0 / measured, inverse);
}
