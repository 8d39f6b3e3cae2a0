// Reads the pixels of a cell's block from the frame, if a tile of them does not fit into workgroup memory (docs/method.md,
// section 10).

// Frame, and column and row of the first pixel of a cell's block.
struct WindowOrigin {
    frame: u32,
    x: i32,
    y: i32,
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    let first = vec2<i32>(cell * CELL) - i32(WINDOW);
    return WindowOrigin(frame, first.x, first.y);
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    return point_at(window.frame, window.x + i32(column), window.y + i32(row));
}
