//! Smooths LAS, LAZ and PLY files that do not fit in memory, tile by tile.
//!
//! The file is read once, and its records are distributed to temporary files, one per tile. A tile is a rectangle of
//! grid cells seen from above. It is smoothed together with a halo of surrounding points. The halo is wide enough for
//! the tile's own points to get the same result as in the whole cloud, and only the records of these points are kept.
//! Finally, all records are written in input order.

mod plan;
mod spill;

use std::io::{BufWriter, Write};
use std::path::Path;

use crate::{AtomicFile, Encoding, Format, LasReader, PlyReader, RecordEncoder, RecordReader, Temporary, folder_of};
use plan::{Tile, bytes_a_point};
use planish_core::{
    CloudEstimate, CloudParams, CloudRadius, Engine, EngineError, Error, FormatError, Frame, IntoFrame, IoError,
    Outputs, ParamError, Params, PointCloud, PointsView, Progress, SensorPose, Settings, Smoothed, Smoother,
    SmootherOptions, Status,
    internal::{NeededHalo, halo},
};
use spill::{Spill, too_large};

/// Fraction of a tile's points whose radius may reach beyond the halo before the halo is widened.
const MAY_REACH_BEYOND: f64 = 1e-4;
/// Maximum number of points that may reach beyond the halo if a wider halo does not fit in memory. It is a fraction of
/// the points in the tile or in an average tile, whichever has more.
const MAY_BE_INEXACT: f64 = 0.01;
/// Minimum halo width when memory is short, as a fraction of the width estimated from the tile's point density.
const NARROWEST: f64 = 0.01;

/// Options for smoothing in tiles.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct TileOptions {
    /// The settings, as for any unorganized cloud, but limited to one pass. Parameters that they leave open are
    /// estimated from the tile with the most points.
    pub settings: Settings,
    /// The engine and its options. The reference engine does not support radii by density in tiles.
    pub smoother: SmootherOptions,
    /// Outputs to write in addition to the points.
    pub fields: Outputs,
    /// Pose of the sensor, towards which normals are oriented; `None` for the pose in the file.
    pub pose: Option<SensorPose>,
    /// The encoding of a PLY file; `None` to keep the input's encoding.
    pub encoding: Option<Encoding>,
    /// Memory limit in bytes; LAZ needs about 100 MB in addition.
    pub max_memory_bytes: u64,
}

impl TileOptions {
    /// Creates options with these settings and engine options, and with a memory limit in bytes.
    pub fn new(settings: Settings, smoother: SmootherOptions, max_memory_bytes: u64) -> Self {
        Self { settings, smoother, fields: Outputs::POINTS, pose: None, encoding: None, max_memory_bytes }
    }

    /// Sets the fields to write.
    pub fn with_fields(self, fields: Outputs) -> Self {
        Self { fields, ..self }
    }

    /// Sets the encoding of PLY files.
    pub fn with_encoding(self, encoding: Option<Encoding>) -> Self {
        Self { encoding, ..self }
    }

    /// Sets the sensor's pose.
    pub fn with_pose(self, pose: Option<SensorPose>) -> Self {
        Self { pose, ..self }
    }
}

/// Report on a smoothed file.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub struct TilesReport {
    /// Number of points.
    pub points: usize,
    /// Number of tiles.
    pub tiles: usize,
    /// The parameters that were used.
    pub params: CloudParams,
    /// The estimate that determined the number of neighbours; `None` if the settings state this number.
    pub cloud_estimate: Option<CloudEstimate>,
    /// The engine used; for an empty file, the requested one.
    pub engine: Engine,
    /// Number of points with each status, indexed by the status code.
    pub status_counts: [usize; Status::ALL.len()],
    /// Number of points whose neighbourhood reaches beyond the halo, such as stray points. Their radius may differ
    /// from the radius in the whole cloud.
    pub reaching_beyond: usize,
    /// True if the file or the options state the sensor's pose.
    pub has_pose: bool,
    /// Assumed position of the sensor in metres, if neither the file nor the options state it and it cannot have been
    /// the origin of coordinates.
    pub assumed_sensor_m: Option<[f64; 3]>,
    /// Notes for users on data of the file that were dropped, one clause each.
    pub notes: Vec<String>,
}

