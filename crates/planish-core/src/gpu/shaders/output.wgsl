// The result in its readback layout: channels of words for numbers, rows of packed bytes and half-words for codes
// (layout.rs).
//
// Packed rows start at whole words, so a row of a tile also consists of whole words.

var<workgroup> codes: array<u32, TILE_WIDTH * TILE_HEIGHT>;

fn store_word(frame: u32, channel: u32, pixel: u32, bits: u32) {
    output[frame * batch.output_words + channel * batch.width * batch.height + pixel] = bits;
}

// Stores packed rows of fields of `bits` bits each, shifted by `shift`, after the channels; one thread per word.
fn store_packed(frame: u32, rows_at: u32, origin: vec2<u32>, thread: u32, shift: u32, bits: u32) {
    let in_word = 32u / bits;
    let words_in_tile_row = TILE_WIDTH / in_word;
    let row = thread / words_in_tile_row;
    let word = thread % words_in_tile_row;
    let row_words = (batch.width + in_word - 1u) / in_word;
    let y = origin.y + row * ROW_STEP;
    let at = origin.x / in_word + word;
    if row >= TILE_HEIGHT || y >= batch.height || at >= row_words {
        return;
    }
    var packed = 0u;
    for (var i = 0u; i < in_word; i++) {
        packed |= extractBits(codes[row * TILE_WIDTH + word * in_word + i], shift, bits) << (i * bits);
    }
    output[frame * batch.output_words + rows_at + y * row_words + at] = packed;
}

fn store(frame: u32, origin: vec2<u32>, pixel: vec2<u32>, thread: u32, result: PixelResult) {
    if pixel.x < batch.width && pixel.y < batch.height {
        let at = pixel.y * batch.width + pixel.x;
        if WANTS_POINTS {
            store_word(frame, POINTS_CHANNEL, at, result.point.x);
            store_word(frame, POINTS_CHANNEL + 1u, at, result.point.y);
            store_word(frame, POINTS_CHANNEL + 2u, at, result.point.z);
        }
        if WANTS_NORMALS {
            store_word(frame, NORMALS_CHANNEL, at, result.normal.x);
            store_word(frame, NORMALS_CHANNEL + 1u, at, result.normal.y);
            store_word(frame, NORMALS_CHANNEL + 2u, at, result.normal.z);
        }
        if WANTS_CURVATURE {
            store_word(frame, CURVATURE_CHANNEL, at, result.curvature);
        }
        if WANTS_DEPTH_M {
            store_word(frame, DEPTH_M_CHANNEL, at, result.depth_m);
        }
    }
    if WANTS_STATUS || WANTS_NEIGHBOURS || WANTS_DEPTH {
        codes[thread] = result.codes;
        workgroupBarrier();
        var rows_at = CHANNELS * batch.width * batch.height;
        if WANTS_STATUS {
            store_packed(frame, rows_at, origin, thread, 0u, 8u);
            rows_at += batch.height * ((batch.width + 3u) / 4u);
        }
        if WANTS_NEIGHBOURS {
            store_packed(frame, rows_at, origin, thread, 8u, 8u);
            rows_at += batch.height * ((batch.width + 3u) / 4u);
        }
        if WANTS_DEPTH {
            store_packed(frame, rows_at, origin, thread, 16u, 16u);
        }
    }
}
