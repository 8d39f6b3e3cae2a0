// Writes each point's radius by density, before its limit, or NaN for a hole. Overwrites the results, which the host
// has already read.

@compute @workgroup_size(256)
fn write_point_radii(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = number_of(group, groups) * 256u + thread;
    if i >= cloud.points {
        return;
    }
    var radius = NAN_BITS;
    if any(keys[i] != HOLE_KEY) {
        radius = bitcast<u32>(radii[order_out[i]]);
    }
    output[order[i]] = radius;
}
