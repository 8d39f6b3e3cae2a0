// Intermediate data that passes of a frame leave on the device: points and planes, one channel per number, frame after
// frame (docs/method.md, sections 2 and 10). They belong to cells of CELL x CELL pixels.

@group(0) @binding(3) var<storage, read_write> kept_points: array<f32>;
@group(0) @binding(4) var<storage, read_write> planes: array<f32>;

// Measured points; NO_POINT for a hole, here and in the means.
const KEPT_POINT: u32 = 0u;
// Block means.
const KEPT_MEAN: u32 = 3u;
// Means of the points on the surface.
const KEPT_SURFACE_MEAN: u32 = 6u;

// First plane: the normal.
const FIRST_NORMAL: u32 = 0u;
// First plane: the mean of the neighbours, relative to the point.
const FIRST_CENTROID: u32 = 3u;
// First plane: the variance along the normal plus the plane's uncertainty, in m². It is larger, up to NOT_USABLE, if
// neighbours are too few, collinear, or on a plane seen edge-on.
const FIRST_RESIDUAL: u32 = 6u;
// First plane: the variance along the plane in m².
const FIRST_SPREAD: u32 = 7u;
// First plane: the curvature.
const FIRST_CURVATURE: u32 = 8u;
// First plane: the number of neighbours, negative if they are collinear.
const FIRST_COUNT: u32 = 9u;
// First plane: the squared extent in m².
const FIRST_EXTENT: u32 = 10u;
// First plane: the bend of the window in 1/m (window_bend.wgsl).
const FIRST_BEND: u32 = 11u;
// Surface found from the first planes: the normal.
const SURFACE_NORMAL: u32 = 12u;
// Surface: the height over the point in metres.
const SURFACE_HEIGHT: u32 = 15u;
// Surface: the distance in metres within which neighbours count.
const SURFACE_WIDTH: u32 = 16u;
// Surface: the bend along the tangents of the normal in 1/m.
const SURFACE_BEND: u32 = 17u;
// Surface: from 0, if planes around the point fit, to 1, if none does.
const SURFACE_NO_PLANE_FITS: u32 = 20u;
// Surface: the certainty, from 0, if no plane near the point fits it, to 1.
const SURFACE_CERTAINTY: u32 = 21u;

// Result of a cell, in place of the surface, which is no longer needed: the normal; 0 without one.
const RESULT_NORMAL: u32 = SURFACE_NORMAL;
// Result of a cell: the point; 0 without a normal.
const RESULT_POINT: u32 = SURFACE_BEND;
// Result of a cell: the status.
const RESULT_STATUS: u32 = SURFACE_NO_PLANE_FITS;

// Exceeds every variance; its multiples are finite.
const NOT_USABLE: f32 = 1e18;

// Returns the number of columns and rows of cells.
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

// Returns the standard deviation of depth at a range, between bounds whose squares fit into f32 for all coordinates.
fn noise_at(frame: u32, range: f32, radius: f32) -> f32 {
    return clamp(max(polynomial_in_range(frame, SIGMA, range), radius * MIN_NOISE), 1e-15, MAX_RADIUS_M);
}
