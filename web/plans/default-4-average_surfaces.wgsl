const HEADER_WORDS: u32 = 22u;
const METRES_PER_UNIT: u32 = 0u;
const UNITS_PER_METRE: u32 = 1u;
const RADIUS_LINEAR: u32 = 2u;
const RADIUS: u32 = 3u;
const SIGMA: u32 = 10u;
const BANDWIDTH: u32 = 13u;
const RIDGE: u32 = 14u;
const FLAGS: u32 = 15u;
const POSITION: u32 = 16u;
const AXIS: u32 = 19u;
const BY_DISTANCE: u32 = 1u;
const ON_RAY: u32 = 2u;
const BLOCK_LINEAR: u32 = 6u;
const BLOCK: u32 = 7u;
const POINT_CHANNELS: u32 = 6u;
const PLANE_CHANNELS: u32 = 21u;
const SATURATED_DEPTH: u32 = 65535u;
const POINTS_CHANNEL: u32 = 0u;
const NORMALS_CHANNEL: u32 = 3u;
const CURVATURE_CHANNEL: u32 = 6u;
const DEPTH_M_CHANNEL: u32 = 6u;
const CHANNELS: u32 = 6u;
const STATUS_HOLE: u32 = 0u;
const STATUS_TOO_FEW: u32 = 1u;
const STATUS_DEGENERATE: u32 = 2u;
const STATUS_PLANE: u32 = 3u;
const STATUS_POLYNOMIAL_2: u32 = 4u;
const STATUS_POLYNOMIAL_3: u32 = 5u;
const STATUS_ISOLATED: u32 = 6u;
const IS_RAW_DEPTH: bool = true;
const IS_DEPTH_METRES: bool = false;
const IS_POINTS: bool = false;
const WANTS_POINTS: bool = true;
const WANTS_NORMALS: bool = true;
const WANTS_CURVATURE: bool = false;
const WANTS_STATUS: bool = true;
const WANTS_NEIGHBOURS: bool = false;
const WANTS_DEPTH: bool = true;
const WANTS_DEPTH_M: bool = false;
const MIN_POSITIVE: f32 = 1.1754944e-38;
const GRAZING_COSINE: f32 = 0.2;
const MAX_ALONG: f32 = 0.5;
const MAX_RADIUS_M: f32 = 1000000.0;
const MAX_RANGE_M: f32 = 1e18;
const DEGENERATE_RATIO: f32 = 0.0001;
const MAX_DOUBT: f32 = 1000000.0;
const MIN_TOTAL: f32 = 5.0;
const COSINE_FADE: f32 = 0.01;
const GENERAL_MEAN_REACH: f32 = 0.4;
const GENERAL_DISTANCE_WEIGHT: f32 = 0.2;
const FACING_COSINE: f32 = 0.1;
const STAY_WEIGHT: f32 = 0.001;
const OWN_NORMAL_WEIGHT: f32 = 1e-12;
const MIN_NOISE: f32 = 0.01;
const MIN_GATE_M: f32 = 1e-12;
const MAX_RADIUS_RATIO: f32 = 1.5;
const GATE_FADE: f32 = 16.0;
const PLANE_REACH: f32 = 2.0;
const BLOCK_WIDTH: f32 = 1.5;
const MIN_BLOCK_WEIGHT: f32 = 0.02;
const DISTANCE_WEIGHT: f32 = 0.3;
const NARROW_WIDTH: f32 = 1.0;
const DOUBT_WEIGHT: f32 = 0.01;
const FITTING_LEAST: f32 = 0.6;
const FITTING_ENOUGH: f32 = 1.6;
const NEAR_ENOUGH: f32 = 0.05;
const MISSING_PLANE: f32 = 0.011111111;
const TURNING_FLAT: f32 = 0.02;
const TURNING_ROUND: f32 = 0.07;
const LOW_RIDGE: f32 = 0.0003;
const CLOSE_FROM: f32 = 0.3;
const CLOSE_TO: f32 = 0.8;
const MEAN_WIDTH: f32 = 1.5;
const ALIKE_FROM: f32 = 0.9;
const ALIKE_TO: f32 = 0.95;
const AROUND_FROM: f32 = 0.6;
const AROUND_TO: f32 = 0.9;
const LEAST_AVERAGED: f32 = 5.0;
const LEAST_SPREAD: f32 = 0.01;
const MOST_WINDOW_BEND: f32 = 4.0;
const BEND_DAMPING: f32 = 0.009;
const LEAST_BEND_WEIGHT: f32 = 1e-12;
const LEAST_TURN: f32 = 1.0;
const BEND_EXPLAINED_FROM: f32 = 0.65;
const BEND_EXPLAINED_TO: f32 = 0.85;
const BEND_SHARED_FROM: f32 = 0.2;
const BEND_SHARED_TO: f32 = 0.4;
const MOST_BEND: f32 = 1.2;
const MIN_INCIDENCE_COSINE: f32 = 0.05;
const SQRT_LOG2_E: f32 = 1.2011224;
const MAX_OFF_SURFACE: f32 = 11.54156;
const TILE_WIDTH: u32 = 32u;
const TILE_HEIGHT: u32 = 8u;
const WINDOW: u32 = 2u;
const STRIDE: u32 = 1u;
const DEGREE: u32 = 1u;
const EDGE_SHIFT: u32 = 0u;
const KEEPS_EDGES: bool = false;
const BENDS: bool = false;
const READS_MEANS: bool = false;

