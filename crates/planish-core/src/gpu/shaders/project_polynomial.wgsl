// The point on the polynomial over the plane (docs/method.md, section 7).

// Projects p onto the polynomial with the coefficients `c` (c_00, c_10 and c_01 in the units of the fit), or onto the
// plane if the polynomial is farther away than the radius or its height is NaN.
fn project_on_polynomial(frame: u32, p: vec3<f32>, plane: Plane, fit: Fit, c: vec3<f32>, radius: f32, n: f32) -> Projected {
    let height = c.x / fit.per_metre + plane.height;
    if !(height * height <= radius * radius) || !is_finite(bitcast<u32>(height)) {
        return project_on_plane(frame, p, plane, radius);
    }
    var normal = plane.normal;
    if WANTS_NORMALS || WANTS_DEPTH || WANTS_DEPTH_M || is_on_ray(frame) {
        normal = plane.normal - c.y * fit.u - c.z * fit.v;
        normal *= select(1.0, -1.0, dot(normal, ray_to(frame, p)) > 0.0) / sqrt(dot(normal, normal));
    }
    let status = select(STATUS_POLYNOMIAL_2, STATUS_POLYNOMIAL_3, DEGREE == 3u && n >= 10.0);
    return put_on_surface(frame, p, plane.normal, height, normal, radius, status);
}

fn surface_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> Projected {
    if surface.n < 6.0 {
        return project_on_plane(frame, p, surface.plane, radius);
    }
    let own_bandwidth = header(frame, BANDWIDTH);
    let bandwidth = select(radius, own_bandwidth, own_bandwidth > 0.0);
    let ridge = header(frame, RIDGE);
    let low_ridge = min(ridge, select(LOW_RIDGE, FEWEST_RIDGE, surface.n == 6.0));
    var fit: Fit;
    var c = vec3<f32>(0.0);
    // If no plane fits, a polynomial of all neighbours replaces the first, provided that it is close to them. This is
    // a loop because two copies of the fit would exceed the instruction cache.
    let rounds = select(1u, 2u, BENDS && surface.no_plane_fits > 0.0);
    for (var round = 0u; round < rounds; round++) {
        let of_all = BENDS && round == 1u;
        fit = fit_of(window, p, radius * radius, surface, select(surface.width, 1e18, of_all), bandwidth);
        let solution = solve(fit.moments, select(ridge, low_ridge, of_all), fit.extent_squared, surface.n);
        var share = 1.0;
        if of_all {
            let per_noise = NARROW_WIDTH / (surface.width * fit.per_metre);
            let variance = (fit.squares - solution.w) * per_noise * per_noise / fit.moments.m00;
            let close = clamp((CLOSE_TO - variance) / (CLOSE_TO - CLOSE_FROM), 0.0, 1.0);
            share = select(0.0, surface.no_plane_fits * close, fit.moments.m00 > 0.0);
        }
        c = mix(c, solution.xyz, share);
    }
    return project_on_polynomial(frame, p, surface.plane, fit, c, radius, surface.n);
}
