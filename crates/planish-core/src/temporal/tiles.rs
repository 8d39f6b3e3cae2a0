//! Tests whole tiles, to detect common motion that is smaller than the noise.

use super::constants::{
    AGREEING, AGREEING_NOISE, FEW, FIRST_TILE_VARIANCE, LEAK, LEARN, LEARNT, LEAST_CHANGE, LEAST_TILE_VARIANCE,
    LEAST_TILES, PAIR, PERSISTENT, PERSISTENT_NOISE, TILE_BIAS, TILE_CHANGE,
};

/// The state of a tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    /// Mean of the clipped changes of the tile's pixels in the current frame.
    change: f32,
    bias: f32,
    variance: f32,
    /// True if enough pixels were updated for a test.
    counts: bool,
    /// Weight of the past frames of the tile's pixels, 0 to 1.
    pub(super) weight: f32,
}

impl Default for Tile {
    fn default() -> Self {
        Self { change: 0.0, bias: 0.0, variance: FIRST_TILE_VARIANCE, counts: false, weight: 1.0 }
    }
}

/// Updates all tiles, of which `across` form a row. `sums` contains, for each tile, the sum of its pixels' clipped
/// changes and their number. `sorted` is a reusable buffer.
pub(super) fn update_tiles(
    tiles: &mut [Tile],
    across: usize,
    sums: &[[f32; 2]],
    knows_motion: bool,
    sorted: &mut Vec<f32>,
) {
    for (tile, &[sum, count]) in tiles.iter_mut().zip(sums) {
        tile.counts = count > FEW;
        tile.change = if tile.counts { sum / count } else { 0.0 };
    }
    // Noise differs from frame to frame and between distant tiles. A moving camera changes a tile in the same
    // direction for some time, and changes distant tiles in the same way.
    let (persistence, agreement) = match median(tiles, |tile| tile.change, sorted) {
        Some(change) if !knows_motion && change > LEAST_CHANGE => {
            let next_bias = |tile: &Tile| tile.bias + LEAK * (tile.change - tile.bias);
            (median(tiles, next_bias, sorted).unwrap_or(0.0) / change, agreement(tiles, across))
        }
        _ => (0.0, 0.5),
    };
    let by_time = (persistence / PERSISTENT).powi(8);
    let by_place = fourth_power((agreement - 0.5).max(0.0) / AGREEING);
    let of_camera = 1.0 / (1.0 + by_time + by_place);
    let gate = if knows_motion { 2.0 } else { 1.0 };
    let is_noise = persistence <= PERSISTENT_NOISE && agreement <= AGREEING_NOISE;
    for tile in tiles {
        tile.update(of_camera, gate, is_noise);
    }
}

/// Returns the share of the pairs of tiles, three apart in a row or column, that change in the same direction; 0.5
/// without pairs.
fn agreement(tiles: &[Tile], across: usize) -> f32 {
    let in_row = (0..tiles.len()).filter(|i| i % across + PAIR < across).map(|i| (i, i + PAIR));
    let in_column = (0..tiles.len().saturating_sub(PAIR * across)).map(|i| (i, i + PAIR * across));
    let (mut same, mut all) = (0u32, 0u32);
    for (i, j) in in_row.chain(in_column).filter(|&(i, j)| tiles[i].counts && tiles[j].counts) {
        all += 1;
        same += u32::from((tiles[i].change > 0.0) == (tiles[j].change > 0.0));
    }
    if all == 0 { 0.5 } else { same as f32 / all as f32 }
}

impl Tile {
    fn update(&mut self, of_camera: f32, gate: f32, learns: bool) {
        if !self.counts {
            (self.bias, self.weight) = (0.0, of_camera);
            return;
        }
        let deviation = self.variance.sqrt();
        let from_bias = (self.change - self.bias).abs().min(3.0 * deviation);
        self.bias += LEAK * (self.change - self.bias);
        let by_change = fourth_power(self.change / (TILE_CHANGE * gate * deviation));
        let by_bias = fourth_power(self.bias / (TILE_BIAS * gate * deviation));
        self.weight = of_camera / (1.0 + by_change + by_bias);
        if learns {
            let learnt = LEARNT * from_bias * from_bias - self.variance;
            self.variance = (self.variance + LEARN * learnt).clamp(LEAST_TILE_VARIANCE, 1.0);
        }
    }
}

/// Returns the median magnitude over the tiles with enough updated pixels; `None` if there are fewer than
/// [`LEAST_TILES`] such tiles.
fn median(tiles: &[Tile], value: impl Fn(&Tile) -> f32, sorted: &mut Vec<f32>) -> Option<f32> {
    sorted.clear();
    sorted.extend(tiles.iter().filter(|tile| tile.counts).map(|tile| value(tile).abs()));
    let middle = sorted.len() / 2;
    (sorted.len() >= LEAST_TILES).then(|| *sorted.select_nth_unstable_by(middle, f32::total_cmp).1)
}

fn fourth_power(value: f32) -> f32 {
    let square = value * value;
    square * square
}
