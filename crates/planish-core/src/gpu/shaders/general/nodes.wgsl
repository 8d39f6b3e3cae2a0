// Builds the nodes of a level from those of the level below.

@compute @workgroup_size(64)
fn build_nodes(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let level = part.number;
    let number = number_of(group, groups) * 64u + thread;
    if number >= nodes_of_level(level) {
        return;
    }
    var node = empty_node();
    let below = nodes_of_level(level - 1u);
    for (var child = CHILDREN * number; child < min(CHILDREN * (number + 1u), below); child++) {
        node = union_of(node, node_at(level - 1u, child));
    }
    store_node(level, number, node);
}
