//! The flicker of depth from frame to frame, before and after smoothing over time.

use planish_core::{Outputs, Smoothed, Status};

use crate::source::OwnedFrame;

/// Approximate number of pixels compared per frame.
const SAMPLES: usize = 10_000;
/// Number of averaged frames below which a point counts as restarted.
const FEW_FRAMES: f32 = 1.5;
/// Fraction of points without earlier frames above which a frame counts as the first of a new scene or video.
const ALL: f64 = 0.99;
/// Fraction of the depth changes that is averaged, beginning with the smallest; the largest belong to moving edges.
/// Unlike a median, this mean is not 0 for depth in coarse steps.
const COUNTED: f64 = 0.95;
/// Mean magnitude of the 95 % of standard normal values that are closest to 0.
const MEAN_OF_COUNTED: f64 = 0.7168;

/// Difference between a frame of a video and the previous frame.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Flicker {
    /// Jitter of the input in metres: standard deviation of the depth change per pixel divided by √2, estimated from
    /// the smallest 95 % of the changes. It includes the motion of a moving camera.
    pub measured_m: f64,
    /// Jitter after smoothing, in metres.
    pub smoothed_m: f64,
    /// Fraction of the points averaged over fewer than 1.5 frames: new surfaces, or most points if the camera moves.
    pub restarted: f64,
    /// Fraction of the points that were carried over from the previous frame.
    pub carried: f64,
}

/// Fraction of restarted points above which the camera probably moves. Moving objects cover less.
const MOVING: f64 = 0.2;

impl Flicker {
    /// Returns true if so many points restart that the camera probably moves. With tracking, this means that tracking
    /// fails.
    pub fn looks_like_a_moving_camera(&self) -> bool {
        self.restarted > MOVING
    }

    /// Returns the mean over `count` frames, whose mean is `self`, and one more frame.
    pub(super) fn mean_with(self, count: f64, one_more: Self) -> Self {
        let mean = |before: f64, now: f64| before + (now - before) / (count + 1.0);
        Self {
            measured_m: mean(self.measured_m, one_more.measured_m),
            smoothed_m: mean(self.smoothed_m, one_more.smoothed_m),
            restarted: mean(self.restarted, one_more.restarted),
            carried: mean(self.carried, one_more.carried),
        }
    }
}

/// A meter that compares successive frames of a video on a sample of their pixels.
#[derive(Debug, Default)]
pub(super) struct FlickerMeter {
    shape: (usize, usize),
    measured_m: Vec<f32>,
    smoothed_m: Vec<f32>,
    changes_m: Vec<f32>,
}

impl FlickerMeter {
    /// Returns `outputs` with the additional outputs that the meter needs.
    pub(super) fn outputs(outputs: Outputs) -> Outputs {
        outputs.with_status(true).with_frames(true)
    }

    /// Compares a frame with the previous one; `None` if the previous one had another shape or showed another scene,
    /// or if too few points are in both.
    pub(super) fn add(&mut self, frame: &OwnedFrame, smoothed: &Smoothed) -> Option<Flicker> {
        let shape @ (width, height) = (smoothed.width, smoothed.height);
        let step = ((width * height / SAMPLES) as f64).sqrt().ceil().max(1.0) as usize;
        let sampled = || (0..height).step_by(step).flat_map(|v| (0..width).step_by(step).map(move |u| v * width + u));
        let measured_m = |i: usize| match frame {
            OwnedFrame::Depth(depth) => depth.camera.depth_m(depth.raw[i]),
            OwnedFrame::Cloud { cloud, .. } => cloud.positions().z()[i],
        };
        let result_m = |i: usize| match (&smoothed.depth_m, &smoothed.depth, frame) {
            _ if !smoothed.points.is_empty() => smoothed.points.z()[i],
            (Some(depth_m), ..) => depth_m[i],
            (None, Some(raw), OwnedFrame::Depth(depth)) => depth.camera.depth_m(raw[i]),
            _ => f32::NAN,
        };
        // Filled values were not measured, and jump like the rims of their holes.
        let is_filled = |i: usize| smoothed.status.as_ref().is_some_and(|status| status[i] == Status::Filled);
        let result_m = |i: usize| if is_filled(i) { f32::NAN } else { result_m(i) };
        let is_next = self.shape == shape;
        let measured = self.jitter_m(is_next, sampled().map(measured_m), |meter| &mut meter.measured_m);
        let result = self.jitter_m(is_next, sampled().map(result_m), |meter| &mut meter.smoothed_m);
        self.shape = shape;
        let (status, frames) = (smoothed.status.as_ref()?, smoothed.frames.as_ref()?);
        let (mut points, mut fresh, mut restarted, mut carried) = (0.0f64, 0.0, 0.0, 0.0);
        for i in sampled().filter(|&i| status[i].has_point()) {
            points += 1.0;
            fresh += f64::from(u8::from(frames[i] <= 1.0));
            restarted += f64::from(u8::from(frames[i] < FEW_FRAMES));
            carried += f64::from(u8::from(status[i] == Status::Carried));
        }
        let share = |count: f64| count / points.max(1.0);
        let (restarted, carried) = (share(restarted), share(carried));
        // Frames are not compared across a gap or a cut.
        if share(fresh) > ALL {
            return None;
        }
        Some(Flicker { measured_m: measured?, smoothed_m: result?, restarted, carried })
    }

    /// Returns the jitter in metres from the previous depths to `depths_m`, which replace the previous ones.
    fn jitter_m(
        &mut self,
        is_next: bool,
        depths_m: impl Iterator<Item = f32>,
        kept: impl Fn(&mut Self) -> &mut Vec<f32>,
    ) -> Option<f64> {
        let mut changes_m = std::mem::take(&mut self.changes_m);
        changes_m.clear();
        let kept = kept(self);
        if is_next {
            for (before_m, now_m) in kept.iter_mut().zip(depths_m) {
                let change_m = (now_m - std::mem::replace(before_m, now_m)).abs();
                changes_m.extend(Some(change_m).filter(|change_m| change_m.is_finite()));
            }
        } else {
            kept.clear();
            kept.extend(depths_m);
        }
        let counted = (COUNTED * changes_m.len() as f64) as usize;
        let mean_m = (counted > 0).then(|| {
            let (smaller, ..) = changes_m.select_nth_unstable_by(counted, f32::total_cmp);
            smaller.iter().map(|&change_m| f64::from(change_m)).sum::<f64>() / counted as f64
        });
        self.changes_m = changes_m;
        mean_m.map(|mean_m| mean_m / MEAN_OF_COUNTED / std::f64::consts::SQRT_2)
    }
}
