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
const CELL: u32 = 2u;
const POINT_CHANNELS: u32 = 9u;
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
const TILE_HEIGHT: u32 = 8u;
const WINDOW: u32 = 0u;
const SIDE: u32 = 1u;
const STRIDE: u32 = 1u;
const ROW_STEP: u32 = 1u;
const DEGREE: u32 = 1u;
const EDGE_SHIFT: u32 = 0u;
const KEEPS_EDGES: bool = false;
const KEEPS_RESULTS: bool = false;
const BENDS: bool = false;
const READS_MEANS: bool = false;
const AVERAGES_BLOCKS: bool = true;
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

struct WindowOrigin {
frame: u32,
x: i32,
y: i32,
}

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
return WindowOrigin(frame, i32(cell.x), i32(cell.y));
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
return sample_at(window.frame, window.x + offset_of(column), window.y + offset_of(row));
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

fn middle_of(window: WindowOrigin) -> vec3<f32> {
var p = candidate(window, WINDOW, WINDOW);
for (var i = 1u; i < CELL * CELL && p.x == NO_POINT; i++) {
p = candidate(window, WINDOW + i % CELL, WINDOW + i / CELL);
}
return p;
}

fn block_gate(frame: u32, range: f32) -> f32 {
let gate_m = max(range * header(frame, BLOCK_LINEAR), polynomial_in_range(frame, BLOCK, range));
return clamp(gate_m, MIN_GATE_M, MAX_RADIUS_M);
}

fn block_mean(window: WindowOrigin, p: vec3<f32>, gate: Gate, normal_per_width: vec3<f32>, height_in_widths: f32) -> vec3<f32> {
var sum = vec3<f32>(0.0);
var total = 0.0;
for (var row = 0u; row < SIDE; row++) {
for (var column = 0u; column < SIDE; column++) {
let offset = candidate(window, column, row) - p;
let squared = square(offset);
let nearness = unclamped(gate, squared);
let e = select(vec3<f32>(0.0), offset, nearness > 0.0);
let f = dot(e, normal_per_width) - height_in_widths;
let on_surface = max(fma(-f, f, 1.0), MIN_BLOCK_WEIGHT);
let weight = clamp(nearness, 0.0, 1.0) * on_surface * on_surface;
sum = fma(vec3<f32>(weight), e, sum);
total += weight;
}
}
return p + sum / total;
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

const BEFORE: u32 = 1u;
const PITCH: u32 = TILE_WIDTH / CELL + 3u;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT / CELL + 3u);

var<workgroup> result_points: array<vec4<f32>, TILE_AREA>;
var<workgroup> result_normals: array<vec3<f32>, TILE_AREA>;

