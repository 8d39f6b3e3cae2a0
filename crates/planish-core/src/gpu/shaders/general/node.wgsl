// A node: the box of its positions, their number, their mean, and the sum of their squared distances from the mean.

struct Node {
    low: vec3<f32>,
    high: vec3<f32>,
    count: f32,
    mean: vec3<f32>,
    spread: f32,
}

fn empty_node() -> Node {
    return Node(vec3<f32>(NO_POINT), vec3<f32>(-NO_POINT), 0.0, vec3<f32>(0.0), 0.0);
}

fn union_of(a: Node, b: Node) -> Node {
    let count = a.count + b.count;
    let share = b.count / max(count, 1.0);
    let apart = b.mean - a.mean;
    let mean = fma(vec3<f32>(share), apart, a.mean);
    let spread = a.spread + b.spread + a.count * share * dot(apart, apart);
    return Node(min(a.low, b.low), max(a.high, b.high), count, mean, spread);
}

// Returns the number of nodes of a level, including those that pad the last group of children.
fn nodes_of_level(level: u32) -> u32 {
    return level_at(level + 1u) - level_at(level);
}

fn node_at(level: u32, number: u32) -> Node {
    let at = NODE_WORDS * (level_at(level) + number);
    let low = nodes[at];
    let high = nodes[at + 1u];
    return Node(low.xyz, high.xyz, low.w, nodes[at + 2u].xyz, high.w);
}

fn store_node(level: u32, number: u32, node: Node) {
    let at = NODE_WORDS * (level_at(level) + number);
    nodes[at] = vec4<f32>(node.low, node.count);
    nodes[at + 1u] = vec4<f32>(node.high, node.spread);
    nodes[at + 2u] = vec4<f32>(node.mean, 0.0);
}
