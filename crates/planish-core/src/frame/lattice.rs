//! Reconstruction of the pixel grid that a frame lost when it was saved as an unorganized cloud (docs/method.md,
//! section 11).

use std::ops::Range;

use glam::{DQuat, DVec3};

use super::PointsView;
use crate::pose::{RigidTransform, SensorPose};
use crate::xyz::Xyz;

/// Number of points in the sample that is tested before all points.
const SAMPLE: usize = 4096;
/// Fractional part of the golden ratio, whose multiples modulo 1 are spread evenly over the unit interval.
const GOLDEN: f64 = 0.618_033_988_749_894_9;
/// Minimum number of columns and of rows in a lattice.
const LEAST_LINES: usize = 16;
/// Maximum number of columns and of rows in a lattice.
const MOST_LINES: usize = 8192;
/// Minimum ratio of the gaps between lines to the gaps within a line.
const LEAST_CONTRAST: f64 = 8.0;
/// Maximum RMS distance of values from their lines, in line spacings.
const CLOSE: f64 = 0.05;
/// Maximum distance in line spacings of a value from its line, and maximum deviation of the distance between lines
/// from a multiple of the spacing.
const NEAR: f64 = 0.3;
/// Minimum share of the pixels that have a point.
const LEAST_FILLED: f64 = 0.1;
/// Minimum mean share of the pixels around a point that have a point. With fewer, windows have too few samples.
const LEAST_FILLED_AROUND: f64 = 0.6;
/// Distance in rows and in columns up to which a pixel counts as being around a point.
const AROUND: usize = 2;
/// Minimum median depth of a frame in metres; for a smaller value, the unit of the cloud is probably not the metre.
const NEAREST_M: f64 = 0.1;
/// Maximum median depth of a frame in metres; for a larger value, the unit of the cloud is probably not the metre.
const FARTHEST_M: f64 = 20.0;

/// A reconstructed grid: the points of a cloud on the pixels of a frame.
#[derive(Debug, PartialEq)]
pub(crate) struct Lattice {
    width: usize,
    height: usize,
    /// The pixel of each point; `None` for holes.
    pixels: Vec<Option<u32>>,
    /// The points, relative to the cloud's origin; NaN for pixels without a point.
    positions: Xyz,
    pose: SensorPose,
    /// The camera's pose relative to the cloud's origin.
    transform: RigidTransform,
    /// Median depth of the sampled points, in the unit of the cloud.
    middle_m: f64,
}

/// Evenly spaced lines: line k is at `first + k * spacing`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lines {
    first: f64,
    spacing: f64,
    count: usize,
}

