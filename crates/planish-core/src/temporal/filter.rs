//! The temporal filter for the frames of one stream.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::constants::TILE;
use super::motion::{CameraMotion, Lookup};
use super::rows::{ChangeRow, MARGIN, RowBuffers, Rule, UpdateRow, measure_changes, update};
use super::state::State;
use super::tiles::{Tile, update_tiles};
use super::{Domain, TemporalParams};
use crate::camera::Rays;
use crate::error::{FrameError, ParamError};
use crate::sensor::SensorModel;

/// Minimum number of frames averaged in a pixel's last value for a hole to keep that value.
const FRAMES_TO_HOLD: f32 = 4.0;
/// Minimum number of calm pixels among the 5x5 around a hole for the hole to keep its last value.
const CALM_TO_HOLD: f32 = 13.0;

/// Smooths the depth of a video over time, frame by frame (docs/method.md, section 16).
///
/// Each pixel becomes a mean of up to [`TemporalParams::frames`] frames. Fewer frames are averaged where the scene
/// changes, so only objects that are barely in front of their background leave trails, and those are short. Use one
/// filter per stationary camera; a frame of another shape resets it. Smooth every frame in space first: the test for
/// changes relies on it.
///
/// ```
/// use planish::{SensorModel, TemporalFilter, TemporalParams};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let mut filter = TemporalFilter::new(TemporalParams::STEADY, SensorModel::KINECT_V1)?;
/// for frame in 0..20 {
///     let mut depth_m = vec![2.0 + if frame % 2 == 0 { 0.003 } else { -0.003 }; 64 * 48];
///     filter.smooth(64, 48, &mut depth_m)?;
///     assert!(frame < 10 || (depth_m[1000] - 2.0).abs() < 0.0008);
/// }
/// assert!(filter.frames(1000) > 10.0 && !filter.is_carried(1000));
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct TemporalFilter {
    params: TemporalParams,
    rule: Rule,
    level: Level,
    shape: (usize, usize),
    /// Number of pixels per row of the planes, a multiple of [`TILE`].
    pitch: usize,
    state: State,
    /// The other state buffer: states are moved into it if the camera moves.
    moved: State,
    rays: Rays,
    tiles: Vec<Tile>,
    planes: Planes,
}

/// The pixels of the last frame whose values were carried over from earlier frames.
#[derive(Clone, Copy)]
pub(crate) struct Carried<'a> {
    state: &'a State,
    width: usize,
    pitch: usize,
}

impl Carried<'_> {
    /// Returns the columns in a row whose values were carried over.
    pub(crate) fn columns(&self, row: usize) -> impl Iterator<Item = usize> {
        let (state, start) = (self.state, row * self.pitch);
        // Few pixels are carried over, so whole tiles are tested first.
        let tiles = (0..self.width).step_by(TILE).map(|from| from..(from + TILE).min(self.width));
        let some = tiles.filter(move |tile| state.has_carried(start + tile.start..start + tile.end));
        some.flatten().filter(move |column| state.is_carried(start + column))
    }
}

/// Intermediate results, row by row of `pitch` pixels.
#[derive(Debug, Default)]
struct Planes {
    depth_m: Vec<f32>,
    changes: Vec<f32>,
    /// Sums of clipped changes over five columns, with [`MARGIN`] rows of zeros above and below.
    sums: Vec<f32>,
    /// Number of changes in each of the `sums`, with the same margins.
    counts: Vec<f32>,
    /// Sums of candidates' signs over three columns, with the same margins.
    signs: Vec<f32>,
    calm: Vec<f32>,
    tiles: Vec<[f32; 2]>,
    /// A reusable buffer for the medians over all tiles.
    sorted: Vec<f32>,
    /// One set of buffers per row of tiles.
    buffers: Vec<RowBuffers>,
}

impl TemporalFilter {
    /// Creates a filter for the frames of a sensor.
    ///
    /// # Errors
    /// If a parameter is outside its range.
    pub fn new(params: TemporalParams, sensor: SensorModel) -> Result<Self, ParamError> {
        params.validate()?;
        sensor.validate()?;
        let rule = Rule { domain: Domain::of(&sensor), sigma: sensor.sigma, most_frames: params.frames };
        let (state, moved, rays, tiles, planes) = Default::default();
        let level = Level::new();
        Ok(Self { params, rule, level, shape: (0, 0), pitch: 0, state, moved, rays, tiles, planes })
    }

    /// Smooths the depth of the next frame, in metres along the optical axis, row by row. Values that are not
    /// positive, or not below 1e18, are holes, which become NaN. Runs on the threads of the current Rayon pool.
    ///
    /// # Errors
    /// If the number of values is not `width` x `height`.
    pub fn smooth(&mut self, width: usize, height: usize, depth_m: &mut [f32]) -> Result<(), FrameError> {
        self.smooth_moved_by(None, width, height, depth_m)
    }

