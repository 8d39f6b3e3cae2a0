// The pixels of the blocks of a tile of cells, in workgroup memory (docs/method.md, section 10). Even and odd columns
// are stored separately, so that the threads of a row read adjacent words.

const PITCH: u32 = TILE_WIDTH * CELL + 2u * WINDOW;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT * CELL + 2u * WINDOW);

var<workgroup> tile_x: array<f32, TILE_AREA>;
var<workgroup> tile_y: array<f32, TILE_AREA>;
var<workgroup> tile_z: array<f32, TILE_AREA>;

// Column and row of the first pixel of a cell's block.
alias WindowOrigin = vec2<u32>;

fn place_of(column: u32, row: u32) -> u32 {
    return row * PITCH + column % CELL * (PITCH / CELL) + column / CELL;
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
    let first = vec2<i32>(origin * CELL) - i32(WINDOW);
    for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
        let p = point_at(frame, first.x + i32(i % PITCH), first.y + i32(i / PITCH));
        let at = place_of(i % PITCH, i / PITCH);
        tile_x[at] = p.x;
        tile_y[at] = p.y;
        tile_z[at] = p.z;
    }
    workgroupBarrier();
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    return local * CELL;
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    let at = place_of(window.x + column, window.y + row);
    return vec3<f32>(tile_x[at], tile_y[at], tile_z[at]);
}