impl Lattice {
    /// Finds a pixel grid for an unorganized cloud such that every point is on the ray of a different pixel. The
    /// camera has no distortion and looks along z or, as in OpenGL, along -z. `None` if the cloud has no such grid.
    pub(crate) fn of(points: &PointsView<'_>) -> Option<Self> {
        let transform = points.transform();
        let seen = |i: usize| Some(transform.to_sensor(points.point(i))).filter(|p| p.is_finite());
        // Unlike a constant step, multiples of the golden ratio do not align with rows.
        let sampled = |k: usize| ((k as f64 * GOLDEN).fract() * points.len() as f64) as usize;
        let sample: Vec<DVec3> = (0..SAMPLE.min(points.len())).map(sampled).filter_map(seen).collect();
        let is_in_front = sample.iter().all(|p| p.z > 0.0);
        let is_behind = sample.iter().all(|p| p.z < 0.0) && points.pose().is_identity();
        if sample.len() < LEAST_LINES * LEAST_LINES || !(is_in_front || is_behind) {
            return None;
        }
        // Half a turn around x: y points down again, and z forward.
        let turn = if is_behind { DVec3::new(1.0, -1.0, -1.0) } else { DVec3::ONE };
        let slope = |p: DVec3, axis: usize| (turn * p)[axis] / (turn * p).z;
        for axis in 0..2 {
            Lines::of(sample.iter().map(|&p| slope(p, axis)).collect())?;
        }
        let mut depths: Vec<f64> = sample.iter().map(|p| p.z.abs()).collect();
        let middle = depths.len() / 2;
        let (_, &mut middle_m, _) = depths.select_nth_unstable_by(middle, f64::total_cmp);
        let all: Vec<DVec3> = (0..points.len()).filter_map(seen).collect();
        if all.iter().any(|p| turn.z * p.z <= 0.0) {
            return None;
        }
        let [columns, rows] = [0, 1].map(|axis| Lines::of(all.iter().map(|&p| slope(p, axis)).collect()));
        let (columns, rows) = (columns?, rows?);
        let (width, height) = (columns.count, rows.count);
        if (all.len() as f64) < LEAST_FILLED * (width * height) as f64 {
            return None;
        }
        drop(all);
        let pixel = |p: DVec3| {
            let (u, v) = (columns.nearest(slope(p, 0))?, rows.nearest(slope(p, 1))?);
            Some((v * width + u) as u32)
        };
        let mut positions = Xyz::filled(width * height, f32::NAN);
        let mut pixels = vec![None; points.len()];
        for (i, place) in pixels.iter_mut().enumerate() {
            let Some(p) = seen(i) else { continue };
            let at = pixel(p)?;
            // Two points on one ray do not come from a single frame.
            if positions.is_finite(at as usize) {
                return None;
            }
            positions.set(at as usize, points.point(i).to_array().map(|value| value as f32));
            *place = Some(at);
        }
        let around = (0..SAMPLE.min(points.len())).map(sampled).filter_map(|i| pixels[i]);
        let (mut filled, mut count) = (0, 0);
        for pixel in around {
            let (u, v) = (pixel as usize % width, pixel as usize / width);
            let (us, vs) = (near(u, width), near(v, height));
            count += us.len() * vs.len();
            filled +=
                vs.flat_map(|v| us.clone().map(move |u| v * width + u)).filter(|&at| positions.is_finite(at)).count();
        }
        if (filled as f64) < LEAST_FILLED_AROUND * count as f64 {
            return None;
        }
        let pose = if is_behind { half_turn() } else { points.pose() };
        Some(Self { width, height, pixels, positions, pose, transform, middle_m })
    }

    /// Returns the width and height of the grid.
    pub(crate) fn shape(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Returns the pixel of a point; `None` for a hole.
    pub(crate) fn pixel(&self, i: usize) -> Option<usize> {
        self.pixels[i].map(|pixel| pixel as usize)
    }

    /// Returns true if the grid was found for these points.
    pub(crate) fn is_of(&self, points: &PointsView<'_>) -> bool {
        let is_same = |i: usize| match self.pixel(i) {
            Some(pixel) => self.positions.get(pixel) == points.point(i).to_array().map(|value| value as f32),
            None => !points.point(i).is_finite(),
        };
        let is_same_camera = self.transform == points.transform();
        is_same_camera && self.pixels.len() == points.len() && (0..points.len()).all(is_same)
    }

    /// Returns true if the median depth is plausible for a frame whose unit is the metre.
    pub(crate) fn may_be_in_metres(&self) -> bool {
        (NEAREST_M..=FARTHEST_M).contains(&self.middle_m)
    }

    /// Returns a view of the points on the grid.
    pub(crate) fn view<'a>(&'a self, of: &PointsView<'_>) -> PointsView<'a> {
        of.regridded(&self.positions, self.shape(), self.pose)
    }
}

/// Returns the numbers of the lines that are at most [`AROUND`] away from `line`.
fn near(line: usize, lines: usize) -> Range<usize> {
    line.saturating_sub(AROUND)..(line + AROUND + 1).min(lines)
}

/// Returns the pose of a sensor that looks along -z, with y up.
fn half_turn() -> SensorPose {
    let orientation = DQuat::from_rotation_x(std::f64::consts::PI);
    SensorPose::from_viewpoint([0.0, 0.0, 0.0, orientation.w, orientation.x, orientation.y, orientation.z])
}

impl Lines {
    /// Finds evenly spaced lines near which all values lie; `None` if there are no such lines.
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_unstable_by(f64::total_cmp);
        let gaps: Vec<f64> = values.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let widest = between_lines(gaps.clone())?;
        // The mean of each line's values.
        let mut lines = Vec::new();
        let mut from = 0;
        for to in (1..=values.len()).filter(|&to| to == values.len() || gaps[to - 1] > widest) {
            lines.push(values[from..to].iter().sum::<f64>() / (to - from) as f64);
            from = to;
        }
        let mut apart: Vec<f64> = lines.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let unit = spacing_of(&apart);
        // The numbering also counts lines without a point.
        let mut numbers = vec![0.0];
        for apart in &mut apart {
            let steps = (*apart / unit).round();
            if steps < 1.0 || (*apart / unit - steps).abs() > NEAR {
                return None;
            }
            numbers.push(numbers[numbers.len() - 1] + steps);
        }
        let lines = Self::through(&numbers, &lines)?;
        let off = |value: &f64| (value - lines.first) / lines.spacing;
        let from_line: Vec<f64> = values.iter().map(off).map(|at| at - at.round()).collect();
        let square = from_line.iter().map(|off| off * off).sum::<f64>() / from_line.len() as f64;
        (square.sqrt() <= CLOSE && from_line.iter().all(|off| off.abs() <= NEAR)).then_some(lines)
    }

