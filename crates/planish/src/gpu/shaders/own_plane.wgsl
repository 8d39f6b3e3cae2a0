// The plane that a point lies on: that of its own window (docs/method.md, section 4).

fn smooth_point(frame: u32, pixel: vec2<u32>, home: Home, p: vec3<f32>) -> Result {
    let radius = radius_at(frame, p.z);
    let sums = sums_of(home, p, radius * radius);
    let n = u32(sums.n);
    if n < 3u {
        return no_result(STATUS_TOO_FEW, n);
    }
    return result_of(frame, pixel, home, p, radius, Found(plane_of(p, sums), sums.n, 0.0));
}
