// Reads candidates directly from the frame if their tile does not fit into workgroup memory (docs/method.md, section
// 2).

// Frame, and column and row of a pixel's first candidate.
struct WindowOrigin {
    frame: u32,
    x: i32,
    y: i32,
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn window_origin_of(frame: u32, pixel: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    let first = vec2<i32>(pixel) - i32(WINDOW * STRIDE);
    return WindowOrigin(frame, first.x, first.y);
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    return sample_at(window.frame, window.x + i32(column * STRIDE), window.y + i32(row * STRIDE));
}
