// The results of the cells around a tile of pixels, in workgroup memory (docs/method.md, section 10). x, y and z are separate
// arrays.

// Cells around a pixel that count: one before its own and two after it.
const BEFORE: u32 = 1u;
const PITCH: u32 = TILE_WIDTH / CELL + 3u;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT / CELL + 3u);

var<workgroup> point_x: array<f32, TILE_AREA>;
var<workgroup> point_y: array<f32, TILE_AREA>;
var<workgroup> point_z: array<f32, TILE_AREA>;
var<workgroup> normal_x: array<f32, TILE_AREA>;
var<workgroup> normal_y: array<f32, TILE_AREA>;
var<workgroup> normal_z: array<f32, TILE_AREA>;
var<workgroup> certainties: array<f32, TILE_AREA>;

struct CellResult {
    point: vec3<f32>,
    // 0 without a normal.
    normal: vec3<f32>,
    certainty: f32,
}

fn load_results(frame: u32, origin: vec2<u32>, thread: u32) {
    let first = vec2<i32>(origin / CELL) - i32(BEFORE);
    for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
        let cell = first + vec2<i32>(vec2<u32>(i % PITCH, i / PITCH));
        var point = vec3<f32>(0.0);
        var normal = vec3<f32>(0.0);
        var certainty = 0.0;
        if all(cell >= vec2<i32>(0)) && !is_outside(vec2<u32>(cell)) {
            let at = cell_index(vec2<u32>(cell));
            point = plane_vector(frame, RESULT_POINT, at);
            normal = plane_vector(frame, RESULT_NORMAL, at);
            certainty = planes[plane_word(frame, SURFACE_CERTAINTY, at)];
        }
        point_x[i] = point.x;
        point_y[i] = point.y;
        point_z[i] = point.z;
        normal_x[i] = normal.x;
        normal_y[i] = normal.y;
        normal_z[i] = normal.z;
        certainties[i] = certainty;
    }
    workgroupBarrier();
}

// Returns a result by its place in the tile.
fn result_at(place: vec2<u32>) -> CellResult {
    let at = place.y * PITCH + place.x;
    let point = vec3<f32>(point_x[at], point_y[at], point_z[at]);
    return CellResult(point, vec3<f32>(normal_x[at], normal_y[at], normal_z[at]), certainties[at]);
}