    /// Fits evenly spaced lines to `places` by least squares. `numbers` are the numbers of the lines; the first is 0.
    fn through(numbers: &[f64], places: &[f64]) -> Option<Self> {
        let last = numbers.last().copied().filter(|&last| last < MOST_LINES as f64)?;
        let n = numbers.len() as f64;
        let mean = |values: &[f64]| values.iter().sum::<f64>() / n;
        let (mean_number, mean_place) = (mean(numbers), mean(places));
        let (mut product, mut square) = (0.0, 0.0);
        for (number, place) in numbers.iter().zip(places) {
            product += (number - mean_number) * (place - mean_place);
            square += (number - mean_number).powi(2);
        }
        let spacing = product / square;
        let count = last as usize + 1;
        let is_even = spacing > 0.0 && (LEAST_LINES..=MOST_LINES).contains(&count);
        is_even.then_some(Self { first: mean_place - mean_number * spacing, spacing, count })
    }

    /// Returns the number of the line nearest to a value; `None` if the value is outside the lines.
    fn nearest(&self, value: f64) -> Option<usize> {
        let number = ((value - self.first) / self.spacing).round();
        (number >= 0.0 && number < self.count as f64).then_some(number as usize)
    }
}

/// Returns the threshold between the gaps from line to line and the narrower gaps within lines: the first sudden drop
/// when the gaps are sorted in descending order.
fn between_lines(mut gaps: Vec<f64>) -> Option<f64> {
    gaps.sort_unstable_by(|a, b| f64::total_cmp(b, a));
    let most = gaps.len().min(MOST_LINES);
    let next = |k: usize| gaps.get(k).copied().unwrap_or(0.0);
    let between = (LEAST_LINES - 1..=most).find(|&k| gaps[k - 1] > LEAST_CONTRAST * next(k))?;
    Some(gaps[between - 1] / LEAST_CONTRAST.sqrt())
}

