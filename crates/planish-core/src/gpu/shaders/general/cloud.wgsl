// Declarations shared by all kernels for unorganized clouds (general/passes.rs declares the buffers).
//
// Points are sorted along a curve; equal positions become one entry with a count. Each 16 entries are a leaf, each 8
// nodes a node of the next level; the indices of a node's children follow from its index.

struct Cloud {
    // The cloud's points, holes among them.
    points: u32,
    // Tiles of the sort.
    tiles: u32,
    // The highest level of nodes, and how many nodes it has.
    top: u32,
    top_nodes: u32,
    // The middle of most points, and one over half the extent of most.
    middle: vec3<f32>,
    per_half_extent: f32,
    // Half of the neighbours that evenly spread points would have, where radii follow the density, and the largest radius in metres.
    half_count: f32,
    largest_radius: f32,
    // A point with fewer is isolated.
    least_neighbours: u32,
    // Places in a part of the fit.
    part_places: u32,
    // Offset of each level of nodes.
    levels: array<vec4<u32>, 3>,
    // Number of points of a part that need results, without its halo; they come first.
    own_points: u32,
}

// Parameters that differ between the dispatches of a pass.
struct Part {
    number: u32,
}

const LEAF: u32 = 16u;
const CHILDREN: u32 = 8u;
// Words of four floats of a node (node.wgsl).
const NODE_WORDS: u32 = 3u;
// The points of a sort's tile are dealt to its threads in runs.
const SORT_THREADS: u32 = 128u;
const RUN: u32 = 16u;
const TILE: u32 = SORT_THREADS * RUN;
// Words of the state: how many positions there are; not 0 if a walk did not come to its end.
const PLACES: u32 = 0u;
const ENDED_EARLY: u32 = 1u;
// No key of a point (keys.wgsl).
const HOLE_KEY: vec2<u32> = vec2<u32>(0xffffffffu, 0xffffffffu);

fn sample_bits(i: u32) -> vec3<u32> {
    let at = HEADER_WORDS + i;
    return vec3<u32>(input[at], input[at + cloud.points], input[at + 2u * cloud.points]);
}

fn level_at(level: u32) -> u32 {
    return cloud.levels[level / 4u][level % 4u];
}

// The group's number, of a dispatch that may be wider than a device's limit.
fn number_of(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}
