// Intermediate data that passes of a frame leave on the device: points and planes, one channel per number, frame after
// frame (docs/method.md, sections 2 and 10). They belong to cells of CELL x CELL pixels.

@group(0) @binding(3) var<storage, read_write> kept_points: array<f32>;
@group(0) @binding(4) var<storage, read_write> planes: array<f32>;

// Points as measured, block means, and the means of the points on the surface. NO_POINT for a hole.
const KEPT_POINT: u32 = 0u;
const KEPT_MEAN: u32 = 3u;
const KEPT_SURFACE_MEAN: u32 = 6u;

// First planes: the normal; the mean of the neighbours, relative to the point; the variance along the normal plus the
// plane's uncertainty in m² (more, up to NOT_USABLE, if neighbours are too few, collinear, or on a plane seen edge-on);
// the variance along the plane in m²; the curvature; the number of neighbours, negative if they are collinear; the
// squared extent in m²; and how the window bends.
const FIRST_NORMAL: u32 = 0u;
const FIRST_CENTROID: u32 = 3u;
const FIRST_RESIDUAL: u32 = 6u;
const FIRST_SPREAD: u32 = 7u;
const FIRST_CURVATURE: u32 = 8u;
const FIRST_COUNT: u32 = 9u;
const FIRST_EXTENT: u32 = 10u;
const FIRST_BEND: u32 = 11u;
// Surfaces found from them: the normal, the height over the point, the distance in metres within which neighbours
// count, how it bends along the tangents of the normal, and how far no plane fits.
const SURFACE_NORMAL: u32 = 12u;
const SURFACE_HEIGHT: u32 = 15u;
const SURFACE_WIDTH: u32 = 16u;
const SURFACE_BEND: u32 = 17u;
const SURFACE_NO_PLANE_FITS: u32 = 20u;
// How certain a surface is: from 0, if no plane near the point fits it, to 1.
const SURFACE_CERTAINTY: u32 = 21u;

// Results of cells, in place of surfaces that are no longer needed: normal and point, 0 without a normal; status.
const RESULT_NORMAL: u32 = SURFACE_NORMAL;
const RESULT_POINT: u32 = SURFACE_BEND;
const RESULT_STATUS: u32 = SURFACE_NO_PLANE_FITS;

// More than any variance, and its multiples are finite.
const NOT_USABLE: f32 = 1e18;

// Columns and rows of cells.
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

// The standard deviation of depth at a range, between bounds whose squares are within f32, whatever the coordinates.
fn noise_at(frame: u32, range: f32, radius: f32) -> f32 {
    return clamp(max(polynomial_in_range(frame, SIGMA, range), radius * MIN_NOISE), 1e-15, MAX_RADIUS_M);
}
