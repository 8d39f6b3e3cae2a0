// Computes the key of each point, its position along a Hilbert curve: first the lowest bits, then, in the order
// sorted by them, the higher bits.

const LOWEST_BITS: u32 = 0u;

const CELL_BITS: u32 = 30u;
// Number of cells from the middle of the curve's box to its border.
const HALF: u32 = 1u << 29u;
// Number of doublings of the distance that the cells cover beyond most points. There, cells grow with the distance, so
// that stray points do not make the other cells coarser.
const OCTAVES: f32 = 64.0;

fn cell_of(p: vec3<f32>) -> vec3<u32> {
    let t = (p - cloud.middle) * cloud.per_half_extent;
    let within = 0.5 * abs(t);
    let beyond = 0.5 + log2(max(abs(t), vec3<f32>(1.0))) * (0.5 / OCTAVES);
    // Stay clear of the border: the curve ends in a corner, whose key marks holes.
    let u = min(select(within, beyond, abs(t) > vec3<f32>(1.0)), vec3<f32>(0.99999));
    // Relative to the middle, because f32 is finer near zero.
    let steps = vec3<u32>(u * f32(HALF));
    return select(HALF + steps, HALF - 1u - steps, t < vec3<f32>(0.0));
}

// Returns the position of a cell along the curve, with its bits not yet interleaved: Skilling's transposition
// ("Programming the Hilbert curve", 2004).
fn transposed(cell_: vec3<u32>) -> vec3<u32> {
    var cell = cell_;
    for (var bit = 1u << (CELL_BITS - 1u); bit > 1u; bit >>= 1u) {
        let below = bit - 1u;
        for (var axis = 0u; axis < 3u; axis++) {
            if (cell[axis] & bit) != 0u {
                cell.x ^= below;
            } else {
                let exchanged = (cell.x ^ cell[axis]) & below;
                cell.x ^= exchanged;
                cell[axis] ^= exchanged;
            }
        }
    }
    cell.y ^= cell.x;
    cell.z ^= cell.y;
    var flips = 0u;
    for (var bit = 1u << (CELL_BITS - 1u); bit > 1u; bit >>= 1u) {
        if (cell.z & bit) != 0u {
            flips ^= bit - 1u;
        }
    }
    return cell ^ vec3<u32>(flips);
}

// Spreads the low 10 bits, with two zeros between adjacent bits.
fn spread(low: u32) -> u32 {
    var value = low;
    value = (value | (value << 16u)) & 0x030000ffu;
    value = (value | (value << 8u)) & 0x0300f00fu;
    value = (value | (value << 4u)) & 0x030c30c3u;
    return (value | (value << 2u)) & 0x09249249u;
}

// Interleaves ten bits of each axis, from `from_bit` upwards.
fn interleaved(along: vec3<u32>, from_bit: u32) -> u32 {
    let bits = (along >> vec3<u32>(from_bit)) & vec3<u32>(0x3ffu);
    return (spread(bits.x) << 2u) | (spread(bits.y) << 1u) | spread(bits.z);
}

@compute @workgroup_size(256)
fn find_keys(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let place = number_of(group, groups) * 256u + thread;
    if place >= cloud.points {
        return;
    }
    if part.number == LOWEST_BITS {
        order[place] = place;
    }
    let i = order[place];
    var bits = sample_bits(i);
    if !(is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z)) {
        keys[place] = HOLE_KEY;
        store(i, no_result(STATUS_HOLE, 0u));
        return;
    }
    // -0 and 0 are the same position.
    bits = select(bits, vec3<u32>(0u), bits == vec3<u32>(0x80000000u));
    let p = bitcast<vec3<f32>>(bits);
    if any(abs(p) > vec3<f32>(MAX_RANGE_M)) {
        // Squared distances from this point may overflow f32.
        keys[place] = HOLE_KEY;
        store(i, isolated(p, 1u));
        return;
    }
    let along = transposed(cell_of(p));
    if part.number == LOWEST_BITS {
        keys[place] = vec2<u32>(0u, interleaved(along, 0u));
    } else {
        keys[place] = vec2<u32>(interleaved(along, 20u), interleaved(along, 10u));
    }
}