struct Batch {
    width: u32,
    height: u32,
    input_words: u32,
    output_words: u32,
}

@group(0) @binding(0) var<uniform> batch: Batch;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> output: array<u32>;

const NO_POINT: f32 = 4.0e18;

fn header(frame: u32, field: u32) -> f32 {
    return bitcast<f32>(input[frame * batch.input_words + field]);
}

fn header_bits(frame: u32, field: u32) -> u32 {
    return input[frame * batch.input_words + field];
}

fn is_finite(bits: u32) -> bool {
    return (bits & 0x7f800000u) != 0x7f800000u;
}

@group(0) @binding(3) var<storage, read_write> kept_points: array<f32>;
@group(0) @binding(4) var<storage, read_write> planes: array<f32>;

const KEPT_POINT: u32 = 0u;
const KEPT_MEAN: u32 = 3u;

const FIRST_NORMAL: u32 = 0u;
const FIRST_CENTROID: u32 = 3u;
const FIRST_RESIDUAL: u32 = 6u;
const FIRST_SPREAD: u32 = 7u;
const FIRST_CURVATURE: u32 = 8u;
const FIRST_COUNT: u32 = 9u;
const FIRST_EXTENT: u32 = 10u;
const FIRST_BEND: u32 = 11u;
const SURFACE_NORMAL: u32 = 12u;
const SURFACE_HEIGHT: u32 = 15u;
const SURFACE_WIDTH: u32 = 16u;
const SURFACE_BEND: u32 = 17u;
const SURFACE_NO_PLANE_FITS: u32 = 20u;

const RESULT_NORMAL: u32 = SURFACE_NORMAL;
const RESULT_DEPTH: u32 = SURFACE_HEIGHT;
const RESULT_POINT: u32 = SURFACE_BEND;
const RESULT_STATUS: u32 = SURFACE_NO_PLANE_FITS;

const NOT_USABLE: f32 = 1e18;

fn kept_at(frame: u32, channel: u32, pixel: u32) -> vec3<f32> {
    let pixels = batch.width * batch.height;
    let at = (frame * POINT_CHANNELS + channel) * pixels + pixel;
    return vec3<f32>(kept_points[at], kept_points[at + pixels], kept_points[at + 2u * pixels]);
}

