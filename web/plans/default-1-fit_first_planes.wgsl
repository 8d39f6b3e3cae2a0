const UNITS_PER_METRE: u32 = 1u;
const SATURATED_DEPTH: u32 = 65535u;
const POINTS_CHANNEL: u32 = 0u;
const NORMALS_CHANNEL: u32 = 3u;
const CURVATURE_CHANNEL: u32 = 3u;
const DEPTH_M_CHANNEL: u32 = 3u;
const CHANNELS: u32 = 3u;
const STATUS_HOLE: u32 = 0u;
const STATUS_TOO_FEW: u32 = 1u;
const STATUS_DEGENERATE: u32 = 2u;
const STATUS_PLANE: u32 = 3u;
const STATUS_POLYNOMIAL_2: u32 = 4u;
const STATUS_POLYNOMIAL_3: u32 = 5u;
const STATUS_ISOLATED: u32 = 6u;
const WANTS_POINTS: bool = true;
const WANTS_NORMALS: bool = false;
const WANTS_CURVATURE: bool = false;
const WANTS_STATUS: bool = false;
const WANTS_NEIGHBOURS: bool = false;
const WANTS_DEPTH: bool = false;
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
const WINDOW: u32 = 2u;
const SIDE: u32 = 5u;
const STRIDE: u32 = 5u;
const ROW_STEP: u32 = 1u;
const DEGREE: u32 = 1u;
const EDGE_SHIFT: u32 = 0u;
const KEEPS_EDGES: bool = false;
const KEEPS_RESULTS: bool = false;
const BENDS: bool = false;
const READS_MEANS: bool = true;
const AVERAGES_BLOCKS: bool = true;
const SAMPLES: u32 = KEPT_MEAN;
const MIDDLE_SHARE: f32 = 0.44117644;

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
return kept_at(frame, KEPT_POINT, u32(y) * batch.width + u32(x));
}

fn sample_at(frame: u32, x: i32, y: i32) -> vec3<f32> {
let size = vec2<i32>(grid_size());
if x < 0 || y < 0 || x >= size.x || y >= size.y {
return vec3<f32>(NO_POINT);
}
return kept_at(frame, SAMPLES, u32(y * size.x + x));
}

fn centre_of(frame: u32, cell: vec2<u32>, window: WindowOrigin) -> vec3<f32> {
if is_outside(cell) {
return vec3<f32>(NO_POINT);
}
return kept_at(frame, KEPT_POINT, cell_index(cell));
}

const REACH: u32 = (WINDOW * STRIDE + CELL - 1u) / CELL;
const PITCH: u32 = TILE_WIDTH + 2u * REACH;
const TILE_AREA: u32 = PITCH * (TILE_HEIGHT + 2u * REACH);

var<workgroup> tile_x: array<f32, TILE_AREA>;
var<workgroup> tile_y: array<f32, TILE_AREA>;
var<workgroup> tile_z: array<f32, TILE_AREA>;

alias WindowOrigin = u32;

fn load_candidates(frame: u32, origin: vec2<u32>, thread: u32) {
let first = vec2<i32>(origin) - i32(REACH);
for (var i = thread; i < TILE_AREA; i += TILE_WIDTH * TILE_HEIGHT) {
let p = sample_at(frame, first.x + i32(i % PITCH), first.y + i32(i / PITCH));
tile_x[i] = p.x;
tile_y[i] = p.y;
tile_z[i] = p.z;
}
workgroupBarrier();
}

fn window_origin_of(frame: u32, cell: vec2<u32>, local: vec2<u32>) -> WindowOrigin {
return (local.y + REACH) * PITCH + local.x + REACH;
}

fn candidate(window: WindowOrigin, column: u32, row: u32) -> vec3<f32> {
let at = u32(i32(window) + offset_of(row) * i32(PITCH) + offset_of(column));
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

const MIDDLE: u32 = WINDOW / 2u;

fn window_bend(window: WindowOrigin, p: vec3<f32>, gate: Gate, plane: Plane, radius: f32) -> f32 {
var total = 0.0;
var height = 0.0;
for (var row = WINDOW - MIDDLE; row <= WINDOW + MIDDLE; row++) {
for (var column = WINDOW - MIDDLE; column <= WINDOW + MIDDLE; column++) {
let offset = candidate(window, column, row) - p;
let nearness = unclamped(gate, square(offset));
if nearness > 0.0 {
let weight = min(nearness, 1.0);
total += weight;
height = fma(weight, dot(offset, plane.normal) - plane.height, height);
}
}
}
let spread = max(plane.spread, radius * radius * LEAST_SPREAD);
let bend = height * (-4.0 / (1.0 - MIDDLE_SHARE)) / (max(total, 1.0) * spread);
let most = MOST_WINDOW_BEND / radius;
return clamp(bend, -most, most);
}

@compute @workgroup_size(TILE_WIDTH, TILE_HEIGHT)
fn fit_first_planes(
@builtin(workgroup_id) group: vec3<u32>,
@builtin(local_invocation_id) local: vec3<u32>,
@builtin(local_invocation_index) thread: u32,
) {
let frame = group.z;
let origin = origin_of(group);
let cell = origin + local.xy * vec2<u32>(1u, ROW_STEP);
load_candidates(frame, origin, thread);
if is_outside(cell) {
return;
}
let at = cell_index(cell);
let window = window_origin_of(frame, cell, local.xy);
let p = centre_of(frame, cell, window);
if !READS_MEANS {
keep_point(frame, KEPT_POINT, at, p);
}
if p.x == NO_POINT {
return;
}
let ray = ray_to(frame, p);
let range = range_of(frame, ray);
let radius = radius_at(frame, range);
let gate = gate_of(radius);
let sums = sums_of(window, p, gate);
let plane = plane_of(ray, sums);
let direction = ray / max(max(abs(ray.x), abs(ray.y)), max(abs(ray.z), MIN_POSITIVE));
let cosine = abs(dot(plane.normal, direction)) / sqrt(dot(direction, direction));
let enough = clamp(sums.total - MIN_TOTAL, 0.0, 1.0);
let facing = clamp((cosine - MIN_INCIDENCE_COSINE) / COSINE_FADE, 0.0, 1.0);
let usable = enough * clamp(plane.off_line, 0.0, 1.0) * facing;
let noise = noise_at(frame, range, radius);
let residual = fma(noise * noise * DOUBT_WEIGHT, plane.doubt, plane.residual) / max(usable, 1e-15);
keep_vector(frame, FIRST_NORMAL, at, plane.normal);
keep_vector(frame, FIRST_CENTROID, at, plane.centroid);
planes[plane_word(frame, FIRST_SPREAD, at)] = plane.spread;
planes[plane_word(frame, FIRST_RESIDUAL, at)] = select(NOT_USABLE, min(residual, NOT_USABLE), usable > 0.0);
planes[plane_word(frame, FIRST_CURVATURE, at)] = plane.curvature;
planes[plane_word(frame, FIRST_EXTENT, at)] = plane.extent_squared;
planes[plane_word(frame, FIRST_COUNT, at)] = select(sums.n, -sums.n, plane.is_degenerate);
planes[plane_word(frame, FIRST_BEND, at)] = window_bend(window, p, gate, plane, radius);
}
