//! Scores for the steadiness and lag of depth videos under several smoothing methods.

use planish_core::{Camera, OrganizedCloud, SensorModel, Xyz};
use serde::Serialize;

use super::{flat_pixels, tile_planes};
use crate::simulate::Truth;

/// Number of initial frames excluded from errors against the truth, because temporal filters need time to settle.
const SETTLING_FRAMES: u64 = 8;
/// Interval at which flatness is measured, in frames.
const FLATNESS_EVERY: u64 = 10;
/// Minimum length of a still period for it to count, in frames.
const LEAST_STILL: u16 = 10;
/// Minimum share of all frames during which a pixel must be still to be scored.
const LEAST_SHARE_STILL: f64 = 2.0 / 3.0;
/// Maximum change of a still pixel between consecutive frames, in standard deviations of the sensor noise.
const STILL_SIGMAS: f64 = 8.0;
/// Relative depth error above which a pixel counts as showing another surface.
const SAME_SURFACE: f32 = 0.02;
/// Relative depth error above which a pixel counts as an outlier.
const OUTLIER: f32 = 0.05;
/// Upper depth limit of the near range, in metres.
const NEAR_M: f32 = 0.9;
/// Lower depth limit of the far range, in metres.
const FAR_M: f32 = 2.0;
/// Minimum depth change of a moving surface per frame, in metres. The maximum is [`SAME_SURFACE`] times its depth.
const LEAST_MOTION_M: f32 = 0.0002;
/// Minimum depth change of a moving surface per frame if there is no ground truth, in metres; it exceeds the noise.
const LEAST_SEEN_MOTION_M: f32 = 0.004;

/// Scores within one depth range, in millimetres.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
#[non_exhaustive]
pub struct VideoRange {
    /// Number of pixels that were still during at least two thirds of the frames, in periods of 10 frames or longer.
    pub still_pixels: usize,
    /// Median over the still pixels of the root mean square difference between consecutive frames, divided by √2.
    pub jitter_mm: Option<f64>,
    /// 95th percentile of the jitter over the still pixels.
    pub jitter_95_mm: Option<f64>,
    /// Median over the still pixels of the standard deviation of depth within their still periods.
    pub wander_mm: Option<f64>,
    /// 95th percentile of the wander over the still pixels.
    pub wander_95_mm: Option<f64>,
    /// Root mean square depth error on flat surfaces, after the first 8 frames; errors over 5 % are excluded.
    pub rms_mm: Option<f64>,
}

/// Scores of one method of smoothing a video.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct VideoReport {
    /// Name of the method.
    pub name: String,
    /// Scores below 0.9 m.
    pub near: VideoRange,
    /// Scores beyond 2 m.
    pub far: VideoRange,
    /// Share of the measured pixels on the moving object whose smoothed depth is within 2 % of the truth.
    pub found_share: Option<f64>,
    /// Share of the pixels newly covered by the moving object that do not show it yet. Without ground truth: the share
    /// of depth jumps over 2 % and 8 sigmas after which a smoothed pixel is still nearer to its previous depth, or a
    /// hole.
    pub late_share: Option<f64>,
    /// Share of the pixels just uncovered by the moving object that do not show the surface behind it yet.
    pub left_share: Option<f64>,
    /// Mean distance by which moving surfaces lag behind, in millimetres. Without ground truth, it is relative to the
    /// first method, and measured only below 0.9 m.
    pub lag_mm: Option<f64>,
    /// Share of the points whose depth was carried over from earlier frames.
    pub carried_share: f64,
    /// Share of the carried-over points whose depth is off by more than 5 %.
    pub carried_wrong_share: Option<f64>,
    /// Flatness in millimetres: the median over tiles of 8x8 pixels of the RMS distance of their points from a plane,
    /// averaged over every tenth frame. Measured for camera frames only.
    pub flatness_mm: Option<f64>,
}

/// A video frame smoothed by one method.
#[derive(Debug, Clone, Copy)]
pub struct VideoDepth<'a> {
    /// Depth in metres, row by row; NaN or 0 for holes.
    pub depth_m: &'a [f32],
    /// Mask of the pixels whose depth is carried over from earlier frames; empty if there are none.
    pub carried: &'a [bool],
}