fn keep_point(frame: u32, channel: u32, pixel: u32, point: vec3<f32>) {
    let pixels = batch.width * batch.height;
    let at = (frame * POINT_CHANNELS + channel) * pixels + pixel;
    kept_points[at] = point.x;
    kept_points[at + pixels] = point.y;
    kept_points[at + 2u * pixels] = point.z;
}

fn plane_word(frame: u32, channel: u32, pixel: u32) -> u32 {
    return (frame * PLANE_CHANNELS + channel) * (batch.width * batch.height) + pixel;
}

fn plane_vector(frame: u32, channel: u32, pixel: u32) -> vec3<f32> {
    let at = plane_word(frame, channel, pixel);
    let pixels = batch.width * batch.height;
    return vec3<f32>(planes[at], planes[at + pixels], planes[at + 2u * pixels]);
}

fn keep_vector(frame: u32, channel: u32, pixel: u32, vector: vec3<f32>) {
    let at = plane_word(frame, channel, pixel);
    let pixels = batch.width * batch.height;
    planes[at] = vector.x;
    planes[at + pixels] = vector.y;
    planes[at + 2u * pixels] = vector.z;
}

fn noise_at(frame: u32, range: f32, radius: f32) -> f32 {
    return clamp(max(polynomial_in_range(frame, SIGMA, range), radius * MIN_NOISE), 1e-15, MAX_RADIUS_M);
}

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
        return vec3<f32>(NO_POINT);
    }
    return kept_at(frame, KEPT_POINT, u32(y) * batch.width + u32(x));
}

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
    return point_at(frame, x, y);
}

fn centre_of(frame: u32, pixel: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
    return candidate(window, WINDOW, WINDOW);
}

struct WindowOrigin {
    frame: u32,
    x: i32,
    y: i32,
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn window_origin_of(frame: u32, pixel: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
    let first = vec2<i32>(pixel) - i32(WINDOW * STRIDE);
    return WindowOrigin(frame, first.x, first.y);
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
    return sample_at(window.frame, window.x + i32(column * STRIDE), window.y + i32(row * STRIDE));
}

struct Gate {
    slope: f32,
}

fn gate_of(radius: f32) -> Gate {
    return Gate(-GATE_FADE / (radius * radius));
}

fn unclamped(gate: Gate, squared: f32) -> f32 {
    return fma(squared, gate.slope, GATE_FADE + 0.5);
}

struct Sums {
    n: f32,
    total: f32,
    e: vec3<f32>,
    x_row: vec3<f32>,
    rest: vec3<f32>,
}

fn square(e: vec3<f32>) -> f32 {
    return fma(e.x, e.x, fma(e.y, e.y, e.z * e.z));
}

const SIDE: u32 = 2u * WINDOW + 1u;

fn origin_of(group: vec3<u32>) -> vec2<u32> {
    return vec2<u32>(group.x * TILE_WIDTH, group.y / STRIDE * (STRIDE * TILE_HEIGHT) + group.y % STRIDE);
}

fn range_of(frame: u32, ray: vec3<f32>) -> f32 {
    if IS_POINTS && (header_bits(frame, FLAGS) & BY_DISTANCE) != 0u {
        let largest = max(max(abs(ray.x), abs(ray.y)), max(abs(ray.z), MIN_POSITIVE));
        let scaled = ray / largest;
        return min(largest * sqrt(dot(scaled, scaled)), MAX_RANGE_M);
    }
    return min(abs(depth_of(frame, ray)), MAX_RANGE_M);
}

fn polynomial_in_range(frame: u32, field: u32, range: f32) -> f32 {
    return fma(fma(range, header(frame, field + 2u), header(frame, field + 1u)), range, header(frame, field));
}

fn radius_at(frame: u32, range: f32) -> f32 {
    let radius = max(range * header(frame, RADIUS_LINEAR), polynomial_in_range(frame, RADIUS, range));
    return clamp(radius, MIN_GATE_M, MAX_RADIUS_M);
}

fn sums_of(window: WindowOrigin, p: vec3<f32>, gate: Gate) -> Sums {
    var sums: Sums;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = 0u; column < SIDE; column++) {
            let offset = candidate(window, column, row) - p;
            let squared = square(offset);
            let nearness = unclamped(gate, squared);
            let is_neighbour = nearness > 0.0;
            let e = select(vec3<f32>(0.0), offset, is_neighbour);
            let weight = clamp(nearness, 0.0, 1.0);
            let weighted = weight * e;
            sums.n += select(0.0, 1.0, is_neighbour);
            sums.total += weight;
            sums.e += weighted;
            sums.x_row = fma(vec3<f32>(weighted.x), e, sums.x_row);
            sums.rest = fma(weighted.yyz, e.yzz, sums.rest);
        }
    }
    return sums;
}

