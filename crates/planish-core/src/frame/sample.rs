//! Statistics of a sample of a grid's points: whether they are arranged as a camera sees them, their spacing, and their
//! extent.

use glam::{DMat3, DVec3};

use super::PointsView;
use super::range_rule::FrameGeometry;
use crate::pose::RigidTransform;

/// Maximum number of sampled rows.
const SAMPLED_ROWS: usize = 16;
/// Maximum number of sampled columns.
const SAMPLED_COLUMNS: usize = 24;
/// Maximum number of sampled rows in the test for a camera's grid.
const LAW_ROWS: usize = 12;
/// Distance in pixels between the points whose spacing is measured. Points farther apart have a larger spacing, but
/// the same noise.
pub(super) const LAG_PX: usize = 4;
/// Maximum variation of X/z along a column, or of Y/z along a row, relative to its extent over the image. Lenses
/// distort by less, rotated cameras by more.
const RAY_LAW_TOLERANCE: f64 = 0.1;
/// Maximum share of points behind the sensor in a camera's grid.
const MAX_BEHIND: f64 = 0.01;
/// Maximum share of pixel corners that have the opposite orientation in a sensor's grid.
pub(super) const MAX_TURNED: f64 = 0.1;
/// Ratio of two spreads below which the first is clearly smaller.
pub(super) const CLEARLY_LESS: f64 = 0.7;

/// Buffers for the samples of a frame, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct GeometryScratch {
    pub(super) pitches: Vec<f64>,
    tangents: Vec<f64>,
    spreads: Vec<f64>,
    medians: Vec<f64>,
    pub(super) horizontal: Vec<NeighbourPair>,
    pub(super) vertical: Vec<NeighbourPair>,
    pub(super) extent: Vec<DVec3>,
}

/// Two neighbours on the grid.
#[derive(Debug, Clone, Copy)]
pub(super) struct NeighbourPair {
    /// Distance between the points in metres, divided by their distance on the grid in pixels.
    pub(super) spacing_m: f64,
    /// Sine of the angle between the points' directions from the sensor, divided by their distance on the grid in
    /// pixels.
    pub(super) angle: f64,
}

/// A sample of the points of a grid, under an assumed geometry.
#[derive(Clone, Copy)]
pub(super) struct Sample<'a, 'p> {
    pub(super) points: &'a PointsView<'p>,
    pub(super) geometry: FrameGeometry,
    pub(super) width: usize,
    pub(super) height: usize,
}

impl Sample<'_, '_> {
    /// Returns a point in the sensor's frame; `None` for a hole, and for zeros, which some writers use as holes.
    fn point(&self, i: usize) -> Option<DVec3> {
        let point = self.points.point_in_sensor(i, &self.geometry);
        (point.is_finite() && self.points.point(i) != DVec3::ZERO).then_some(point)
    }

    /// Returns true if the camera was more likely at the origin of coordinates (`self`) than at the stated pose
    /// (`stated`). PCL's grabbers state the camera's rotation, and other programs its position, but both write points
    /// in the camera's frame.
    pub(super) fn is_likelier_than(&self, stated: &Self, scratch: &mut GeometryScratch) -> bool {
        if stated.points.pose().position_m == [0.0; 3] {
            return true;
        }
        let GeometryScratch { pitches, horizontal, .. } = scratch;
        let [own, stated] = [self, stated].map(|sample| {
            sample.neighbours(horizontal, [LAG_PX.min(sample.width - 1), 0]);
            spread(horizontal.iter().map(|pair| pair.angle), pitches)
        });
        own < CLEARLY_LESS * stated
    }

    fn rows(&self) -> impl Iterator<Item = usize> + Clone + use<> {
        (0..self.height).step_by(self.height.div_ceil(SAMPLED_ROWS))
    }

    fn law_rows(&self) -> impl Iterator<Item = usize> + Clone + use<> {
        (0..self.height).step_by(self.height.div_ceil(LAW_ROWS))
    }

    /// Returns true if the grid may be a camera's: the points are in front of the sensor, X/z is constant along
    /// columns and Y/z along rows, and columns go to the right if rows go down.
    pub(super) fn is_of_a_camera(&self, scratch: &mut GeometryScratch) -> bool {
        let columns = || (0..self.width).step_by(self.width.div_ceil(SAMPLED_COLUMNS));
        let points = self.law_rows().flat_map(|row| columns().map(move |column| row * self.width + column));
        let (mut behind, mut count) = (0u32, 0u32);
        for p in points.filter_map(|i| self.point(i)) {
            count += 1;
            behind += u32::from(p.z <= 0.0);
        }
        let [right_handed, left_handed] = self.turns();
        let is_rare = |part: u32, of: u32, share: f64| f64::from(part) <= share * f64::from(of);
        is_rare(behind, count, MAX_BEHIND)
            && is_rare(left_handed, left_handed + right_handed, MAX_TURNED)
            && self.is_constant(columns(), |column, row| (column, row), |p| p.x / p.z, self.law_rows(), scratch)
            && self.is_constant(self.law_rows(), |row, column| (column, row), |p| p.y / p.z, columns(), scratch)
    }

