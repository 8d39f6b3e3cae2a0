// The results of pixels from the surfaces of the cells around them (docs/method.md, section 10).

// Sum of the shares of all cells around a pixel.
const ALL_SHARES: f32 = 4.0;

// The cells around a pixel that count.
struct CellsAround {
    // Column and row of the first cell in the tile.
    first: vec2<u32>,
    // Distance in pixels from the first cell to the pixel.
    from_first: vec2<u32>,
    // Number of columns and rows: three for the first pixel of a cell, four for the second.
    size: vec2<u32>,
}

// Returns the weight of a column or row of cells, which falls linearly with its distance from the pixel, to 0 at
// `reach` pixels.
fn share_of(column: u32, from_first: u32, reach: f32) -> f32 {
    return 1.0 - abs(f32(CELL * column) - f32(from_first)) / reach;
}

fn cells_around(local: vec2<u32>) -> CellsAround {
    let place = local % CELL;
    return CellsAround(local / CELL, place + CELL * BEFORE, place + 3u);
}

// Sums over the surfaces around a point, weighted by how well they fit.
struct Voted {
    total: f32,
    // Sum of weight times certainty times |side|, the divisor of `height`.
    certain: f32,
    normal: vec3<f32>,
    height: f32,
    // Position in the tile of the cell with the largest weight.
    best: vec2<u32>,
}

fn vote_of(around: CellsAround, p: vec3<f32>, ray: vec3<f32>, to_mean: vec3<f32>, radius: f32, noise: f32) -> Voted {
    let gate = gate_of(radius);
    let per_noise = 1.0 / noise;
    let length = sqrt(dot(ray, ray));
    let towards = ray * (-1.0 / SIDE_COSINE / max(length, LEAST_RAY_M));
    var voted: Voted;
    var most = 0.0;
    // Cells less than three pixels away: two or three along each axis.
    let start = around.size - 3u;
    for (var row = start.y; row < 3u; row++) {
        let down = share_of(row, around.from_first.y, 3.0);
        for (var column = start.x; column < 3u; column++) {
            let place = around.first + vec2<u32>(column, row);
            let other = result_at(place);
            let offset = other.point - p;
            let nearness = min(unclamped(gate, square(offset)), 1.0);
            if !(nearness > 0.0) || dot(other.normal, other.normal) == 0.0 {
                continue;
            }
            let height = dot(offset, other.normal);
            let from_mean = (height - dot(to_mean, other.normal)) * per_noise;
            let root = 1.0 / fma(from_mean, from_mean, 1.0);
            let share = down * share_of(column, around.from_first.x, 3.0);
            // The product of `side` and the normal does not depend on the normal's orientation, unless the normal is
            // exactly perpendicular to the ray.
            let towards_side = select(dot(other.normal, towards), 1.0, length < LEAST_RAY_M);
            let side = clamp(abs(towards_side), LEAST_SIDE, 1.0) * select(1.0, -1.0, towards_side < 0.0);
            let fits = nearness * share * (root * root) * (root * root);
            let certain = fits * other.certainty * side;
            let weight = fits * (other.certainty + LEAST_CERTAINTY);
            if weight > most {
                most = weight;
                voted.best = place;
            }
            voted.total += fits;
            voted.certain += abs(certain);
            voted.height = fma(certain, height, voted.height);
            voted.normal = fma(vec3<f32>(weight * side), other.normal, voted.normal);
        }
    }
    return voted;
}

// The mean of the surfaces around a point that resemble its own.
struct Mean {
    height: f32,
    normal: vec3<f32>,
}

fn mean_around(around: CellsAround, point: vec3<f32>, own_normal: vec3<f32>, noise: f32) -> Mean {
    let per_width = 1.0 / (noise * MEAN_WIDTH);
    var total = 0.0;
    var heights = 0.0;
    var offsets = vec3<f32>(0.0);
    var normals = STAY_WEIGHT * own_normal;
    for (var row = 0u; row < around.size.y; row++) {
        let down = share_of(row, around.from_first.y, 4.0);
        for (var column = 0u; column < around.size.x; column++) {
            let other = result_at(around.first + vec2<u32>(column, row));
            let offset = other.point - point;
            let height = dot(offset, other.normal);
            let widths = height * per_width;
            let cosine = dot(own_normal, other.normal);
            let alike = clamp((abs(cosine) - ALIKE_FROM) / (ALIKE_TO - ALIKE_FROM), 0.0, 1.0);
            let share = down * share_of(column, around.from_first.x, 4.0) * other.certainty;
            let weight = max(fma(-widths, widths, 1.0), 0.0) * alike * share;
            let signed = select(weight, -weight, cosine < 0.0);
            total += weight;
            heights = fma(signed, height, heights);
            offsets = fma(vec3<f32>(weight), offset, offsets);
            normals = fma(vec3<f32>(signed), other.normal, normals);
        }
    }
    let normal = normalize(normals);
    let bend = dot(offsets, normal) - heights;
    let all_around = clamp((total / ALL_SHARES - AROUND_FROM) / (AROUND_TO - AROUND_FROM), 0.0, 1.0);
    return Mean(fma(0.5 * all_around, bend, heights) / (total + MEAN_STAY), normal);
}

