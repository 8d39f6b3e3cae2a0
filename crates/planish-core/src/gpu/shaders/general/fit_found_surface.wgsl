// Finds the plane of a position from the first planes around it (docs/method.md, section 10).

// The noise, and the mean of nearby positions relative to p, which replaces p in distances to planes.
struct Surroundings {
    // 1/noise²; 0 if no plane is usable.
    per_variance: f32,
    mean: vec3<f32>,
}

fn surroundings_of(p: vec3<f32>, radius: f32) -> Surroundings {
    let radius_squared = radius * radius;
    let plane_reach = PLANE_REACH * radius;
    let gate = gate_of(plane_reach);
    let mean_gate = gate_of(GENERAL_MEAN_REACH * radius);
    var total = 0.0;
    var inverse = 0.0;
    var near = 0.0;
    var mean = vec3<f32>(0.0);
    var walk = new_walk();
    while next_leaf(&walk, p, reach_squared_of(plane_reach * plane_reach)) {
        for (var place = LEAF * walk.leaf; place < LEAF * (walk.leaf + 1u); place++) {
            let offset = positions[place].xyz - p;
            let squared = square(offset);
            let nearness = clamp(unclamped(gate, squared), 0.0, 1.0);
            if nearness > 0.0 {
                total += nearness;
                let residual = planes[PLANE_WORDS * place + FIRST_NUMBERS].x;
                // Planes that fit well dominate the harmonic mean.
                inverse += select(nearness * (radius_squared / residual), 0.0, residual >= NOT_USABLE);
                let closeness = clamp(unclamped(mean_gate, squared), 0.0, 1.0);
                near += closeness;
                mean += closeness * offset;
            }
        }
    }
    check_done(walk);
    let per_variance = min(inverse / total, 1.0 / (MIN_NOISE * MIN_NOISE)) / radius_squared;
    return Surroundings(per_variance, mean / max(near, MIN_POSITIVE));
}

fn found_surface(place: u32, p: vec3<f32>, radius: f32, own: Plane, n: f32) -> LocalSurface {
    // Without a plane, every neighbour counts.
    let unchanged = LocalSurface(own, n, 1e37, vec3<f32>(0.0), 0.0);
    if n < 3.0 || own.is_degenerate {
        return unchanged;
    }
    let around = surroundings_of(p, radius);
    if !(around.per_variance > 0.0) {
        return unchanged;
    }
    let plane_reach = PLANE_REACH * radius;
    let gate = gate_of(plane_reach);
    var normal = OWN_NORMAL_WEIGHT * own.normal;
    var height = 0.0;
    var total = STAY_WEIGHT;
    var walk = new_walk();
    while next_leaf(&walk, p, reach_squared_of(plane_reach * plane_reach)) {
        for (var other = LEAF * walk.leaf; other < LEAF * (walk.leaf + 1u); other++) {
            let offset = positions[other].xyz - p;
            let nearness = unclamped(gate, square(offset));
            if !(nearness > 0.0) {
                continue;
            }
            let own_residual = planes[PLANE_WORDS * other + FIRST_NUMBERS].x;
            if own_residual >= NOT_USABLE {
                continue;
            }
            let first = planes[PLANE_WORDS * other + FIRST_NORMAL];
            // Distances to the plane along its normal, from p and from the mean.
            let to_plane = dot(offset, first.xyz) + first.w;
            let from_mean = to_plane - dot(around.mean, first.xyz);
            let residual = fma(GENERAL_DISTANCE_WEIGHT * from_mean, from_mean, own_residual);
            let root = 1.0 / fma(residual, around.per_variance, 1.0);
            let weight = (root * root) * (root * root) * min(nearness, 1.0);
            // Flip normals that point the other way.
            let facing = clamp(dot(own.normal, first.xyz) / FACING_COSINE, -1.0, 1.0);
            normal += weight * facing * first.xyz;
            height += weight * facing * to_plane;
            total += weight * abs(facing);
        }
    }
    check_done(walk);
    // Planes that disagree may be farther away than a point may move. Flipping the normal also flips the height.
    let sign = select(1.0, -1.0, dot(normal, ray_to(0u, p)) > 0.0);
    var found = own;
    found.normal = normal * (sign / sqrt(dot(normal, normal)));
    found.height = sign * clamp(height / total, -radius, radius);
    return LocalSurface(found, n, NARROW_WIDTH * inverseSqrt(around.per_variance), vec3<f32>(0.0), 0.0);
}

fn smooth_place(place: u32) -> PixelResult {
    let p = positions[place].xyz;
    let at = PLANE_WORDS * place;
    let first = planes[at + FIRST_NORMAL];
    let numbers = planes[at + FIRST_NUMBERS];
    let n = abs(numbers.z);
    if u32(n) < cloud.least_neighbours {
        return isolated(p, u32(n));
    }
    var own: Plane;
    own.normal = first.xyz;
    own.height = first.w;
    own.curvature = numbers.y;
    own.is_degenerate = numbers.z < 0.0;
    own.extent_squared = numbers.w;
    let radius = planes[at + FIRST_RADIUS].x;
    return result_of(0u, place, p, radius, found_surface(place, p, radius, own, n));
}