/// Scores several methods of smoothing one video on the same pixels.
pub struct VideoEvaluation {
    sensor: SensorModel,
    frames: u64,
    methods: Vec<Method>,
    /// The previous frame, as smoothed by the first method, in metres.
    before_m: Vec<f32>,
    /// The frame before the previous frame, as smoothed by the first method, in metres.
    before_that_m: Vec<f32>,
    truth_before: Option<(Truth, Option<u16>)>,
}

/// A pixel's sums over its current still period, and over all its finished still periods.
#[derive(Clone, Copy, Default)]
struct Pixel {
    /// Number of frames in the current still period.
    frames: u16,
    last_m: f32,
    mean_m: f32,
    squares: f32,
    differences: f32,
    all_squares: f32,
    all_differences: f32,
    all_frames: u16,
    all_times: u16,
    range_m: f32,
}

#[derive(Default)]
struct Share {
    of: u64,
    all: u64,
}

#[derive(Default)]
struct Method {
    name: String,
    pixels: Vec<Pixel>,
    errors: [(f64, u64); 2],
    found: Share,
    late: Share,
    left: Share,
    carried: Share,
    carried_wrong: Share,
    lag_m: (f64, u64),
    flatness_mm: (f64, u64),
}

impl Share {
    fn add(&mut self, is_one: bool) {
        self.all += 1;
        self.of += u64::from(is_one);
    }

    fn value(&self) -> Option<f64> {
        (self.all > 0).then(|| self.of as f64 / self.all as f64)
    }
}

impl VideoEvaluation {
    /// Creates an evaluation of the named smoothing methods. The first must smooth each frame on its own; its result
    /// determines which pixels are still.
    pub fn new(sensor: SensorModel, names: &[&str]) -> Self {
        let methods = names.iter().map(|name| Method { name: (*name).to_owned(), ..Method::default() }).collect();
        let (before_m, before_that_m) = Default::default();
        Self { sensor, frames: 0, methods, before_m, before_that_m, truth_before: None }
    }

