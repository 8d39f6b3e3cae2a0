// The plane that a point lies on: that of its own window (docs/method.md, section 4).

struct Found {
    plane: Plane,
    // How many neighbours.
    n: f32,
    // How far from the plane a neighbour counts, in metres; means nothing where KEEPS_EDGES is false.
    width: f32,
}

fn plane_at(frame: u32, pixel: vec2<u32>, home: Home, p: vec3<f32>, radius: f32) -> Found {
    let sums = sums_of(home, p, radius * radius);
    var found: Found;
    found.n = sums.n;
    if sums.n >= 3.0 {
        found.plane = plane_of(p, sums);
    }
    return found;
}
