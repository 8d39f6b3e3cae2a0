// Assigns consecutive indices to the distinct positions.

var<workgroup> sums: array<u32, SORT_THREADS>;

@compute @workgroup_size(SORT_THREADS)
fn place_heads(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = number_of(group, groups);
    let first = tile * TILE + thread * RUN;
    var own = 0u;
    for (var k = 0u; k < RUN; k++) {
        own += select(0u, 1u, is_head(first + k));
    }
    sums[thread] = own;
    workgroupBarrier();
    for (var reach = 1u; reach < SORT_THREADS; reach *= 2u) {
        let before = select(0u, sums[max(thread, reach) - reach], thread >= reach);
        workgroupBarrier();
        sums[thread] += before;
        workgroupBarrier();
    }
    if tile >= cloud.tiles {
        return;
    }
    var place = counts[tile] + sums[thread] - own;
    for (var i = first; i < min(first + RUN, cloud.points); i++) {
        if is_head(i) {
            positions[place] = vec4<f32>(bitcast<vec3<f32>>(position_bits(order[i])), 1.0);
            firsts[place] = i;
            place++;
        }
        // Undefined for holes.
        order_out[i] = place - 1u;
        // After the last valid point, store the end of the last run and the number of positions.
        if any(keys[i] != HOLE_KEY) && (i + 1u == cloud.points || all(keys[min(i + 1u, cloud.points - 1u)] == HOLE_KEY)) {
            firsts[place] = i + 1u;
            atomicStore(&state[PLACES], place);
        }
    }
}