    /// Returns the number of pixel corners with a camera's orientation, and with the opposite orientation. The
    /// orientation is the sign of the determinant of three neighbouring rays; it does not depend on surface or noise.
    pub(super) fn turns(&self) -> [u32; 2] {
        let mut turns = [0, 0];
        for row in self.law_rows().filter(|row| row + 1 < self.height) {
            for column in (0..self.width - 1).step_by(self.width.div_ceil(SAMPLED_COLUMNS)) {
                let i = row * self.width + column;
                let neighbours = self.point(i + 1).zip(self.point(i + self.width));
                let Some((p, (right, below))) = self.point(i).zip(neighbours) else { continue };
                let determinant = right.cross(below).dot(p);
                turns[usize::from(determinant < 0.0)] += u32::from(determinant != 0.0);
            }
        }
        turns
    }

    /// Returns true if a tangent is constant along lines of pixels: its median spread within a line is at most
    /// [`RAY_LAW_TOLERANCE`] of its extent over the lines.
    fn is_constant<L: Iterator<Item = usize>, P: Iterator<Item = usize> + Clone>(
        &self,
        lines: L,
        pixel: fn(usize, usize) -> (usize, usize),
        tangent: fn(DVec3) -> f64,
        positions: P,
        scratch: &mut GeometryScratch,
    ) -> bool {
        let GeometryScratch { tangents, spreads, medians, .. } = scratch;
        spreads.clear();
        medians.clear();
        for line in lines {
            tangents.clear();
            tangents.extend(positions.clone().filter_map(|position| {
                let (column, row) = pixel(line, position);
                self.point(row * self.width + column).map(tangent).filter(|tangent| tangent.is_finite())
            }));
            tangents.sort_by(f64::total_cmp);
            // The extremes are ignored, since they may be stray values.
            let cut = if tangents.len() >= 5 { 1 } else { 0 };
            if let [first, .., last] = tangents[cut..tangents.len() - cut] {
                spreads.push(last - first);
                medians.push(tangents[tangents.len() / 2]);
            }
        }
        let (low, high) = (quantile(medians, 0.05), quantile(medians, 0.95));
        let extent = high.zip(low).map_or(0.0, |(high, low)| high - low);
        quantile(spreads, 0.5).is_none_or(|spread| spread <= RAY_LAW_TOLERANCE * extent)
    }

    /// Returns 1/fx of a camera: the median difference of X/Z between a pixel and its right neighbour over the
    /// sampled rows. In a pinhole image, this difference is 1/fx for any surface. `None` without two valid
    /// neighbours.
    pub(super) fn camera_pitch(&self, scratch: &mut GeometryScratch) -> Option<f64> {
        let pitches = &mut scratch.pitches;
        pitches.clear();
        let planes = self.points.plain_planes().filter(|_| self.geometry.cloud_from_sensor.is_none());
        for row in self.rows() {
            let pixels = row * self.width..(row + 1) * self.width;
            match planes {
                Some([x, _, z]) => {
                    let samples = x[pixels.clone()].iter().zip(&z[pixels]);
                    add_pitches(samples.map(|(&x, &z)| f64::from(x) / f64::from(z)), pitches);
                }
                None => {
                    let points = pixels.map(|i| self.points.point_in_sensor(i, &self.geometry));
                    add_pitches(points.map(|p| if p.is_finite() { p.x / p.z } else { f64::NAN }), pitches);
                }
            }
        }
        quantile(pitches, 0.5)
    }

    /// Collects the pairs of points that are `columns` columns and `rows` rows apart, with the first point in a sampled
    /// row.
    pub(super) fn neighbours(&self, pairs: &mut Vec<NeighbourPair>, [columns, rows]: [usize; 2]) {
        pairs.clear();
        let lag = columns + rows;
        if lag == 0 {
            return;
        }
        for row in self.rows().filter(|row| row + rows < self.height) {
            for column in 0..self.width - columns {
                let i = row * self.width + column;
                let Some((p, q)) = self.point(i).zip(self.point(i + columns + rows * self.width)) else { continue };
                let spacing_m = p.distance(q) / lag as f64;
                let angle = p.cross(q).length() / (p.length() * q.length()) / lag as f64;
                if spacing_m > 0.0 && angle > 0.0 && spacing_m.is_finite() && angle.is_finite() {
                    pairs.push(NeighbourPair { spacing_m, angle });
                }
            }
        }
    }
}

