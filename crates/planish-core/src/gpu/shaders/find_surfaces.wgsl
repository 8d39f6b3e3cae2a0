// Finds the plane of each point from its first plane and the eight around it and, if blocks are averaged, the mean of
// the points on that plane (docs/method.md, section 10).

struct Surface {
    normal: vec3<f32>,
    height: f32,
    width: f32,
    // Bend along the tangents of the normal: uu, uv and vv, in 1/m.
    bend: vec3<f32>,
    // From 0, if planes around the point fit, to 1, if none does.
    no_plane_fits: f32,
    certainty: f32,
}

// Returns the fourth power of 1/(1 + variance).
fn fit_by(variance: f32) -> f32 {
    let root = 1.0 / (1.0 + variance);
    return (root * root) * (root * root);
}

// Sums the nine planes, weighted by how well they fit a point.
fn vote(frame: u32, cell: vec2<u32>, p: vec3<f32>, to_mean: vec3<f32>, radius: f32, noise: f32) -> Around {
    let per_variance = 1.0 / (noise * noise);
    let gate = gate_of(radius * PLANE_REACH);
    var around: Around;
    for (var row = 0u; row < 3u; row++) {
        for (var column = 0u; column < 3u; column++) {
            let other = vec2<i32>(cell + vec2<u32>(column, row) * EDGE_SHIFT) - i32(EDGE_SHIFT);
            if any(other < vec2<i32>(0)) || is_outside(vec2<u32>(other)) {
                continue;
            }
            let at = cell_index(vec2<u32>(other));
            let offset = kept_at(frame, KEPT_POINT, at) - p;
            let nearness = unclamped(gate, square(offset));
            if !(nearness > 0.0) {
                continue;
            }
            let variance = planes[plane_word(frame, FIRST_RESIDUAL, at)];
            if variance >= NOT_USABLE {
                continue;
            }
            let n = plane_vector(frame, FIRST_NORMAL, at);
            let centroid = offset + plane_vector(frame, FIRST_CENTROID, at);
            // Distances to the plane along its normal, from p and from the mean.
            let to_plane = dot(centroid, n);
            let from_mean = to_plane - dot(to_mean, n);
            let residual = fma(DISTANCE_WEIGHT * from_mean, from_mean, variance);
            let weight = fit_by(residual * per_variance) * min(nearness, 1.0);
            around.fitting = fma(fit_by(variance * per_variance), min(nearness, 1.0), around.fitting);
            let counts = min(nearness / NEAR_ENOUGH, 1.0);
            around.normals = fma(vec3<f32>(counts), n, around.normals);
            around.count += counts;
            let weighted = weight * n;
            around.total += weight;
            around.height = fma(weight, to_plane, around.height);
            around.normal += weighted;
            around.offset = fma(vec3<f32>(weight), centroid, around.offset);
            around.offsets = plus_products(around.offsets, weight * centroid, centroid, 0.5);
            around.slopes = plus_products(around.slopes, weighted, centroid, 1.0);
            around.windows = fma(weight, planes[plane_word(frame, FIRST_BEND, at)], around.windows);
            around.spreads = fma(weight, planes[plane_word(frame, FIRST_SPREAD, at)], around.spreads);
        }
    }
    return around;
}

// Returns 0 if enough planes fit or their normals hardly turn, up to 1 if none fits.
fn lack_of_planes(around: Around) -> f32 {
    let lacking = clamp((FITTING_ENOUGH - around.fitting) / (FITTING_ENOUGH - FITTING_LEAST), 0.0, 1.0);
    let mean = length(around.normals) / max(around.count, NEAR_ENOUGH);
    let turning = 1.0 - mean + MISSING_PLANE * (9.0 - around.count);
    return lacking * clamp((turning - TURNING_FLAT) / (TURNING_ROUND - TURNING_FLAT), 0.0, 1.0);
}

// A unit normal towards the sensor, and the sign, 1 or -1, that turned the vote's normal towards it.
struct Facing {
    normal: vec3<f32>,
    sign: f32,
}

fn facing(normal: vec3<f32>, ray: vec3<f32>) -> Facing {
    let sign = select(1.0, -1.0, dot(normal, ray) > 0.0);
    return Facing(normal * (sign / sqrt(dot(normal, normal))), sign);
}