const LINE_LIKE: f32 = 0.9;

struct Symmetric {
    xx: f32,
    xy: f32,
    xz: f32,
    yy: f32,
    yz: f32,
    zz: f32,
}

struct Smallest {
    values: vec3<f32>,
    vector: vec3<f32>,
}

fn symmetric_times(m: Symmetric, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(vec3<f32>(m.xx, m.xy, m.xz), v),
        dot(vec3<f32>(m.xy, m.yy, m.yz), v),
        dot(vec3<f32>(m.xz, m.yz, m.zz), v),
    );
}

fn cos_third_acos(x: f32) -> f32 {
    let magnitude = abs(x);
    var p = -0.0012624911;
    p = fma(p, magnitude, 0.0066700901);
    p = fma(p, magnitude, -0.0170881256);
    p = fma(p, magnitude, 0.0308918810);
    p = fma(p, magnitude, -0.0501743046);
    p = fma(p, magnitude, 0.0889789874);
    p = fma(p, magnitude, -0.2145988016);
    p = fma(p, magnitude, 1.5707963268);
    let acute = sqrt(max(1.0 - magnitude, 0.0)) * p;
    let angle = select(acute, 3.1415926536 - acute, x < 0.0);
    let s = (angle * (1.0 / 3.0)) * (angle * (1.0 / 3.0));
    var c = 2.4801587e-5;
    c = fma(c, s, -1.3888889e-3);
    c = fma(c, s, 4.1666667e-2);
    c = fma(c, s, -0.5);
    return fma(c, s, 1.0);
}

fn minor(a: f32, b: f32, c: f32, d: f32) -> f32 {
    return fma(a, b, -(c * d));
}

fn null_vector(b: Symmetric, value: f32) -> vec3<f32> {
    let x = vec3<f32>(b.xx - value, b.xy, b.xz);
    let y = vec3<f32>(b.xy, b.yy - value, b.yz);
    let z = vec3<f32>(b.xz, b.yz, b.zz - value);
    var longest = cross(x, y);
    var length_squared = dot(longest, longest);
    for (var i = 0; i < 2; i++) {
        let other = cross(select(y, x, i == 0), z);
        let other_squared = dot(other, other);
        if other_squared > length_squared {
            longest = other;
            length_squared = other_squared;
        }
    }
    if length_squared > MIN_POSITIVE {
        return longest * (1.0 / sqrt(length_squared));
    }
    return vec3<f32>(0.0, 0.0, 1.0);
}

struct Tangents {
    u: vec3<f32>,
    v: vec3<f32>,
}

fn tangents_of(n: vec3<f32>) -> Tangents {
    let sign = bitcast<f32>((bitcast<u32>(n.z) & 0x80000000u) | 0x3f800000u);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    return Tangents(
        vec3<f32>(fma(sign * n.x * n.x, a, 1.0), sign * b, -(sign * n.x)),
        vec3<f32>(b, fma(n.y * n.y, a, sign), -n.y),
    );
}

