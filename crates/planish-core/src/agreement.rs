//! Required agreement of every engine with the f64 reference (docs/method.md, section 9), with the reason for each
//! tolerance.

use std::ops::Range;

use crate::frame::{Frame, FrameGeometry, GeometryScratch, IntoFrame, RangeRule};
use crate::params::{EngineParams, Params, Radius};
use crate::smoothed::Smoothed;

/// Minimum share of pixels with equal status. The other pixels are within rounding of a threshold: the gate, the
/// degenerate ratio, a displacement of exactly the radius.
pub const EQUAL_STATUS: f64 = 0.9999;

/// Tolerance for 99.9 % of positions in metres: f32 rounding of coordinates up to 5 m (half an ulp is 2.4e-7 m) and of
/// the sums over a window. Rounding is relative, so both errors grow with ranges above [`RANGE_M`] and radii above
/// [`RADIUS_M`].
pub const POSITION_999_M: f64 = 1e-5;

/// Maximum range in metres at which the tolerances apply without scaling.
pub const RANGE_M: f64 = 5.0;

/// Maximum radius of a neighbourhood in metres at which the tolerances apply without scaling.
pub const RADIUS_M: f64 = 0.25;

/// Tolerance for 99.99 % of positions in metres.
pub const POSITION_9999_M: f64 = 1e-4;

/// Tolerance for all positions in metres. It is larger because the normal of a neighbourhood of few points is badly
/// determined if they deviate from a plane almost equally in two directions.
pub const POSITION_WORST_M: f64 = 6e-4;

/// Factor for all position tolerances if edges are kept and windows have nine samples. So few samples hardly
/// determine the surfaces that pixels share.
pub const NINE_SAMPLES: f64 = 10.0;

/// Differences between results and the reference, collected over one or more frames.
#[derive(Debug, Clone, Default)]
pub struct Agreement {
    nine_samples: bool,
    pixels: usize,
    equal: usize,
    distances_m: Vec<f64>,
}

impl Agreement {
    /// Starts a comparison with the tolerances for these parameters. [`Agreement::default`] has the tolerances
    /// without [`NINE_SAMPLES`].
    pub fn with_params(params: impl Into<Params>) -> Self {
        let params: EngineParams = match params.into() {
            Params::Frame(params) => params.into(),
            Params::Cloud(params) => params.into(),
        };
        Self { nine_samples: params.window == 1 && params.cell_px() > 1, ..Self::default() }
    }

    /// Adds the result for a frame. If a result lacks points or status, all pixels count as disagreeing. The tolerances
    /// hold up to [`RANGE_M`] and [`RADIUS_M`], so distances at larger ranges or radii are scaled down.
    pub fn add(&mut self, result: &Smoothed, reference: &Smoothed, radius_m: impl Fn(usize) -> f64) {
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
                self.distances_m.push(distance_m(result.points.get(i), reference.points.get(i), radius_m(i)));
            }
        }
    }

    /// Compares some pixels of a result that contains only points (x, y and z). Status counts as equal if both
    /// results have a point or both have a hole. The points that differ most are ignored, up to the number that may
    /// differ in status. `pixels` are indices in the reference; pixels missing in the result count as disagreeing.
    pub fn add_points(
        &mut self,
        [x, y, z]: [&[f32]; 3],
        reference: &Smoothed,
        pixels: Range<usize>,
        radius_m: impl Fn(usize) -> f64,
    ) {
        self.pixels += pixels.len();
        let found = |i: usize| Some([*x.get(i)?, *y.get(i)?, *z.get(i)?]);
        let expected = |i: usize| (i < reference.points.len()).then(|| reference.points.get(i));
        let may_differ = (pixels.len() as f64 * (1.0 - EQUAL_STATUS)) as usize;
        let mut distances_m = Vec::with_capacity(pixels.len());
        for (i, found, expected) in pixels.filter_map(|i| Some((i, found(i)?, expected(i)?))) {
            let is_point = |point: [f32; 3]| point.iter().all(|value| value.is_finite());
            if is_point(found) == is_point(expected) {
                self.equal += 1;
                if is_point(expected) {
                    distances_m.push(distance_m(found, expected, radius_m(i)));
                }
            }
        }
        distances_m.sort_by(f64::total_cmp);
        distances_m.truncate(distances_m.len() - may_differ.min(distances_m.len()));
        self.distances_m.append(&mut distances_m);
    }

    /// Returns the share of pixels with equal status.
    pub fn equal_status(&self) -> f64 {
        self.equal as f64 / self.pixels as f64
    }

    /// Returns the distance in metres within which the given share of the positions with equal status agree.
    pub fn position_m(&mut self, share: f64) -> f64 {
        self.distances_m.sort_by(f64::total_cmp);
        let place = (self.distances_m.len() as f64 * share) as usize;
        self.distances_m.get(place).or(self.distances_m.last()).copied().unwrap_or(0.0)
    }

    /// Returns a message for each violated limit of docs/method.md, section 9. (The limit on the motion of points is
    /// checked elsewhere.)
    pub fn misses(mut self) -> Vec<String> {
        // In a small cloud, one pixel already exceeds the share that may differ.
        let one_pixel = 1.0 / self.pixels as f64;
        let mut misses = Vec::new();
        if self.pixels == 0 {
            misses.push("no frame was compared".to_owned());
        }
        if self.equal_status() < EQUAL_STATUS - one_pixel {
            misses.push(format!("the status agrees for a share of only {} of the points", self.equal_status()));
        }
        let times = if self.nine_samples { NINE_SAMPLES } else { 1.0 };
        for (share, tolerance_m) in [(0.999, POSITION_999_M), (0.9999, POSITION_9999_M), (1.0, POSITION_WORST_M)] {
            let tolerance_m = times * tolerance_m;
            let found_m = self.position_m(share);
            if found_m > tolerance_m {
                misses.push(format!(
                    "{} % of the points agree only to within {found_m:e} m; the tolerance is {tolerance_m:e} m",
                    100.0 * share
                ));
            }
        }
        misses
    }
}

