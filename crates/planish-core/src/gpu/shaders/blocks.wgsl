// The means of blocks of points (docs/method.md, sections 2 and 10). The windows of this pass are the blocks.

// Returns the first valid point of the pixels in the middle of a block, which form a cell.
fn middle_of(window: WindowOrigin) -> vec3<f32> {
    var p = candidate(window, WINDOW, WINDOW);
    for (var i = 1u; i < CELL * CELL && p.x == NO_POINT; i++) {
        p = candidate(window, WINDOW + i % CELL, WINDOW + i / CELL);
    }
    return p;
}

// Returns the maximum distance between a pixel's point at this range and the points of its block.
fn block_gate(frame: u32, range: f32) -> f32 {
    let gate_m = max(range * header(frame, BLOCK_LINEAR), polynomial_in_range(frame, BLOCK, range));
    return clamp(gate_m, MIN_GATE_M, MAX_RADIUS_M);
}

// Returns the mean around p. A point's weight decreases with its distance from a plane, measured in widths. With
// `normal_per_width` and `height_in_widths` of 0, the plane has no effect.
fn block_mean(window: WindowOrigin, p: vec3<f32>, gate: Gate, normal_per_width: vec3<f32>, height_in_widths: f32) -> vec3<f32> {
    var sum = vec3<f32>(0.0);
    var total = 0.0;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = 0u; column < SIDE; column++) {
            let offset = candidate(window, column, row) - p;
            let squared = square(offset);
            let nearness = unclamped(gate, squared);
            let e = select(vec3<f32>(0.0), offset, nearness > 0.0);
            let f = dot(e, normal_per_width) - height_in_widths;
            let on_surface = max(fma(-f, f, 1.0), MIN_BLOCK_WEIGHT);
            let weight = clamp(nearness, 0.0, 1.0) * on_surface * on_surface;
            sum = fma(vec3<f32>(weight), e, sum);
            total += weight;
        }
    }
    // The total is positive, since p itself has a weight.
    return p + sum / total;
}
