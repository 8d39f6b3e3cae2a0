const UNITS_PER_METRE: u32 = 1u;
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
const WANTS_POINTS: bool = true;
const WANTS_NORMALS: bool = true;
const WANTS_CURVATURE: bool = false;
const WANTS_STATUS: bool = true;
const WANTS_NEIGHBOURS: bool = false;
const WANTS_DEPTH: bool = true;
const WANTS_DEPTH_M: bool = false;
const HEADER_WORDS: u32 = 22u;
const METRES_PER_UNIT: u32 = 0u;
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
const CELL: u32 = 1u;
const POINT_CHANNELS: u32 = 6u;
const PLANE_CHANNELS: u32 = 22u;
const IS_RAW_DEPTH: bool = true;
const IS_DEPTH_METRES: bool = false;
const IS_POINTS: bool = false;
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
const FEWEST_RIDGE: f32 = 0.003;
const CLOSE_FROM: f32 = 0.3;
const CLOSE_TO: f32 = 0.8;
const MEAN_WIDTH: f32 = 1.5;
const ALIKE_FROM: f32 = 0.9;
const ALIKE_TO: f32 = 0.95;
const AROUND_FROM: f32 = 0.6;
const AROUND_TO: f32 = 0.9;
const LEAST_SURFACE_WEIGHT: f32 = 1e-12;
const LEAST_CERTAINTY: f32 = 1e-6;
const AGREEING: f32 = 0.5;
const LEAST_MEANS: f32 = 0.1;
const LEAST_NORMAL: f32 = 1e-15;
const MEAN_STAY: f32 = 0.05;
const LEAST_RAY_M: f32 = 0.0001;
const LEAST_SIDE: f32 = 1e-6;
const SIDE_COSINE: f32 = 0.1;
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
const TILE_HEIGHT: u32 = 4u;
const WINDOW: u32 = 3u;
const SIDE: u32 = 7u;
const STRIDE: u32 = 1u;
const ROW_STEP: u32 = 1u;
const DEGREE: u32 = 3u;
const EDGE_SHIFT: u32 = 0u;
const KEEPS_EDGES: bool = false;
const KEEPS_RESULTS: bool = false;
const BENDS: bool = false;
const READS_MEANS: bool = false;
const AVERAGES_BLOCKS: bool = false;
const SAMPLES: u32 = KEPT_MEAN;

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

fn pixels() -> u32 {
return batch.width * batch.height;
}

@group(0) @binding(3) var<storage, read_write> kept_points: array<f32>;
@group(0) @binding(4) var<storage, read_write> planes: array<f32>;

const KEPT_POINT: u32 = 0u;
const KEPT_MEAN: u32 = 3u;
const KEPT_SURFACE_MEAN: u32 = 6u;

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
const SURFACE_CERTAINTY: u32 = 21u;

const RESULT_NORMAL: u32 = SURFACE_NORMAL;
const RESULT_POINT: u32 = SURFACE_BEND;
const RESULT_STATUS: u32 = SURFACE_NO_PLANE_FITS;

const NOT_USABLE: f32 = 1e18;

fn grid_size() -> vec2<u32> {
return (vec2<u32>(batch.width, batch.height) + (CELL - 1u)) / CELL;
}

fn cells_in_frame() -> u32 {
let size = grid_size();
return size.x * size.y;
}

fn is_outside(cell: vec2<u32>) -> bool {
return any(cell >= grid_size());
}

fn cell_index(cell: vec2<u32>) -> u32 {
return cell.y * grid_size().x + cell.x;
}

fn kept_at(frame: u32, channel: u32, cell: u32) -> vec3<f32> {
let cells = cells_in_frame();
let at = (frame * POINT_CHANNELS + channel) * cells + cell;
return vec3<f32>(kept_points[at], kept_points[at + cells], kept_points[at + 2u * cells]);
}

fn keep_point(frame: u32, channel: u32, cell: u32, point: vec3<f32>) {
let cells = cells_in_frame();
let at = (frame * POINT_CHANNELS + channel) * cells + cell;
kept_points[at] = point.x;
kept_points[at + cells] = point.y;
kept_points[at + 2u * cells] = point.z;
}

fn plane_word(frame: u32, channel: u32, cell: u32) -> u32 {
return (frame * PLANE_CHANNELS + channel) * cells_in_frame() + cell;
}

fn plane_vector(frame: u32, channel: u32, cell: u32) -> vec3<f32> {
let at = plane_word(frame, channel, cell);
let cells = cells_in_frame();
return vec3<f32>(planes[at], planes[at + cells], planes[at + 2u * cells]);
}

fn keep_vector(frame: u32, channel: u32, cell: u32, vector: vec3<f32>) {
let at = plane_word(frame, channel, cell);
let cells = cells_in_frame();
planes[at] = vector.x;
planes[at + cells] = vector.y;
planes[at + 2u * cells] = vector.z;
}

fn noise_at(frame: u32, range: f32, radius: f32) -> f32 {
return clamp(max(polynomial_in_range(frame, SIGMA, range), radius * MIN_NOISE), 1e-15, MAX_RADIUS_M);
}

