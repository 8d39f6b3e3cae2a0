// The hole pixels of a tile. They are handled by the first threads of the workgroup, so that no warp has only a few.

// The hole bits of each row of the tile, which is as wide as a word.
var<workgroup> tile_rows: array<u32, TILE_HEIGHT>;
// The hole pixels, as indices of threads.
var<workgroup> tile_list: array<u32, TILE_WIDTH * TILE_HEIGHT>;
var<workgroup> tile_count: u32;

// Lists the hole pixels of a tile and returns their number.
fn list_holes(frame: u32, tile: vec2<u32>, thread: u32) -> u32 {
    if thread < TILE_HEIGHT {
        let row = tile.y * TILE_HEIGHT + thread;
        var bits = 0u;
        if row < batch.height {
            bits = scratch[hole_bits_word(frame, row, tile.x)];
        }
        tile_rows[thread] = bits;
    }
    workgroupBarrier();
    let column = thread % TILE_WIDTH;
    var count = 0u;
    var before = 0u;
    for (var row = 0u; row < TILE_HEIGHT; row++) {
        before = select(before, count, row == thread / TILE_WIDTH);
        count += countOneBits(tile_rows[row]);
    }
    let bits = tile_rows[thread / TILE_WIDTH];
    if extractBits(bits, column, 1u) != 0u {
        tile_list[before + countOneBits(bits & ((1u << column) - 1u))] = thread;
    }
    if thread == 0u {
        tile_count = count;
    }
    return workgroupUniformLoad(&tile_count);
}

// Returns hole pixel n of the tile.
fn listed_hole(tile: vec2<u32>, n: u32) -> vec2<i32> {
    let local = vec2<u32>(tile_list[n] % TILE_WIDTH, tile_list[n] / TILE_WIDTH);
    return vec2<i32>(tile * vec2<u32>(TILE_WIDTH, TILE_HEIGHT) + local);
}
