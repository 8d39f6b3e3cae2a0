// The sums over a window for its plane and its bend (docs/method.md, sections 2 and 10). Places (i, j) are columns and rows
// from its centre.

// Of i² over a row, of i⁴, and of (i² - mean)² and (i j)² over a window in which every pixel counts 1.
const HALF: f32 = f32(WINDOW);
const WHOLE_SECOND: f32 = HALF * (HALF + 1.0) * (2.0 * HALF + 1.0) / 3.0;
const WHOLE_FOURTH: f32 = WHOLE_SECOND * (3.0 * HALF * (HALF + 1.0) - 1.0) / 5.0;
const MEAN_SQUARE: f32 = WHOLE_SECOND / (2.0 * HALF + 1.0);
const WHOLE_SQUARES: f32 = (2.0 * HALF + 1.0) * WHOLE_FOURTH - WHOLE_SECOND * WHOLE_SECOND;
const WHOLE_MIXED: f32 = WHOLE_SECOND * WHOLE_SECOND;

// Sums over the columns or rows: of the weights times powers of the place, and of the weighted offsets times such.
struct LineSums {
    weights: f32,
    weights_1: f32,
    weights_2: f32,
    weights_3: f32,
    weights_4: f32,
    offsets_1: vec3<f32>,
    offsets_2: vec3<f32>,
}

struct PlaceSums {
    sums: Sums,
    columns: LineSums,
    rows: LineSums,
    // Of the weighted offsets times i j, and of the weights times i j and its square.
    mixed: vec3<f32>,
    mixed_weights: f32,
    mixed_squares: f32,
}

fn place_sums_of(window: WindowOrigin, p: vec3<f32>, gate: Gate) -> PlaceSums {
    var sums: Sums;
    var columns: LineSums;
    var rows: LineSums;
    var mixed = vec3<f32>(0.0);
    var mixed_weights = 0.0;
    var mixed_squares = 0.0;
    for (var row = 0u; row < SIDE; row++) {
        var of_row: LineSums;
        var offsets = vec3<f32>(0.0);
        for (var column = 0u; column < SIDE; column++) {
            let offset = candidate(window, column, row) - p;
            let nearness = unclamped(gate, square(offset));
            let is_neighbour = nearness > 0.0;
            let e = select(vec3<f32>(0.0), offset, is_neighbour);
            let weight = clamp(nearness, 0.0, 1.0);
            let weighted = weight * e;
            sums.n += select(0.0, 1.0, is_neighbour);
            sums.x_row = fma(vec3<f32>(weighted.x), e, sums.x_row);
            sums.rest = fma(weighted.yyz, e.yzz, sums.rest);
            let i = f32(column) - HALF;
            let i2 = i * i;
            of_row.weights += weight;
            of_row.weights_1 = fma(weight, i, of_row.weights_1);
            of_row.weights_2 = fma(weight, i2, of_row.weights_2);
            of_row.weights_3 = fma(weight, i2 * i, of_row.weights_3);
            of_row.weights_4 = fma(weight, i2 * i2, of_row.weights_4);
            offsets += weighted;
            of_row.offsets_1 = fma(vec3<f32>(i), weighted, of_row.offsets_1);
            of_row.offsets_2 = fma(vec3<f32>(i2), weighted, of_row.offsets_2);
        }
        let j = f32(row) - HALF;
        let j2 = j * j;
        sums.total += of_row.weights;
        sums.e += offsets;
        columns.weights_1 += of_row.weights_1;
        columns.weights_2 += of_row.weights_2;
        columns.weights_3 += of_row.weights_3;
        columns.weights_4 += of_row.weights_4;
        columns.offsets_1 += of_row.offsets_1;
        columns.offsets_2 += of_row.offsets_2;
        rows.weights_1 = fma(of_row.weights, j, rows.weights_1);
        rows.weights_2 = fma(of_row.weights, j2, rows.weights_2);
        rows.weights_3 = fma(of_row.weights, j2 * j, rows.weights_3);
        rows.weights_4 = fma(of_row.weights, j2 * j2, rows.weights_4);
        rows.offsets_1 = fma(vec3<f32>(j), offsets, rows.offsets_1);
        rows.offsets_2 = fma(vec3<f32>(j2), offsets, rows.offsets_2);
        mixed = fma(vec3<f32>(j), of_row.offsets_1, mixed);
        mixed_weights = fma(of_row.weights_1, j, mixed_weights);
        mixed_squares = fma(of_row.weights_2, j2, mixed_squares);
    }
    columns.weights = sums.total;
    rows.weights = sums.total;
    return PlaceSums(sums, columns, rows, mixed, mixed_weights, mixed_squares);
}

// The second derivative, by the place, of the distance from the plane, and the offset of one stride.
struct AlongLine {
    bend: f32,
    stride: vec3<f32>,
}

fn along_line(line: LineSums, e: vec3<f32>, plane: Plane) -> AlongLine {
    let total = max(line.weights, MIN_POSITIVE);
    let mean_place = line.weights_1 / total;
    // Of the places, of i² - mean, of its square, and of its product with i.
    let places = max(line.weights_2 - mean_place * line.weights_1, total * LEAST_PLACES);
    let square = line.weights_2 - MEAN_SQUARE * total;
    let squares = line.weights_4 - MEAN_SQUARE * (line.weights_2 + square);
    let both = line.weights_3 - MEAN_SQUARE * line.weights_1 - mean_place * square;
    let unexplained =
        max(squares - square * square / total - both * both / places, 0.0) + WINDOW_BEND_DAMPING * WHOLE_SQUARES;
    let heights = (dot(line.offsets_2, plane.normal) - MEAN_SQUARE * dot(e, plane.normal)) - plane.height * square;
    return AlongLine(2.0 * heights / unexplained, (line.offsets_1 - mean_place * e) / places);
}

// How the surface in a window bends.
fn window_bend(places: PlaceSums, plane: Plane, radius: f32) -> Symmetric {
    let columns = along_line(places.columns, places.sums.e, plane);
    let rows = along_line(places.rows, places.sums.e, plane);
    let n = plane.normal;
    let heights = dot(places.mixed, n) - plane.height * places.mixed_weights;
    let mixed = heights / (places.mixed_squares + WINDOW_BEND_DAMPING * WHOLE_MIXED);
    let area = dot(cross(columns.stride, rows.stride), n);
    if !(abs(area) > radius * radius * LEAST_AREA) || places.sums.n < LEAST_BEND_NEIGHBOURS {
        return Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    }
    // Gradients of the place along the plane.
    let c = cross(rows.stride, n) / area;
    let r = cross(n, columns.stride) / area;
    let by_c = columns.bend * c + mixed * r;
    let by_r = mixed * c + rows.bend * r;
    var x_row = by_c.x * c + by_r.x * r;
    var rest = by_c.yyz * c.yzz + by_r.yyz * r.yzz;
    let twice = 2.0 * (dot(x_row.yz, x_row.yz) + rest.y * rest.y);
    let size = radius * sqrt(x_row.x * x_row.x + rest.x * rest.x + rest.z * rest.z + twice);
    let limit = MOST_WINDOW_BEND / max(size, MOST_WINDOW_BEND);
    x_row *= limit;
    rest *= limit;
    return Symmetric(x_row.x, x_row.y, x_row.z, rest.x, rest.y, rest.z);
}
