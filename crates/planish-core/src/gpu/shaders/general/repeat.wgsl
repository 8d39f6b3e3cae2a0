// Copies the result of the first point at each position to the others.

@compute @workgroup_size(256)
fn repeat_results(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = number_of(group, groups) * 256u + thread;
    if i >= cloud.points || all(keys[i] == HOLE_KEY) {
        return;
    }
    let first = firsts[order_out[i]];
    if i == first {
        return;
    }
    var channels = CHANNELS;
    if WANTS_STATUS || WANTS_NEIGHBOURS {
        channels += 1u;
    }
    for (var channel = 0u; channel < channels; channel++) {
        output[channel * batch.width + order[i]] = output[channel * batch.width + order[first]];
    }
}