fn point_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
if x < 0 || y < 0 || x >= i32(batch.width) || y >= i32(batch.height) {
return vec3<f32>(NO_POINT);
}
let base = frame * batch.input_words + HEADER_WORDS;
let pixel = u32(y) * batch.width + u32(x);
let samples = base + batch.width + batch.height;
if IS_RAW_DEPTH || IS_DEPTH_METRES {
return deproject(frame, base, x, y, depth_at(frame, samples, pixel));
}
let pixels = batch.width * batch.height;
let bits = vec3<u32>(input[samples + pixel], input[samples + pixels + pixel], input[samples + 2u * pixels + pixel]);
if !(is_finite(bits.x) && is_finite(bits.y) && is_finite(bits.z)) {
return vec3<f32>(NO_POINT);
}
return bitcast<vec3<f32>>(bits);
}

fn depth_at(frame: u32, samples: u32, pixel: u32) -> f32 {
if IS_RAW_DEPTH {
let raw = (input[samples + (pixel >> 1u)] >> ((pixel & 1u) * 16u)) & 0xffffu;
return select(f32(raw) * header(frame, METRES_PER_UNIT), 0.0, raw == 0u || raw == SATURATED_DEPTH);
}
let bits = input[samples + pixel];
return select(0.0, bitcast<f32>(bits), is_finite(bits));
}

fn deproject(frame: u32, base: u32, x: i32, y: i32, z: f32) -> vec3<f32> {
if z <= 0.0 {
return vec3<f32>(NO_POINT);
}
let ray_x = bitcast<f32>(input[base + u32(x)]);
let ray_y = bitcast<f32>(input[base + batch.width + u32(y)]);
let point = vec3<f32>(ray_x * z, ray_y * z, z);
let is_point = is_finite(bitcast<u32>(point.x)) && is_finite(bitcast<u32>(point.y));
return select(vec3<f32>(NO_POINT), point, is_point);
}

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
return point_at(frame, x, y);
}

fn centre_of(frame: u32, pixel: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
return candidate(window, WINDOW, WINDOW);
}

const REACH: u32 = WINDOW * STRIDE;
const PITCH: u32 = TILE_WIDTH + 2u * REACH;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * WINDOW);