// Returns the offset from a point to the mean of the block means less than two pixels away.
fn offset_to_mean(frame: u32, pixel: vec2<u32>, p: vec3<f32>, gate: f32) -> vec3<f32> {
    let place = pixel % CELL;
    // Both cells of a row or column count equally.
    let share = 1.0 / f32((place.x + 1u) * (place.y + 1u));
    let per_square = 1.0 / (gate * gate);
    var sum = vec3<f32>(0.0);
    var total = 0.0;
    for (var i = 0u; i < CELL * CELL; i++) {
        let after = vec2<u32>(i % CELL, i / CELL);
        let cell = pixel / CELL + after;
        if any(after > place) || is_outside(cell) {
            continue;
        }
        let offset = kept_at(frame, KEPT_MEAN, cell_index(cell)) - p;
        let nearness = fma(-square(offset), per_square, 1.0);
        if nearness > 0.0 {
            sum = fma(vec3<f32>(nearness * share), offset, sum);
            total += nearness * share;
        }
    }
    return sum / max(total, LEAST_MEANS);
}

fn step_onto(frame: u32, height: f32, normal: vec3<f32>, along: f32, ray: vec3<f32>) -> vec3<f32> {
    return select(height * normal, along * ray, is_on_ray(frame));
}

// Returns the result of a point that is on no surface around it, or so far away that its square may overflow f32.
fn unmoved(frame: u32, p: vec3<f32>, cell: u32, is_far: bool) -> PixelResult {
    let status = u32(planes[plane_word(frame, RESULT_STATUS, cell)]);
    let n = u32(abs(planes[plane_word(frame, FIRST_COUNT, cell)]));
    let keeps_normal = is_far && status >= STATUS_PLANE;
    if status >= STATUS_PLANE && !keeps_normal {
        return no_result(STATUS_TOO_FEW, 0u);
    }
    var result = no_result(status, n);
    if status < STATUS_DEGENERATE {
        return result;
    }
    result.point = bitcast<vec3<u32>>(p);
    if keeps_normal {
        result.normal = bitcast<vec3<u32>>(plane_vector(frame, RESULT_NORMAL, cell));
        result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, cell)]);
    }
    return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
}

fn result_of_pixel(frame: u32, origin: vec2<u32>, pixel: vec2<u32>, local: vec2<u32>) -> PixelResult {
    let p = point_at(frame, i32(pixel.x), i32(pixel.y));
    if p.x == NO_POINT {
        return no_result(STATUS_HOLE, 0u);
    }
    let own_cell = cell_index(pixel / CELL);
    let ray = ray_to(frame, p);
    let range = range_of(frame, ray);
    let radius = radius_at(frame, range);
    let noise = noise_at(frame, range, radius);
    var to_mean = vec3<f32>(0.0);
    if AVERAGES_BLOCKS {
        to_mean = offset_to_mean(frame, pixel, p, block_gate(frame, range));
    }
    let around = cells_around(local);
    let voted = vote_of(around, p, ray, to_mean, radius, noise);
    // Squares may overflow f32.
    let is_far = !(square(p) < MAX_RANGE_M * MAX_RANGE_M);
    if is_far || !(voted.total > LEAST_SURFACE_WEIGHT) {
        return unmoved(frame, p, own_cell, is_far);
    }
    // Divided by the total first, so that squares do not underflow.
    let normals = voted.normal / voted.total;
    let length = sqrt(dot(normals, normals));
    let agreeing = min(length / AGREEING, 1.0);
    let trust = agreeing * agreeing;
    // Normals of equal surfaces that face opposite sides cancel.
    let own_normal = select(normals / length, result_at(voted.best).normal, length < LEAST_NORMAL);
    let height = voted.height * trust / max(voted.certain, MIN_POSITIVE);
    let along = along_ray(height, own_normal, ray, radius);
    let first = step_onto(frame, height, own_normal, along, ray);
    let best = cell_index(origin / CELL + voted.best - BEFORE);
    let n = abs(planes[plane_word(frame, FIRST_COUNT, best)]);
    let mean = mean_around(around, p + first, own_normal, noise);
    let more = along_ray(mean.height * trust, mean.normal, ray, radius);
    let second = step_onto(frame, mean.height * trust, mean.normal, more, ray);
    // The sum of both steps stays within the limits of one step.
    let left = max(min(radius, MAX_ALONG * sqrt(dot(ray, ray))) - sqrt(dot(first, first)), 0.0);
    let share = left / max(max(sqrt(dot(second, second)), left), MIN_POSITIVE);
    var result = no_result(u32(planes[plane_word(frame, RESULT_STATUS, best)]), u32(n));
    result.point = bitcast<vec3<u32>>(p + fma(vec3<f32>(share), second, first));
    result.normal = bitcast<vec3<u32>>(mean.normal * select(1.0, -1.0, dot(mean.normal, ray) > 0.0));
    result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, best)]);
    let depth = depth_of(frame, ray);
    return with_depth(frame, fma(depth, fma(share, more, along), depth), result);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn results_of_pixels(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let pixel = origin + local.xy;
    load_results(frame, origin, thread);
    store(frame, origin, pixel, thread, result_of_pixel(frame, origin, pixel, local.xy));
}
