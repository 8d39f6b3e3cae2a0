// Moves each result onto the mean of the surfaces that the pixels of its block have found (docs/method.md, section 10).

// Half the width of a block gives this many places of one colour of a chessboard.
const PLACES: u32 = 2u * WINDOW * (WINDOW + 1u) + 1u;

// Weighted sums over surfaces around a point: offsets, normals, and heights over the point.
struct Around {
    total: f32,
    offset: vec3<f32>,
    normal: vec3<f32>,
    height: f32,
}

fn surfaces_around(block: u32, own: KeptResult, width: f32) -> Around {
    let per_width = 1.0 / width;
    var around: Around;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = row & 1u; column < SIDE; column += 2u) {
            let other = result_in_block(block, column, row);
            let offset = other.point - own.point;
            let height = dot(offset, other.normal);
            let widths = height * per_width;
            let cosine = dot(own.normal, other.normal);
            let alike = clamp((abs(cosine) - ALIKE_FROM) / (ALIKE_TO - ALIKE_FROM), 0.0, 1.0);
            let weight = max(fma(-widths, widths, 1.0), 0.0) * alike;
            // Rounding decides which side of a surface seen edge-on faces the sensor.
            let signed = select(weight, -weight, cosine < 0.0);
            around.total += weight;
            around.height = fma(signed, height, around.height);
            around.offset = fma(vec3<f32>(weight), offset, around.offset);
            around.normal = fma(vec3<f32>(signed), other.normal, around.normal);
        }
    }
    return around;
}

fn result_on_mean(frame: u32, pixel: vec2<u32>, block: u32) -> PixelResult {
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return no_result(STATUS_HOLE, 0u);
    }
    let at = pixel.y * batch.width + pixel.x;
    let p = kept_at(frame, KEPT_POINT, at);
    if p.x == NO_POINT {
        return no_result(STATUS_HOLE, 0u);
    }
    let n = u32(abs(planes[plane_word(frame, FIRST_COUNT, at)]));
    let status = u32(planes[plane_word(frame, RESULT_STATUS, at)]);
    var result = no_result(status, n);
    if status == STATUS_DEGENERATE {
        result.point = bitcast<vec3<u32>>(p);
        // Without a normal the depth is the point's own.
        return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
    }
    if status < STATUS_PLANE {
        return result;
    }
    let own = result_in_block(block, WINDOW, WINDOW);
    let width = planes[plane_word(frame, SURFACE_WIDTH, at)] * (MEAN_WIDTH / NARROW_WIDTH);
    let around = surfaces_around(block, own, width);
    let normal = normalize(around.normal);
    let bend = dot(around.offset, normal) - around.height;
    let all_around = clamp((around.total / f32(PLACES) - AROUND_FROM) / (AROUND_TO - AROUND_FROM), 0.0, 1.0);
    let height = fma(0.5 * all_around, bend, around.height) / around.total;
    let ray = ray_to(frame, p);
    let radius = radius_at(frame, range_of(frame, ray));
    let along = along_ray(height, normal, ray, radius);
    let moved = select(fma(vec3<f32>(height), normal, own.point), fma(vec3<f32>(along), ray, own.point), is_on_ray(frame));
    result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, at)]);
    let depth = planes[plane_word(frame, RESULT_DEPTH, at)];
    // Both steps together stay within the limits of one.
    let limit = min(radius, MAX_ALONG * sqrt(dot(ray, ray)));
    if f32(n) < LEAST_AVERAGED || !(square(moved - p) <= limit * limit) || !is_finite(bitcast<u32>(moved.x + moved.y + moved.z)) {
        let is_near = square(own.point) < MAX_RANGE_M * MAX_RANGE_M;
        result.point = bitcast<vec3<u32>>(select(p, own.point, is_near));
        result.normal = bitcast<vec3<u32>>(own.normal);
        return with_depth(frame, depth, result);
    }
    result.point = bitcast<vec3<u32>>(moved);
    result.normal = bitcast<vec3<u32>>(normal * select(1.0, -1.0, dot(normal, ray) > 0.0));
    return with_depth(frame, fma(depth_of(frame, ray), along, depth), result);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn average_surfaces(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let origin = origin_of(group);
    let pixel = origin + local.xy;
    load_results(group.z, origin, thread);
    store(group.z, origin, pixel, thread, result_on_mean(group.z, pixel, local.y * PITCH + local.x));
}
