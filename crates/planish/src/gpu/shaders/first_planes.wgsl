// The results of the first pass with edge preservation: each pixel's point and first plane (docs/method.md, section 10). One
// channel per number, frame after frame.

@group(0) @binding(3) var<storage, read_write> first_planes: array<f32>;

// The channels in order: the point (NO_POINT for a hole), the normal, the height over the point, the variance along the normal
// plus the plane's uncertainty in m² (NOT_USABLE where the neighbours are too few, on a line, or on a plane seen edge-on), the
// curvature, the number of neighbours, negative where they are on a line, and the square of the extent in m².
const FIRST_POINT: u32 = 0u;
const FIRST_NORMAL: u32 = 3u;
const FIRST_HEIGHT: u32 = 6u;
const FIRST_RESIDUAL: u32 = 7u;
const FIRST_CURVATURE: u32 = 8u;
const FIRST_COUNT: u32 = 9u;
const FIRST_EXTENT: u32 = 10u;

// More than any variance, and its multiples are finite.
const NOT_USABLE: f32 = 1e18;

// The standard deviation of depth at a range, between bounds whose squares are within f32, whatever the coordinates.
fn noise_at(frame: u32, range: f32, radius: f32) -> f32 {
    return clamp(max(polynomial_in_range(frame, SIGMA, range), radius * MIN_NOISE), 1e-15, MAX_RADIUS_M);
}

fn first_at(frame: u32, channel: u32, pixel: u32) -> u32 {
    return (frame * FIRST_CHANNELS + channel) * (batch.width * batch.height) + pixel;
}

fn first_vec3(frame: u32, channel: u32, pixel: u32) -> vec3<f32> {
    let at = first_at(frame, channel, pixel);
    let pixels = batch.width * batch.height;
    return vec3<f32>(first_planes[at], first_planes[at + pixels], first_planes[at + 2u * pixels]);
}

fn keep_vec3(frame: u32, channel: u32, pixel: u32, value: vec3<f32>) {
    let at = first_at(frame, channel, pixel);
    let pixels = batch.width * batch.height;
    first_planes[at] = value.x;
    first_planes[at + pixels] = value.y;
    first_planes[at + 2u * pixels] = value.z;
}
