// Fits the first planes if edges are kept: sections 2 to 4 for every cell (docs/method.md, section 10).

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn fit_first_planes(
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
    let p = centre_of(frame, cell, window);
    if !READS_MEANS {
        keep_point(frame, KEPT_POINT, at, p);
    }
    if p.x == NO_POINT {
        return;
    }
    let ray = ray_to(frame, p);
    let range = range_of(frame, ray);
    let radius = radius_at(frame, range);
    let gate = gate_of(radius);
    let sums = sums_of(window, p, gate);
    let plane = plane_of(ray, sums);
    // Scaled, since the square of the ray may overflow.
    let direction = ray / max(max(abs(ray.x), abs(ray.y)), max(abs(ray.z), MIN_POSITIVE));
    let cosine = abs(dot(plane.normal, direction)) / sqrt(dot(direction, direction));
    // Enough points, not collinear, on a plane not seen edge-on: each from 0 to 1.
    let enough = clamp(sums.total - MIN_TOTAL, 0.0, 1.0);
    let facing = clamp((cosine - MIN_INCIDENCE_COSINE) / COSINE_FADE, 0.0, 1.0);
    let usable = enough * clamp(plane.off_line, 0.0, 1.0) * facing;
    let noise = noise_at(frame, range, radius);
    let residual = fma(noise * noise * DOUBT_WEIGHT, plane.doubt, plane.residual) / max(usable, 1e-15);
    keep_vector(frame, FIRST_NORMAL, at, plane.normal);
    keep_vector(frame, FIRST_CENTROID, at, plane.centroid);
    planes[plane_word(frame, FIRST_SPREAD, at)] = plane.spread;
    planes[plane_word(frame, FIRST_RESIDUAL, at)] = select(NOT_USABLE, min(residual, NOT_USABLE), usable > 0.0);
    planes[plane_word(frame, FIRST_CURVATURE, at)] = plane.curvature;
    planes[plane_word(frame, FIRST_EXTENT, at)] = plane.extent_squared;
    planes[plane_word(frame, FIRST_COUNT, at)] = select(sums.n, -sums.n, plane.is_degenerate);
    planes[plane_word(frame, FIRST_BEND, at)] = window_bend(window, p, gate, plane, radius);
}
