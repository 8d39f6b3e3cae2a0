// Reads candidates directly from the kept samples if their tile does not fit into workgroup memory (docs/method.md,
// section 10).

// Frame, and column and row of the cell in the middle of a window.
struct WindowOrigin {
    frame: u32,
    x: i32,
    y: i32,
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    return WindowOrigin(frame, i32(cell.x), i32(cell.y));
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    return sample_at(window.frame, window.x + offset_of(column), window.y + offset_of(row));
}
