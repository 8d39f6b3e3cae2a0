//! Distributes the records of a file to temporary files, one per tile, and merges the smoothed records in the order of
//! the input.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use super::plan::{Cells, Tile, bytes_a_point};

use crate::{AtomicFile, RecordEncoder, RecordReader, Temporary};
use planish_core::{
    FormatError, Progress,
    internal::{KIB, OWN_SHARE, assumed_sensor_of_sample, memory, middle, sampling_step},
};

/// Number of records that are read or written at once.
const BATCH: usize = 1 << 18;
/// Maximum number of tiles. Each tile has two open files; in total, these are fewer than any system allows.
const MOST_TILES: usize = 100;
/// Maximum number of sampled points from which a cloud's extent is determined.
const SAMPLE: usize = 10_000;

/// The records of a file, distributed to one temporary file per tile.
pub(super) struct Spill<R: RecordReader> {
    pub(super) header: R::Header,
    pub(super) record: usize,
    pub(super) points: usize,
    pub(super) most_in_memory: u64,
    pub(super) extent_m: f64,
    /// Assumed position of the sensor in metres, if it cannot be the origin of coordinates.
    pub(super) assumed_sensor_m: Option<[f64; 3]>,
    /// True if only the latest version of the format can store the records.
    needs_latest_version: bool,
    pub(super) cells: Cells,
    pub(super) tiles: Vec<TileFiles>,
    /// The number of each record's tile, in file order.
    sequence: Temporary,
    pub(super) folder: PathBuf,
}

/// A tile with its original and its smoothed records.
pub(super) struct TileFiles {
    pub(super) tile: Tile,
    records: Temporary,
    /// For each record, a byte that is 1 if the point is kept and 0 otherwise, followed by the new record.
    pub(super) smoothed: Option<Temporary>,
}

/// Returns the error for a file whose tiles do not fit within the memory limit.
pub(super) fn too_large(points: usize, record: usize, max_memory_bytes: u64) -> FormatError {
    let (allowed, whole) = (memory(max_memory_bytes), memory(points as u64 * bytes_a_point(record) + KIB - 1));
    FormatError::Unsupported(format!(
        "a tile with its surrounding points exceeds the memory limit of {allowed}; raise the limit (the whole file \
         needs {whole})"
    ))
}

type FormatResult<T> = Result<T, FormatError>;

