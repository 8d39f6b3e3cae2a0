// Finds the plane of each point from its first plane and the eight around it and, if blocks are averaged, the mean of
// the points on that plane (docs/method.md, section 10).

struct Surface {
    normal: vec3<f32>,
    height: f32,
    width: f32,
}

fn surface_of(frame: u32, pixel: vec2<u32>, p: vec3<f32>, to_mean: vec3<f32>, ray: vec3<f32>, radius: f32, noise: f32) -> Surface {
    let own = pixel.y * batch.width + pixel.x;
    let per_variance = 1.0 / (noise * noise);
    let gate = gate_of(radius * PLANE_REACH);
    var normal = OWN_NORMAL_WEIGHT * normal_at(frame, FIRST_NORMAL, own);
    var height = 0.0;
    var total = STAY_WEIGHT;
    for (var row = 0u; row < 3u; row++) {
        for (var column = 0u; column < 3u; column++) {
            let x = i32(pixel.x + column * EDGE_SHIFT) - i32(EDGE_SHIFT);
            let y = i32(pixel.y + row * EDGE_SHIFT) - i32(EDGE_SHIFT);
            if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
                continue;
            }
            let at = u32(y) * batch.width + u32(x);
            let offset = kept_at(frame, KEPT_POINT, at) - p;
            let nearness = unclamped(gate, square(offset));
            if !(nearness > 0.0) {
                continue;
            }
            let own_residual = planes[plane_word(frame, FIRST_RESIDUAL, at)];
            if own_residual >= NOT_USABLE {
                continue;
            }
            let n = normal_at(frame, FIRST_NORMAL, at);
            // Distances to the plane along its normal, from p and from the mean.
            let to_plane = dot(offset, n) + planes[plane_word(frame, FIRST_HEIGHT, at)];
            let from_mean = to_plane - dot(to_mean, n);
            let residual = fma(DISTANCE_WEIGHT * from_mean, from_mean, own_residual);
            let root = 1.0 / fma(residual, per_variance, 1.0);
            let weight = (root * root) * (root * root) * min(nearness, 1.0);
            normal += weight * n;
            height += weight * to_plane;
            total += weight;
        }
    }
    // Without a plane every neighbour counts.
    if planes[plane_word(frame, FIRST_COUNT, own)] < 3.0 {
        return Surface(normal_at(frame, FIRST_NORMAL, own), planes[plane_word(frame, FIRST_HEIGHT, own)], 1e18);
    }
    // Planes that disagree may lie further away than a point may move. The other way round it is the same plane.
    let sign = select(1.0, -1.0, dot(normal, ray) > 0.0);
    let moved = clamp(height / total, -radius, radius);
    return Surface(normal * (sign / sqrt(dot(normal, normal))), sign * moved, NARROW_WIDTH * noise);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn find_surfaces(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let pixel = origin + local.xy * vec2<u32>(1u, STRIDE);
    load_candidates(frame, origin, thread);
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return;
    }
    let at = pixel.y * batch.width + pixel.x;
    let window = window_origin_of(frame, pixel, local.xy);
    let p = candidate(window, WINDOW, WINDOW);
    if p.x == NO_POINT {
        return;
    }
    let ray = ray_to(frame, p);
    let range = range_of(frame, ray);
    let radius = radius_at(frame, range);
    let noise = noise_at(frame, range, radius);
    var to_mean = vec3<f32>(0.0);
    if WINDOW > 0u {
        to_mean = kept_at(frame, KEPT_MEAN, at) - p;
    }
    let surface = surface_of(frame, pixel, p, to_mean, ray, radius, noise);
    keep_normal(frame, SURFACE_NORMAL, at, surface.normal);
    planes[plane_word(frame, SURFACE_HEIGHT, at)] = surface.height;
    planes[plane_word(frame, SURFACE_WIDTH, at)] = surface.width;
    if WINDOW > 0u {
        let per_width = 1.0 / (BLOCK_WIDTH * surface.width);
        let mean = block_mean(window, p, block_gate(frame, range), surface.normal * per_width, surface.height * per_width);
        keep_point(frame, KEPT_MEAN, at, mean);
    }
}