struct CellResult {
point: vec3<f32>,
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

fn result_at(place: vec2<u32>) -> CellResult {
let at = place.y * PITCH + place.x;
let point = result_points[at];
return CellResult(point.xyz, result_normals[at], point.w);
}

const ALL_SHARES: f32 = 4.0;

struct CellsAround {
first: vec2<u32>,
from_first: vec2<u32>,
size: vec2<u32>,
}

fn share_of(column: u32, from_first: u32, reach: f32) -> f32 {
return 1.0 - abs(f32(CELL * column) - f32(from_first)) / reach;
}

fn cells_around(local: vec2<u32>) -> CellsAround {
let place = local % CELL;
return CellsAround(local / CELL, place + CELL * BEFORE, place + 3u);
}

struct Voted {
total: f32,
certain: f32,
normal: vec3<f32>,
height: f32,
best: vec2<u32>,
}

fn vote_of(around: CellsAround, p: vec3<f32>, ray: vec3<f32>, to_mean: vec3<f32>, radius: f32, noise: f32) -> Voted {
let gate = gate_of(radius);
let per_noise = 1.0 / noise;
let length = sqrt(dot(ray, ray));
let towards = ray * (-1.0 / SIDE_COSINE / max(length, LEAST_RAY_M));
var voted: Voted;
var most = 0.0;
let start = around.size - 3u;
for (var row = start.y; row < 3u; row++) {
let down = share_of(row, around.from_first.y, 3.0);
for (var column = start.x; column < 3u; column++) {
let place = around.first + vec2<u32>(column, row);
let other = result_at(place);
let offset = other.point - p;
let nearness = min(unclamped(gate, square(offset)), 1.0);
if !(nearness > 0.0) || dot(other.normal, other.normal) == 0.0 {
continue;
}
let height = dot(offset, other.normal);
let from_mean = (height - dot(to_mean, other.normal)) * per_noise;
let root = 1.0 / fma(from_mean, from_mean, 1.0);
let share = down * share_of(column, around.from_first.x, 3.0);
let towards_side = select(dot(other.normal, towards), 1.0, length < LEAST_RAY_M);
let side = clamp(abs(towards_side), LEAST_SIDE, 1.0) * select(1.0, -1.0, towards_side < 0.0);
let fits = nearness * share * (root * root) * (root * root);
let certain = fits * other.certainty * side;
let weight = fits * (other.certainty + LEAST_CERTAINTY);
if weight > most {
most = weight;
voted.best = place;
}
voted.total += fits;
voted.certain += abs(certain);
voted.height = fma(certain, height, voted.height);
voted.normal = fma(vec3<f32>(weight * side), other.normal, voted.normal);
}
}
return voted;
}

struct Mean {
height: f32,
normal: vec3<f32>,
}

fn mean_around(around: CellsAround, point: vec3<f32>, own_normal: vec3<f32>, noise: f32) -> Mean {
let per_width = 1.0 / (noise * MEAN_WIDTH);
var total = 0.0;
var heights = 0.0;
var offsets = vec3<f32>(0.0);
var normals = STAY_WEIGHT * own_normal;
for (var row = 0u; row < around.size.y; row++) {
let down = share_of(row, around.from_first.y, 4.0);
for (var column = 0u; column < around.size.x; column++) {
let other = result_at(around.first + vec2<u32>(column, row));
let offset = other.point - point;
let height = dot(offset, other.normal);
let widths = height * per_width;
let cosine = dot(own_normal, other.normal);
let alike = clamp((abs(cosine) - ALIKE_FROM) / (ALIKE_TO - ALIKE_FROM), 0.0, 1.0);
let share = down * share_of(column, around.from_first.x, 4.0) * other.certainty;
let weight = max(fma(-widths, widths, 1.0), 0.0) * alike * share;
let signed = select(weight, -weight, cosine < 0.0);
total += weight;
heights = fma(signed, height, heights);
offsets = fma(vec3<f32>(weight), offset, offsets);
normals = fma(vec3<f32>(signed), other.normal, normals);
}
}
let normal = normalize(normals);
let bend = dot(offsets, normal) - heights;
let all_around = clamp((total / ALL_SHARES - AROUND_FROM) / (AROUND_TO - AROUND_FROM), 0.0, 1.0);
return Mean(fma(0.5 * all_around, bend, heights) / (total + MEAN_STAY), normal);
}

fn offset_to_mean(frame: u32, pixel: vec2<u32>, p: vec3<f32>, gate: f32) -> vec3<f32> {
let place = pixel % CELL;
let share = 1.0 / f32((place.x + 1u) * (place.y + 1u));
let per_square = 1.0 / (gate * gate);
var sum = vec3<f32>(0.0);
var total = 0.0;
for (var i = 0u; i < CELL * CELL; i++) {
let after = vec2<u32>(i % CELL, i / CELL);
let cell = pixel / CELL + after;
if any(after > place) || is_outside(cell) {
continue;
}
let offset = kept_at(frame, KEPT_MEAN, cell_index(cell)) - p;
let nearness = fma(-square(offset), per_square, 1.0);
if nearness > 0.0 {
sum = fma(vec3<f32>(nearness * share), offset, sum);
total += nearness * share;
}
}
return sum / max(total, LEAST_MEANS);
}

fn step_onto(frame: u32, height: f32, normal: vec3<f32>, along: f32, ray: vec3<f32>) -> vec3<f32> {
return select(height * normal, along * ray, is_on_ray(frame));
}

fn unmoved(frame: u32, p: vec3<f32>, cell: u32, is_far: bool) -> PixelResult {
let status = u32(planes[plane_word(frame, RESULT_STATUS, cell)]);
let n = u32(abs(planes[plane_word(frame, FIRST_COUNT, cell)]));
let keeps_normal = is_far && status >= STATUS_PLANE;
if status >= STATUS_PLANE && !keeps_normal {
return no_result(STATUS_TOO_FEW, 0u);
}
var result = no_result(status, n);
if status < STATUS_DEGENERATE {
return result;
}
result.point = bitcast<vec3<u32>>(p);
if keeps_normal {
result.normal = bitcast<vec3<u32>>(plane_vector(frame, RESULT_NORMAL, cell));
result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, cell)]);
}
return with_depth(frame, depth_of(frame, ray_to(frame, p)), result);
}

