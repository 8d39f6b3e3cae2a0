// Counts the distinct positions that begin in each tile.

var<workgroup> found: atomic<u32>;

@compute @workgroup_size(SORT_THREADS)
fn count_heads(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = number_of(group, groups);
    if thread == 0u {
        atomicStore(&found, 0u);
    }
    workgroupBarrier();
    var own = 0u;
    for (var k = 0u; k < RUN; k++) {
        own += select(0u, 1u, is_head(tile * TILE + k * SORT_THREADS + thread));
    }
    atomicAdd(&found, own);
    workgroupBarrier();
    if thread == 0u && tile < cloud.tiles {
        counts[tile] = atomicLoad(&found);
    }
}
