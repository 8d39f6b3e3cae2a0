// The candidates of a tile of pixels, in workgroup memory (docs/method.md, section 2).
//
// A workgroup smooths TILE_WIDTH columns of TILE_HEIGHT rows that are ROW_STEP apart, so its windows cover the rows of
// the tile and WINDOW more on either side. Columns are adjacent, so loads and stores cover whole cache lines. x, y and
// z are separate arrays, in which the threads of a row read adjacent words.

const REACH: u32 = WINDOW * STRIDE;
const PITCH: u32 = TILE_WIDTH + 2u * REACH;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * WINDOW);

var<workgroup> tile_x: array<f32, TILE_AREA>;
var<workgroup> tile_y: array<f32, TILE_AREA>;
var<workgroup> tile_z: array<f32, TILE_AREA>;

// Index of a pixel's first candidate.
alias WindowOrigin = u32;

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
    let first = vec2<i32>(origin) - i32(REACH);
    for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
        let p = sample_at(frame, first.x + i32(i % PITCH), first.y + i32(i / PITCH * ROW_STEP));
        tile_x[i] = p.x;
        tile_y[i] = p.y;
        tile_z[i] = p.z;
    }
    workgroupBarrier();
}

fn window_origin_of(frame: u32, pixel: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    return local.y * PITCH + local.x;
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    let at = window + row * PITCH + column * STRIDE;
    return vec3<f32>(tile_x[at], tile_y[at], tile_z[at]);
}
