//! The constants of the filter, for the CPU and for the GPU, whose shaders have them by the same names.

// Pixels (rows.rs).

/// Beyond this, the inverse of depth leaves f32.
pub(crate) const MOST_DEPTH_M: f32 = 1e18;
/// Noise below this share of a value is below what f32 resolves.
pub(crate) const LEAST_NOISE: f32 = 1e-6;
/// Changes are limited to this many sigmas in means over 5x5 pixels, and over tiles.
pub(crate) const CLIP: f32 = 8.0;
pub(crate) const CLIP_OF_TILE: f32 = 4.0;
/// A pixel whose change exceeds this many deviations may show a new surface.
pub(crate) const CANDIDATE: f32 = 4.0;
/// Deviations are at least this when single pixels are compared, in sigmas.
pub(crate) const LEAST_DEVIATION: f32 = 0.7;
/// A supported candidate whose change exceeds this many deviations is a new surface at once. Real noise exceeds
/// [`CANDIDATE`] now and then, for one frame.
pub(crate) const AT_ONCE: f32 = 5.0;
/// Support in 3x3 pixels, itself included, that a candidate above [`AT_ONCE`] needs to be a new surface at once.
pub(crate) const SUPPORT: f32 = 3.0;
/// Frames that a pixel must have for a single change to wait.
pub(crate) const FRAMES_TO_WAIT: f32 = 3.0;
/// Deviations of the mean change, of its bias, and of the own change, that halve a pixel's frames.
pub(crate) const CHANGE: f32 = 2.5;
pub(crate) const BIAS: f32 = 1.2;
pub(crate) const OWN_CHANGE: f32 = 6.0;
/// Share by which the bias follows the mean change, of pixels and of tiles.
pub(crate) const LEAK: f32 = 0.25;
/// Share by which the variance follows, of a pixel of the most frames and of a tile.
pub(crate) const LEARN: f32 = 1.0 / 16.0;
/// Factor from the squared distance to the bias, limited to three deviations, to the variance that is learnt.
pub(crate) const LEARNT: f32 = 0.875;
pub(crate) const LEAST_VARIANCE: f32 = 0.04;
pub(crate) const MOST_VARIANCE: f32 = 2.25;
/// Frames for which a hole's state is kept.
pub(crate) const MEMORY: f32 = 8.0;

// The state of pixels (state.rs).

/// Variance of the change of a pixel's surroundings before anything was learnt.
pub(crate) const FIRST_VARIANCE: f32 = 0.5;
/// Steps of stored frames and biases.
pub(crate) const PER_UNIT: f32 = 2048.0;
/// Steps of stored variances.
pub(crate) const PER_VARIANCE: f32 = 16384.0;
/// Largest magnitude of a bias, which is added to it when it is stored.
pub(crate) const MOST_BIAS: f32 = 8.0;
/// The bit of a pixel whose value in the last frame was carried over.
pub(crate) const CARRIED: u32 = 1 << 31;
pub(crate) const LOW: u32 = 0xffff;

// Tiles (tiles.rs).

/// Columns and rows of a tile in pixels.
pub(crate) const TILE: usize = 16;
/// Tiles with at most this many updated pixels are not tested; only the weight of the camera applies to them.
pub(crate) const FEW: f32 = 64.0;
/// Deviations of a tile's change, and of its bias, that halve its weight; doubled if the camera's motion is known.
pub(crate) const TILE_CHANGE: f32 = 3.0;
pub(crate) const TILE_BIAS: f32 = 1.5;
/// Median bias of all tiles over their median change that halves the weight of all pixels. Noise has about 0.35, a
/// moving camera 0.5 to 1.
pub(crate) const PERSISTENT: f32 = 0.55;
/// Above this ratio, changes are not learnt as noise.
pub(crate) const PERSISTENT_NOISE: f32 = 0.5;
/// Tiles this far apart have independent noise: windows are narrower.
pub(crate) const PAIR: usize = 3;
/// Excess over 0.5 of the share of pairs of distant tiles that change alike, at which all weights halve. Noise has at
/// most 0.05, a moving camera up to 0.4.
pub(crate) const AGREEING: f32 = 0.12;
/// Changes are learnt as noise only up to this share of pairs that change alike.
pub(crate) const AGREEING_NOISE: f32 = 0.58;
/// Fewest tiles for which the two statistics of a moving camera are used.
pub(crate) const LEAST_TILES: usize = 150;
/// Median change in sigmas up to which they are not used: motion is too small to blur anything.
pub(crate) const LEAST_CHANGE: f32 = 0.1;
pub(crate) const FIRST_TILE_VARIANCE: f32 = 0.04;
pub(crate) const LEAST_TILE_VARIANCE: f32 = 0.0025;

// A camera that moves (motion.rs).

/// Sigmas by which pixels of one surface differ at most.
pub(crate) const SAME_SURFACE: f32 = 5.0;
/// Allowance for the slope of a surface, relative to the value.
pub(crate) const SLOPE: f32 = 0.004;
/// Weight of the pixels of the same surface above which they count; otherwise the pixel is new.
pub(crate) const LEAST_WEIGHT: f32 = 0.2;
/// Nearest depth in metres at which points are looked up.
pub(crate) const NEAREST_M: f32 = 0.05;
