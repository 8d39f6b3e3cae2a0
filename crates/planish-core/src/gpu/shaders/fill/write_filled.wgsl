// Closes gaps for the last time, and writes the filled pixels into the result.

var<workgroup> codes: array<u32, TILE_WIDTH * TILE_HEIGHT>;

// Returns the patch of a filled pixel; one without samples for other pixels.
fn filled_patch(frame: u32, i: u32, at: vec2<i32>) -> Patch {
    if !is_in_image(at) || !is_hole(frame, at) {
        return no_patch();
    }
    if scratch[scratch_word(frame, FILLED, i)] != 0u {
        return patch_at(frame, i);
    }
    return close(frame, i, at, 2u);
}

fn set_word(frame: u32, channel: u32, i: u32, bits: u32) {
    output[frame * batch.output_words + channel * pixels() + i] = bits;
}

// Writes the channels of a filled pixel and returns its codes; 0 if it stays a hole.
fn write_pixel(frame: u32, i: u32, at: vec2<i32>) -> u32 {
    let found = filled_patch(frame, i, at);
    if found.samples == 0u {
        return 0u;
    }
    let z = 1.0 / found.inverse;
    var result = no_result(STATUS_FILLED, min(found.samples, 255u));
    result = with_depth(frame, z, result);
    // Depths outside the range of raw depth stay holes.
    if WANTS_DEPTH && (result.codes >> 16u) == 0u {
        return 0u;
    }
    let direction = vec2<f32>(ray(frame, u32(at.x)), ray(frame, batch.width + u32(at.y)));
    if WANTS_POINTS {
        let point = z * vec3<f32>(direction, 1.0);
        set_word(frame, POINTS_CHANNEL, i, bitcast<u32>(point.x));
        set_word(frame, POINTS_CHANNEL + 1u, i, bitcast<u32>(point.y));
        set_word(frame, POINTS_CHANNEL + 2u, i, bitcast<u32>(point.z));
    }
    if WANTS_NORMALS {
        // Over the pixels of a plane, 1/z is linear; its slopes determine the plane's equation.
        let plane = found.slopes * focal_lengths(frame) * z;
        let normal = -normalize(vec3<f32>(plane, 1.0 - dot(plane, direction)));
        set_word(frame, NORMALS_CHANNEL, i, bitcast<u32>(normal.x));
        set_word(frame, NORMALS_CHANNEL + 1u, i, bitcast<u32>(normal.y));
        set_word(frame, NORMALS_CHANNEL + 2u, i, bitcast<u32>(normal.z));
    }
    if WANTS_CURVATURE {
        set_word(frame, CURVATURE_CHANNEL, i, found.curvature);
    }
    if WANTS_DEPTH_M {
        set_word(frame, DEPTH_M_CHANNEL, i, bitcast<u32>(z));
    }
    if WANTS_SIGMA {
        set_word(frame, SIGMA_CHANNEL, i, bitcast<u32>(found.sigma_m));
    }
    return result.codes;
}

// Replaces fields of `bits` bits, shifted by `shift`, in the packed rows at `rows_at`; one thread per word.
fn replace_packed(frame: u32, rows_at: u32, origin: vec2<u32>, thread: u32, shift: u32, bits: u32) {
    let in_word = 32u / bits;
    let words_in_tile_row = TILE_WIDTH / in_word;
    let row = thread / words_in_tile_row;
    let word = thread % words_in_tile_row;
    let row_words = (batch.width + in_word - 1u) / in_word;
    let at = origin.x / in_word + word;
    if row >= TILE_HEIGHT || origin.y + row >= batch.height || at >= row_words {
        return;
    }
    let word_at = frame * batch.output_words + rows_at + (origin.y + row) * row_words + at;
    var packed = output[word_at];
    for (var k = 0u; k < in_word; k++) {
        let code = codes[row * TILE_WIDTH + word * in_word + k];
        if code != 0u {
            packed = insertBits(packed, extractBits(code, shift, bits), k * bits, bits);
        }
    }
    output[word_at] = packed;
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn write_filled(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = group.xy * vec2<u32>(TILE_WIDTH, TILE_HEIGHT);
    let at = origin + local.xy;
    codes[thread] = write_pixel(frame, at.y * batch.width + at.x, vec2<i32>(at));
    workgroupBarrier();
    // The statuses were read above and are replaced below.
    storageBarrier();
    var rows_at = CHANNELS * pixels();
    replace_packed(frame, rows_at, origin, thread, 0u, 8u);
    rows_at += batch.height * ((batch.width + 3u) / 4u);
    if WANTS_NEIGHBOURS {
        replace_packed(frame, rows_at, origin, thread, 8u, 8u);
        rows_at += batch.height * ((batch.width + 3u) / 4u);
    }
    if WANTS_DEPTH {
        replace_packed(frame, rows_at, origin, thread, 16u, 16u);
    }
}