    /// Smooths the depth of the next frame of a camera that has moved since the previous frame. The motion is ignored
    /// for the first frame, and for the first after a [`reset`](Self::reset).
    ///
    /// # Errors
    /// If the number of values does not match the camera's shape, or the camera or the motion is invalid.
    pub fn smooth_moved(&mut self, motion: &CameraMotion, depth_m: &mut [f32]) -> Result<(), FrameError> {
        motion.camera.validate()?;
        self.smooth_moved_by(Some(motion), motion.camera.width, motion.camera.height, depth_m)
    }

    fn smooth_moved_by(
        &mut self,
        motion: Option<&CameraMotion>,
        width: usize,
        height: usize,
        depth_m: &mut [f32],
    ) -> Result<(), FrameError> {
        let expected = width * height;
        if depth_m.len() != expected {
            return Err(FrameError::LengthMismatch { what: "the depth".to_owned(), len: depth_m.len(), expected });
        }
        if depth_m.is_empty() {
            return Ok(());
        }
        self.smooth_rows(motion, (width, height), |v, row| row.copy_from_slice(&depth_m[v * width..(v + 1) * width]))?;
        let rows = depth_m.par_chunks_mut(width).zip(self.planes.depth_m.par_chunks(self.pitch));
        rows.for_each(|(row, from)| row.copy_from_slice(&from[..width]));
        Ok(())
    }

    /// Smooths the depth of the next frame. `write_row` writes each row of the input, and
    /// [`rows_mut`](Self::rows_mut) returns the results.
    pub(crate) fn smooth_rows(
        &mut self,
        motion: Option<&CameraMotion>,
        (width, height): (usize, usize),
        write_row: impl Fn(usize, &mut [f32]) + Sync,
    ) -> Result<(), FrameError> {
        if self.shape != (width, height) {
            self.start(width, height);
        }
        let pitch = self.pitch;
        let rows = self.planes.depth_m.par_chunks_mut(pitch).enumerate();
        rows.for_each(|(v, row)| write_row(v, &mut row[..width]));
        if let Some(motion) = motion {
            self.move_state(motion)?;
        }
        self.measure_changes();
        let across = pitch / TILE;
        update_tiles(&mut self.tiles, across, &self.planes.tiles, motion.is_some(), &mut self.planes.sorted);
        self.update();
        if self.params.hold_frames > 0 {
            self.hold();
        }
        Ok(())
    }

    /// Returns the rows of the smoothed depth, which may be overwritten, and the carried values. Rows may be longer
    /// than the image's width.
    pub(crate) fn rows_mut(&mut self) -> (impl IndexedParallelIterator<Item = &mut [f32]>, Carried<'_>) {
        let Self { planes, state, shape, pitch, .. } = self;
        (planes.depth_m.par_chunks_mut(*pitch), Carried { state, width: shape.0, pitch: *pitch })
    }

    pub(crate) fn level(&self) -> Level {
        self.level
    }

    /// Forgets all frames. Call it after a gap in time or a jump of the camera.
    pub fn reset(&mut self) {
        self.shape = (0, 0);
    }

    /// Returns the number of frames averaged in pixel `i` of the last frame, 1 to [`TemporalParams::frames`]; 0 for a
    /// hole.
    ///
    /// # Panics
    /// If `i` is not a pixel of the last frame.
    pub fn frames(&self, i: usize) -> f32 {
        self.state.frames(self.place(i))
    }

    /// Returns true if pixel `i` of the last frame was a hole or a suspected outlier, and its value is carried over
    /// from earlier frames.
    ///
    /// # Panics
    /// If `i` is not a pixel of the last frame.
    pub fn is_carried(&self, i: usize) -> bool {
        self.state.is_carried(self.place(i))
    }

    fn place(&self, i: usize) -> usize {
        let (width, height) = self.shape;
        assert!(i < width * height, "pixel {i} of {width} x {height}");
        i / width * self.pitch + i % width
    }

    /// Resets the filter for frames of another shape.
    fn start(&mut self, width: usize, height: usize) {
        self.shape = (width, height);
        self.pitch = width.next_multiple_of(TILE);
        let len = self.pitch * height;
        self.state.reset(len);
        self.moved = State::default();
        let tiles = self.pitch / TILE * height.div_ceil(TILE);
        self.tiles = vec![Tile::default(); tiles];
        let with_margin = vec![0.0; len + 2 * MARGIN * self.pitch];
        self.planes = Planes {
            depth_m: vec![f32::NAN; len],
            changes: vec![0.0; len],
            sums: with_margin.clone(),
            counts: with_margin.clone(),
            signs: with_margin,
            calm: vec![0.0; len],
            tiles: vec![[0.0; 2]; tiles],
            sorted: Vec::with_capacity(tiles),
            buffers: vec![RowBuffers::of_pitch(self.pitch); height.div_ceil(TILE)],
        };
    }