/// Returns the spacing of lines, some of which may be missing: the mean of the gaps that are 0.5 to 1.5 times as wide
/// as the 10 % quantile.
fn spacing_of(apart: &[f64]) -> f64 {
    let mut sorted = apart.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let narrow = sorted.get(sorted.len() / 10).copied().unwrap_or(f64::NAN);
    let narrow: Vec<f64> = sorted.into_iter().filter(|apart| (0.5..1.5).contains(&(apart / narrow))).collect();
    narrow.iter().sum::<f64>() / narrow.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neighbours::tests::Random;

    /// Returns the points of a wavy surface as a camera sees them: with holes, in random order, rounded to `digits`
    /// decimals.
    fn seen(width: usize, height: usize, holes: f32, digits: i32) -> Vec<[f32; 3]> {
        let mut random = Random(7);
        let mut points = Vec::new();
        for v in 0..height {
            for u in 0..width {
                if random.next() < holes {
                    continue;
                }
                let (a, b) = ((u as f64 - 47.3) / 60.0, (v as f64 - 20.9) / 61.0);
                let z = 1.2 + 0.2 * (5.0 * a).sin() * (4.0 * b).cos() + 0.01 * f64::from(random.next());
                let scale = 10f64.powi(digits);
                points.push([a * z, b * z, z].map(|value| ((value * scale).round() / scale) as f32));
            }
        }
        for i in (1..points.len()).rev() {
            points.swap(i, (random.next() * i as f32) as usize);
        }
        points
    }

    #[test]
    fn a_frame_without_its_holes_finds_its_pixels_again() {
        for (holes, digits) in [(0.1, 9), (0.25, 9), (0.2, 5)] {
            let points = seen(97, 41, holes, digits);
            let view = PointsView::from_rows(&points).unwrap();
            let lattice = Lattice::of(&view).unwrap();
            assert_eq!(lattice.shape(), (97, 41), "{holes} {digits}");
            for (i, &point) in points.iter().enumerate() {
                let pixel = lattice.pixel(i).unwrap();
                assert_eq!(lattice.positions.get(pixel), point);
                let (u, v) =
                    (f64::from(point[0] / point[2]) * 60.0 + 47.3, f64::from(point[1] / point[2]) * 61.0 + 20.9);
                assert_eq!(((pixel % 97) as f64, (pixel / 97) as f64), (u.round(), v.round()));
            }
            let on_pixels = (0..97 * 41).filter(|&pixel| lattice.positions.is_finite(pixel)).count();
            assert_eq!(on_pixels, points.len());
        }
    }

    #[test]
    fn a_camera_that_looks_against_z_is_turned_round() {
        let points: Vec<_> = seen(64, 48, 0.2, 9).into_iter().map(|[x, y, z]| [x, -y, -z]).collect();
        let view = PointsView::from_rows(&points).unwrap();
        let lattice = Lattice::of(&view).unwrap();
        assert_eq!(lattice.shape(), (64, 48));
        let on_grid = lattice.view(&view);
        let transform = on_grid.transform();
        assert!((0..on_grid.len()).map(|i| transform.to_sensor(on_grid.point(i))).all(|p| p.z.is_nan() || p.z > 0.9));
    }

    #[test]
    fn clouds_of_no_single_frame_have_no_grid() {
        let frame = seen(64, 48, 0.1, 9);
        let none = |points: &[[f32; 3]]| Lattice::of(&PointsView::from_rows(points).unwrap()).is_none();
        assert!(!none(&frame));
        // Two frames in one cloud, one point twice, one behind the camera, and points that have moved.
        let nearer = frame.iter().map(|p| p.map(|value| 0.9 * value));
        assert!(none(&frame.iter().copied().chain(nearer).collect::<Vec<_>>()));
        assert!(none(&frame.iter().copied().chain([frame[5]]).collect::<Vec<_>>()));
        assert!(none(&frame.iter().copied().chain([[0.0, 0.0, -1.0]]).collect::<Vec<_>>()));
        let mut random = Random(3);
        let mut moved = |by: f32| {
            let mut shift = |value: f32| value + by * (random.next() - 0.5);
            frame.iter().map(|p| p.map(&mut shift)).collect::<Vec<_>>()
        };
        let (little, far) = (moved(1e-4), moved(0.02));
        assert!(!none(&little) && none(&far));
        // Points that are evenly spaced when seen from above do not come from a camera.
        let field =
            |i: usize| [(i % 80) as f32, (i / 80) as f32, 30.0 + (i as f32 * 0.37).sin()].map(|value| 0.1 * value);
        assert!(none(&(0..6400).map(field).collect::<Vec<_>>()));
        assert!(none(&[]) && none(&frame[..100]));
        // Too few pixels have a point: a tenth at random, or a frame that fills only one corner of a large image.
        assert!(none(&seen(64, 48, 0.9, 9)));
        let mut corners = frame.clone();
        corners.push([40.0, 40.0, 1.0]);
        assert!(none(&corners));
        let mut far = frame.clone();
        far.push([0.4, 0.0, 1e-20]);
        assert!(none(&far));
        let lattice = |scale: f32| {
            let points: Vec<_> = frame.iter().map(|p| p.map(|value| scale * value)).collect();
            Lattice::of(&PointsView::from_rows(&points).unwrap()).unwrap()
        };
        assert!(lattice(1.0).may_be_in_metres() && !lattice(1000.0).may_be_in_metres());
    }
}