fn surface_of(frame: u32, cell: vec2<u32>, p: vec3<f32>, to_mean: vec3<f32>, ray: vec3<f32>, radius: f32, noise: f32) -> Surface {
    let own = cell_index(cell);
    let own_normal = plane_vector(frame, FIRST_NORMAL, own);
    // Without a plane, every neighbour counts.
    if planes[plane_word(frame, FIRST_COUNT, own)] < 3.0 {
        let height = dot(plane_vector(frame, FIRST_CENTROID, own), own_normal);
        return Surface(own_normal, height, 1e18, vec3<f32>(0.0), 0.0, 0.0);
    }
    let around = vote(frame, cell, p, to_mean, radius, noise);
    let found = facing(around.normal + OWN_NORMAL_WEIGHT * own_normal, ray);
    let turn = turn_of(around, radius, noise);
    let tangents = tangents_of(found.normal);
    var measured: Measured;
    // Most surfaces are flat.
    if turn.certain > 0.0 {
        measured = bend_around(around, turn, tangents, radius);
    }
    // Planes that disagree may be farther away than a point may move.
    let moved = clamp((around.height + measured.rise) / (around.total + STAY_WEIGHT), -radius, radius);
    let no_plane_fits = lack_of_planes(around);
    let certainty = around.total / (around.total + STAY_WEIGHT);
    let surface = Surface(found.normal, found.sign * moved, NARROW_WIDTH * noise, vec3<f32>(0.0), no_plane_fits, certainty);
    if bend_square(measured.bend) == 0.0 {
        return surface;
    }
    // The vote's normal applies at the centre of the planes; the slope at p differs.
    let tilt = bend_times(measured.bend, measured.centre);
    let tilted = facing(found.normal + tilt.x * tangents.u + tilt.y * tangents.v, ray);
    // Flipping the normal flips the sign of the bend.
    let bend = turned(measured.bend, tangents, tangents_of(tilted.normal)) * tilted.sign;
    return Surface(tilted.normal, tilted.sign * surface.height, surface.width, bend, no_plane_fits, certainty);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn find_surfaces(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let frame = group.z;
    let origin = origin_of(group);
    let cell = origin + local.xy * vec2<u32>(1u, ROW_STEP);
    load_candidates(frame, origin, thread);
    if is_outside(cell) {
        return;
    }
    let at = cell_index(cell);
    let window = window_origin_of(frame, cell, local.xy);
    let p = kept_at(frame, KEPT_POINT, at);
    if p.x == NO_POINT {
        if CELL > 1u {
            keep_point(frame, KEPT_SURFACE_MEAN, at, p);
        }
        return;
    }
    let ray = ray_to(frame, p);
    let range = range_of(frame, ray);
    let radius = radius_at(frame, range);
    let noise = noise_at(frame, range, radius);
    var to_mean = vec3<f32>(0.0);
    if AVERAGES_BLOCKS {
        to_mean = kept_at(frame, KEPT_MEAN, at) - p;
    }
    let surface = surface_of(frame, cell, p, to_mean, ray, radius, noise);
    keep_vector(frame, SURFACE_NORMAL, at, surface.normal);
    keep_vector(frame, SURFACE_BEND, at, surface.bend);
    planes[plane_word(frame, SURFACE_HEIGHT, at)] = surface.height;
    planes[plane_word(frame, SURFACE_WIDTH, at)] = surface.width;
    planes[plane_word(frame, SURFACE_NO_PLANE_FITS, at)] = surface.no_plane_fits;
    planes[plane_word(frame, SURFACE_CERTAINTY, at)] = surface.certainty;
    if CELL == 1u {
        return;
    }
    var mean = p;
    if AVERAGES_BLOCKS {
        let per_width = sqrt(1.0 - surface.no_plane_fits) / (BLOCK_WIDTH * surface.width);
        mean = block_mean(window, p, gate_of(block_gate(frame, range)), surface.normal * per_width, surface.height * per_width);
    }
    keep_point(frame, KEPT_SURFACE_MEAN, at, mean);
}
