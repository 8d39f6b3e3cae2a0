// Radii from the density of the points (docs/method.md, section 8).
//
// The sum of 1 - d²/r² is convex and decreasing in u = 1/r², and linear between two candidates. Starting from a large
// radius, Newton's method reaches the solution without overshooting, and stops there.

// Maximum number of Newton steps; five to eight usually suffice.
const MOST_STEPS: u32 = 50u;
// Factor by which the squared reach grows if it contains too few points.
const NEXT_REACH: f32 = 2.25;

// Number of positions within a radius, and the sum of their squared distances.
struct Within {
    n: f32,
    sum: f32,
}

fn farthest_squared(at: u32, p: vec3<f32>) -> f32 {
    let farther = max(p - nodes[at].xyz, nodes[at + 1u].xyz - p);
    return dot(farther, farther);
}

fn within(p: vec3<f32>, limit: f32) -> Within {
    var found = Within(0.0, 0.0);
    var walk = new_walk();
    while true {
        var has_leaf = false;
        while !walk.is_done && !has_leaf {
            let at = NODE_WORDS * (level_at(walk.level) + walk.node);
            if box_distance_squared(at, p) < limit {
                if farthest_squared(at, p) < limit {
                    // The whole node is within the limit: add its moments.
                    let apart = nodes[at + 2u].xyz - p;
                    let count = nodes[at].w;
                    found.n += count;
                    found.sum += fma(count, dot(apart, apart), nodes[at + 1u].w);
                } else if walk.level > 0u {
                    descend(&walk);
                    continue;
                } else {
                    walk.leaf = walk.node;
                    has_leaf = true;
                }
            }
            step_on(&walk);
        }
        if !has_leaf {
            break;
        }
        // Test four positions at a time.
        for (var place = LEAF * walk.leaf; place < LEAF * (walk.leaf + 1u); place += 4u) {
            let squared = vec4<f32>(
                square(positions[place].xyz - p),
                square(positions[place + 1u].xyz - p),
                square(positions[place + 2u].xyz - p),
                square(positions[place + 3u].xyz - p),
            );
            let is_near = squared < vec4<f32>(limit);
            found.n += dot(select(vec4<f32>(0.0), vec4<f32>(1.0), is_near), vec4<f32>(1.0));
            found.sum += dot(select(vec4<f32>(0.0), squared, is_near), vec4<f32>(1.0));
        }
    }
    check_done(walk);
    return found;
}

// Returns the square of the fourth smallest distance to another position of the point's own leaf.
fn fourth_squared(p: vec3<f32>, leaf: u32) -> f32 {
    var nearest = vec4<f32>(MAX_RANGE_M * MAX_RANGE_M);
    for (var place = LEAF * leaf; place < LEAF * (leaf + 1u); place++) {
        let squared = square(positions[place].xyz - p);
        if squared > 0.0 {
            // Insert it into the four smallest, in ascending order.
            nearest = min(nearest, max(vec4<f32>(0.0, nearest.xyz), vec4<f32>(squared)));
        }
    }
    return nearest.w;
}

// Returns the smallest squared distance within which a whole node of the second level lies, or a whole leaf if the
// cloud has only one level.
fn crowd_squared(p: vec3<f32>) -> f32 {
    let level = min(1u, cloud.top);
    var nearest = NO_POINT * NO_POINT;
    var walk = new_walk();
    while !walk.is_done {
        let at = NODE_WORDS * (level_at(walk.level) + walk.node);
        if box_distance_squared(at, p) < nearest {
            if walk.level > level {
                descend(&walk);
                continue;
            }
            nearest = select(nearest, min(nearest, farthest_squared(at, p)), nodes[at].w > 0.0);
        }
        step_on(&walk);
    }
    check_done(walk);
    return nearest;
}

fn radius_of(place: u32) -> f32 {
    let p = positions[place].xyz;
    let largest = cloud.largest_radius * cloud.largest_radius;
    // Start with a radius derived from the density of the point's leaf, slightly enlarged and at most the largest
    // radius. Starting from too large a radius makes the search slow.
    let near = min(0.5 * cloud.half_count * min(fourth_squared(p, place / LEAF), largest), crowd_squared(p));
    var limit = clamp(near, 1e-12 * largest, largest);
    var found = within(p, limit);
    while (found.n - cloud.half_count) * limit < found.sum || found.n <= cloud.half_count {
        if limit >= largest {
            return cloud.largest_radius;
        }
        limit = min(max(NEXT_REACH * limit, MIN_POSITIVE), largest);
        found = within(p, limit);
    }
    for (var steps = 0u; steps < MOST_STEPS; steps++) {
        limit = found.sum / (found.n - cloud.half_count);
        let fewer = within(p, limit);
        if fewer.n == found.n || fewer.n <= cloud.half_count {
            break;
        }
        found = fewer;
    }
    return min(sqrt(limit), cloud.largest_radius);
}

// Returns a radius by density, raised to the radius by range within bounds. Rays are limited, so their squares are
// finite.
fn raised(p: vec3<f32>, radius: f32) -> f32 {
    if !HAS_SENSOR {
        return radius;
    }
    let ray = ray_to(0u, p);
    let range = min(sqrt(dot(ray, ray)), MAX_RANGE_M);
    let window = range * header(0u, RADIUS_LINEAR);
    let c = header_vec3(0u, RADIUS);
    let ranged = clamp(fma(fma(range, c.z, c.y), range, c.x), window, WINDOWS_IN_CLOUD * window);
    return min(max(radius, min(ranged, DENSITIES_IN_CLOUD * radius)), cloud.largest_radius);
}

@compute @workgroup_size(64)
fn find_radii(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let in_part = number_of(group, groups) * 64u + thread;
    let place = part.number * cloud.part_places + in_part;
    if in_part < cloud.part_places && place < atomicLoad(&state[PLACES]) {
        radii[place] = raised(positions[place].xyz, radius_of(place));
    }
}
