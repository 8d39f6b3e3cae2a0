// The neighbours of a pixel: the candidates within the radius, and their sums (docs/method.md, sections 2 and 3).
//
// Offsets e = q - p in metres. NO_POINT, and any offset whose square overflows, fails the gate.

const SIDE: u32 = 2u * WINDOW + 1u;

// A radius beyond this makes no difference to any scene, and its square is far from the end of f32.
const MAX_RADIUS_M: f32 = 1e6;

// One pixel a thread, one tile of pixels a workgroup, one frame a layer of workgroups: a tile's first pixel. STRIDE workgroups
// share a block of rows, each with its rows STRIDE apart.
fn origin_of(group: vec3<u32>) -> vec2<u32> {
    return vec2<u32>(group.x * TILE_WIDTH, group.y / STRIDE * (STRIDE * TILE_HEIGHT) + group.y % STRIDE);
}

// Sums over the neighbours, relative to p.
struct Sums {
    n: f32,
    e: vec3<f32>,
    // xx, xy, xz
    x_row: vec3<f32>,
    // yy, yz, zz
    rest: vec3<f32>,
}

fn radius_at(frame: u32, z: f32) -> f32 {
    // Beyond the clamp the radius is at its limit or fixed; the square stays finite.
    let range = min(abs(z), 1e18);
    let grown = max(range * header(frame, RADIUS_LINEAR), range * range * header(frame, RADIUS_QUADRATIC));
    return min(header(frame, RADIUS_CONSTANT) + grown, MAX_RADIUS_M);
}

fn square(e: vec3<f32>) -> f32 {
    return fma(e.x, e.x, fma(e.y, e.y, e.z * e.z));
}

// First pass. Masks instead of a branch: with so little to skip, branching costs more.
fn sums_of(home: Home, p: vec3<f32>, radius_squared: f32) -> Sums {
    var sums: Sums;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = 0u; column < SIDE; column++) {
            let offset = candidate(home, column, row) - p;
            let is_neighbour = square(offset) <= radius_squared;
            let e = select(vec3<f32>(0.0), offset, is_neighbour);
            sums.n += select(0.0, 1.0, is_neighbour);
            sums.e += e;
            sums.x_row = fma(vec3<f32>(e.x), e, sums.x_row);
            sums.rest = fma(e.yyz, e.yzz, sums.rest);
        }
    }
    return sums;
}
