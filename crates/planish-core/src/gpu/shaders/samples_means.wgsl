// The samples of the windows are the block means kept by an earlier pass.

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    let size = vec2<i32>(grid_size());
    if x < 0 || y < 0 || x >= size.x || y >= size.y {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, SAMPLES, u32(y * size.x + x));
}

// Returns the measured point of a cell.
fn centre_of(frame: u32, cell: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
    if is_outside(cell) {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, KEPT_POINT, cell_index(cell));
}
