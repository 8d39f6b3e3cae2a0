// The plane that a point lies on, as its own first plane and the eight around it say (docs/method.md, section 10).

fn smooth_point(frame: u32, pixel: vec2<u32>, window: WindowOrigin, p: vec3<f32>) -> PixelResult {
    let ray = ray_to(frame, p);
    let range = range_of(frame, ray);
    let radius = radius_at(frame, range);
    let surface = plane_at(frame, pixel, p, ray, radius, noise_at(frame, range, radius));
    let n = u32(surface.n);
    if n < 3u {
        return no_result(STATUS_TOO_FEW, n);
    }
    return result_of(frame, window, p, radius, surface);
}

fn plane_at(frame: u32, pixel: vec2<u32>, p: vec3<f32>, ray: vec3<f32>, radius: f32, noise: f32) -> LocalSurface {
    let own = pixel.y * batch.width + pixel.x;
    let per_variance = 1.0 / (noise * noise);
    var normal = vec3<f32>(0.0);
    var height = 0.0;
    var total = 0.0;
    for (var row = 0u; row < 3u; row++) {
        for (var column = 0u; column < 3u; column++) {
            let x = i32(pixel.x + column * EDGE_SHIFT) - i32(EDGE_SHIFT);
            let y = i32(pixel.y + row * EDGE_SHIFT) - i32(EDGE_SHIFT);
            if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
                continue;
            }
            let at = u32(y) * batch.width + u32(x);
            let offset = first_vec3(frame, FIRST_POINT, at) - p;
            if !(square(offset) <= radius * radius) {
                continue;
            }
            let own_residual = first_planes[first_at(frame, FIRST_RESIDUAL, at)];
            if own_residual == NOT_USABLE {
                continue;
            }
            let n = first_vec3(frame, FIRST_NORMAL, at);
            // From p to the plane along its normal.
            let to_plane = dot(offset, n) + first_planes[first_at(frame, FIRST_HEIGHT, at)];
            let residual = fma(DISTANCE_WEIGHT * to_plane, to_plane, own_residual);
            let root = 1.0 / fma(residual, per_variance, 1.0);
            let weight = (root * root) * (root * root);
            normal += weight * n;
            height += weight * to_plane;
            total += weight;
        }
    }
    let count = first_planes[first_at(frame, FIRST_COUNT, own)];
    var plane: Plane;
    var width = NARROW_WIDTH * noise;
    plane.is_degenerate = count < 0.0;
    plane.curvature = first_planes[first_at(frame, FIRST_CURVATURE, own)];
    plane.extent_squared = first_planes[first_at(frame, FIRST_EXTENT, own)];
    let is_usable = first_planes[first_at(frame, FIRST_RESIDUAL, own)] != NOT_USABLE;
    // Planes that agree on nothing may be further away than a point may move.
    if !is_usable || abs(height) > radius * total {
        plane.normal = first_vec3(frame, FIRST_NORMAL, own);
        plane.height = first_planes[first_at(frame, FIRST_HEIGHT, own)];
        // Every neighbour counts.
        width = 1e18;
    } else {
        // The other way round it is the same plane.
        let sign = select(1.0, -1.0, dot(normal, ray) > 0.0);
        plane.normal = normal * (sign / sqrt(dot(normal, normal)));
        plane.height = sign * height / total;
    }
    return LocalSurface(plane, abs(count), width);
}