fn across_line(b: Symmetric, axis: vec3<f32>) -> Smallest {
    let tangents = tangents_of(axis);
    let bu = symmetric_times(b, tangents.u);
    let bv = symmetric_times(b, tangents.v);
    let uu = dot(tangents.u, bu);
    let uv = dot(tangents.u, bv);
    let vv = dot(tangents.v, bv);
    let half_sum = (uu + vv) * 0.5;
    let half_difference = (uu - vv) * 0.5;
    let spread = sqrt(fma(half_difference, half_difference, uv * uv));
    let reach = abs(half_difference) + spread;
    let along = select(vec2<f32>(-reach, uv), vec2<f32>(uv, -reach), half_difference >= 0.0);
    let length_squared = dot(along, along);
    var vector = tangents.u;
    if length_squared > MIN_POSITIVE {
        vector = (along.x * tangents.u + along.y * tangents.v) * (1.0 / sqrt(length_squared));
    }
    return Smallest(vec3<f32>(half_sum - spread, half_sum + spread, half_sum + spread), vector);
}

fn smallest_eigenvector(m: Symmetric) -> Smallest {
    let mean = (m.xx + m.yy + m.zz) * (1.0 / 3.0);
    let d = vec3<f32>(m.xx, m.yy, m.zz) - mean;
    let off = vec3<f32>(m.xy, m.xz, m.yz);
    let p = sqrt((dot(d, d) + 2.0 * dot(off, off)) * (1.0 / 6.0));
    let inverse_p = 1.0 / max(p, MIN_POSITIVE);
    let b = Symmetric(
        d.x * inverse_p,
        m.xy * inverse_p,
        m.xz * inverse_p,
        d.y * inverse_p,
        m.yz * inverse_p,
        d.z * inverse_p,
    );
    let det = fma(
        b.xx,
        minor(b.yy, b.zz, b.yz, b.yz),
        fma(b.xz, minor(b.xy, b.yz, b.yy, b.xz), -(b.xy * minor(b.xy, b.zz, b.yz, b.xz))),
    );
    let half_det = clamp(det * 0.5, -1.0, 1.0);

    let is_line_like = half_det > LINE_LIKE;
    let sign = select(-1.0, 1.0, is_line_like);
    let half_alone = sign * cos_third_acos(half_det * sign);
    let axis = null_vector(b, 2.0 * half_alone);
    let alone = fma(p, 2.0 * half_alone, mean);
    if is_line_like {
        let across = across_line(b, axis);
        return Smallest(vec3<f32>(fma(p, across.values.x, mean), fma(p, across.values.y, mean), alone), across.vector);
    }
    let spread = sqrt(max(3.0 * fma(-half_alone, half_alone, 1.0), 0.0));
    return Smallest(vec3<f32>(alone, fma(p, -half_alone - spread, mean), fma(p, -half_alone + spread, mean)), axis);
}

fn header_vec3(frame: u32, field: u32) -> vec3<f32> {
    return vec3<f32>(header(frame, field), header(frame, field + 1u), header(frame, field + 2u));
}

fn ray_to(frame: u32, p: vec3<f32>) -> vec3<f32> {
    if !IS_POINTS {
        return p;
    }
    return clamp(p, vec3<f32>(-1e18), vec3<f32>(1e18)) - header_vec3(frame, POSITION);
}

fn depth_of(frame: u32, ray: vec3<f32>) -> f32 {
    if !IS_POINTS {
        return ray.z;
    }
    return dot(header_vec3(frame, AXIS), ray);
}

struct Plane {
    normal: vec3<f32>,
    height: f32,
    centroid: vec3<f32>,
    spread: f32,
    residual: f32,
    doubt: f32,
    extent_squared: f32,
    curvature: f32,
    off_line: f32,
    is_degenerate: bool,
}

struct LocalSurface {
    plane: Plane,
    n: f32,
    width: f32,
    bend: vec3<f32>,
    no_plane_fits: f32,
}