    /// Moves the state into the view of the current frame.
    fn move_state(&mut self, motion: &CameraMotion) -> Result<(), FrameError> {
        let transform = motion.previous_from_current.transform()?;
        if transform.is_identity() {
            return Ok(());
        }
        self.rays.set(&motion.camera);
        if self.moved.mean.len() != self.state.mean.len() {
            self.moved.reset(self.state.mean.len());
        }
        let lookup = Lookup::new(self.rule, self.level, &motion.camera, &self.rays, self.pitch);
        lookup.move_state(&transform, &self.planes.depth_m, &self.state, &mut self.moved);
        std::mem::swap(&mut self.state, &mut self.moved);
        Ok(())
    }

    fn measure_changes(&mut self) {
        let Self { rule, level, pitch, state, planes, .. } = self;
        let (rule, level, pitch) = (*rule, *level, *pitch);
        let band = TILE * pitch;
        let inner = MARGIN * pitch..planes.sums.len() - MARGIN * pitch;
        let inputs = planes.depth_m.par_chunks(band).zip(state.mean.par_chunks(band));
        let inputs = inputs.zip(state.frames_variance.par_chunks(band)).zip(state.bias_idle.par_chunks(band));
        let sums =
            planes.sums[inner.clone()].par_chunks_mut(band).zip(planes.counts[inner.clone()].par_chunks_mut(band));
        let outputs = sums.zip(planes.signs[inner].par_chunks_mut(band)).zip(planes.changes.par_chunks_mut(band));
        let outputs = outputs.zip(planes.tiles.par_chunks_mut(pitch / TILE)).zip(&mut planes.buffers);
        inputs.zip(outputs).for_each(|(inputs, (outputs, buffers))| {
            let (((depth_m, mean), frames_variance), bias_idle) = inputs;
            let ((((sums, counts), signs), changes), tiles) = outputs;
            buffers.begin();
            for start in (0..depth_m.len()).step_by(pitch) {
                let at = start..start + pitch;
                let row = ChangeRow {
                    depth_m: &depth_m[at.clone()],
                    mean: &mean[at.clone()],
                    frames_variance: &frames_variance[at.clone()],
                    bias_idle: &bias_idle[at.clone()],
                    changes: &mut changes[at.clone()],
                    sums: &mut sums[at.clone()],
                    counts: &mut counts[at.clone()],
                    signs: &mut signs[at],
                };
                dispatch!(level, simd => measure_changes(simd, rule, row, buffers));
            }
            buffers.sum_tiles(tiles);
        });
    }

    fn update(&mut self) {
        let Self { params, rule, level, pitch, state, tiles, planes, .. } = self;
        let (rule, level, pitch, holds) = (*rule, *level, *pitch, params.hold_frames > 0);
        let Planes { depth_m, changes, sums, counts, signs, calm, .. } = planes;
        let outputs = depth_m.par_chunks_mut(pitch).zip(state.mean.par_chunks_mut(pitch));
        let outputs = outputs.zip(state.frames_variance.par_chunks_mut(pitch));
        let outputs = outputs.zip(state.bias_idle.par_chunks_mut(pitch)).zip(calm.par_chunks_mut(pitch));
        outputs.enumerate().for_each(|(v, ((((depth_m, mean), frames_variance), bias_idle), calm))| {
            // In a plane with margins, image row v is row v + MARGIN.
            let row = UpdateRow {
                depth_m,
                mean,
                frames_variance,
                bias_idle,
                changes: row_of(changes, pitch, v),
                sums: std::array::from_fn(|k| row_of(sums, pitch, v + k)),
                counts: std::array::from_fn(|k| row_of(counts, pitch, v + k)),
                signs: std::array::from_fn(|k| row_of(signs, pitch, v + 1 + k)),
                tiles: &tiles[v / TILE * (pitch / TILE)..],
                calm: holds.then_some(calm),
            };
            dispatch!(level, simd => update(simd, rule, row));
        });
    }

    /// Fills holes in calm surroundings with their last values, if those are recent.
    fn hold(&mut self) {
        let Self { params, rule, shape: (width, height), pitch, state, planes, .. } = self;
        let (width, height, pitch) = (*width, *height, *pitch);
        for v in 0..height {
            for u in 0..width {
                let at = v * pitch + u;
                let is_recent = (1..=params.hold_frames).contains(&state.idle(at));
                let is_hole = planes.depth_m[at].is_nan();
                if !is_hole || !is_recent || state.remembered_frames(at) < FRAMES_TO_HOLD {
                    continue;
                }
                let rows = v.saturating_sub(2)..(v + 3).min(height);
                let columns = u.saturating_sub(2)..(u + 3).min(width);
                let calm = rows.flat_map(|row| &planes.calm[row * pitch + columns.start..row * pitch + columns.end]);
                if calm.sum::<f32>() >= CALM_TO_HOLD {
                    planes.depth_m[at] = match rule.domain {
                        Domain::InverseDepth => 1.0 / state.mean[at],
                        Domain::Depth => state.mean[at],
                    };
                    state.set_carried(at);
                }
            }
        }
    }
}

/// Returns a row of a plane.
fn row_of(plane: &[f32], pitch: usize, number: usize) -> &[f32] {
    &plane[pitch * number..pitch * (number + 1)]
}
