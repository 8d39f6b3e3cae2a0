// The results that the pass before this one has kept, around a tile of pixels, in workgroup memory (docs/method.md, section
// 10). x, y and z are separate arrays, in which the threads of a row read adjacent words. The tile of the widest block,
// of 9x9 pixels, fits the 16 KiB that every device has.

const PITCH: u32 = TILE_WIDTH + 2u * WINDOW;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * WINDOW);

var<workgroup> point_x: array<f32, TILE_AREA>;
var<workgroup> point_y: array<f32, TILE_AREA>;
var<workgroup> point_z: array<f32, TILE_AREA>;
var<workgroup> normal_x: array<f32, TILE_AREA>;
var<workgroup> normal_y: array<f32, TILE_AREA>;
var<workgroup> normal_z: array<f32, TILE_AREA>;

struct KeptResult {
    point: vec3<f32>,
    normal: vec3<f32>,
}

fn kept_result(frame: u32, x: i32, y: i32) -> KeptResult {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return KeptResult(vec3<f32>(0.0), vec3<f32>(0.0));
    }
    let at = u32(y) * batch.width + u32(x);
    return KeptResult(plane_vector(frame, RESULT_POINT, at), plane_vector(frame, RESULT_NORMAL, at));
}

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

// Returns a result of a block, whose first is at this index.
fn result_in_block(block: u32, column: u32, row: u32) -> KeptResult {
    let at = block + row * PITCH + column;
    let point = vec3<f32>(point_x[at], point_y[at], point_z[at]);
    return KeptResult(point, vec3<f32>(normal_x[at], normal_y[at], normal_z[at]));
}