/// Returns the distance between two points in metres, scaled down to a range of [`RANGE_M`] and a radius of
/// [`RADIUS_M`] if theirs are larger; infinity for NaN.
fn distance_m(found: [f32; 3], expected: [f32; 3], radius_m: f64) -> f64 {
    let square: f64 = (0..3).map(|k| (f64::from(found[k]) - f64::from(expected[k])).powi(2)).sum();
    let coordinate_m = expected.map(|value| f64::from(value).abs()).into_iter().fold(0.0, f64::max);
    let scale = 1f64.max(coordinate_m / RANGE_M).max(radius_m / RADIUS_M);
    if square.is_nan() { f64::INFINITY } else { square.sqrt() / scale }
}

/// Returns the stated or assumed position of the sensor, in the frame of the points.
pub fn sensor_position_m<'a>(frame: impl IntoFrame<'a>) -> [f64; 3] {
    let geometry = |frame| FrameGeometry::of(frame, true, &mut GeometryScratch::default());
    frame.into_frame().map_or([0.0; 3], |frame| geometry(frame).sensor_position().to_array())
}

/// Returns the radius of each point of a frame in metres (docs/method.md, sections 3 and 11), in the frame's order.
/// Window sizes are adapted to the resolution of the frame.
pub fn radii_m<'a>(frame: impl IntoFrame<'a>, params: impl Into<Params>) -> Vec<f64> {
    let Ok(frame) = frame.into_frame() else { return Vec::new() };
    let params: EngineParams = match params.into() {
        Params::Frame(params) => params.at_resolution_of(frame).into(),
        Params::Cloud(params) => params.into(),
    };
    let geometry = FrameGeometry::of(frame, true, &mut GeometryScratch::default());
    let (width, height) = frame.shape();
    let range_m = |i: usize| match frame {
        Frame::Depth(depth) => f64::from(depth.depth_m(i % width, i / width)),
        Frame::Points(points) => geometry.range_m(points.point_in_sensor(i, &geometry)),
    };
    let radius_m = |range_m: f64| match params.radius {
        Radius::Fixed { radius_m } => f64::from(radius_m),
        // For unorganized clouds, a radius of 0 leaves the tolerances unscaled.
        Radius::Neighbours { .. } | Radius::SensorAndDensity { .. } => 0.0,
        Radius::Sensor => {
            let spacing_m = match geometry.rule {
                RangeRule::Constant { spacing_m } => spacing_m,
                rule => range_m * rule.pitch_at_1m(),
            };
            let reach = f64::from(params.window * params.stride);
            (2.0 * reach * spacing_m).max(4.0 * params.sensor.step_m(range_m))
        }
    };
    (0..width * height).map(|i| radius_m(range_m(i))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xyz::Xyz;

    #[test]
    fn points_alone_agree_up_to_the_tolerance_and_not_where_one_is_missing() {
        let points: Xyz = (0..100).map(|i| [0.01 * i as f32, 0.0, if i == 7 { f32::NAN } else { 1.0 }]).collect();
        let reference = Smoothed { width: 10, height: 10, points: points.clone(), ..Smoothed::default() };
        let misses = |found: &Xyz, pixels: Range<usize>| {
            let mut agreement = Agreement::default();
            agreement.add_points(found.as_slices(), &reference, pixels, |_| 0.03);
            agreement.misses()
        };
        assert!(misses(&points, 0..100).is_empty());
        let mut off = points.clone();
        off.set(50, [0.5, 4e-5, 1.0]);
        assert!(!misses(&off, 0..100).is_empty() && misses(&off, 0..50).is_empty());
        let mut holed = points.clone();
        holed.set(1, [f32::NAN; 3]);
        holed.set(2, [f32::NAN; 3]);
        assert!(!misses(&holed, 0..100).is_empty());
        let short: Xyz = points.iter().take(60).collect();
        assert!(!misses(&short, 0..100).is_empty() && !misses(&points, 0..0).is_empty());
    }
}
