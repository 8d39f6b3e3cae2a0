// Computes the results: sections 3 to 7 and 10, with the points within the radius as neighbours, one position per
// thread.

@compute @workgroup_size(64)
fn fit_places(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let in_part = number_of(group, groups) * 64u + thread;
    let place = part.number * cloud.part_places + in_part;
    if in_part >= cloud.part_places || place >= atomicLoad(&state[PLACES]) {
        return;
    }
    // The part's own points come first, and the sort is stable. If any point at a position is one of them, so is the
    // first point at that position.
    let point = order[firsts[place]];
    if point < cloud.own_points {
        store(point, smooth_place(place));
    }
}