impl<R: RecordReader> Spill<R> {
    pub(super) fn of(mut reader: R, folder: &Path, max_memory_bytes: u64, progress: &Progress) -> FormatResult<Self> {
        let header = reader.header().clone();
        let (record, points) = (reader.record(), reader.points());
        let most_in_memory = max_memory_bytes / bytes_a_point(record);
        // A copy of all records, so that a compressed file is decompressed only once.
        let spool = Temporary::new(folder)?;
        let mut sample: [Vec<f64>; 3] = Default::default();
        let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        let step = points.div_ceil(SAMPLE).max(1);
        let mut of_sensor: Vec<[f64; 3]> = Vec::new();
        let mut to = BufWriter::with_capacity(1 << 20, spool.file());
        let (mut read, mut finite) = (0, 0usize);
        while read < points {
            let records = reader.next_records(BATCH)?;
            to.write_all(records)?;
            for (i, point) in (read..).zip(records.chunks_exact(record)) {
                let position = R::position_m(&header, point);
                if !is_finite(position) {
                    continue;
                }
                if i.is_multiple_of(sampling_step(points)) {
                    of_sensor.push(position);
                }
                for axis in 0..2 {
                    bounds[0][axis] = bounds[0][axis].min(position[axis]);
                    bounds[1][axis] = bounds[1][axis].max(position[axis]);
                }
                if finite.is_multiple_of(step) {
                    sample.iter_mut().zip(position).for_each(|(sample, value)| sample.push(value));
                }
                finite += 1;
            }
            read += records.len() / record;
            progress.add(records.len() / record / 2);
        }
        to.flush()?;
        drop(to);
        let needs_latest_version = reader.needs_latest_version();
        drop(reader);
        let span = |values: &Vec<f64>| middle(values.len(), |i| values[i]).map_or(0.0, |[low, high]| high - low);
        let extent_m = sample.iter().map(|values| span(values).powi(2)).sum::<f64>().sqrt();
        // The grid covers most points, but not the farthest ones, so that a stray point does not force all others into
        // one cell.
        for axis in 0..2 {
            if let Some([low, high]) = middle(sample[axis].len(), |i| sample[axis][i]) {
                bounds[0][axis] = bounds[0][axis].max(low - (high - low));
                bounds[1][axis] = bounds[1][axis].min(high + (high - low));
            }
        }
        let mut cells = Cells::new(bounds[0], bounds[1]);
        let mut places = Places { sample: &sample, holes: 0 };
        for_each_batch(spool.file(), record, |records| {
            for point in records.chunks_exact(record) {
                let [x, y] = places.of(R::position_m(&header, point));
                cells.add(x, y);
            }
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
            let mut places = Places { sample: &sample, holes: 0 };
            for_each_batch(spool.file(), record, |records| {
                for point in records.chunks_exact(record) {
                    let [x, y] = places.of(R::position_m(&header, point));
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
        Ok(Self {
            header,
            record,
            points,
            most_in_memory,
            extent_m,
            assumed_sensor_m: assumed_sensor_of_sample(&of_sensor),
            needs_latest_version,
            cells,
            tiles,
            sequence,
            folder,
        })
    }

    /// Returns a tile's records, followed by the records of its halo; `None` if they do not fit in memory.
    pub(super) fn with_halo(&self, number: usize, halo_m: f64) -> FormatResult<Option<Vec<u8>>> {
        let most = usize::try_from(self.most_in_memory).unwrap_or(usize::MAX).saturating_mul(self.record);
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
                    let [x, y, z] = R::position_m(&self.header, point);
                    if z.is_finite() && is_near(x, y) {
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

    /// Writes the smoothed records in input order. `encoder` is the encoder that produced them.
    pub(super) fn put_together(
        &self,
        encoder: R::Encoder,
        whole: &AtomicFile,
        progress: &Progress,
    ) -> FormatResult<()> {
        let encoder = if self.needs_latest_version { encoder.in_latest_version()? } else { encoder };
        let length = encoder.record();
        let to = BufWriter::with_capacity(1 << 20, whole.file().try_clone()?);
        let mut sources = Vec::new();
        for tile in &self.tiles {
            let Some(smoothed) = &tile.smoothed else { continue };
            let mut file = smoothed.file();
            file.seek(SeekFrom::Start(0))?;
            sources.push(BufReader::with_capacity(1 << 16, file));
        }
        let mut point = vec![0u8; 1 + length];
        let mut sequence = self.sequence.file();
        sequence.seek(SeekFrom::Start(0))?;
        let mut numbers = BufReader::with_capacity(1 << 20, sequence);
        let mut left = self.points;
        encoder.write(to, self.points, || {
            let mut batch = Vec::new();
            // An empty batch would end the file, so a batch that consists only of dropped holes must not be returned.
            while batch.is_empty() && left > 0 {
                let read = left.min(BATCH);
                batch.reserve(read * length);
                for _ in 0..read {
                    let mut number = [0; 2];
                    numbers.read_exact(&mut number)?;
                    let source = &mut sources[usize::from(u16::from_le_bytes(number))];
                    source.read_exact(&mut point)?;
                    if point[0] != 0 {
                        batch.extend_from_slice(&point[1..]);
                    }
                }
                left -= read;
                progress.add(read);
            }
            Ok(batch)
        })
    }
}

fn is_finite(position: [f64; 3]) -> bool {
    position.iter().all(|value| value.is_finite())
}

/// Assigns each point a position seen from above. Holes get the positions of sampled points in turn, so that they
/// spread over all tiles.
struct Places<'a> {
    sample: &'a [Vec<f64>; 3],
    holes: usize,
}

impl Places<'_> {
    fn of(&mut self, position: [f64; 3]) -> [f64; 2] {
        let [xs, ys, _] = self.sample;
        if is_finite(position) || xs.is_empty() {
            return [position[0], position[1]];
        }
        self.holes += 1;
        let i = self.holes % xs.len();
        [xs[i], ys[i]]
    }
}

/// Reads a temporary file from its beginning, in batches of whole items of `size` bytes each.
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
