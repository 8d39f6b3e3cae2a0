// The candidates of a tile of cells, in workgroup memory (docs/method.md, section 10): the samples of the cells around
// the tile. x, y and z are separate arrays, in which the threads of a row read adjacent words.

const REACH: u32 = (WINDOW * STRIDE + CELL - 1u) / CELL;
const PITCH: u32 = TILE_WIDTH + 2u * REACH;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * REACH);

var<workgroup> tile_x: array<f32, TILE_AREA>;
var<workgroup> tile_y: array<f32, TILE_AREA>;
var<workgroup> tile_z: array<f32, TILE_AREA>;

// Index of the cell in the middle of a window.
alias WindowOrigin = u32;

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
    let first = vec2<i32>(origin) - i32(REACH);
    for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
        let p = sample_at(frame, first.x + i32(i % PITCH), first.y + i32(i / PITCH));
        tile_x[i] = p.x;
        tile_y[i] = p.y;
        tile_z[i] = p.z;
    }
    workgroupBarrier();
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    return (local.y + REACH) * PITCH + local.x + REACH;
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    let at = u32(i32(window) + offset_of(row) * i32(PITCH) + offset_of(column));
    return vec3<f32>(tile_x[at], tile_y[at], tile_z[at]);
}
