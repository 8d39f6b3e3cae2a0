// The results around a tile of pixels, in workgroup memory (docs/method.md, section 10). x, y and z are separate arrays,
// in which the threads of a row read adjacent words.

const PITCH: u32 = TILE_WIDTH + 2u * WINDOW;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * WINDOW);

var<workgroup> point_x: array<f32, TILE_AREA>;
var<workgroup> point_y: array<f32, TILE_AREA>;
var<workgroup> point_z: array<f32, TILE_AREA>;
var<workgroup> normal_x: array<f32, TILE_AREA>;
var<workgroup> normal_y: array<f32, TILE_AREA>;
var<workgroup> normal_z: array<f32, TILE_AREA>;

// Index of the first result of a pixel's block.
alias BlockOrigin = u32;

fn load_results(frame: u32, origin: vec2<u32>, thread: u32) {
    let first = vec2<i32>(origin) - i32(WINDOW);
    for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
        let kept = kept_result(frame, first.x + i32(i % PITCH), first.y + i32(i / PITCH));
        point_x[i] = kept.point.x;
        point_y[i] = kept.point.y;
        point_z[i] = kept.point.z;
        normal_x[i] = kept.normal.x;
        normal_y[i] = kept.normal.y;
        normal_z[i] = kept.normal.z;
    }
    workgroupBarrier();
}

fn block_origin_of(frame: u32, pixel: vec2<u32>, local: vec2<u32>) -> BlockOrigin {
    return local.y * PITCH + local.x;
}

fn result_in_block(block: BlockOrigin, column: u32, row: u32) -> KeptResult {
    let at = block + row * PITCH + column;
    let point = vec3<f32>(point_x[at], point_y[at], point_z[at]);
    return KeptResult(point, vec3<f32>(normal_x[at], normal_y[at], normal_z[at]));
}
