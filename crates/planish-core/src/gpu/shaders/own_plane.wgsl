// Smooths a point over the plane of its window (docs/method.md, section 4).

fn smooth_point(frame: u32, pixel: vec2<u32>, window: WindowOrigin, p: vec3<f32>) -> PixelResult {
    let ray = ray_to(frame, p);
    let radius = radius_at(frame, range_of(frame, ray));
    let sums = sums_of(window, p, gate_of(radius));
    let n = u32(sums.n);
    if n < 3u {
        return no_result(STATUS_TOO_FEW, n);
    }
    return result_of(frame, window, p, radius, LocalSurface(plane_of(ray, sums), sums.n, 0.0, vec3<f32>(0.0), 0.0));
}
