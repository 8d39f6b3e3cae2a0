//! Assigns points to tiles. A tile is a rectangle of grid cells seen from above, whose points fit in memory.

/// Number of grid cells along the longer side of a cloud.
const CELLS: usize = 2048;

/// A grid of cells over a cloud seen from above, with the number of points in each cell.
pub(super) struct Cells {
    low: [f64; 2],
    size_m: f64,
    across: usize,
    down: usize,
    counts: Vec<u32>,
}

/// A rectangle of cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tile {
    /// Index of the first cell along each axis.
    pub(super) from: [usize; 2],
    /// Index of the cell after the last, along each axis.
    pub(super) to: [usize; 2],
    pub(super) points: u64,
}

impl Cells {
    /// Creates an empty grid over a box, given by its smallest and largest coordinates. Points outside the box are
    /// counted in the border cells.
    pub(super) fn new(low: [f64; 2], high: [f64; 2]) -> Self {
        let longest = (high[0] - low[0]).max(high[1] - low[1]).max(f64::MIN_POSITIVE);
        let size_m = longest / CELLS as f64;
        let [across, down] = [0, 1].map(|axis| ((high[axis] - low[axis]) / size_m) as usize).map(|n| n.min(CELLS) + 1);
        Self { low, size_m, across, down, counts: vec![0; across * down] }
    }

    pub(super) fn cell_of(&self, x: f64, y: f64) -> [usize; 2] {
        // The cast saturates at 0.
        let along = |value: f64, low: f64, cells: usize| (((value - low) / self.size_m) as usize).min(cells - 1);
        [along(x, self.low[0], self.across), along(y, self.low[1], self.down)]
    }

    pub(super) fn add(&mut self, x: f64, y: f64) {
        let [column, row] = self.cell_of(x, y);
        self.counts[row * self.across + column] += 1;
    }

    /// Returns the smallest and largest coordinates of a tile. Tiles at the border extend to infinity.
    pub(super) fn bounds(&self, tile: &Tile) -> [[f64; 2]; 2] {
        let cells = [self.across, self.down];
        let edge = |axis: usize, cell: usize| match cell {
            0 => f64::NEG_INFINITY,
            cell if cell == cells[axis] => f64::INFINITY,
            cell => self.low[axis] + cell as f64 * self.size_m,
        };
        [[edge(0, tile.from[0]), edge(1, tile.from[1])], [edge(0, tile.to[0]), edge(1, tile.to[1])]]
    }

    /// Returns the area of a tile in square metres.
    pub(super) fn area(&self, tile: &Tile) -> f64 {
        let sides = [0, 1].map(|axis| (tile.to[axis] - tile.from[axis]) as f64 * self.size_m);
        sides[0] * sides[1]
    }

    /// Returns tiles with at most `most` points each; only a tile of a single cell may have more. Omits tiles without
    /// points.
    pub(super) fn tiles(&self, most: u64) -> Vec<Tile> {
        let whole = self.tile([0, 0], [self.across, self.down]);
        let (mut waiting, mut tiles) = (vec![whole], Vec::new());
        while let Some(tile) = waiting.pop() {
            let sides = [0, 1].map(|axis| tile.to[axis] - tile.from[axis]);
            let axis = usize::from(sides[1] > sides[0]);
            if tile.points <= most || sides[axis] < 2 {
                tiles.extend((tile.points > 0).then_some(tile));
                continue;
            }
            waiting.extend(self.halves(&tile, axis));
        }
        tiles
    }

    /// Cuts a tile in two across an axis, with a similar number of points in each half.
    fn halves(&self, tile: &Tile, axis: usize) -> [Tile; 2] {
        let mut at = tile.from[axis];
        let mut before = 0;
        while at + 1 < tile.to[axis] && (before == 0 || 2 * before < tile.points) {
            let (mut from, mut to) = (tile.from, tile.to);
            (from[axis], to[axis]) = (at, at + 1);
            before += self.tile(from, to).points;
            at += 1;
        }
        let (mut first_to, mut second_from) = (tile.to, tile.from);
        (first_to[axis], second_from[axis]) = (at, at);
        [self.tile(tile.from, first_to), self.tile(second_from, tile.to)]
    }

    fn tile(&self, from: [usize; 2], to: [usize; 2]) -> Tile {
        let row = |row: usize| &self.counts[row * self.across + from[0]..row * self.across + to[0]];
        let points = (from[1]..to[1]).flat_map(row).map(|&count| u64::from(count)).sum();
        Tile { from, to, points }
    }

    /// Returns the number of the tile that contains each cell, row by row. `tiles` must cover all cells that have
    /// points.
    pub(super) fn tile_of_cells(&self, tiles: &[Tile]) -> Vec<u16> {
        let mut of_cells = vec![0; self.counts.len()];
        for (number, tile) in (0u16..).zip(tiles) {
            for row in tile.from[1]..tile.to[1] {
                of_cells[row * self.across + tile.from[0]..row * self.across + tile.to[0]].fill(number);
            }
        }
        of_cells
    }

    /// Returns the index of a cell in [`tile_of_cells`](Self::tile_of_cells).
    pub(super) fn place(&self, [column, row]: [usize; 2]) -> usize {
        row * self.across + column
    }
}

/// Memory per point of a tile in addition to its records, in bytes: positions twice, an engine and its results.
const ENGINE_BYTES_A_POINT: u64 = 250;
/// Number of copies of a tile's records in memory: as read, in columns, and as written.
const COPIES: u64 = 3;

/// Returns the memory needed per point of a tile, in bytes.
pub(super) fn bytes_a_point(record: usize) -> u64 {
    COPIES * record as u64 + ENGINE_BYTES_A_POINT
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_have_every_point_once_and_no_more_than_fit() {
        let mut cells = Cells::new([-3.0, 10.0], [5.0, 12.0]);
        let points: Vec<[f64; 2]> = (0..10_000)
            .map(|i| [-3.0 + 8.0 * f64::from(i % 100) / 99.0, 10.0 + 2.0 * (f64::from(i / 100) / 99.0).powi(3)])
            .collect();
        points.iter().for_each(|&[x, y]| cells.add(x, y));
        let tiles = cells.tiles(700);
        assert!(tiles.iter().all(|tile| tile.points <= 700) && tiles.len() < 40, "{}", tiles.len());
        assert_eq!(tiles.iter().map(|tile| tile.points).sum::<u64>(), 10_000);
        let of_cells = cells.tile_of_cells(&tiles);
        let mut counts = vec![0; tiles.len()];
        for &[x, y] in &points {
            let number = usize::from(of_cells[cells.place(cells.cell_of(x, y))]);
            counts[number] += 1;
            let [low, high] = cells.bounds(&tiles[number]);
            // Bounds hold up to rounding.
            let within = |value: f64, axis: usize| low[axis] - 1e-9 <= value && value <= high[axis] + 1e-9;
            assert!(within(x, 0) && within(y, 1));
        }
        assert_eq!(counts, tiles.iter().map(|tile| tile.points).collect::<Vec<_>>());
        assert_eq!(cells.tiles(20_000).len(), 1);
        // A single cell may exceed the limit.
        let mut heap = Cells::new([0.0; 2], [1.0; 2]);
        (0..50).for_each(|_| heap.add(0.5, 0.5));
        heap.add(0.9, 0.1);
        assert_eq!(heap.tiles(10).iter().map(|tile| tile.points).max(), Some(50));
    }
}
