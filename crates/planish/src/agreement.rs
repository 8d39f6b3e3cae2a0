//! The agreement that every engine owes the f64 reference (docs/method.md, section 9), each figure with its cause.

use crate::cloud::OrganizedCloud;
use crate::params::{Radius, SmoothParams};
use crate::smoothed::Smoothed;

/// Share of pixels whose status must be equal. The others lie within rounding of a threshold: the gate, the degenerate
/// ratio, a point that moves by just the radius.
pub const EQUAL_STATUS: f64 = 0.9999;

/// Most positions: f32 rounding of coordinates up to 5 m (half an ulp is 2.4e-7 m) and of the sums over a window.
/// Rounding is relative: both figures grow with a range over [`RANGE_M`] and a radius over [`RADIUS_M`].
pub const POSITION_999_M: f64 = 5e-6;

/// The range up to which the tolerances hold as they are.
pub const RANGE_M: f64 = 5.0;

/// The radius of a neighbourhood up to which the tolerances hold as they are.
pub const RADIUS_M: f64 = 0.25;

/// Nearly all positions: a neighbour within rounding of the gate, or a pivot within rounding of being dropped.
pub const POSITION_9999_M: f64 = 2e-5;

/// How far results are from the reference's, gathered over one or more frames.
#[derive(Debug, Clone, Default)]
pub struct Agreement {
    pixels: usize,
    equal: usize,
    distances_m: Vec<f64>,
}

impl Agreement {
    /// Adds a frame; both results need points and status, or they agree on no pixel. Distances are scaled to a range of
    /// [`RANGE_M`] and a radius of [`RADIUS_M`] where theirs are larger.
    pub fn add(&mut self, result: &Smoothed, reference: &Smoothed, radius_m: impl Fn(f64) -> f64) {
        let pixels = reference.width * reference.height;
        self.pixels += pixels;
        let (Some(status), Some(expected)) = (&result.status, &reference.status) else { return };
        let lengths = [status.len(), expected.len(), result.points.len(), reference.points.len()];
        if lengths != [pixels; 4] {
            return;
        }
        for i in (0..status.len()).filter(|&i| status[i] == expected[i]) {
            self.equal += 1;
            if expected[i].has_point() {
                let (a, b) = (result.points.get(i), reference.points.get(i));
                let square: f64 = (0..3).map(|k| (f64::from(a[k]) - f64::from(b[k])).powi(2)).sum();
                let z = f64::from(b[2]).abs();
                let scale = 1f64.max(z / RANGE_M).max(radius_m(z) / RADIUS_M);
                // A NaN is infinitely far.
                self.distances_m.push(if square.is_nan() { f64::INFINITY } else { square.sqrt() / scale });
            }
        }
    }

    /// Share of pixels with equal status.
    pub fn equal_status(&self) -> f64 {
        self.equal as f64 / self.pixels as f64
    }

    /// The distance that this share of the positions with equal status keeps, in metres.
    pub fn position_m(&mut self, share: f64) -> f64 {
        self.distances_m.sort_by(f64::total_cmp);
        let place = (self.distances_m.len() as f64 * share) as usize;
        self.distances_m.get(place).or(self.distances_m.last()).copied().unwrap_or(0.0)
    }

    /// What breaks section 9's figures, each in words. (That no point moves by more than the radius is not among them.)
    pub fn misses(mut self) -> Vec<String> {
        // Of a small cloud a single pixel is more than the share that may differ.
        let one_pixel = 1.0 / self.pixels as f64;
        let mut misses = Vec::new();
        if self.pixels == 0 {
            misses.push("no frame was compared".to_owned());
        }
        if self.equal_status() < EQUAL_STATUS - one_pixel {
            misses.push(format!("status equal on {}", self.equal_status()));
        }
        for (share, tolerance_m) in [(0.999, POSITION_999_M), (0.9999, POSITION_9999_M)] {
            let found_m = self.position_m(share);
            if found_m > tolerance_m {
                misses.push(format!("{} % within {found_m:e} m instead of {tolerance_m:e} m", 100.0 * share));
            }
        }
        misses
    }
}

/// r(z) of docs/method.md, section 3, in f64, for the pixels of a cloud.
pub fn radius_m(cloud: &OrganizedCloud, params: SmoothParams) -> impl Fn(f64) -> f64 + use<> {
    let pitch = cloud.pixel_pitch_at_1m().unwrap_or(1.0 / 525.0);
    move |z| match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        Radius::Sensor { depth_step_at_1m } => {
            let reach = f64::from(params.window * params.stride);
            (1.5 * reach * z.abs() * pitch).max(4.0 * f64::from(depth_step_at_1m) * z * z)
        }
    }
}
