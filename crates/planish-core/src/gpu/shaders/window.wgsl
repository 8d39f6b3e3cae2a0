// The neighbours of a pixel: the candidates within the radius, and their sums (docs/method.md, sections 2 and 3).
//
// Offsets e = q - p are in metres. NO_POINT, and any offset whose square overflows, fails the gate. The gate fades
// out, so that results change continuously.

// Returns the first pixel or cell of a tile. Each pixel or cell has one thread, each tile one workgroup, each frame
// one layer of workgroups. ROW_STEP workgroups share a block of rows; each has rows that are ROW_STEP apart.
fn origin_of(group: vec3<u32>) -> vec2<u32> {
    return vec2<u32>(group.x * TILE_WIDTH, group.y / ROW_STEP * (ROW_STEP * TILE_HEIGHT) + group.y % ROW_STEP);
}

// Returns the range at the end of a ray, clamped so that its square is finite. Beyond the clamp, the radius is at its
// limit or fixed.
fn range_of(frame: u32, ray: vec3<f32>) -> f32 {
    if IS_POINTS && (header_bits(frame, FLAGS) & BY_DISTANCE) != 0u {
        // Scaled, since the square of the ray may overflow.
        let largest = max(max(abs(ray.x), abs(ray.y)), max(abs(ray.z), MIN_POSITIVE));
        let scaled = ray / largest;
        return min(largest * sqrt(dot(scaled, scaled)), MAX_RANGE_M);
    }
    return min(abs(depth_of(frame, ray)), MAX_RANGE_M);
}

// Evaluates the polynomial in the range whose coefficients of 1, z and z² are in the header, starting at `field`.
fn polynomial_in_range(frame: u32, field: u32, range: f32) -> f32 {
    return fma(fma(range, header(frame, field + 2u), header(frame, field + 1u)), range, header(frame, field));
}

fn radius_at(frame: u32, range: f32) -> f32 {
    let radius = max(range * header(frame, RADIUS_LINEAR), polynomial_in_range(frame, RADIUS, range));
    return clamp(radius, MIN_GATE_M, MAX_RADIUS_M);
}

// First pass over the window. Uses masks instead of a branch: with so little to skip, a branch costs more.
fn sums_of(window: WindowOrigin, p: vec3<f32>, gate: Gate) -> Sums {
    var sums: Sums;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = 0u; column < SIDE; column++) {
            let offset = candidate(window, column, row) - p;
            let squared = square(offset);
            let nearness = unclamped(gate, squared);
            let is_neighbour = nearness > 0.0;
            let e = select(vec3<f32>(0.0), offset, is_neighbour);
            let weight = clamp(nearness, 0.0, 1.0);
            let weighted = weight * e;
            sums.n += select(0.0, 1.0, is_neighbour);
            sums.total += weight;
            sums.e += weighted;
            sums.x_row = fma(vec3<f32>(weighted.x), e, sums.x_row);
            sums.rest = fma(weighted.yyz, e.yzz, sums.rest);
        }
    }
    return sums;
}