fn plane_of(ray: vec3<f32>, sums: Sums) -> Plane {
    let inverse_total = 1.0 / max(sums.total, MIN_POSITIVE);
    let c = sums.e * inverse_total;
    let x_row = fma(sums.x_row, vec3<f32>(inverse_total), -(c.x * c));
    let rest = fma(sums.rest, vec3<f32>(inverse_total), -(c.yyz * c.yzz));
    let eigen = smallest_eigenvector(Symmetric(x_row.x, x_row.y, x_row.z, rest.x, rest.y, rest.z));
    let normal = select(eigen.vector, -eigen.vector, dot(eigen.vector, ray) > 0.0);
    let l = eigen.values;
    let residual = max(l.x, 0.0);
    let curvature = residual / max(l.x + l.y + l.z, MIN_POSITIVE);
    let doubt = min(l.z / max(l.y - residual, MIN_POSITIVE), MAX_DOUBT);
    let line = l.z * DEGENERATE_RATIO;
    let off_line = l.y / max(line, MIN_POSITIVE) - 1.0;
    return Plane(normal, dot(c, normal), c, l.y + l.z, residual, doubt, 4.0 * l.z, curvature, off_line, l.y <= line);
}

struct Projected {
    point: vec3<f32>,
    normal: vec3<f32>,
    status: u32,
    depth_scale: f32,
}

fn is_on_ray(frame: u32) -> bool {
    return (header_bits(frame, FLAGS) & ON_RAY) != 0u;
}

fn put_on_surface(frame: u32, p: vec3<f32>, plane_normal: vec3<f32>, height: f32, normal: vec3<f32>, radius: f32, status: u32) -> Projected {
    let on_ray = is_on_ray(frame);
    var point = fma(vec3<f32>(height), plane_normal, p);
    var along = 0.0;
    if WANTS_DEPTH || WANTS_DEPTH_M || on_ray {
        let ray = ray_to(frame, p);
        along = along_ray(height * dot(plane_normal, normal), normal, ray, radius);
        if on_ray {
            point = fma(vec3<f32>(along), ray, p);
        }
    }
    return Projected(point, normal, status, 1.0 + along);
}

fn along_ray(height: f32, normal: vec3<f32>, ray: vec3<f32>, radius: f32) -> f32 {
    let square = max(dot(ray, ray), MIN_POSITIVE);
    let across = dot(ray, normal);
    let divisor = max(max(across * across, square * (GRAZING_COSINE * GRAZING_COSINE)), MIN_POSITIVE);
    let along = height * across / divisor;
    let limit = min(radius / sqrt(square), MAX_ALONG);
    return clamp(along, -limit, limit);
}

fn project_on_plane(frame: u32, p: vec3<f32>, plane: Plane, radius: f32) -> Projected {
    return put_on_surface(frame, p, plane.normal, plane.height, plane.normal, radius, STATUS_PLANE);
}

const NAN_BITS: u32 = 0x7fc00000u;

struct PixelResult {
    point: vec3<u32>,
    normal: vec3<u32>,
    curvature: u32,
    depth_m: u32,
    codes: u32,
}

fn no_result(status: u32, n: u32) -> PixelResult {
    return PixelResult(vec3<u32>(NAN_BITS), vec3<u32>(NAN_BITS), NAN_BITS, NAN_BITS, status | (n << 8u));
}

fn product_error(x: f32, y: f32, product: f32) -> f32 {
    let upper = vec2<f32>(bitcast<f32>(bitcast<u32>(x) & 0xfffff000u), bitcast<f32>(bitcast<u32>(y) & 0xfffff000u));
    let lower = vec2<f32>(x, y) - upper;
    return ((upper.x * upper.y - product) + upper.x * lower.y + lower.x * upper.y) + lower.x * lower.y;
}