var<workgroup> tile_x: array<f32, TILE_AREA>;
var<workgroup> tile_y: array<f32, TILE_AREA>;
var<workgroup> tile_z: array<f32, TILE_AREA>;

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
fn offset_of(column: u32) -> i32 {
let from_middle = i32(column) - i32(WINDOW);
return sign(from_middle) * ((abs(from_middle) * i32(STRIDE) + i32(CELL) - 1) / i32(CELL));
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

fn origin_of(group: vec3<u32>) -> vec2<u32> {
return vec2<u32>(group.x * TILE_WIDTH, group.y / ROW_STEP * (ROW_STEP * TILE_HEIGHT) + group.y % ROW_STEP);
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

fn smooth_point(frame: u32, pixel: vec2<u32>, window: WindowOrigin, p: vec3<f32>) -> PixelResult {
let ray = ray_to(frame, p);
let radius = radius_at(frame, range_of(frame, ray));
let sums = sums_of(window, p, gate_of(radius));
let n = u32(sums.n);
if n < 3u {
return no_result(STATUS_TOO_FEW, n);
}
return result_of(frame, window, p, radius, LocalSurface(plane_of(ray, sums), sums.n, 0.0, vec3<f32>(0.0), 0.0));
}

struct Projected {
point: vec3<f32>,
normal: vec3<f32>,
status: u32,
depth_scale: f32,
}

fn is_on_ray(frame: u32) -> bool {
return !KEEPS_RESULTS && (header_bits(frame, FLAGS) & ON_RAY) != 0u;
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
struct Moments {
    m00: f32,
    m01: f32,
    m02: f32,
    m03: f32,
    m04: f32,
    m05: f32,
    m06: f32,
    m10: f32,
    m11: f32,
    m12: f32,
    m13: f32,
    m14: f32,
    m15: f32,
    m20: f32,
    m21: f32,
    m22: f32,
    m23: f32,
    m24: f32,
    m30: f32,
    m31: f32,
    m32: f32,
    m33: f32,
    m40: f32,
    m41: f32,
    m42: f32,
    m50: f32,
    m51: f32,
    m60: f32,
    t00: f32,
    t01: f32,
    t02: f32,
    t03: f32,
    t10: f32,
    t11: f32,
    t12: f32,
    t20: f32,
    t21: f32,
    t30: f32,
}

struct Fit {
moments: Moments,
squares: f32,
u: vec3<f32>,
v: vec3<f32>,
per_metre: f32,
extent_squared: f32,
}

fn fit_of(window: WindowOrigin, p: vec3<f32>, radius_squared: f32, surface: LocalSurface, width: f32, bandwidth: f32) -> Fit {
let plane = surface.plane;
let tangents = tangents_of(plane.normal);
let per_metre = SQRT_LOG2_E / bandwidth;
let a_axis = tangents.u * per_metre;
let b_axis = tangents.v * per_metre;
let f_axis = plane.normal * per_metre;
let f_offset = plane.height * per_metre;
let gate = Gate(-GATE_FADE / (radius_squared * per_metre * per_metre));
let narrowing = (bandwidth / width) * (bandwidth / width);
let half_bend = surface.bend * (0.5 / per_metre);
var s: Moments;
var squares = 0.0;
for (var row = 0u; row < SIDE; row++) { for (var column = 0u; column < SIDE; column++) {
        let e = candidate(window, column, row) - p;
        let count = 1.0;
let a = fma(e.x, a_axis.x, fma(e.y, a_axis.y, e.z * a_axis.z));
let b = fma(e.x, b_axis.x, fma(e.y, b_axis.y, e.z * b_axis.z));
let above_p = fma(e.x, f_axis.x, fma(e.y, f_axis.y, e.z * f_axis.z));
let in_plane = fma(a, a, b * b);
let squared = fma(above_p, above_p, in_plane);
let nearness = unclamped(gate, squared);
if nearness > 0.0 {
var f = above_p - f_offset;
var exponent = fma(f, f, in_plane);
if BENDS {
f -= fma(a * a, half_bend.x, fma(b * b, half_bend.z, 2.0 * a * b * half_bend.y));
}
if KEEPS_EDGES {
exponent += min(f * f * narrowing, MAX_OFF_SURFACE);
}
let w = count * (min(nearness, 1.0) * exp2(-exponent));
if BENDS {
squares = fma(w * f, f, squares);
}
let wa0 = w;
let wa1 = w * a;
let a2 = a * a;
let b1 = b;
let b2 = b * b;
let wa2 = wa0 * a2;
let wa3 = wa1 * a2;
let wa4 = wa2 * a2;
let wa5 = wa3 * a2;
let b3 = b1 * b2;
let b4 = b2 * b2;
let b5 = b2 * b3;
let b6 = b3 * b3;
s.m00 += wa0;
s.m01 = fma(wa0, b1, s.m01);
s.m02 = fma(wa0, b2, s.m02);
s.m03 = fma(wa0, b3, s.m03);
s.m04 = fma(wa0, b4, s.m04);
s.m05 = fma(wa0, b5, s.m05);
s.m06 = fma(wa0, b6, s.m06);
s.m10 += wa1;
s.m11 = fma(wa1, b1, s.m11);
s.m12 = fma(wa1, b2, s.m12);
s.m13 = fma(wa1, b3, s.m13);
s.m14 = fma(wa1, b4, s.m14);
s.m15 = fma(wa1, b5, s.m15);
s.m20 += wa2;
s.m21 = fma(wa2, b1, s.m21);
s.m22 = fma(wa2, b2, s.m22);
s.m23 = fma(wa2, b3, s.m23);
s.m24 = fma(wa2, b4, s.m24);
s.m30 += wa3;
s.m31 = fma(wa3, b1, s.m31);
s.m32 = fma(wa3, b2, s.m32);
s.m33 = fma(wa3, b3, s.m33);
s.m40 += wa4;
s.m41 = fma(wa4, b1, s.m41);
s.m42 = fma(wa4, b2, s.m42);
s.m50 += wa5;
s.m51 = fma(wa5, b1, s.m51);
s.m60 = fma(wa4, a2, s.m60);
let wf0 = wa0 * f;
s.t00 += wf0;
s.t01 = fma(wf0, b1, s.t01);
s.t02 = fma(wf0, b2, s.t02);
s.t03 = fma(wf0, b3, s.t03);
let wf1 = wa1 * f;
s.t10 += wf1;
s.t11 = fma(wf1, b1, s.t11);
s.t12 = fma(wf1, b2, s.t12);
let wf2 = wa2 * f;
s.t20 += wf2;
s.t21 = fma(wf2, b1, s.t21);
s.t30 = fma(wa3, f, s.t30);

}
} }
let extent_squared = min(plane.extent_squared, radius_squared) * per_metre * per_metre;
return Fit(s, squares, tangents.u, tangents.v, per_metre, extent_squared);
}
fn solve(s: Moments, ridge: f32, extent_squared: f32, n: f32) -> vec4<f32> {
let ridge0 = 0.0;
let ridge1 = s.m00 * ridge * extent_squared;
let ridge2 = ridge1 * extent_squared;
let ridge3 = ridge2 * extent_squared;
var pivot0 = fma(ridge0, 0.0, s.m00);
var y0 = s.t00;
let inverse0 = select(0.0, 1.0 / pivot0, pivot0 > 0.0);
var d1_0 = s.m10;
let l1_0 = d1_0 * inverse0;
var d2_0 = s.m01;
let l2_0 = d2_0 * inverse0;
var d3_0 = s.m20;
let l3_0 = d3_0 * inverse0;
var d4_0 = s.m11;
let l4_0 = d4_0 * inverse0;
var d5_0 = s.m02;
let l5_0 = d5_0 * inverse0;
var d6_0 = s.m30;
let l6_0 = d6_0 * inverse0;
var d7_0 = s.m21;
let l7_0 = d7_0 * inverse0;
var d8_0 = s.m12;
let l8_0 = d8_0 * inverse0;
var d9_0 = s.m03;
let l9_0 = d9_0 * inverse0;
var pivot1 = fma(ridge1, 1.0, s.m20);
var y1 = s.t10;
pivot1 = fma(-l1_0, d1_0, pivot1);
y1 = fma(-l1_0, y0, y1);
let inverse1 = select(0.0, 1.0 / pivot1, pivot1 > 0.0);
var d2_1 = s.m11;
d2_1 = fma(-l2_0, d1_0, d2_1);
let l2_1 = d2_1 * inverse1;
var d3_1 = s.m30;
d3_1 = fma(-l3_0, d1_0, d3_1);
let l3_1 = d3_1 * inverse1;
var d4_1 = s.m21;
d4_1 = fma(-l4_0, d1_0, d4_1);
let l4_1 = d4_1 * inverse1;
var d5_1 = s.m12;
d5_1 = fma(-l5_0, d1_0, d5_1);
let l5_1 = d5_1 * inverse1;
var d6_1 = s.m40;
d6_1 = fma(-l6_0, d1_0, d6_1);
let l6_1 = d6_1 * inverse1;
var d7_1 = s.m31;
d7_1 = fma(-l7_0, d1_0, d7_1);
let l7_1 = d7_1 * inverse1;
var d8_1 = s.m22;
d8_1 = fma(-l8_0, d1_0, d8_1);
let l8_1 = d8_1 * inverse1;
var d9_1 = s.m13;
d9_1 = fma(-l9_0, d1_0, d9_1);
let l9_1 = d9_1 * inverse1;
var pivot2 = fma(ridge1, 1.0, s.m02);
var y2 = s.t01;
pivot2 = fma(-l2_0, d2_0, pivot2);
y2 = fma(-l2_0, y0, y2);
pivot2 = fma(-l2_1, d2_1, pivot2);
y2 = fma(-l2_1, y1, y2);
let inverse2 = select(0.0, 1.0 / pivot2, pivot2 > 0.0);
var d3_2 = s.m21;
d3_2 = fma(-l3_0, d2_0, d3_2);
d3_2 = fma(-l3_1, d2_1, d3_2);
let l3_2 = d3_2 * inverse2;
var d4_2 = s.m12;
d4_2 = fma(-l4_0, d2_0, d4_2);
d4_2 = fma(-l4_1, d2_1, d4_2);
let l4_2 = d4_2 * inverse2;
var d5_2 = s.m03;
d5_2 = fma(-l5_0, d2_0, d5_2);
d5_2 = fma(-l5_1, d2_1, d5_2);
let l5_2 = d5_2 * inverse2;
var d6_2 = s.m31;
d6_2 = fma(-l6_0, d2_0, d6_2);
d6_2 = fma(-l6_1, d2_1, d6_2);
let l6_2 = d6_2 * inverse2;
var d7_2 = s.m22;
d7_2 = fma(-l7_0, d2_0, d7_2);
d7_2 = fma(-l7_1, d2_1, d7_2);
let l7_2 = d7_2 * inverse2;
var d8_2 = s.m13;
d8_2 = fma(-l8_0, d2_0, d8_2);
d8_2 = fma(-l8_1, d2_1, d8_2);
let l8_2 = d8_2 * inverse2;
var d9_2 = s.m04;
d9_2 = fma(-l9_0, d2_0, d9_2);
d9_2 = fma(-l9_1, d2_1, d9_2);
let l9_2 = d9_2 * inverse2;
var pivot3 = fma(ridge2, 1.0, s.m40);
var y3 = s.t20;
pivot3 = fma(-l3_0, d3_0, pivot3);
y3 = fma(-l3_0, y0, y3);
pivot3 = fma(-l3_1, d3_1, pivot3);
y3 = fma(-l3_1, y1, y3);
pivot3 = fma(-l3_2, d3_2, pivot3);
y3 = fma(-l3_2, y2, y3);
let inverse3 = select(0.0, 1.0 / pivot3, pivot3 > 0.0);
var d4_3 = s.m31;
d4_3 = fma(-l4_0, d3_0, d4_3);
d4_3 = fma(-l4_1, d3_1, d4_3);
d4_3 = fma(-l4_2, d3_2, d4_3);
let l4_3 = d4_3 * inverse3;
var d5_3 = s.m22;
d5_3 = fma(-l5_0, d3_0, d5_3);
d5_3 = fma(-l5_1, d3_1, d5_3);
d5_3 = fma(-l5_2, d3_2, d5_3);
let l5_3 = d5_3 * inverse3;
var d6_3 = s.m50;
d6_3 = fma(-l6_0, d3_0, d6_3);
d6_3 = fma(-l6_1, d3_1, d6_3);
d6_3 = fma(-l6_2, d3_2, d6_3);
let l6_3 = d6_3 * inverse3;
var d7_3 = s.m41;
d7_3 = fma(-l7_0, d3_0, d7_3);
d7_3 = fma(-l7_1, d3_1, d7_3);
d7_3 = fma(-l7_2, d3_2, d7_3);
let l7_3 = d7_3 * inverse3;
var d8_3 = s.m32;
d8_3 = fma(-l8_0, d3_0, d8_3);
d8_3 = fma(-l8_1, d3_1, d8_3);
d8_3 = fma(-l8_2, d3_2, d8_3);
let l8_3 = d8_3 * inverse3;
var d9_3 = s.m23;
d9_3 = fma(-l9_0, d3_0, d9_3);
d9_3 = fma(-l9_1, d3_1, d9_3);
d9_3 = fma(-l9_2, d3_2, d9_3);
let l9_3 = d9_3 * inverse3;
var pivot4 = fma(ridge2, 0.5, s.m22);
var y4 = s.t11;
pivot4 = fma(-l4_0, d4_0, pivot4);
y4 = fma(-l4_0, y0, y4);
pivot4 = fma(-l4_1, d4_1, pivot4);
y4 = fma(-l4_1, y1, y4);
pivot4 = fma(-l4_2, d4_2, pivot4);
y4 = fma(-l4_2, y2, y4);
pivot4 = fma(-l4_3, d4_3, pivot4);
y4 = fma(-l4_3, y3, y4);
let inverse4 = select(0.0, 1.0 / pivot4, pivot4 > 0.0);
var d5_4 = s.m13;
d5_4 = fma(-l5_0, d4_0, d5_4);
d5_4 = fma(-l5_1, d4_1, d5_4);
d5_4 = fma(-l5_2, d4_2, d5_4);
d5_4 = fma(-l5_3, d4_3, d5_4);
let l5_4 = d5_4 * inverse4;
var d6_4 = s.m41;
d6_4 = fma(-l6_0, d4_0, d6_4);
d6_4 = fma(-l6_1, d4_1, d6_4);
d6_4 = fma(-l6_2, d4_2, d6_4);
d6_4 = fma(-l6_3, d4_3, d6_4);
let l6_4 = d6_4 * inverse4;
var d7_4 = s.m32;
d7_4 = fma(-l7_0, d4_0, d7_4);
d7_4 = fma(-l7_1, d4_1, d7_4);
d7_4 = fma(-l7_2, d4_2, d7_4);
d7_4 = fma(-l7_3, d4_3, d7_4);
let l7_4 = d7_4 * inverse4;
var d8_4 = s.m23;
d8_4 = fma(-l8_0, d4_0, d8_4);
d8_4 = fma(-l8_1, d4_1, d8_4);
d8_4 = fma(-l8_2, d4_2, d8_4);
d8_4 = fma(-l8_3, d4_3, d8_4);
let l8_4 = d8_4 * inverse4;
var d9_4 = s.m14;
d9_4 = fma(-l9_0, d4_0, d9_4);
d9_4 = fma(-l9_1, d4_1, d9_4);
d9_4 = fma(-l9_2, d4_2, d9_4);
d9_4 = fma(-l9_3, d4_3, d9_4);
let l9_4 = d9_4 * inverse4;
var pivot5 = fma(ridge2, 1.0, s.m04);
var y5 = s.t02;
pivot5 = fma(-l5_0, d5_0, pivot5);
y5 = fma(-l5_0, y0, y5);
pivot5 = fma(-l5_1, d5_1, pivot5);
y5 = fma(-l5_1, y1, y5);
pivot5 = fma(-l5_2, d5_2, pivot5);
y5 = fma(-l5_2, y2, y5);
pivot5 = fma(-l5_3, d5_3, pivot5);
y5 = fma(-l5_3, y3, y5);
pivot5 = fma(-l5_4, d5_4, pivot5);
y5 = fma(-l5_4, y4, y5);
let inverse5 = select(0.0, 1.0 / pivot5, pivot5 > 0.0);
var d6_5 = s.m32;
d6_5 = fma(-l6_0, d5_0, d6_5);
d6_5 = fma(-l6_1, d5_1, d6_5);
d6_5 = fma(-l6_2, d5_2, d6_5);
d6_5 = fma(-l6_3, d5_3, d6_5);
d6_5 = fma(-l6_4, d5_4, d6_5);
let l6_5 = d6_5 * inverse5;
var d7_5 = s.m23;
d7_5 = fma(-l7_0, d5_0, d7_5);
d7_5 = fma(-l7_1, d5_1, d7_5);
d7_5 = fma(-l7_2, d5_2, d7_5);
d7_5 = fma(-l7_3, d5_3, d7_5);
d7_5 = fma(-l7_4, d5_4, d7_5);
let l7_5 = d7_5 * inverse5;
var d8_5 = s.m14;
d8_5 = fma(-l8_0, d5_0, d8_5);
d8_5 = fma(-l8_1, d5_1, d8_5);
d8_5 = fma(-l8_2, d5_2, d8_5);
d8_5 = fma(-l8_3, d5_3, d8_5);
d8_5 = fma(-l8_4, d5_4, d8_5);
let l8_5 = d8_5 * inverse5;
var d9_5 = s.m05;
d9_5 = fma(-l9_0, d5_0, d9_5);
d9_5 = fma(-l9_1, d5_1, d9_5);
d9_5 = fma(-l9_2, d5_2, d9_5);
d9_5 = fma(-l9_3, d5_3, d9_5);
d9_5 = fma(-l9_4, d5_4, d9_5);
let l9_5 = d9_5 * inverse5;
var pivot6 = fma(ridge3, 1.0, s.m60);
var y6 = s.t30;
pivot6 = fma(-l6_0, d6_0, pivot6);
y6 = fma(-l6_0, y0, y6);
pivot6 = fma(-l6_1, d6_1, pivot6);
y6 = fma(-l6_1, y1, y6);
pivot6 = fma(-l6_2, d6_2, pivot6);
y6 = fma(-l6_2, y2, y6);
pivot6 = fma(-l6_3, d6_3, pivot6);
y6 = fma(-l6_3, y3, y6);
pivot6 = fma(-l6_4, d6_4, pivot6);
y6 = fma(-l6_4, y4, y6);
pivot6 = fma(-l6_5, d6_5, pivot6);
y6 = fma(-l6_5, y5, y6);
let inverse6 = select(0.0, 1.0 / pivot6, pivot6 > 0.0 && n >= 10.0);
var d7_6 = s.m51;
d7_6 = fma(-l7_0, d6_0, d7_6);
d7_6 = fma(-l7_1, d6_1, d7_6);
d7_6 = fma(-l7_2, d6_2, d7_6);
d7_6 = fma(-l7_3, d6_3, d7_6);
d7_6 = fma(-l7_4, d6_4, d7_6);
d7_6 = fma(-l7_5, d6_5, d7_6);
let l7_6 = d7_6 * inverse6;
var d8_6 = s.m42;
d8_6 = fma(-l8_0, d6_0, d8_6);
d8_6 = fma(-l8_1, d6_1, d8_6);
d8_6 = fma(-l8_2, d6_2, d8_6);
d8_6 = fma(-l8_3, d6_3, d8_6);
d8_6 = fma(-l8_4, d6_4, d8_6);
d8_6 = fma(-l8_5, d6_5, d8_6);
let l8_6 = d8_6 * inverse6;
var d9_6 = s.m33;
d9_6 = fma(-l9_0, d6_0, d9_6);
d9_6 = fma(-l9_1, d6_1, d9_6);
d9_6 = fma(-l9_2, d6_2, d9_6);
d9_6 = fma(-l9_3, d6_3, d9_6);
d9_6 = fma(-l9_4, d6_4, d9_6);
d9_6 = fma(-l9_5, d6_5, d9_6);
let l9_6 = d9_6 * inverse6;
var pivot7 = fma(ridge3, 0.33333334, s.m42);
var y7 = s.t21;
pivot7 = fma(-l7_0, d7_0, pivot7);
y7 = fma(-l7_0, y0, y7);
pivot7 = fma(-l7_1, d7_1, pivot7);
y7 = fma(-l7_1, y1, y7);
pivot7 = fma(-l7_2, d7_2, pivot7);
y7 = fma(-l7_2, y2, y7);
pivot7 = fma(-l7_3, d7_3, pivot7);
y7 = fma(-l7_3, y3, y7);
pivot7 = fma(-l7_4, d7_4, pivot7);
y7 = fma(-l7_4, y4, y7);
pivot7 = fma(-l7_5, d7_5, pivot7);
y7 = fma(-l7_5, y5, y7);
pivot7 = fma(-l7_6, d7_6, pivot7);
y7 = fma(-l7_6, y6, y7);
let inverse7 = select(0.0, 1.0 / pivot7, pivot7 > 0.0 && n >= 10.0);
var d8_7 = s.m33;
d8_7 = fma(-l8_0, d7_0, d8_7);
d8_7 = fma(-l8_1, d7_1, d8_7);
d8_7 = fma(-l8_2, d7_2, d8_7);
d8_7 = fma(-l8_3, d7_3, d8_7);
d8_7 = fma(-l8_4, d7_4, d8_7);
d8_7 = fma(-l8_5, d7_5, d8_7);
d8_7 = fma(-l8_6, d7_6, d8_7);
let l8_7 = d8_7 * inverse7;
var d9_7 = s.m24;
d9_7 = fma(-l9_0, d7_0, d9_7);
d9_7 = fma(-l9_1, d7_1, d9_7);
d9_7 = fma(-l9_2, d7_2, d9_7);
d9_7 = fma(-l9_3, d7_3, d9_7);
d9_7 = fma(-l9_4, d7_4, d9_7);
d9_7 = fma(-l9_5, d7_5, d9_7);
d9_7 = fma(-l9_6, d7_6, d9_7);
let l9_7 = d9_7 * inverse7;
var pivot8 = fma(ridge3, 0.33333334, s.m24);
var y8 = s.t12;
pivot8 = fma(-l8_0, d8_0, pivot8);
y8 = fma(-l8_0, y0, y8);
pivot8 = fma(-l8_1, d8_1, pivot8);
y8 = fma(-l8_1, y1, y8);
pivot8 = fma(-l8_2, d8_2, pivot8);
y8 = fma(-l8_2, y2, y8);
pivot8 = fma(-l8_3, d8_3, pivot8);
y8 = fma(-l8_3, y3, y8);
pivot8 = fma(-l8_4, d8_4, pivot8);
y8 = fma(-l8_4, y4, y8);
pivot8 = fma(-l8_5, d8_5, pivot8);
y8 = fma(-l8_5, y5, y8);
pivot8 = fma(-l8_6, d8_6, pivot8);
y8 = fma(-l8_6, y6, y8);
pivot8 = fma(-l8_7, d8_7, pivot8);
y8 = fma(-l8_7, y7, y8);
let inverse8 = select(0.0, 1.0 / pivot8, pivot8 > 0.0 && n >= 10.0);
var d9_8 = s.m15;
d9_8 = fma(-l9_0, d8_0, d9_8);
d9_8 = fma(-l9_1, d8_1, d9_8);
d9_8 = fma(-l9_2, d8_2, d9_8);
d9_8 = fma(-l9_3, d8_3, d9_8);
d9_8 = fma(-l9_4, d8_4, d9_8);
d9_8 = fma(-l9_5, d8_5, d9_8);
d9_8 = fma(-l9_6, d8_6, d9_8);
d9_8 = fma(-l9_7, d8_7, d9_8);
let l9_8 = d9_8 * inverse8;
var pivot9 = fma(ridge3, 1.0, s.m06);
var y9 = s.t03;
pivot9 = fma(-l9_0, d9_0, pivot9);
y9 = fma(-l9_0, y0, y9);
pivot9 = fma(-l9_1, d9_1, pivot9);
y9 = fma(-l9_1, y1, y9);
pivot9 = fma(-l9_2, d9_2, pivot9);
y9 = fma(-l9_2, y2, y9);
pivot9 = fma(-l9_3, d9_3, pivot9);
y9 = fma(-l9_3, y3, y9);
pivot9 = fma(-l9_4, d9_4, pivot9);
y9 = fma(-l9_4, y4, y9);
pivot9 = fma(-l9_5, d9_5, pivot9);
y9 = fma(-l9_5, y5, y9);
pivot9 = fma(-l9_6, d9_6, pivot9);
y9 = fma(-l9_6, y6, y9);
pivot9 = fma(-l9_7, d9_7, pivot9);
y9 = fma(-l9_7, y7, y9);
pivot9 = fma(-l9_8, d9_8, pivot9);
y9 = fma(-l9_8, y8, y9);
let inverse9 = select(0.0, 1.0 / pivot9, pivot9 > 0.0 && n >= 10.0);
var c9 = y9 * inverse9;
var c8 = y8 * inverse8;
c8 = fma(-l9_8, c9, c8);
var c7 = y7 * inverse7;
c7 = fma(-l9_7, c9, c7);
c7 = fma(-l8_7, c8, c7);
var c6 = y6 * inverse6;
c6 = fma(-l9_6, c9, c6);
c6 = fma(-l8_6, c8, c6);
c6 = fma(-l7_6, c7, c6);
var c5 = y5 * inverse5;
c5 = fma(-l9_5, c9, c5);
c5 = fma(-l8_5, c8, c5);
c5 = fma(-l7_5, c7, c5);
c5 = fma(-l6_5, c6, c5);
var c4 = y4 * inverse4;
c4 = fma(-l9_4, c9, c4);
c4 = fma(-l8_4, c8, c4);
c4 = fma(-l7_4, c7, c4);
c4 = fma(-l6_4, c6, c4);
c4 = fma(-l5_4, c5, c4);
var c3 = y3 * inverse3;
c3 = fma(-l9_3, c9, c3);
c3 = fma(-l8_3, c8, c3);
c3 = fma(-l7_3, c7, c3);
c3 = fma(-l6_3, c6, c3);
c3 = fma(-l5_3, c5, c3);
c3 = fma(-l4_3, c4, c3);
var c2 = y2 * inverse2;
c2 = fma(-l9_2, c9, c2);
c2 = fma(-l8_2, c8, c2);
c2 = fma(-l7_2, c7, c2);
c2 = fma(-l6_2, c6, c2);
c2 = fma(-l5_2, c5, c2);
c2 = fma(-l4_2, c4, c2);
c2 = fma(-l3_2, c3, c2);
var c1 = y1 * inverse1;
c1 = fma(-l9_1, c9, c1);
c1 = fma(-l8_1, c8, c1);
c1 = fma(-l7_1, c7, c1);
c1 = fma(-l6_1, c6, c1);
c1 = fma(-l5_1, c5, c1);
c1 = fma(-l4_1, c4, c1);
c1 = fma(-l3_1, c3, c1);
c1 = fma(-l2_1, c2, c1);
var c0 = y0 * inverse0;
c0 = fma(-l9_0, c9, c0);
c0 = fma(-l8_0, c8, c0);
c0 = fma(-l7_0, c7, c0);
c0 = fma(-l6_0, c6, c0);
c0 = fma(-l5_0, c5, c0);
c0 = fma(-l4_0, c4, c0);
c0 = fma(-l3_0, c3, c0);
c0 = fma(-l2_0, c2, c0);
c0 = fma(-l1_0, c1, c0);
return vec4<f32>(c0, c1, c2, y0 * (y0 * inverse0) + y1 * (y1 * inverse1) + y2 * (y2 * inverse2) + y3 * (y3 * inverse3) + y4 * (y4 * inverse4) + y5 * (y5 * inverse5) + y6 * (y6 * inverse6) + y7 * (y7 * inverse7) + y8 * (y8 * inverse8) + y9 * (y9 * inverse9));
}

fn project_on_polynomial(frame: u32, p: vec3<f32>, plane: Plane, fit: Fit, c: vec3<f32>, radius: f32, n: f32) -> Projected {
let height = c.x / fit.per_metre + plane.height;
if !(height * height <= radius * radius) || !is_finite(bitcast<u32>(height)) {
return project_on_plane(frame, p, plane, radius);
}
var normal = plane.normal;
if WANTS_NORMALS || WANTS_DEPTH || WANTS_DEPTH_M || is_on_ray(frame) {
normal = plane.normal - c.y * fit.u - c.z * fit.v;
normal *= select(1.0, -1.0, dot(normal, ray_to(frame, p)) > 0.0) / sqrt(dot(normal, normal));
}
let status = select(STATUS_POLYNOMIAL_2, STATUS_POLYNOMIAL_3, DEGREE == 3u && n >= 10.0);
return put_on_surface(frame, p, plane.normal, height, normal, radius, status);
}

fn surface_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> Projected {
if surface.n < 6.0 {
return project_on_plane(frame, p, surface.plane, radius);
}
let own_bandwidth = header(frame, BANDWIDTH);
let bandwidth = select(radius, own_bandwidth, own_bandwidth > 0.0);
let ridge = header(frame, RIDGE);
let low_ridge = min(ridge, select(LOW_RIDGE, FEWEST_RIDGE, surface.n == 6.0));
var fit: Fit;
var c = vec3<f32>(0.0);
let rounds = select(1u, 2u, BENDS && surface.no_plane_fits > 0.0);
for (var round = 0u; round < rounds; round++) {
let of_all = BENDS && round == 1u;
fit = fit_of(window, p, radius * radius, surface, select(surface.width, 1e18, of_all), bandwidth);
let solution = solve(fit.moments, select(ridge, low_ridge, of_all), fit.extent_squared, surface.n);
var share = 1.0;
if of_all {
let per_noise = NARROW_WIDTH / (surface.width * fit.per_metre);
let variance = (fit.squares - solution.w) * per_noise * per_noise / fit.moments.m00;
let close = clamp((CLOSE_TO - variance) / (CLOSE_TO - CLOSE_FROM), 0.0, 1.0);
share = select(0.0, surface.no_plane_fits * close, fit.moments.m00 > 0.0);
}
c = mix(c, solution.xyz, share);
}
return project_on_polynomial(frame, p, surface.plane, fit, c, radius, surface.n);
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

fn result_of(frame: u32, window: WindowOrigin, p: vec3<f32>, radius: f32, surface: LocalSurface) -> PixelResult {
let n = u32(surface.n);
if surface.plane.is_degenerate {
var result = no_result(STATUS_DEGENERATE, n);
result.point = bitcast<vec3<u32>>(p);
return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
}
let projected = surface_of(frame, window, p, radius, surface);
let result = PixelResult(
bitcast<vec3<u32>>(projected.point),
bitcast<vec3<u32>>(projected.normal),
bitcast<u32>(surface.plane.curvature),
NAN_BITS,
projected.status | (n << 8u),
);
return with_depth(frame, depth_of(frame, ray_to(frame, p)) * projected.depth_scale, result);
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
let y = origin.y + row * ROW_STEP;
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

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn smooth_frames(
@builtin(workgroup_id) group: vec3<u32>,
@builtin(local_invocation_id) local: vec3<u32>,
@builtin(local_invocation_index) thread: u32,
) {
let frame = group.z;
let origin = origin_of(group);
let cell = origin + local.xy * vec2<u32>(1u, ROW_STEP);
load_candidates(frame, origin, thread);
let window = window_origin_of(frame, cell, local.xy);
let p = centre_of(frame, cell, window);
var result = no_result(STATUS_HOLE, 0u);
if p.x != NO_POINT {
result = smooth_point(frame, cell, window, p);
}
store(frame, origin, cell, thread, result);
}
