//! The test of whole tiles: what moves by less than the noise, but all together.

/// Columns and rows of a tile in pixels.
pub(super) const TILE: usize = 16;
/// Tiles with at most this many pixels keep a weight of 1.
const FEW: f32 = 64.0;
/// Deviations of a tile's change, and of its bias, that halve its weight; twice as many if the camera's motion is known.
const CHANGE: f32 = 3.0;
const BIAS: f32 = 1.5;
const FIRST_VARIANCE: f32 = 0.04;
const LEAST_VARIANCE: f32 = 0.0025;
const LEAK: f32 = 0.25;
const LEARN: f32 = 1.0 / 16.0;

/// The state of a tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    bias: f32,
    variance: f32,
    /// Weight of the past frames of the tile's pixels, 0 to 1.
    pub(super) weight: f32,
}

impl Default for Tile {
    fn default() -> Self {
        Self { bias: 0.0, variance: FIRST_VARIANCE, weight: 1.0 }
    }
}

impl Tile {
    /// Takes the sum of the clipped changes of its pixels, and their number.
    pub(super) fn update(&mut self, sum: f32, count: f32, knows_motion: bool) {
        if count <= FEW {
            (self.bias, self.weight) = (0.0, 1.0);
            return;
        }
        let mean = sum / count;
        let deviation = self.variance.sqrt();
        let from_bias = (mean - self.bias).abs().min(3.0 * deviation);
        self.bias += LEAK * (mean - self.bias);
        let gate = if knows_motion { 2.0 * deviation } else { deviation };
        let ratios = [mean / (CHANGE * gate), self.bias / (BIAS * gate)];
        self.weight = 1.0 / (1.0 + ratios.map(|ratio| (ratio * ratio) * (ratio * ratio)).iter().sum::<f32>());
        let learnt = 0.875 * from_bias * from_bias - self.variance;
        self.variance = (self.variance + LEARN * learnt).clamp(LEAST_VARIANCE, 1.0);
    }
}