    /// Measures the flatness of every tenth frame, on the tiles that are flat in the result of the first method. Call
    /// it before [`add`](Self::add).
    pub fn add_flatness(&mut self, camera: &Camera, depths: &[VideoDepth<'_>]) {
        let Some(alone) = depths.first().filter(|_| self.frames % FLATNESS_EVERY == FLATNESS_EVERY - 1) else { return };
        let points = |depth: &VideoDepth<'_>| camera.deproject_m(depth.depth_m.iter().copied());
        let Ok(cloud) = OrganizedCloud::from_positions(camera.width, camera.height, points(alone)) else { return };
        for (method, depth) in self.methods.iter_mut().zip(depths) {
            let normals: Xyz = std::iter::repeat_n([f32::NAN; 3], depth.depth_m.len()).collect();
            let rms_mm = tile_planes(&cloud, &points(depth), &normals).rms_mm;
            if rms_mm.is_finite() {
                method.flatness_mm.0 += rms_mm;
                method.flatness_mm.1 += 1;
            }
        }
    }

    /// Adds a frame: one depth image per method, all of the same size, and the ground truth with the id of the moving
    /// object, if known.
    pub fn add(&mut self, depths: &[VideoDepth<'_>], truth: Option<(&Truth, Option<u16>)>) {
        let Some(alone) = depths.first() else { return };
        let len = alone.depth_m.len();
        if self.before_m.len() != len {
            (self.before_m, self.before_that_m) = (vec![f32::NAN; len], vec![f32::NAN; len]);
            self.methods.iter_mut().for_each(|method| method.pixels = vec![Pixel::default(); len]);
        }
        let has_moved = |i: usize| match (truth, &self.truth_before) {
            (Some((now, _)), Some((before, _))) => (now.points.z()[i] - before.points.z()[i]).abs() > 1e-5,
            _ => false,
        };
        for i in 0..len {
            let sigma_m = self.sensor.sigma_m(f64::from(alone.depth_m[i])).max(5e-4) as f32;
            let change_m = (alone.depth_m[i] - self.before_m[i]).abs();
            // NaN compares as false, so a NaN hole is never still.
            let is_still = change_m <= STILL_SIGMAS as f32 * sigma_m && !has_moved(i);
            for (method, depth) in self.methods.iter_mut().zip(depths) {
                let pixel = &mut method.pixels[i];
                if !is_still {
                    pixel.finish();
                }
                pixel.take(depth.depth_m[i]);
            }
        }
        match truth {
            Some((truth, object)) => self.against_truth(depths, truth, object),
            None => self.against_first(depths),
        }
        for (method, depth) in self.methods.iter_mut().zip(depths) {
            for (i, depth_m) in depth.depth_m.iter().enumerate().filter(|(_, depth_m)| **depth_m > 0.0) {
                let is_carried = depth.carried.get(i) == Some(&true);
                method.carried.add(is_carried);
                let expected_m = truth.map_or(alone.depth_m[i], |(truth, _)| truth.points.z()[i]);
                if is_carried && expected_m > 0.0 {
                    method.carried_wrong.add((depth_m - expected_m).abs() > OUTLIER * expected_m);
                }
            }
        }
        self.before_that_m.clone_from(&self.before_m);
        self.before_m.copy_from_slice(alone.depth_m);
        self.truth_before = truth.map(|(truth, object)| (truth.clone(), object));
        self.frames += 1;
    }

    fn against_truth(&mut self, depths: &[VideoDepth<'_>], truth: &Truth, object: Option<u16>) {
        let settled = self.frames >= SETTLING_FRAMES;
        let flat = flat_pixels(truth, 3);
        for (i, (&true_m, &id)) in truth.points.z().iter().zip(&truth.objects).enumerate() {
            if !(depths[0].depth_m[i] > 0.0 && true_m > 0.0) {
                continue;
            }
            let (is_object, before) = (object == Some(id), self.truth_before.as_ref());
            let was_object = before.is_some_and(|(before, object)| *object == Some(before.objects[i]));
            let moved_m = before.map_or(0.0, |(before, _)| true_m - before.points.z()[i]);
            for (method, depth) in self.methods.iter_mut().zip(depths) {
                let off_m = depth.depth_m[i] - true_m;
                // Holes count as wrong.
                let is_right = off_m.abs() <= SAME_SURFACE * true_m;
                if is_object {
                    method.found.add(is_right);
                }
                if is_object && !was_object && before.is_some() {
                    method.late.add(!is_right);
                }
                if was_object && !is_object {
                    method.left.add(!is_right);
                }
                let moves = (LEAST_MOTION_M..SAME_SURFACE * true_m).contains(&moved_m.abs());
                if is_object && was_object && is_right && moves && settled && flat[i] {
                    method.lag_m.0 -= f64::from(off_m * moved_m.signum());
                    method.lag_m.1 += 1;
                }
                if settled
                    && flat[i]
                    && off_m.abs() <= OUTLIER * true_m
                    && let Some(range) = range_of(true_m)
                {
                    method.errors[range].0 += f64::from(off_m).powi(2);
                    method.errors[range].1 += 1;
                }
            }
        }
    }

    /// Compares with the first method, which shows every change immediately.
    fn against_first(&mut self, depths: &[VideoDepth<'_>]) {
        for (i, &now_m) in depths[0].depth_m.iter().enumerate() {
            let (change_m, before_m) = (now_m - self.before_m[i], self.before_m[i] - self.before_that_m[i]);
            let sigma_m = self.sensor.sigma_m(f64::from(now_m)) as f32;
            let is_jump = change_m.abs() > (SAME_SURFACE * now_m).max(STILL_SIGMAS as f32 * sigma_m);
            // Farther away, noise looks like motion.
            let most_m = if now_m < NEAR_M { OUTLIER * now_m } else { 0.0 };
            let is_motion = |change_m: f32| (LEAST_SEEN_MOTION_M..most_m).contains(&change_m.abs());
            let moves = is_motion(change_m) && is_motion(before_m) && change_m.signum() == before_m.signum();
            for (method, depth) in self.methods.iter_mut().zip(depths) {
                let off_m = depth.depth_m[i] - now_m;
                if is_jump {
                    // Holes count as late.
                    let is_there = off_m.abs() <= 0.5 * change_m.abs();
                    method.late.add(!is_there);
                }
                if moves && off_m.is_finite() {
                    method.lag_m.0 -= f64::from(off_m * change_m.signum());
                    method.lag_m.1 += 1;
                }
            }
        }
    }

    /// Returns a report for each method.
    pub fn reports(mut self) -> Vec<VideoReport> {
        for method in &mut self.methods {
            method.pixels.iter_mut().for_each(Pixel::finish);
        }
        self.methods.iter().map(|method| method.report(self.frames)).collect()
    }
}

impl Pixel {
    /// Adds the depth of a frame; a hole ends the still period.
    fn take(&mut self, depth_m: f32) {
        if depth_m.is_nan() || depth_m <= 0.0 {
            self.finish();
            return;
        }
        if self.frames == 0 {
            (self.mean_m, self.squares, self.differences) = (depth_m, 0.0, 0.0);
        } else {
            self.differences += (depth_m - self.last_m).powi(2);
            let off_m = depth_m - self.mean_m;
            self.mean_m += off_m / (f32::from(self.frames) + 1.0);
            self.squares += off_m * (depth_m - self.mean_m);
        }
        self.frames = self.frames.saturating_add(1);
        self.last_m = depth_m;
    }

    /// Ends the current still period, which counts if it was long enough.
    fn finish(&mut self) {
        if self.frames >= LEAST_STILL {
            self.all_squares += self.squares;
            self.all_differences += self.differences;
            self.all_frames = self.all_frames.saturating_add(self.frames);
            self.all_times += 1;
            self.range_m = self.mean_m;
        }
        self.frames = 0;
    }
}

impl Method {
    fn report(&self, frames: u64) -> VideoReport {
        VideoReport {
            name: self.name.clone(),
            near: self.range(0, frames),
            far: self.range(1, frames),
            found_share: self.found.value(),
            late_share: self.late.value(),
            left_share: self.left.value(),
            lag_mm: mean(self.lag_m).map(|lag_m| 1e3 * lag_m),
            carried_share: self.carried.value().unwrap_or(0.0),
            carried_wrong_share: self.carried_wrong.value(),
            flatness_mm: mean(self.flatness_mm),
        }
    }

    fn range(&self, range: usize, frames: u64) -> VideoRange {
        let least = (LEAST_SHARE_STILL * frames as f64).max(1.0);
        let is_in = |pixel: &&Pixel| f64::from(pixel.all_frames) >= least && range_of(pixel.range_m) == Some(range);
        let (mut jitter_mm, mut wander_mm) = (Vec::new(), Vec::new());
        for pixel in self.pixels.iter().filter(is_in) {
            let steps = f64::from(pixel.all_frames - pixel.all_times);
            jitter_mm.push(1e3 * (f64::from(pixel.all_differences) / (2.0 * steps)).sqrt());
            wander_mm.push(1e3 * (f64::from(pixel.all_squares) / steps).sqrt());
        }
        let quantile = |values: &mut [f64], share: f64| {
            let at = (share * (values.len().max(1) - 1) as f64).round() as usize;
            (at < values.len()).then(|| *values.select_nth_unstable_by(at, f64::total_cmp).1)
        };
        VideoRange {
            still_pixels: jitter_mm.len(),
            jitter_mm: quantile(&mut jitter_mm, 0.5),
            jitter_95_mm: quantile(&mut jitter_mm, 0.95),
            wander_mm: quantile(&mut wander_mm, 0.5),
            wander_95_mm: quantile(&mut wander_mm, 0.95),
            rms_mm: mean(self.errors[range]).map(|square| 1e3 * square.sqrt()),
        }
    }
}

/// Returns 0 for the near range, 1 for the far range, and `None` between them.
fn range_of(depth_m: f32) -> Option<usize> {
    match depth_m {
        _ if depth_m < NEAR_M => Some(0),
        _ if depth_m > FAR_M => Some(1),
        _ => None,
    }
}

fn mean((sum, count): (f64, u64)) -> Option<f64> {
    (count > 0).then(|| sum / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::{Pose, Random, Scene, Shape};

    fn depth(depth_m: &[f32]) -> VideoDepth<'_> {
        VideoDepth { depth_m, carried: &[] }
    }

    #[test]
    fn jitter_and_wander_are_those_of_known_noise_and_jumps_do_not_count() {
        let mut evaluation = VideoEvaluation::new(SensorModel::KINECT_V1, &["alone", "mean"]);
        let mut random = Random::new(1, 0);
        let mut mean_m = vec![0.7; 4096];
        for frame in 0..60 {
            // Half of the pixels jump in the middle of the video.
            let centre_m = |i: usize| if frame >= 30 && i.is_multiple_of(2) { 0.8 } else { 0.7 };
            let now: Vec<f32> = (0..4096).map(|i| centre_m(i) + 0.0005 * random.normal() as f32).collect();
            for (i, mean_m) in mean_m.iter_mut().enumerate() {
                *mean_m = if frame == 30 { centre_m(i) } else { *mean_m + 0.25 * (now[i] - *mean_m) };
            }
            evaluation.add(&[depth(&now), depth(&mean_m)], None);
        }
        let reports = evaluation.reports();
        let (alone, mean) = (reports[0].near, reports[1].near);
        assert_eq!((alone.still_pixels, reports[0].far.still_pixels), (4096, 0));
        assert!((alone.jitter_mm.unwrap() / 0.5 - 1.0).abs() < 0.03, "{alone:?}");
        assert!((alone.wander_mm.unwrap() / 0.5 - 1.0).abs() < 0.03, "{alone:?}");
        assert!(alone.jitter_95_mm.unwrap() > 1.1 * alone.jitter_mm.unwrap());
        // An exponential mean with weight 1/4 leaves 0.25/sqrt(1.75) of the jitter and sqrt(1/7) of the noise.
        assert!((mean.jitter_mm.unwrap() / 0.5 / 0.189 - 1.0).abs() < 0.05, "{mean:?}");
        assert!((mean.wander_mm.unwrap() / 0.5 / 0.378 - 1.0).abs() < 0.2, "{mean:?}");
        assert_eq!(reports[1].late_share, Some(0.0));
    }

    #[test]
    fn what_comes_late_trails_and_lags_is_counted() {
        let camera = Camera::new((64, 48), [60.0; 2], [31.5, 23.5]);
        let truth = |x_m: f64, z_m: f64| {
            let wall = Shape::Plane { point_m: [0.0, 0.0, 2.0], normal: [0.0, 0.0, 1.0] };
            let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
            let near = Shape::Cuboid { centre_m: [x_m, 0.0, z_m], half_extent_m: [0.2, 0.2, 0.01], axes };
            let scene = Scene { objects: vec![wall, near] };
            scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0))
        };
        let mut evaluation = VideoEvaluation::new(SensorModel::KINECT_V1, &["alone", "a frame behind"]);
        let mut before: Option<Truth> = None;
        for frame in 0..20 {
            let now = truth(0.03 * f64::from(frame) - 0.3, 0.8 - 0.004 * f64::from(frame));
            let behind = before.as_ref().unwrap_or(&now);
            let carried = vec![true; 64 * 48];
            let late = VideoDepth { depth_m: behind.points.z(), carried: &carried };
            evaluation.add(&[depth(now.points.z()), late], Some((&now, Some(1))));
            before = Some(now);
        }
        let reports = evaluation.reports();
        let (alone, behind) = (&reports[0], &reports[1]);
        assert_eq!((alone.found_share, alone.late_share, alone.left_share), (Some(1.0), Some(0.0), Some(0.0)));
        assert_eq!((behind.late_share, behind.left_share), (Some(1.0), Some(1.0)));
        assert!(behind.found_share.unwrap() < 0.95);
        assert!(alone.lag_mm.unwrap().abs() < 1e-3 && (behind.lag_mm.unwrap() - 4.0).abs() < 0.1, "{behind:?}");
        assert!(alone.near.rms_mm.unwrap() < 1e-3 && behind.near.rms_mm.unwrap() > 3.0);
        assert_eq!((alone.carried_share, behind.carried_share), (0.0, 1.0));
        assert!(behind.carried_wrong_share.unwrap() > 0.0);
    }
}
