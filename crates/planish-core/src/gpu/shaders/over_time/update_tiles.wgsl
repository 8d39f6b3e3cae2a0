// Tests whole tiles, which detects common motion below the noise (equations 16.4 to 16.6). One workgroup handles all
// tiles.

const THREADS: u32 = 256u;
// Number of values of a digit; medians are found four bits at a time.
const DIGITS: u32 = 16u;

var<workgroup> digits: array<atomic<u32>, 2u * DIGITS>;
// Numbers of tested tiles, of pairs of tested tiles, and of pairs that change alike.
var<workgroup> counts: array<atomic<u32>, 3>;

fn tile_word(channel: u32, tile: u32) -> u32 {
    return batch.tiles_at + channel * tiles() + tile;
}

// The mean change of a tile, and whether enough of its pixels count.
struct TileChange {
    change: f32,
    counts: bool,
}

fn change_of(tile: u32) -> TileChange {
    let count = bitcast<f32>(memory[tile_word(1u, tile)]);
    let change = bitcast<f32>(memory[tile_word(0u, tile)]) / max(count, 1.0);
    return TileChange(select(0.0, change, count > FEW), count > FEW);
}

fn bias_of(tile: u32) -> f32 {
    return select(bitcast<f32>(memory[tile_word(2u, tile)]), 0.0, batch.starts == 1u);
}

fn next_bias_of(tile: u32, change: f32) -> f32 {
    let bias = bias_of(tile);
    return fma(LEAK, change - bias, bias);
}

// Returns the median magnitudes of the changes and of the next biases. Non-negative floats have the same order as
// their bits.
fn medians(thread: u32, counted: u32) -> vec2<f32> {
    var found = vec2<u32>(0u);
    // Ranks of the medians among the tiles whose higher bits equal those found.
    var rank = vec2<u32>(counted / 2u);
    for (var shift = 28u; shift < 32u; shift -= 4u) {
        if thread < 2u * DIGITS {
            atomicStore(&digits[thread], 0u);
        }
        workgroupBarrier();
        for (var tile = thread; tile < tiles(); tile += THREADS) {
            let now = change_of(tile);
            if !now.counts {
                continue;
            }
            let bits = bitcast<vec2<u32>>(vec2<f32>(abs(now.change), abs(next_bias_of(tile, now.change))));
            let digit = (bits >> vec2<u32>(shift)) & vec2<u32>(DIGITS - 1u);
            // No prefix precedes the first digit, and WGSL does not allow a shift by 32.
            let is_alike = shift == 28u;
            if is_alike || (bits.x >> (shift + 4u)) == (found.x >> (shift + 4u)) {
                atomicAdd(&digits[digit.x], 1u);
            }
            if is_alike || (bits.y >> (shift + 4u)) == (found.y >> (shift + 4u)) {
                atomicAdd(&digits[DIGITS + digit.y], 1u);
            }
        }
        workgroupBarrier();
        for (var k = 0u; k < 2u; k++) {
            var digit = 0u;
            var before = 0u;
            loop {
                let here = atomicLoad(&digits[k * DIGITS + digit]);
                if before + here > rank[k] || digit == DIGITS - 1u {
                    break;
                }
                before += here;
                digit++;
            }
            rank[k] -= before;
            found[k] |= digit << shift;
        }
        workgroupBarrier();
    }
    return bitcast<vec2<f32>>(found);
}

// Counts tested tiles, their pairs, and the pairs that change alike.
fn count(thread: u32) {
    if thread < 3u {
        atomicStore(&counts[thread], 0u);
    }
    workgroupBarrier();
    var own = vec3<u32>(0u);
    for (var tile = thread; tile < tiles(); tile += THREADS) {
        let now = change_of(tile);
        if !now.counts {
            continue;
        }
        own.x++;
        let across = tiles_across();
        for (var k = 0u; k < 2u; k++) {
            let other = tile + PAIR * select(1u, across, k == 1u);
            let is_pair = select(tile % across + PAIR < across, other < tiles(), k == 1u);
            if !is_pair {
                continue;
            }
            let there = change_of(other);
            if there.counts {
                own.y++;
                own.z += select(0u, 1u, (now.change > 0.0) == (there.change > 0.0));
            }
        }
    }
    atomicAdd(&counts[0], own.x);
    atomicAdd(&counts[1], own.y);
    atomicAdd(&counts[2], own.z);
    workgroupBarrier();
}

@compute @workgroup_size(THREADS)
fn update_tiles(@builtin(local_invocation_index) thread: u32) {
    count(thread);
    let counted = atomicLoad(&counts[0]);
    let median = medians(thread, counted);
    var persistence = 0.0;
    var agreement = 0.5;
    if batch.knows_motion == 0u && counted >= LEAST_TILES && median.x > LEAST_CHANGE {
        persistence = median.y / median.x;
        let pairs = atomicLoad(&counts[1]);
        agreement = select(0.5, f32(atomicLoad(&counts[2])) / f32(max(pairs, 1u)), pairs > 0u);
    }
    let by_time = fourth_power(persistence / PERSISTENT);
    let by_place = fourth_power(max(agreement - 0.5, 0.0) / AGREEING);
    let of_camera = 1.0 / (1.0 + by_time * by_time + by_place);
    let gate = select(1.0, 2.0, batch.knows_motion == 1u);
    let learns = persistence <= PERSISTENT_NOISE && agreement <= AGREEING_NOISE;
    for (var tile = thread; tile < tiles(); tile += THREADS) {
        let now = change_of(tile);
        var bias = bias_of(tile);
        var variance = select(bitcast<f32>(memory[tile_word(3u, tile)]), FIRST_TILE_VARIANCE, batch.starts == 1u);
        var weight = of_camera;
        if now.counts {
            let deviation = sqrt(variance);
            let from_bias = min(abs(now.change - bias), 3.0 * deviation);
            bias = next_bias_of(tile, now.change);
            let by_change = fourth_power(now.change / (TILE_CHANGE * gate * deviation));
            let by_bias = fourth_power(bias / (TILE_BIAS * gate * deviation));
            weight = of_camera / (1.0 + by_change + by_bias);
            if learns {
                let learnt = LEARNT * from_bias * from_bias - variance;
                variance = clamp(fma(LEARN, learnt, variance), LEAST_TILE_VARIANCE, 1.0);
            }
        } else {
            bias = 0.0;
        }
        memory[tile_word(2u, tile)] = bitcast<u32>(bias);
        memory[tile_word(3u, tile)] = bitcast<u32>(variance);
        memory[tile_word(4u, tile)] = bitcast<u32>(weight);
    }
}
