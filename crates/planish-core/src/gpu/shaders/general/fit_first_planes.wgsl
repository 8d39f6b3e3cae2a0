// Computes the first planes, one position per thread (docs/method.md, section 10).

fn fit_first_plane(place: u32) {
    let p = positions[place].xyz;
    let radius = max(radius_at(place, p), MIN_GATE_M);
    let sums = sums_of(p, radius);
    let plane = plane_of(ray_to(0u, p), sums);
    let usable = clamp(sums.total - MIN_TOTAL, 0.0, 1.0) * clamp(plane.off_line, 0.0, 1.0);
    let least = radius * MIN_NOISE;
    let doubtful = fma(least, least, plane.residual) * fma(plane.doubt, DOUBT_WEIGHT, 1.0);
    let residual = select(NOT_USABLE, min(doubtful / max(usable, MIN_POSITIVE), NOT_USABLE), usable > 0.0);
    let n = min(sums.n, MOST_COUNTED);
    let at = PLANE_WORDS * place;
    planes[at + FIRST_NORMAL] = vec4<f32>(plane.normal, plane.height);
    planes[at + FIRST_NUMBERS] =
        vec4<f32>(residual, plane.curvature, select(n, -n, plane.is_degenerate), plane.extent_squared);
    planes[at + FIRST_RADIUS] = vec4<f32>(radius, 0.0, 0.0, 0.0);
}

@compute @workgroup_size(64)
fn fit_first_planes(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let in_part = number_of(group, groups) * 64u + thread;
    let place = part.number * cloud.part_places + in_part;
    if in_part < cloud.part_places && place < atomicLoad(&state[PLACES]) {
        fit_first_plane(place);
    }
}
