//! The records of a file, dealt to temporary files, one a tile; and the smoothed ones put together in the order of the input.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::plan::{Cells, Tile};
use super::{OWN_SHARE, bytes_a_point};
use crate::error::FormatError;
use crate::io::{LasReader, LasWriter, Records, Temporary, WholeFile, cloud_of};
use crate::neighbours::middle;
use crate::progress::Progress;

/// Records read or written together.
const BATCH: usize = 1 << 18;
/// Each has two open files: fewer than any system allows.
const MOST_TILES: usize = 100;
/// Points by which the extent of a cloud is known.
const SAMPLE: usize = 10_000;

/// The records of a file, dealt to tiles.
pub(super) struct Dealt {
    pub(super) header: Arc<las::Header>,
    pub(super) record: usize,
    pub(super) points: usize,
    pub(super) most_in_memory: u64,
    pub(super) extent_m: f64,
    /// Whether there are points of a later return than the fifth, in records that headers before LAS 1.4 do not count.
    has_late_returns: bool,
    pub(super) cells: Cells,
    pub(super) tiles: Vec<TileFiles>,
    /// The tile of each record, in the order of the file.
    sequence: Temporary,
    pub(super) folder: PathBuf,
}

/// A tile, its records as they were, and what became of them.
pub(super) struct TileFiles {
    pub(super) tile: Tile,
    records: Temporary,
    /// For each record a byte that says whether it is kept, and the new one.
    pub(super) smoothed: Option<Temporary>,
}

/// What a user is told whose memory does not hold the tiles of a file.
pub(super) fn too_large(points: usize, record: usize, max_memory_bytes: u64) -> FormatError {
    let (allowed, whole) = (max_memory_bytes >> 20, (points as u64 * bytes_a_point(record)).div_ceil(1 << 20));
    FormatError::Unsupported(format!(
        "its tiles, with the points around them, do not fit the {allowed} MiB that are allowed: raise the limit (the whole needs {whole} MiB)"
    ))
}

/// Coordinates of a record in metres.
struct Positions([las::Transform; 3]);

impl Positions {
    fn of(header: &las::Header) -> Self {
        let las::Vector { x, y, z } = *header.transforms();
        Self([x, y, z])
    }

    fn of_record(&self, record: &[u8]) -> [f64; 3] {
        std::array::from_fn(|axis| {
            let at = 4 * axis;
            let integer = i32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]);
            self.0[axis].direct(integer)
        })
    }
}

type FormatResult<T> = Result<T, FormatError>;

impl Dealt {
    pub(super) fn of(
        mut reader: LasReader,
        folder: &Path,
        max_memory_bytes: u64,
        progress: &Progress,
    ) -> FormatResult<Self> {
        let header = Arc::clone(reader.header());
        let (record, points) = (reader.record(), reader.points());
        let positions = Positions::of(&header);
        let most_in_memory = max_memory_bytes / bytes_a_point(record);
        // All records once more, so that they are decompressed once.
        let spool = Temporary::new(folder)?;
        let mut sample: [Vec<f64>; 3] = Default::default();
        let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        let step = points.div_ceil(SAMPLE).max(1);
        let mut to = BufWriter::with_capacity(1 << 20, spool.file());
        let (mut read, mut has_late_returns) = (0, false);
        while read < points {
            let records = reader.next_records(BATCH)?;
            to.write_all(records)?;
            for (i, point) in records.chunks_exact(record).enumerate() {
                let position = positions.of_record(point);
                has_late_returns |= !header.point_format().is_extended && point[14] & 7 > 5;
                for axis in 0..2 {
                    bounds[0][axis] = bounds[0][axis].min(position[axis]);
                    bounds[1][axis] = bounds[1][axis].max(position[axis]);
                }
                if (read + i).is_multiple_of(step) {
                    sample.iter_mut().zip(position).for_each(|(sample, value)| sample.push(value));
                }
            }
            read += records.len() / record;
            progress.add(records.len() / record / 2);
        }
        to.flush()?;
        drop(to);
        let span = |values: &Vec<f64>| middle(values.len(), |i| values[i]).map_or(0.0, |[low, high]| high - low);
        let extent_m = sample.iter().map(|values| span(values).powi(2)).sum::<f64>().sqrt();
        // Over most points: one far away is not to make all others lie in one cell.
        for axis in 0..2 {
            if let Some([low, high]) = middle(sample[axis].len(), |i| sample[axis][i]) {
                bounds[0][axis] = bounds[0][axis].max(low - (high - low));
                bounds[1][axis] = bounds[1][axis].min(high + (high - low));
            }
        }
        let mut cells = Cells::new(bounds[0], bounds[1]);
        for_each_batch(spool.file(), record, |records| {
            records.chunks_exact(record).map(|point| positions.of_record(point)).for_each(|[x, y, _]| cells.add(x, y));
            Ok(())
        })?;

        let tiles = cells.tiles(((most_in_memory as f64 * OWN_SHARE) as u64).max(1));
        let largest = tiles.iter().map(|tile| tile.points).max().unwrap_or(0);
        if tiles.len() > MOST_TILES || largest > most_in_memory {
            return Err(too_large(points, record, max_memory_bytes));
        }
        let of_cells = cells.tile_of_cells(&tiles);
        let file = |tile| Ok(TileFiles { tile, records: Temporary::new(folder)?, smoothed: None });
        let tiles = tiles.into_iter().map(file).collect::<FormatResult<Vec<_>>>()?;
        let sequence = Temporary::new(folder)?;
        {
            let mut numbers = BufWriter::with_capacity(1 << 20, sequence.file());
            let mut to: Vec<_> =
                tiles.iter().map(|tile| BufWriter::with_capacity(1 << 16, tile.records.file())).collect();
            for_each_batch(spool.file(), record, |records| {
                for point in records.chunks_exact(record) {
                    let [x, y, _] = positions.of_record(point);
                    let number = of_cells[cells.place(cells.cell_of(x, y))];
                    to[usize::from(number)].write_all(point)?;
                    numbers.write_all(&number.to_le_bytes())?;
                }
                progress.add(records.len() / record / 2);
                Ok(())
            })?;
            to.iter_mut().try_for_each(Write::flush)?;
            numbers.flush()?;
        }
        let folder = folder.to_path_buf();
        Ok(Self { header, record, points, most_in_memory, extent_m, has_late_returns, cells, tiles, sequence, folder })
    }

