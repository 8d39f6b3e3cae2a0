// Computes the boxes and moments of the leaves, and the number of points at each position.

@compute @workgroup_size(64)
fn build_leaves(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let leaf = number_of(group, groups) * 64u + thread;
    if leaf >= nodes_of_level(0u) {
        return;
    }
    let places = atomicLoad(&state[PLACES]);
    let end = min(LEAF * (leaf + 1u), places);
    var node = empty_node();
    for (var place = LEAF * leaf; place < end; place++) {
        let p = positions[place].xyz;
        positions[place].w = f32(firsts[place + 1u] - firsts[place]);
        node = union_of(node, Node(p, p, 1.0, p, 0.0));
    }
    // Pad the last leaf with points that are never neighbours.
    for (var place = max(end, LEAF * leaf); place < LEAF * (leaf + 1u) && end > LEAF * leaf; place++) {
        positions[place] = vec4<f32>(NO_POINT, NO_POINT, NO_POINT, 0.0);
    }
    store_node(0u, leaf, node);
}
