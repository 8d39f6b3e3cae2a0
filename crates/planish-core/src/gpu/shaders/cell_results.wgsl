// The results of the cells around a tile of pixels, in workgroup memory (docs/method.md, section 10).

// Number of cells before a pixel's own cell, along an axis, that count. After it, two cells count.
const BEFORE: u32 = 1u;
const PITCH: u32 = TILE_WIDTH / CELL + 3u;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT / CELL + 3u);

// Points, and their certainties in w.
var<workgroup> result_points: array<vec4<f32>, TILE_AREA>;
// Normals; zero for a point without a normal.
var<workgroup> result_normals: array<vec3<f32>, TILE_AREA>;

struct CellResult {
    point: vec3<f32>,
    // Zero for a point without a normal.
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
        result_points[i] = vec4<f32>(point, certainty);
        result_normals[i] = normal;
    }
    workgroupBarrier();
}

// Returns a result by its place in the tile.
fn result_at(place: vec2<u32>) -> CellResult {
    let at = place.y * PITCH + place.x;
    let point = result_points[at];
    return CellResult(point.xyz, result_normals[at], point.w);
}