/// Appends the difference of tangents between consecutive pixels of a row; NaN marks holes.
fn add_pitches(tangents: impl Iterator<Item = f64>, pitches: &mut Vec<f64>) {
    let mut left = f64::NAN;
    for tangent in tangents {
        let pitch = (tangent - left).abs();
        if pitch.is_finite() && pitch > 0.0 {
            pitches.push(pitch);
        }
        left = tangent;
    }
}

/// Size and orientation of a cloud, without stray points.
pub(super) struct Extent {
    pub(super) centre: DVec3,
    /// Root mean square distance of the points from the centre in metres.
    pub(super) radius_m: f64,
    /// Normal of the plane through the sampled points, pointing upwards (+z).
    normal: DVec3,
}

/// Maximum distance of a point from the middle of the cloud, as a multiple of the median distance. Points farther
/// away are strays, or encode missing data.
const MAX_MEDIAN_DISTANCES: f64 = 5.0;
/// Ratio of the origin's distance from a cloud's plane to its distance from the cloud's centre above which the origin
/// is clearly on one side of the cloud.
const CLEARLY_BESIDE: f64 = 0.2;

impl Extent {
    pub(super) fn of_grid(sample: &Sample<'_, '_>, points: &mut Vec<DVec3>) -> Option<Self> {
        let columns = (0..sample.width).step_by(sample.width.div_ceil(SAMPLED_COLUMNS));
        let pixels = sample.rows().flat_map(|row| columns.clone().map(move |column| row * sample.width + column));
        points.clear();
        points.extend(pixels.filter(|&i| sample.point(i).is_some()).map(|i| sample.points.point(i)));
        Self::of(points)
    }

    /// Removes stray points and computes the extent of the others. The points must be finite. `None` without points,
    /// or for a radius of 0.
    pub(super) fn of(points: &mut Vec<DVec3>) -> Option<Self> {
        let median_of = |points: &mut [DVec3], value: &dyn Fn(&DVec3) -> f64| {
            let middle = points.len() / 2;
            let median = points.select_nth_unstable_by(middle, |a, b| value(a).total_cmp(&value(b))).1;
            value(median)
        };
        if points.is_empty() {
            return None;
        }
        let middle = DVec3::new(median_of(points, &|p| p.x), median_of(points, &|p| p.y), median_of(points, &|p| p.z));
        let typical_m = median_of(points, &|p| p.distance(middle));
        points.retain(|p| p.distance(middle) <= MAX_MEDIAN_DISTANCES * typical_m);
        let n = points.len() as f64;
        let centre = points.iter().sum::<DVec3>() / n;
        let mut covariance = DMat3::ZERO;
        for d in points.iter().map(|&p| p - centre) {
            covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        }
        let radius_m = ((covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z) / n).sqrt();
        let (_, [axis, ..]) = crate::eigen::symmetric_eigen(covariance);
        let normal = if axis.z < 0.0 { -axis } else { axis };
        (radius_m > 0.0).then_some(Self { centre, radius_m, normal })
    }

    /// Returns true if a position is clearly on one side of the cloud's plane.
    pub(super) fn is_clearly_off(&self, place: DVec3) -> bool {
        let to_place = place - self.centre;
        to_place.dot(self.normal).abs() > CLEARLY_BESIDE * to_place.length()
    }

    /// Returns an assumed sensor pose 4 radii from the centre along the cloud's normal. It is on the origin's side if
    /// the origin is clearly on one side, otherwise above. The distance is small enough for coordinates in f32.
    pub(super) fn sensor_beside(&self, origin: Option<DVec3>) -> RigidTransform {
        let to_origin = origin.map_or(DVec3::ZERO, |origin| origin - self.centre);
        let is_outside = to_origin.length() > self.radius_m;
        let is_below = is_outside && to_origin.dot(self.normal) < -CLEARLY_BESIDE * to_origin.length();
        let side = if is_below { -self.normal } else { self.normal };
        RigidTransform { rotation: DMat3::IDENTITY, translation: self.centre + 4.0 * self.radius_m * side }
    }
}

/// Returns the natural logarithm of the ratio of the 80 % quantile to the 20 % quantile; 0 without values.
pub(super) fn spread(values: impl Iterator<Item = f64>, scratch: &mut Vec<f64>) -> f64 {
    scratch.clear();
    scratch.extend(values);
    match (quantile(scratch, 0.8), quantile(scratch, 0.2)) {
        (Some(high), Some(low)) => (high / low).ln(),
        _ => 0.0,
    }
}

/// Returns the quantile of the values at `share`, 0 to 1; `None` without values.
pub(super) fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let at = ((values.len() as f64 * share) as usize).min(values.len().saturating_sub(1));
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(at, f64::total_cmp).1)
}