fn result_of_pixel(frame: u32, origin: vec2<u32>, pixel: vec2<u32>, local: vec2<u32>) -> PixelResult {
let p = point_at(frame, i32(pixel.x), i32(pixel.y));
if p.x == NO_POINT {
return no_result(STATUS_HOLE, 0u);
}
let own_cell = cell_index(pixel / CELL);
let ray = ray_to(frame, p);
let range = range_of(frame, ray);
let radius = radius_at(frame, range);
let noise = noise_at(frame, range, radius);
var to_mean = vec3<f32>(0.0);
if AVERAGES_BLOCKS {
to_mean = offset_to_mean(frame, pixel, p, block_gate(frame, range));
}
let around = cells_around(local);
let voted = vote_of(around, p, ray, to_mean, radius, noise);
let is_far = !(square(p) < MAX_RANGE_M * MAX_RANGE_M);
if is_far || !(voted.total > LEAST_SURFACE_WEIGHT) {
return unmoved(frame, p, own_cell, is_far);
}
let normals = voted.normal / voted.total;
let length = sqrt(dot(normals, normals));
let agreeing = min(length / AGREEING, 1.0);
let trust = agreeing * agreeing;
let own_normal = select(normals / length, result_at(voted.best).normal, length < LEAST_NORMAL);
let height = voted.height * trust / max(voted.certain, MIN_POSITIVE);
let along = along_ray(height, own_normal, ray, radius);
let first = step_onto(frame, height, own_normal, along, ray);
let best = cell_index(origin / CELL + voted.best - BEFORE);
let n = abs(planes[plane_word(frame, FIRST_COUNT, best)]);
let mean = mean_around(around, p + first, own_normal, noise);
let more = along_ray(mean.height * trust, mean.normal, ray, radius);
let second = step_onto(frame, mean.height * trust, mean.normal, more, ray);
let left = max(min(radius, MAX_ALONG * sqrt(dot(ray, ray))) - sqrt(dot(first, first)), 0.0);
let share = left / max(max(sqrt(dot(second, second)), left), MIN_POSITIVE);
var result = no_result(u32(planes[plane_word(frame, RESULT_STATUS, best)]), u32(n));
result.point = bitcast<vec3<u32>>(p + fma(vec3<f32>(share), second, first));
result.normal = bitcast<vec3<u32>>(mean.normal * select(1.0, -1.0, dot(mean.normal, ray) > 0.0));
result.curvature = bitcast<u32>(planes[plane_word(frame, FIRST_CURVATURE, best)]);
let depth = depth_of(frame, ray);
return with_depth(frame, fma(depth, fma(share, more, along), depth), result);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn results_of_pixels(
@builtin(workgroup_id) group: vec3<u32>,
@builtin(local_invocation_id) local: vec3<u32>,
@builtin(local_invocation_index) thread: u32,
) {
let frame = group.z;
let origin = origin_of(group);
let pixel = origin + local.xy;
load_results(frame, origin, thread);
store(frame, origin, pixel, thread, result_of_pixel(frame, origin, pixel, local.xy));
}
