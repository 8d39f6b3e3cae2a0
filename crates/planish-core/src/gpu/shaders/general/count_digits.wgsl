// Counts the keys of each tile by digit.

var<workgroup> found: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(SORT_THREADS)
fn count_digits(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = number_of(group, groups);
    if thread < DIGITS {
        atomicStore(&found[thread], 0u);
    }
    workgroupBarrier();
    for (var k = 0u; k < RUN; k++) {
        let i = tile * TILE + k * SORT_THREADS + thread;
        if i < cloud.points {
            atomicAdd(&found[digit_of(keys[i])], 1u);
        }
    }
    workgroupBarrier();
    if thread < DIGITS && tile < cloud.tiles {
        counts[thread * cloud.tiles + tile] = atomicLoad(&found[thread]);
    }
}
