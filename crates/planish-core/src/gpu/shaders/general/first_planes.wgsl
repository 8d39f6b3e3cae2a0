// The first planes of all positions, and the radii used for them: three words of four floats each (docs/method.md,
// section 10).

const PLANE_WORDS: u32 = 3u;
// The plane's normal, and the height of the position over it.
const FIRST_NORMAL: u32 = 0u;
// The mean squared residual in m², increased if the points determine the plane poorly (NOT_USABLE for too few or
// collinear points); the curvature; the number of neighbours, negative if they are collinear; the squared extent in
// m².
const FIRST_NUMBERS: u32 = 1u;
// The radius in metres.
const FIRST_RADIUS: u32 = 2u;

const NOT_USABLE: f32 = 1e37;
