//! Constants of the temporal filter, for the CPU and for the GPU's shaders, which use the same names.

// Pixels (rows.rs).

/// Depth in metres from which a value counts as a hole, because computations with its inverse would leave the range
/// of f32.
pub(crate) const MOST_DEPTH_M: f32 = 1e18;
/// Minimum noise relative to the value: about the resolution of f32.
pub(crate) const LEAST_NOISE: f32 = 1e-6;
/// Limit to which changes are clipped in means over 5x5 pixels, in sigmas.
pub(crate) const CLIP: f32 = 8.0;
/// Limit to which changes are clipped in means over tiles, in sigmas.
pub(crate) const CLIP_OF_TILE: f32 = 4.0;
/// Change above which a pixel may show a new surface, in deviations.
pub(crate) const CANDIDATE: f32 = 4.0;
/// Minimum deviation in comparisons of single pixels, in sigmas.
pub(crate) const LEAST_DEVIATION: f32 = 0.7;
/// Change above which a supported candidate counts as a new surface immediately, in deviations. Real noise
/// occasionally exceeds [`CANDIDATE`] for one frame.
pub(crate) const AT_ONCE: f32 = 5.0;
/// Minimum support in 3x3 pixels, including the candidate, for a candidate above [`AT_ONCE`] to count as a new
/// surface immediately.
pub(crate) const SUPPORT: f32 = 3.0;
/// Minimum number of frames averaged in a pixel for its candidate to wait for the next frame.
pub(crate) const FRAMES_TO_WAIT: f32 = 3.0;
/// Mean change over 5x5 pixels that halves a pixel's number of averaged frames, in deviations.
pub(crate) const CHANGE: f32 = 2.5;
/// Bias of the mean change that halves a pixel's number of averaged frames, in deviations.
pub(crate) const BIAS: f32 = 1.2;
/// Change of a pixel itself that halves its number of averaged frames, in deviations.
pub(crate) const OWN_CHANGE: f32 = 6.0;
/// Rate at which the bias of a pixel or tile approaches the mean change, as a share of the difference per frame.
pub(crate) const LEAK: f32 = 0.25;
/// Rate at which the variance of a tile, or of a pixel with the maximum number of frames, approaches the learnt
/// value, as a share of the difference per frame.
pub(crate) const LEARN: f32 = 1.0 / 16.0;
/// Ratio of the learnt variance to the squared difference between the mean change and the bias. The difference is
/// limited to three deviations.
pub(crate) const LEARNT: f32 = 0.875;
/// Minimum variance of the mean change around a pixel, in squared sigmas.
pub(crate) const LEAST_VARIANCE: f32 = 0.04;
/// Maximum variance of the mean change around a pixel, in squared sigmas.
pub(crate) const MOST_VARIANCE: f32 = 2.25;
/// Number of frames for which the state of a hole is kept.
pub(crate) const MEMORY: f32 = 8.0;

// The state of pixels (state.rs).

/// Initial variance of the mean change around a pixel, in squared sigmas.
pub(crate) const FIRST_VARIANCE: f32 = 0.5;
/// Quantization steps per unit of a stored number of frames or bias.
pub(crate) const PER_UNIT: f32 = 2048.0;
/// Quantization steps per unit of a stored variance.
pub(crate) const PER_VARIANCE: f32 = 16384.0;
/// Maximum magnitude of a bias. It is added to stored biases, so that they are not negative.
pub(crate) const MOST_BIAS: f32 = 8.0;
/// Flag of a pixel whose value in the last frame was carried over.
pub(crate) const CARRIED: u32 = 1 << 31;
/// Mask of the low half of a word.
pub(crate) const LOW: u32 = 0xffff;

// Tiles (tiles.rs).

/// Width and height of a tile, in pixels.
pub(crate) const TILE: usize = 16;
/// Maximum number of updated pixels for which a tile is not tested; only the weight of the camera applies to it.
pub(crate) const FEW: f32 = 64.0;
/// Change of a tile that halves its weight, in deviations; doubled if the camera's motion is known.
pub(crate) const TILE_CHANGE: f32 = 3.0;
/// Bias of a tile that halves its weight, in deviations; doubled if the camera's motion is known.
pub(crate) const TILE_BIAS: f32 = 1.5;
/// Ratio of the median bias of all tiles to their median change that halves the weight of all pixels. Noise gives
/// about 0.35, a moving camera 0.5 to 1.
pub(crate) const PERSISTENT: f32 = 0.55;
/// Ratio of the median bias of all tiles to their median change above which changes are not learnt as noise.
pub(crate) const PERSISTENT_NOISE: f32 = 0.5;
/// Distance between the tiles of a pair, in tiles. At this distance, their noise is independent, because windows are
/// narrower.
pub(crate) const PAIR: usize = 3;
/// Excess over 0.5, in the share of the pairs of tiles that change alike, at which all weights are halved. Noise gives
/// at most 0.05, a moving camera up to 0.4.
pub(crate) const AGREEING: f32 = 0.12;
/// Share of the pairs of tiles that change alike above which changes are not learnt as noise.
pub(crate) const AGREEING_NOISE: f32 = 0.58;
/// Minimum number of tiles for the two statistics of a moving camera, the ratio of the medians and the share of
/// pairs.
pub(crate) const LEAST_TILES: usize = 150;
/// Median change of the tiles in sigmas up to which the statistics of a moving camera are not used: the motion is too
/// small to blur anything.
pub(crate) const LEAST_CHANGE: f32 = 0.1;
/// Initial variance of a tile's mean change, in squared sigmas.
pub(crate) const FIRST_TILE_VARIANCE: f32 = 0.04;
/// Minimum variance of a tile's mean change, in squared sigmas.
pub(crate) const LEAST_TILE_VARIANCE: f32 = 0.0025;

// Moving cameras (motion.rs).

/// Maximum difference between pixels of one surface, in sigmas.
pub(crate) const SAME_SURFACE: f32 = 5.0;
/// Additional difference allowed for the slope of a surface, as a share of the value.
pub(crate) const SLOPE: f32 = 0.004;
/// Sum of the bilinear weights of the pixels on the same surface up to which a looked-up pixel is unknown.
pub(crate) const LEAST_WEIGHT: f32 = 0.2;
/// Minimum depth of a point that is looked up, in metres.
pub(crate) const NEAREST_M: f32 = 0.05;