/// Returns true if `input` can be smoothed in tiles to `output`: both are LAS or LAZ files, or both are PLY files.
pub fn are_tiled(input: &Path, output: &Path) -> bool {
    let is_las = |path| matches!(Format::of_extension(path), Some(Format::Las | Format::Laz));
    let is_ply = |path| Format::of_extension(path) == Some(Format::Ply);
    (is_las(input) && is_las(output)) || (is_ply(input) && is_ply(output))
}

/// Returns the memory in bytes that smoothing a LAS, LAZ or PLY file without tiles needs; `None` for other, organized
/// or unreadable files.
pub fn bytes_in_memory(path: &Path) -> Option<u64> {
    fn needed<R: RecordReader>(path: &Path) -> Option<u64> {
        let reader = R::open(path).ok()?;
        Some(reader.points() as u64 * bytes_a_point(reader.record()))
    }
    // Query the metadata before opening the file, since opening a pipe waits for its other end.
    if !path.metadata().is_ok_and(|metadata| metadata.is_file()) {
        return None;
    }
    match Format::of_extension(path)? {
        Format::Las | Format::Laz => needed::<LasReader>(path),
        Format::Ply => needed::<PlyReader>(path),
        _ => None,
    }
}

/// Smooths a LAS, LAZ or PLY file into another of the same kind within the memory limit. In addition to the output,
/// this needs disk space for three copies of the records.
///
/// With the same number of neighbours, each point gets the same result as in the whole cloud, computed relative to an
/// origin in its tile.
///
/// # Errors
/// If settings contradict each other, a file cannot be read or written, an engine fails, or a tile does not fit within
/// the memory limit.
pub fn smooth_tiles(
    input: &Path,
    output: &Path,
    options: &TileOptions,
    progress: &Progress,
) -> Result<TilesReport, Error> {
    if !are_tiled(input, output) {
        let reason =
            "smoothing in tiles needs an input and an output of one kind: both .las or .laz, or both .ply".to_owned();
        return Err(IoError::at(output)(FormatError::Unsupported(reason)).into());
    }
    match Format::of_extension(input) {
        Some(Format::Ply) => smooth_records::<PlyReader>(input, output, options, progress),
        _ => smooth_records::<LasReader>(input, output, options, progress),
    }
}

fn smooth_records<R: RecordReader>(
    input: &Path,
    output: &Path,
    options: &TileOptions,
    progress: &Progress,
) -> Result<TilesReport, Error> {
    if let Some(passes) = options.settings.passes.filter(|passes| *passes > 1) {
        let allowed = "1 for a file that is smoothed in tiles; two passes need memory for the whole cloud";
        return Err(ParamError { field: "passes", value: passes.to_string(), allowed }.into());
    }
    if options.settings.spaces_evenly() {
        let allowed = "only for a file that fits into memory, not for one smoothed in tiles";
        return Err(ParamError { field: "even", value: "true".into(), allowed }.into());
    }
    let params = options.settings.cloud_params()?;
    let engine = options.smoother.engine;
    if engine == Engine::Reference && !matches!(params.radius, CloudRadius::Fixed { .. }) {
        // The engine must report radii by density, which the reference engine does not.
        let reason =
            "radii by density in tiles need the CPU or GPU engine; use one of them, or set a radius".to_owned();
        return Err(EngineError::Unavailable { engine: engine.name(), reason }.into());
    }
    let whole = AtomicFile::new(output).map_err(IoError::at(output))?;
    let reader = R::open(input).map_err(IoError::at(input))?;
    progress.begin(3 * reader.points());
    let notes = reader.notes();
    // System errors are attributed to the output, all others to the input.
    let at_either = |problem: FormatError| match problem {
        FormatError::Os(_) => Error::from(IoError::at(output)(problem)),
        _ => IoError::at(input)(problem).into(),
    };
    let mut spill = Spill::of(reader, folder_of(output), options.max_memory_bytes, progress).map_err(at_either)?;
    if options.pose.is_none() {
        options.settings.check_sensor_position(spill.assumed_sensor_m)?;
    }
    let at_files = |error| match error {
        TileError::Files(problem) => at_either(problem),
        TileError::Other(error) => error,
    };
    let report = TilesReport { notes, params, ..TilesReport::default() };
    // The file's normals belong to the measured points, so new normals are computed for the smoothed points.
    let none = R::cloud_of(&spill.header, &[]).map_err(at_either)?;
    let renew = |outputs: Outputs| outputs.renewing(&none);
    let smoother = options.smoother.clone().with_outputs(renew(options.smoother.outputs));
    let options = &TileOptions { fields: renew(options.fields), smoother, ..options.clone() };
    let mut tiler = Tiler::<R> { options, params, smoother: None, halo_share: 1.0, report, encoder: None };
    tiler.choose_neighbours(&spill).map_err(at_files)?;
    for number in 0..spill.tiles.len() {
        tiler.smooth(&mut spill, number, output).map_err(at_files)?;
        progress.add(spill.tiles[number].tile.points as usize);
    }
    let Tiler { report, encoder, smoother, .. } = tiler;
    let engine = smoother.as_ref().map_or(engine, Smoother::engine);
    let put_together = || {
        let encoder = match encoder {
            Some(encoder) => encoder,
            // The file has no points.
            None => new_encoder(&spill, &R::cloud_of(&spill.header, &[])?, &[], output, options)?,
        };
        spill.put_together(encoder, &whole, progress)
    };
    put_together().map_err(IoError::at(output))?;
    whole.finish().map_err(IoError::at(output))?;
    Ok(TilesReport { points: spill.points, tiles: spill.tiles.len(), engine, ..report })
}

