// Declarations shared by all kernels for unorganized clouds (general/passes.rs declares the buffers).
//
// Points are sorted along a curve; equal positions become one entry with a count. 16 entries form a leaf, and 8 nodes
// form a node of the next level; the indices of a node's children follow from its index.

struct Cloud {
    // Number of points of the cloud, including holes.
    points: u32,
    // Number of tiles of the sort.
    tiles: u32,
    // The highest level of nodes.
    top: u32,
    // Number of nodes of the highest level.
    top_nodes: u32,
    // Centre of the box around most points.
    middle: vec3<f32>,
    // Inverse of half the largest extent of that box, in 1/m.
    per_half_extent: f32,
    // If radii follow the density: half the number of neighbours that evenly spread points would have.
    half_count: f32,
    // If radii follow the density: the largest radius in metres.
    largest_radius: f32,
    // Minimum number of neighbours; a point with fewer is isolated.
    least_neighbours: u32,
    // Number of positions in a part of the fit.
    part_places: u32,
    // Index of the first node of each level; after the highest level, the total number of nodes.
    levels: array<vec4<u32>, 3>,
    // Number of points that need results: those of a part without its halo. They come first.
    own_points: u32,
}

// Parameters that differ between the dispatches of a pass.
struct Part {
    number: u32,
}

const LEAF: u32 = 16u;
const CHILDREN: u32 = 8u;
// Number of words of four floats per node (node.wgsl).
const NODE_WORDS: u32 = 3u;
// Number of threads per tile of the sort.
const SORT_THREADS: u32 = 128u;
// Number of points per thread.
const RUN: u32 = 16u;
// Number of points per tile.
const TILE: u32 = SORT_THREADS * RUN;
// Word of the state: the number of positions.
const PLACES: u32 = 0u;
// Word of the state: not 0 if a walk ended before the last node.
const ENDED_EARLY: u32 = 1u;
// The key of holes, and of points beyond MAX_RANGE_M; no other point has it (keys.wgsl).
const HOLE_KEY: vec2<u32> = vec2<u32>(0xffffffffu, 0xffffffffu);

fn sample_bits(i: u32) -> vec3<u32> {
    let at = HEADER_WORDS + i;
    return vec3<u32>(input[at], input[at + cloud.points], input[at + 2u * cloud.points]);
}

fn level_at(level: u32) -> u32 {
    return cloud.levels[level / 4u][level % 4u];
}

// Returns the number of a workgroup. A dispatch uses two dimensions if one would exceed the device's limit.
fn number_of(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}