    /// The records of a tile, and behind them those of others within its halo; `None` if that is more than fits.
    pub(super) fn with_halo(&self, number: usize, halo_m: f64) -> FormatResult<Option<Vec<u8>>> {
        let most = usize::try_from(self.most_in_memory).unwrap_or(usize::MAX).saturating_mul(self.record);
        let positions = Positions::of(&self.header);
        let mut records = Vec::new();
        read_whole(self.tiles[number].records.file(), &mut records)?;
        let [low, high] = self.cells.bounds(&self.tiles[number].tile);
        let is_near = |x: f64, y: f64| {
            [(x, 0), (y, 1)]
                .into_iter()
                .all(|(value, axis)| low[axis] - halo_m <= value && value <= high[axis] + halo_m)
        };
        for (_, other) in self.tiles.iter().enumerate().filter(|(other, _)| *other != number) {
            let [other_low, other_high] = self.cells.bounds(&other.tile);
            let overlaps =
                (0..2).all(|axis| other_low[axis] <= high[axis] + halo_m && other_high[axis] >= low[axis] - halo_m);
            if !overlaps {
                continue;
            }
            for_each_batch(other.records.file(), self.record, |batch| {
                for point in batch.chunks_exact(self.record) {
                    let [x, y, _] = positions.of_record(point);
                    if is_near(x, y) {
                        records.extend_from_slice(point);
                    }
                }
                Ok(())
            })?;
            if records.len() > most {
                return Ok(None);
            }
        }
        Ok(Some(records))
    }

    /// Writes the smoothed records in the order of the input.
    pub(super) fn put_together(
        &self,
        records: Option<Records>,
        compressed: bool,
        whole: &WholeFile,
        progress: &Progress,
    ) -> FormatResult<()> {
        let records = match records {
            Some(records) => records,
            // Without a point.
            None => Records::new(&cloud_of(Arc::clone(&self.header), &[])?, &[], compressed)?,
        };
        let records = if self.has_late_returns { records.with_all_returns()? } else { records };
        let length = records.len();
        let to = BufWriter::with_capacity(1 << 20, whole.file().try_clone()?);
        let mut writer = LasWriter::new(to, records.header)?;
        let mut sources = Vec::new();
        for tile in &self.tiles {
            let Some(smoothed) = &tile.smoothed else { continue };
            let mut file = smoothed.file();
            file.seek(SeekFrom::Start(0))?;
            sources.push(BufReader::with_capacity(1 << 16, file));
        }
        let mut point = vec![0u8; 1 + length];
        for_each_batch(self.sequence.file(), 2, |numbers| {
            let mut batch = Vec::with_capacity(numbers.len() / 2 * length);
            for number in numbers.chunks_exact(2) {
                let source = &mut sources[usize::from(u16::from_le_bytes([number[0], number[1]]))];
                source.read_exact(&mut point)?;
                if point[0] != 0 {
                    batch.extend_from_slice(&point[1..]);
                }
            }
            progress.add(numbers.len() / 2);
            writer.write(batch)
        })?;
        writer.finish()?.into_inner().map_err(|error| FormatError::Os(error.into_error()))?;
        Ok(())
    }
}

/// Reads a temporary file from its beginning, so many things of a size at a time.
fn for_each_batch(mut file: &File, size: usize, mut visit: impl FnMut(&[u8]) -> FormatResult<()>) -> FormatResult<()> {
    let mut left = file.metadata()?.len() as usize;
    file.seek(SeekFrom::Start(0))?;
    let mut bytes = vec![0; (BATCH * size).min(left)];
    while left > 0 {
        let wanted = bytes.len().min(left);
        file.read_exact(&mut bytes[..wanted])?;
        visit(&bytes[..wanted])?;
        left -= wanted;
    }
    Ok(())
}

fn read_whole(mut file: &File, to: &mut Vec<u8>) -> FormatResult<()> {
    file.seek(SeekFrom::Start(0))?;
    file.read_to_end(to)?;
    Ok(())
}
