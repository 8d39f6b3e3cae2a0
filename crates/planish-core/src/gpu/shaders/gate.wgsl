// The weight of a candidate by its distance, and sums over candidates within the gate (docs/method.md, sections 2 and
// 3).

struct Gate {
    // Slope of the weight over the squared distance.
    slope: f32,
}

fn gate_of(radius: f32) -> Gate {
    return Gate(-GATE_FADE / (radius * radius));
}

// Returns the weight of an offset by its squared length, before clamping to 0 to 1.
fn unclamped(gate: Gate, squared: f32) -> f32 {
    return fma(squared, gate.slope, GATE_FADE + 0.5);
}

// Sums over the neighbours, relative to p.
struct Sums {
    // Number of neighbours.
    n: f32,
    // Sum of the weights.
    total: f32,
    e: vec3<f32>,
    // xx, xy, xz
    x_row: vec3<f32>,
    // yy, yz, zz
    rest: vec3<f32>,
}

fn square(e: vec3<f32>) -> f32 {
    return fma(e.x, e.x, fma(e.y, e.y, e.z * e.z));
}
