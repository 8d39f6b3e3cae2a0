// Smooths a position over the plane of its neighbours (docs/method.md, section 4).

fn smooth_place(place: u32) -> PixelResult {
    let p = positions[place].xyz;
    let radius = max(radius_at(place, p), MIN_GATE_M);
    let sums = sums_of(p, radius);
    let n = u32(min(sums.n, MOST_COUNTED));
    if n < cloud.least_neighbours {
        return isolated(p, n);
    }
    return result_of(0u, place, p, radius, LocalSurface(plane_of(ray_to(0u, p), sums), f32(n), 0.0, vec3<f32>(0.0), 0.0));
}
