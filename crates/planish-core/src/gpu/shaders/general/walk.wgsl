// Walks through the nodes from the highest level down, without a stack: the last of eight siblings is followed by the
// sibling of their parent.

struct Walk {
    level: u32,
    node: u32,
    // The last leaf found.
    leaf: u32,
    is_done: bool,
}

fn new_walk() -> Walk {
    return Walk(cloud.top, 0u, 0u, false);
}

fn descend(walk: ptr<function, Walk>) {
    (*walk).level -= 1u;
    (*walk).node *= CHILDREN;
}

fn step_on(walk: ptr<function, Walk>) {
    (*walk).node += 1u;
    while (*walk).level < cloud.top && (*walk).node % CHILDREN == 0u {
        (*walk).level += 1u;
        (*walk).node /= CHILDREN;
    }
    (*walk).is_done = (*walk).level == cloud.top && (*walk).node >= cloud.top_nodes;
}

fn box_distance_squared(at: u32, p: vec3<f32>) -> f32 {
    let outside = max(max(nodes[at].xyz - p, p - nodes[at + 1u].xyz), vec3<f32>(0.0));
    return dot(outside, outside);
}

// Finds the next leaf within reach of p; returns false after the last.
fn next_leaf(walk: ptr<function, Walk>, p: vec3<f32>, reach_squared: f32) -> bool {
    while !(*walk).is_done {
        let at = NODE_WORDS * (level_at((*walk).level) + (*walk).node);
        let is_reached = box_distance_squared(at, p) <= reach_squared;
        if is_reached && (*walk).level > 0u {
            descend(walk);
            continue;
        }
        (*walk).leaf = (*walk).node;
        step_on(walk);
        if is_reached {
            return true;
        }
    }
    return false;
}

// Reports a walk that ended early to the host: some drivers stop long loops.
fn check_done(walk: Walk) {
    if !walk.is_done {
        atomicStore(&state[ENDED_EARLY], 1u);
    }
}