fn new_encoder<R: RecordReader>(
    spill: &Spill<R>,
    cloud: &PointCloud,
    kept: &[usize],
    output: &Path,
    options: &TileOptions,
) -> Result<R::Encoder, FormatError> {
    R::Encoder::new(&spill.header, cloud, kept, output, options.encoding)
}

enum TileError {
    Files(FormatError),
    Other(Error),
}

impl From<FormatError> for TileError {
    fn from(problem: FormatError) -> Self {
        Self::Files(problem)
    }
}

impl From<std::io::Error> for TileError {
    fn from(error: std::io::Error) -> Self {
        Self::Files(error.into())
    }
}

impl From<Error> for TileError {
    fn from(error: Error) -> Self {
        Self::Other(error)
    }
}

/// State carried from tile to tile.
struct Tiler<'a, R: RecordReader> {
    options: &'a TileOptions,
    params: CloudParams,
    smoother: Option<Smoother>,
    /// Width of the last tile's halo, as a fraction of the width estimated from point density.
    halo_share: f64,
    report: TilesReport,
    /// The encoder of records, which is the same for every tile.
    encoder: Option<R::Encoder>,
}

impl<R: RecordReader> Tiler<'_, R> {
    /// Estimates the number of neighbours for the tile with the most points, if the settings leave it open.
    fn choose_neighbours(&mut self, spill: &Spill<R>) -> Result<(), TileError> {
        let largest = (0..spill.tiles.len()).max_by_key(|&number| spill.tiles[number].tile.points);
        let Some(number) = largest.filter(|_| self.options.settings.chooses_neighbours()) else { return Ok(()) };
        let Some(raw) = spill.with_halo(number, 0.0)? else { return Ok(()) };
        let cloud = R::cloud_of(&spill.header, &raw)?;
        drop(raw);
        let view = PointsView::from_cloud(&cloud).map_err(Error::from)?;
        // A tile's halo is wide enough for one pass only.
        let mut settings = self.options.settings.clone();
        settings.passes = Some(1);
        let resolved = settings.resolve_by_density(Frame::Points(view)).map_err(Error::from)?;
        if let Params::Cloud(params) = resolved.params {
            (self.params, self.report.params, self.report.cloud_estimate) = (params, params, resolved.cloud_estimate);
        }
        Ok(())
    }

    /// Smooths a tile with its halo. Widens the halo until its width suffices, or narrows it until it fits in memory.
    fn smooth(&mut self, spill: &mut Spill<R>, number: usize, output: &Path) -> Result<(), TileError> {
        let tile = spill.tiles[number].tile;
        let own = tile.points as usize;
        let by_density_m = halo::first_cloud_halo_m(&self.params, tile.points, spill.cells.area(&tile));
        let mut halo_m = self.halo_share * by_density_m;
        let mut may_widen = true;
        loop {
            let Some(raw) = spill.with_halo(number, halo_m)? else {
                let may_be_narrower = !matches!(self.params.radius, CloudRadius::Fixed { .. });
                if may_be_narrower && halo_m > NARROWEST * by_density_m {
                    (halo_m, may_widen) = (0.7 * halo_m, false);
                    continue;
                }
                return Err(too_large(spill.points, spill.record, self.options.max_memory_bytes).into());
            };
            let mut cloud = R::cloud_of(&spill.header, &raw)?;
            drop(raw);
            if let Some(pose) = self.options.pose {
                cloud.pose = pose;
            }
            let smoothed = self.smoothed(&cloud, spill)?;
            let needed = self.needed_halo(spill, &tile, &cloud, halo_m);
            if may_widen && needed.is_wider {
                halo_m = needed.halo_m;
                continue;
            }
            let usual = spill.points / spill.tiles.len();
            if needed.beyond as f64 > MAY_BE_INEXACT * own.max(usual) as f64 {
                return Err(too_large(spill.points, spill.record, self.options.max_memory_bytes).into());
            }
            self.halo_share = halo_m / by_density_m;
            self.report.reaching_beyond += needed.beyond;
            return self.keep(spill, number, &mut cloud, &smoothed, output);
        }
    }

    fn smoothed(&mut self, cloud: &PointCloud, spill: &Spill<R>) -> Result<Smoothed, Error> {
        let smoother = match &mut self.smoother {
            Some(smoother) => smoother,
            none => {
                let smoother = none.insert(Smoother::open_clouds(self.params, &self.options.smoother)?);
                smoother.keep_radii();
                smoother
            }
        };
        let mut smoothed = Smoothed::default();
        let mut part = PointsView::from_cloud(cloud)?.as_part_of(spill.points, spill.extent_m);
        self.report.has_pose = !cloud.pose.is_identity();
        if let (true, Some(position_m)) = (cloud.pose.is_identity(), spill.assumed_sensor_m) {
            part = part.with_pose(SensorPose { position_m, ..SensorPose::IDENTITY })?;
            self.report.assumed_sensor_m = Some(position_m);
        }
        smoother.smooth(part.into_frame()?, &mut smoothed)?;
        Ok(smoothed)
    }

    /// Returns the halo that the tile's points need.
    fn needed_halo(&self, spill: &Spill<R>, tile: &Tile, cloud: &PointCloud, halo_m: f64) -> NeededHalo {
        let [low, high] = spill.cells.bounds(tile);
        let reach = halo::cloud_reach(&self.params);
        let needed_m = (0..tile.points as usize).filter_map(|i| {
            // A hole has no radius, and may belong to any tile. Without radii by density, no point has one.
            let radius_m = self.smoother.as_ref()?.own_radius_m(i)?;
            // Distance from the point to the border of its tile, beyond which there are other points.
            let to_border = (0..2).map(|axis| {
                let value = cloud.coordinate(axis, i);
                (value - low[axis]).min(high[axis] - value)
            });
            Some(reach * f64::from(radius_m) - to_border.fold(f64::INFINITY, f64::min))
        });
        halo::needed_halo(halo_m, &needed_m.collect::<Vec<_>>(), MAY_REACH_BEYOND * tile.points as f64)
    }

    /// Writes the new records of the tile's own points.
    fn keep(
        &mut self,
        spill: &mut Spill<R>,
        number: usize,
        cloud: &mut PointCloud,
        smoothed: &Smoothed,
        output: &Path,
    ) -> Result<(), TileError> {
        let own = spill.tiles[number].tile.points as usize;
        cloud.apply(smoothed, self.options.fields).map_err(Error::from)?;
        for status in smoothed.status.iter().flatten().take(own) {
            self.report.status_counts[*status as usize] += 1;
        }
        let is_kept = |cloud: &PointCloud, i| R::Encoder::KEEPS_HOLES || cloud.positions.is_finite(i);
        let kept: Vec<usize> = (0..own).filter(|&i| is_kept(cloud, i)).collect();
        let encoder = match &mut self.encoder {
            Some(encoder) => encoder,
            none => none.insert(new_encoder(spill, cloud, &kept, output, self.options)?),
        };
        let raw = encoder.encode(cloud, &kept)?;
        let file = Temporary::new(&spill.folder)?;
        let mut to = BufWriter::with_capacity(1 << 20, file.file());
        let mut next = raw.chunks_exact(encoder.record());
        let none = vec![0; encoder.record()];
        for i in 0..own {
            let is_kept = is_kept(cloud, i);
            to.write_all(&[u8::from(is_kept)])?;
            to.write_all(if is_kept { next.next().unwrap_or(&none) } else { &none })?;
        }
        to.flush()?;
        drop(to);
        spill.tiles[number].smoothed = Some(file);
        Ok(())
    }
}
