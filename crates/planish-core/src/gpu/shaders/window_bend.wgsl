// The bend of a window (docs/method.md, section 10).

// Half the width of the middle of a window in samples. MIDDLE_SHARE is the spread of its samples divided by the
// spread of all samples.
const MIDDLE: u32 = WINDOW / 2u;

// Returns the sum of the principal curvatures in 1/m, from the mean height of the neighbours in the middle over the
// plane, which is fitted to all neighbours.
fn window_bend(window: WindowOrigin, p: vec3<f32>, gate: Gate, plane: Plane, radius: f32) -> f32 {
    var total = 0.0;
    var height = 0.0;
    for (var row = WINDOW - MIDDLE; row <= WINDOW + MIDDLE; row++) {
        for (var column = WINDOW - MIDDLE; column <= WINDOW + MIDDLE; column++) {
            let offset = candidate(window, column, row) - p;
            let nearness = unclamped(gate, square(offset));
            if nearness > 0.0 {
                let weight = min(nearness, 1.0);
                total += weight;
                height = fma(weight, dot(offset, plane.normal) - plane.height, height);
            }
        }
    }
    let spread = max(plane.spread, radius * radius * LEAST_SPREAD);
    let bend = height * (-4.0 / (1.0 - MIDDLE_SHARE)) / (max(total, 1.0) * spread);
    let most = MOST_WINDOW_BEND / radius;
    return clamp(bend, -most, most);
}