fn with_depth(frame: u32, depth: f32, without: PixelResult) -> PixelResult {
    var result = without;
    if WANTS_DEPTH || WANTS_DEPTH_M {
        result.depth_m = bitcast<u32>(depth);
        let units = header(frame, UNITS_PER_METRE);
        let product = depth * units;
        let rounded = round(product);
        let over = product - rounded;
        let error = product_error(depth, units, product);
        let up = select(0.0, 1.0, over == 0.5 && error >= 0.0);
        let down = select(0.0, 1.0, over == -0.5 && error < 0.0);
        let raw = rounded + up - down;
        if raw >= 1.0 && raw < f32(SATURATED_DEPTH) {
            result.codes |= u32(raw) << 16u;
        }
    }
    return result;
}

var<workgroup> codes: array<u32, TILE_WIDTH * TILE_HEIGHT>;

fn store_word(frame: u32, channel: u32, pixel: u32, bits: u32) {
    output[frame * batch.output_words + channel * batch.width * batch.height + pixel] = bits;
}

fn store_packed(frame: u32, rows_at: u32, origin: vec2<u32>, thread: u32, shift: u32, bits: u32) {
    let in_word = 32u / bits;
    let words_in_tile_row = TILE_WIDTH / in_word;
    let row = thread / words_in_tile_row;
    let word = thread % words_in_tile_row;
    let row_words = (batch.width + in_word - 1u) / in_word;
    let y = origin.y + row * STRIDE;
    let at = origin.x / in_word + word;
    if row >= TILE_HEIGHT || y >= batch.height || at >= row_words {
        return;
    }
    var packed = 0u;
    for (var i = 0u; i < in_word; i++) {
        packed |= extractBits(codes[row * TILE_WIDTH + word * in_word + i], shift, bits) << (i * bits);
    }
    output[frame * batch.output_words + rows_at + y * row_words + at] = packed;
}

fn store(frame: u32, origin: vec2<u32>, pixel: vec2<u32>, thread: u32, result: PixelResult) {
    if pixel.x < batch.width && pixel.y < batch.height {
        let at = pixel.y * batch.width + pixel.x;
        if WANTS_POINTS {
            store_word(frame, POINTS_CHANNEL, at, result.point.x);
            store_word(frame, POINTS_CHANNEL + 1u, at, result.point.y);
            store_word(frame, POINTS_CHANNEL + 2u, at, result.point.z);
        }
        if WANTS_NORMALS {
            store_word(frame, NORMALS_CHANNEL, at, result.normal.x);
            store_word(frame, NORMALS_CHANNEL + 1u, at, result.normal.y);
            store_word(frame, NORMALS_CHANNEL + 2u, at, result.normal.z);
        }
        if WANTS_CURVATURE {
            store_word(frame, CURVATURE_CHANNEL, at, result.curvature);
        }
        if WANTS_DEPTH_M {
            store_word(frame, DEPTH_M_CHANNEL, at, result.depth_m);
        }
    }
    if WANTS_STATUS || WANTS_NEIGHBOURS || WANTS_DEPTH {
        codes[thread] = result.codes;
        workgroupBarrier();
        var rows_at = CHANNELS * batch.width * batch.height;
        if WANTS_STATUS {
            store_packed(frame, rows_at, origin, thread, 0u, 8u);
            rows_at += batch.height * ((batch.width + 3u) / 4u);
        }
        if WANTS_NEIGHBOURS {
            store_packed(frame, rows_at, origin, thread, 8u, 8u);
            rows_at += batch.height * ((batch.width + 3u) / 4u);
        }
        if WANTS_DEPTH {
            store_packed(frame, rows_at, origin, thread, 16u, 16u);
        }
    }
}

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

fn result_in_block(block: u32, column: u32, row: u32) -> KeptResult {
    let at = block + row * PITCH + column;
    let point = vec3<f32>(point_x[at], point_y[at], point_z[at]);
    return KeptResult(point, vec3<f32>(normal_x[at], normal_y[at], normal_z[at]));
}

const PLACES: u32 = 2u * WINDOW * (WINDOW + 1u) + 1u;

struct Around {
    total: f32,
    offset: vec3<f32>,
    normal: vec3<f32>,
    height: f32,
}

fn surfaces_around(block: u32, own: KeptResult, width: f32) -> Around {
    let per_width = 1.0 / width;
    var around: Around;
    for (var row = 0u; row < SIDE; row++) {
        for (var column = row & 1u; column < SIDE; column += 2u) {
            let other = result_in_block(block, column, row);
            let offset = other.point - own.point;
            let height = dot(offset, other.normal);
            let widths = height * per_width;
            let cosine = dot(own.normal, other.normal);
            let alike = clamp((abs(cosine) - ALIKE_FROM) / (ALIKE_TO - ALIKE_FROM), 0.0, 1.0);
            let weight = max(fma(-widths, widths, 1.0), 0.0) * alike;
            let signed = select(weight, -weight, cosine < 0.0);
            around.total += weight;
            around.height = fma(signed, height, around.height);
            around.offset = fma(vec3<f32>(weight), offset, around.offset);
            around.normal = fma(vec3<f32>(signed), other.normal, around.normal);
        }
    }
    return around;
}

fn result_on_mean(frame: u32, pixel: vec2<u32>, block: u32) -> PixelResult {
    if pixel.x >= batch.width || pixel.y >= batch.height {
        return no_result(STATUS_HOLE, 0u);
    }
    let at = pixel.y * batch.width + pixel.x;
    let p = kept_at(frame, KEPT_POINT, at);
    if p.x == NO_POINT {
        return no_result(STATUS_HOLE, 0u);
    }
    let n = u32(abs(planes[plane_word(frame, FIRST_COUNT, at)]));
    let status = u32(planes[plane_word(frame, RESULT_STATUS, at)]);
    var result = no_result(status, n);
    if status == STATUS_DEGENERATE {
        result.point = bitcast<vec3<u32>>(p);
        return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
    }
    if status < STATUS_PLANE {
        return result;
    }
    let own = result_in_block(block, WINDOW, WINDOW);
    let width = planes[plane_word(frame, SURFACE_WIDTH, at)] * (MEAN_WIDTH / NARROW_WIDTH);
    let around = surfaces_around(block, own, width);
    let normal = normalize(around.normal);
    let bend = dot(around.offset, normal) - around.height;
    let all_around = clamp((around.total / f32(PLACES) - AROUND_FROM) / (AROUND_TO - AROUND_FROM), 0.0, 1.0);
    let height = fma(0.5 * all_around, bend, around.height) / around.total;
    let ray = ray_to(frame, p);
    let radius = radius_at(frame, range_of(frame, ray));
    let along = along_ray(height, normal, ray, radius);
    let moved = select(fma(vec3<f32>(height), normal, own.point), fma(vec3<f32>(along), ray, own.point), is_on_ray(frame));
    result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, at)]);
    let depth = planes[plane_word(frame, RESULT_DEPTH, at)];
    let limit = min(radius, MAX_ALONG * sqrt(dot(ray, ray)));
    if f32(n) < LEAST_AVERAGED || !(square(moved - p) <= limit * limit) || !is_finite(bitcast<u32>(moved.x + moved.y + moved.z)) {
        let is_near = square(own.point) < MAX_RANGE_M * MAX_RANGE_M;
        result.point = bitcast<vec3<u32>>(select(p, own.point, is_near));
        result.normal = bitcast<vec3<u32>>(own.normal);
        return with_depth(frame, depth, result);
    }
    result.point = bitcast<vec3<u32>>(moved);
    result.normal = bitcast<vec3<u32>>(normal * select(1.0, -1.0, dot(normal, ray) > 0.0));
    return with_depth(frame, fma(depth_of(frame, ray), along, depth), result);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn average_surfaces(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let origin = origin_of(group);
    let pixel = origin + local.xy;
    load_results(group.z, origin, thread);
    store(group.z, origin, pixel, thread, result_on_mean(group.z, pixel, local.y * PITCH + local.x));
}
