//! Where the sensor of a frame stands, and what the range of a point is (docs/method.md, section 11).
//!
//! Engines work in the sensor's frame, where it stands at the origin and looks along +z, and move each measured point by the
//! displacement that they find, turned back into the cloud's frame.

use glam::{DMat3, DVec3};

use super::{Frame, PointsView};
use crate::cloud::OrganizedCloud;
use crate::pose::RigidTransform;

/// How ranges are measured in a frame, and how far apart its pixels are.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum RangeRule {
    /// The grid is a camera's: the range is the depth along its axis.
    Depth {
        /// 1/fx: metres between neighbouring pixels at a depth of 1 m. `None` if no two neighbours are valid.
        pitch_at_1m: Option<f64>,
    },
    /// The grid is another sensor's: the range is the distance from it.
    Distance {
        /// Metres between neighbouring pixels at a distance of 1 m, of rows or columns, whichever are farther apart.
        pitch_at_1m: f64,
    },
    /// It is not known where the sensor stood: every point has the range at which pixels of a Kinect v1 are as far apart as
    /// these points are.
    Constant {
        /// Metres between neighbouring points.
        spacing_m: f64,
    },
}

/// The focal length of a Kinect v1 in pixels: what is assumed where nothing is known.
const KINECT_FOCAL_LENGTH_PX: f64 = 525.0;
/// Sensor models end here: where the range is unknown, none larger than this is assumed.
const MAX_ASSUMED_RANGE_M: f64 = 5.0;
/// Rows that are looked at.
const SAMPLED_ROWS: usize = 16;
/// Columns and rows that are looked at to tell whether the grid is a camera's.
const SAMPLED_COLUMNS: usize = 24;
const LAW_ROWS: usize = 12;
/// Neighbours for the spacing are so many pixels apart: their distance is larger, and the noise of it no more.
const LAG_PX: usize = 4;
/// X/z along a column may vary by this share of its extent over the image: lenses distort by less, turned cameras by more.
const RAY_LAW_TOLERANCE: f64 = 0.1;
/// Points behind the sensor, as a share, from which on the grid is no camera's.
const MAX_BEHIND: f64 = 0.01;
/// Corners of pixels that turn the other way, as a share, from which on the grid is no camera's.
const MAX_TURNED: f64 = 0.1;
/// One spread is clearly less than another if it is below this share of it.
const CLEARLY_LESS: f64 = 0.7;
/// Angles of this spread are the same, lenses and scanners being what they are: a factor of 1.6.
const SMALL_SPREAD: f64 = 0.5;
/// An unknown sensor may be assumed at the origin of coordinates that is at most so many extents of the cloud away.
const MAX_EXTENTS: f64 = 1000.0;

impl RangeRule {
    /// Metres between neighbouring pixels at a range of 1 m; that of a Kinect v1 where it is not known.
    pub fn pitch_at_1m(&self) -> f64 {
        self.known_pitch_at_1m().unwrap_or(1.0 / KINECT_FOCAL_LENGTH_PX)
    }

    /// The same, but `None` where it can only be guessed.
    pub(crate) fn known_pitch_at_1m(&self) -> Option<f64> {
        match *self {
            Self::Depth { pitch_at_1m } => pitch_at_1m,
            Self::Distance { pitch_at_1m } => Some(pitch_at_1m),
            Self::Constant { .. } => None,
        }
    }
}

/// What an engine must know of a frame beside its samples.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameGeometry {
    /// `None` where the cloud's frame is the sensor's.
    pub(crate) cloud_from_sensor: Option<RigidTransform>,
    pub(crate) rule: RangeRule,
}

/// Room for samples of a frame, kept from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct GeometryScratch {
    pitches: Vec<f64>,
    tangents: Vec<f64>,
    spreads: Vec<f64>,
    medians: Vec<f64>,
    horizontal: Vec<NeighbourPair>,
    vertical: Vec<NeighbourPair>,
    extent: Vec<DVec3>,
}

/// Two neighbours on the grid.
#[derive(Debug, Clone, Copy)]
struct NeighbourPair {
    /// Between points of neighbouring pixels.
    spacing_m: f64,
    /// Between their directions from the sensor.
    angle: f64,
}

impl FrameGeometry {
    /// Of a frame for an engine that needs to know ranges, or not.
    pub(crate) fn of(frame: Frame<'_>, needs_range: bool, scratch: &mut GeometryScratch) -> Self {
        let unknown = RangeRule::Depth { pitch_at_1m: None };
        match frame {
            Frame::Depth(depth) => {
                let rule = RangeRule::Depth { pitch_at_1m: Some(1.0 / depth.camera().fx) };
                Self { cloud_from_sensor: None, rule }
            }
            Frame::Points(points) if points.grid().is_none() => Self::new(points.transform(), unknown),
            Frame::Points(points) => Self::of_points(&points, needs_range, scratch),
        }
    }

    /// Of points on a grid.
    pub(super) fn of_points(points: &PointsView<'_>, needs_range: bool, scratch: &mut GeometryScratch) -> Self {
        let assumed = Self::new(points.transform(), RangeRule::Depth { pitch_at_1m: None });
        let Some(grid @ (width, height)) = points.grid() else { return assumed };
        let sample = Sample { points, geometry: assumed, width, height };
        let known_pitch = points.camera().map(|camera| 1.0 / camera.fx);
        let of_camera = |sample: &Sample<'_, '_>, scratch: &mut GeometryScratch| {
            let pitch_at_1m = known_pitch.or_else(|| if needs_range { sample.camera_pitch(scratch) } else { None });
            Self { rule: RangeRule::Depth { pitch_at_1m }, ..sample.geometry }
        };
        let has_pose = !points.pose().is_identity();
        if (known_pitch.is_some() && !has_pose) || sample.is_of_a_camera(scratch) {
            return of_camera(&sample, scratch);
        }
        let own = Sample { geometry: Self::new(points.origin_transform(), assumed.rule), ..sample };
        if has_pose && own.is_of_a_camera(scratch) && own.is_likelier_than(&sample, scratch) {
            return of_camera(&own, scratch);
        }
        if known_pitch.is_some() {
            return of_camera(&sample, scratch);
        }
        let GeometryScratch { pitches, horizontal, vertical, extent, .. } = scratch;
        sample.neighbours(horizontal, [LAG_PX.min(grid.0 - 1), 0]);
        sample.neighbours(vertical, [0, LAG_PX.min(grid.1 - 1)]);
        let mut median_of = |pairs: &[NeighbourPair], value: fn(&NeighbourPair) -> f64| {
            pitches.clear();
            pitches.extend(pairs.iter().map(value));
            quantile(pitches, 0.5)
        };
        let mut larger = |value: fn(&NeighbourPair) -> f64| {
            let (rows, columns) = (median_of(vertical, value), median_of(horizontal, value));
            rows.into_iter().chain(columns).reduce(f64::max)
        };
        let (pitch, spacing) = (larger(|pair| pair.angle), larger(|pair| pair.spacing_m));
        let (Some(pitch_at_1m), Some(spacing_m)) = (pitch, spacing) else { return assumed };
        let distance = Self { rule: RangeRule::Distance { pitch_at_1m }, ..assumed };
        if !points.pose().is_identity() {
            return distance;
        }

        // Nobody said where the sensor stood. Seen from it, neighbours are the same angle apart, however far away they are.
        let pairs = if horizontal.is_empty() { vertical } else { horizontal };
        let of_angle = spread(pairs.iter().map(|pair| pair.angle), pitches);
        let of_spacing = spread(pairs.iter().map(|pair| pair.spacing_m), pitches);
        let Some(extent) = Extent::of(&sample, extent) else { return distance };
        let to_origin_m = (extent.centre - assumed.sensor_position()).length();
        let has_even_angles = of_angle < SMALL_SPREAD || of_angle < CLEARLY_LESS * of_spacing;
        // It sees every surface from the front: corners of pixels all turn the same way.
        let [one, other] = sample.turns();
        let sees_one_side = f64::from(one.min(other)) <= MAX_TURNED * f64::from(one + other);
        if has_even_angles && sees_one_side && to_origin_m <= MAX_EXTENTS * extent.radius_m {
            return distance;
        }
        let origin = (to_origin_m <= MAX_EXTENTS * extent.radius_m).then(|| assumed.sensor_position());
        Self::new(extent.sensor_beside(origin), RangeRule::Constant { spacing_m })
    }

    fn new(transform: RigidTransform, rule: RangeRule) -> Self {
        Self { cloud_from_sensor: (!transform.is_identity()).then_some(transform), rule }
    }

    /// Where the sensor stands in the cloud's frame.
    pub(crate) fn sensor_position(&self) -> DVec3 {
        self.cloud_from_sensor.map_or(DVec3::ZERO, |transform| transform.translation)
    }

    /// The range of a point in the sensor's frame.
    pub(crate) fn range_m(&self, point_in_sensor: DVec3) -> f64 {
        match self.rule {
            RangeRule::Depth { .. } => point_in_sensor.z.abs(),
            RangeRule::Distance { .. } => point_in_sensor.length(),
            RangeRule::Constant { spacing_m } if point_in_sensor.is_finite() => assumed_range_m(spacing_m),
            RangeRule::Constant { .. } => f64::NAN,
        }
    }
}

/// The range at which sensor models are evaluated where it is not known.
pub(crate) fn assumed_range_m(spacing_m: f64) -> f64 {
    (KINECT_FOCAL_LENGTH_PX * spacing_m).min(MAX_ASSUMED_RANGE_M)
}

impl OrganizedCloud {
    /// Metres between neighbouring pixels at a range of 1 m, from the camera where it is known, else from the points (1/fx of a
    /// camera). `None` where it cannot be told.
    pub fn pixel_pitch_at_1m(&self) -> Option<f64> {
        PointsView::from_organized(self).ok()?.range_rule().known_pitch_at_1m()
    }
}

/// Points of a cloud that are looked at.
#[derive(Clone, Copy)]
struct Sample<'a, 'p> {
    points: &'a PointsView<'p>,
    geometry: FrameGeometry,
    width: usize,
    height: usize,
}

impl Sample<'_, '_> {
    /// A point in the sensor's frame; `None` for a hole, and for zeros, which some writers mean as one.
    fn point(&self, i: usize) -> Option<DVec3> {
        let point = self.points.point_in_sensor(i, &self.geometry);
        (point.is_finite() && self.points.point(i) != DVec3::ZERO).then_some(point)
    }

    /// Whether a camera at the origin of coordinates, rather than at the stated pose, took the points. PCL's grabbers state how
    /// the camera is turned and write the points in its own frame nevertheless; others do so with its position.
    fn is_likelier_than(&self, stated: &Self, scratch: &mut GeometryScratch) -> bool {
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

    /// Whether the points lie as a camera's do, before the sensor: X/z is the same along columns and Y/z along rows, and columns go
    /// to the right where rows go down.
    fn is_of_a_camera(&self, scratch: &mut GeometryScratch) -> bool {
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

    /// How many corners of pixels turn right-handed, as a camera's do, and how many the other way: the sign of the determinant of
    /// three neighbouring rays, whatever the surface and the noise.
    fn turns(&self) -> [u32; 2] {
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

    /// Whether a tangent is the same along lines of pixels: all but a tenth of its extent over the lines.
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
            // A stray pixel at either end is none of the camera's.
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

    /// 1/fx of a camera: in a pinhole image X/Z grows by exactly that from a pixel to its right neighbour, whatever the surface;
    /// the median of that difference over a sample of the rows.
    fn camera_pitch(&self, scratch: &mut GeometryScratch) -> Option<f64> {
        let pitches = &mut scratch.pitches;
        pitches.clear();
        if let (Some([x, _, z]), None) = (self.points.plain_planes(), self.geometry.cloud_from_sensor) {
            for row in self.rows() {
                let pixels = row * self.width..(row + 1) * self.width;
                let tangents = x[pixels.clone()].iter().zip(&z[pixels]).map(|(&x, &z)| f64::from(x) / f64::from(z));
                let mut left = f64::NAN;
                for tangent in tangents {
                    let pitch = (tangent - left).abs();
                    if pitch.is_finite() && pitch > 0.0 {
                        pitches.push(pitch);
                    }
                    left = tangent;
                }
            }
            return quantile(pitches, 0.5);
        }
        for row in self.rows() {
            let mut left = None;
            for column in 0..self.width {
                let point = self.points.point_in_sensor(row * self.width + column, &self.geometry);
                let tangent = point.is_finite().then_some(point.x / point.z);
                if let (Some(left), Some(tangent)) = (left, tangent) {
                    let pitch: f64 = f64::abs(tangent - left);
                    if pitch.is_finite() && pitch > 0.0 {
                        pitches.push(pitch);
                    }
                }
                left = tangent;
            }
        }
        quantile(pitches, 0.5)
    }

    /// Pairs of points so many columns and rows apart, in the sampled rows.
    fn neighbours(&self, pairs: &mut Vec<NeighbourPair>, [columns, rows]: [usize; 2]) {
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

/// How large a cloud is, and how it lies; stray points left out.
struct Extent {
    centre: DVec3,
    /// Root mean square of the distance from the centre.
    radius_m: f64,
    /// Of the plane through the sampled points, upwards.
    normal: DVec3,
}

/// Points farther from the middle than so many median distances are stray ones, or stand for no data.
const MAX_MEDIAN_DISTANCES: f64 = 5.0;
/// The origin is on one side of a cloud if it is so far off its plane, as a share of its distance.
const CLEARLY_BESIDE: f64 = 0.2;

impl Extent {
    fn of(sample: &Sample<'_, '_>, points: &mut Vec<DVec3>) -> Option<Self> {
        let columns = (0..sample.width).step_by(sample.width.div_ceil(SAMPLED_COLUMNS));
        let pixels = sample.rows().flat_map(|row| columns.clone().map(move |column| row * sample.width + column));
        points.clear();
        points.extend(pixels.filter(|&i| sample.point(i).is_some()).map(|i| sample.points.point(i)));
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

    /// A sensor that looks along the cloud's normal, from the side of the origin if that is clearly on one, else from above; not so
    /// far away that f32 would lose the coordinates.
    fn sensor_beside(&self, origin: Option<DVec3>) -> RigidTransform {
        let to_origin = origin.map_or(DVec3::ZERO, |origin| origin - self.centre);
        let is_outside = to_origin.length() > self.radius_m;
        let is_below = is_outside && to_origin.dot(self.normal) < -CLEARLY_BESIDE * to_origin.length();
        let side = if is_below { -self.normal } else { self.normal };
        RigidTransform { rotation: DMat3::IDENTITY, translation: self.centre + 4.0 * self.radius_m * side }
    }
}

/// ln of the ratio of the quantiles at 80 and 20 %.
fn spread(values: impl Iterator<Item = f64>, scratch: &mut Vec<f64>) -> f64 {
    scratch.clear();
    scratch.extend(values);
    match (quantile(scratch, 0.8), quantile(scratch, 0.2)) {
        (Some(high), Some(low)) => (high / low).ln(),
        _ => 0.0,
    }
}

/// The value at a share of all values in order; `None` of none.
fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let at = ((values.len() as f64 * share) as usize).min(values.len().saturating_sub(1));
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(at, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::pose::SensorPose;
    use crate::xyz::Xyz;

    const WIDTH: usize = 64;
    const HEIGHT: usize = 48;

    /// What a small camera sees of a slanted wall with a step, in its own frame.
    fn seen_by_a_camera() -> Vec<DVec3> {
        let camera = Camera::new((WIDTH, HEIGHT), [52.5; 2], [31.5, 23.5]);
        let depth = |u: usize, v: usize| if u < 20 { 1.0 } else { 2.0 } + 0.01 * v as f64;
        let point = |u: usize, v: usize| {
            let z = depth(u, v);
            z * DVec3::new((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy, 1.0)
        };
        (0..HEIGHT).flat_map(|v| (0..WIDTH).map(move |u| point(u, v))).collect()
    }

    fn rule_of(points: impl IntoIterator<Item = DVec3>, pose: SensorPose) -> (RangeRule, DVec3) {
        let positions: Xyz = points.into_iter().map(|p| p.to_array().map(|c| c as f32)).collect();
        let mut cloud = OrganizedCloud::from_positions(WIDTH, HEIGHT, positions).unwrap();
        cloud.points.pose = pose;
        let view = PointsView::from_organized(&cloud).unwrap();
        let geometry = view.geometry(&mut GeometryScratch::default());
        (geometry.rule, geometry.sensor_position())
    }

    /// A robot's base frame: x forward, y left, z up.
    const BASE_POSE: [f64; 7] = [0.1, 0.0, 0.6, 0.5, -0.5, 0.5, -0.5];

    #[test]
    fn a_camera_is_recognized_in_its_own_frame_and_by_its_pose() {
        let pose = SensorPose::from_viewpoint(BASE_POSE);
        let transform = pose.transform().unwrap();
        let moved = seen_by_a_camera().into_iter().map(|p| transform.rotation * p + transform.translation);
        for (rule, _) in [rule_of(seen_by_a_camera(), SensorPose::IDENTITY), rule_of(moved, pose)] {
            let RangeRule::Depth { pitch_at_1m: Some(pitch) } = rule else { panic!("{rule:?}") };
            assert!((pitch * 52.5 - 1.0).abs() < 1e-3, "{pitch}");
        }
    }

    #[test]
    fn stray_points_and_overhead_views_make_no_camera_of_a_turned_one() {
        let transform = SensorPose::from_viewpoint(BASE_POSE).transform().unwrap();
        let raised = |p: DVec3| transform.rotation * p + DVec3::new(0.0, 0.0, 3.0);
        let stray = |(i, p): (usize, DVec3)| if i % 64 == 20 && i % 5 == 0 { p.with_z(1e-4) } else { p };
        let (rule, _) =
            rule_of(seen_by_a_camera().into_iter().map(raised).enumerate().map(stray), SensorPose::IDENTITY);
        assert!(!matches!(rule, RangeRule::Depth { .. }), "{rule:?}");
        // Looking down on a floor, in a frame with z up.
        let overhead = SensorPose::from_viewpoint([0.0, 0.0, 4.0, 0.0, 1.0, 0.0, 0.0]).transform().unwrap();
        let floor = seen_by_a_camera().into_iter().map(|p| overhead.rotation * p + overhead.translation);
        let (rule, _) = rule_of(floor, SensorPose::IDENTITY);
        assert!(!matches!(rule, RangeRule::Depth { .. }), "{rule:?}");
    }

    #[test]
    fn a_camera_in_its_own_frame_is_one_whatever_pose_the_file_states() {
        // As PCL's OpenNI grabber writes it, and with a pose in a world.
        for viewpoint in [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0], BASE_POSE] {
            let (rule, sensor) = rule_of(seen_by_a_camera(), SensorPose::from_viewpoint(viewpoint));
            assert!(matches!(rule, RangeRule::Depth { pitch_at_1m: Some(_) }), "{rule:?}");
            assert_eq!(sensor, DVec3::ZERO);
        }
    }

    #[test]
    fn without_its_pose_a_turned_camera_has_distances_of_about_the_same_pitch() {
        let transform = SensorPose::from_viewpoint(BASE_POSE).transform().unwrap();
        let turned = seen_by_a_camera().into_iter().map(|p| transform.rotation * p);
        let (rule, _) = rule_of(turned, SensorPose::IDENTITY);
        let RangeRule::Distance { pitch_at_1m } = rule else { panic!("{rule:?}") };
        assert!((0.8..1.1).contains(&(pitch_at_1m * 52.5)), "{pitch_at_1m}");
    }

    #[test]
    fn a_spinning_lidar_has_distances_from_its_middle() {
        let beam = |u: usize, v: usize| {
            let (azimuth, elevation) = (u as f64 / 64.0 * std::f64::consts::TAU, 0.01 * (v as f64 - 24.0));
            let range = 3.0 + 2.0 * (2.0 * azimuth).sin();
            range * DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin())
        };
        let points = (0..HEIGHT).flat_map(|v| (0..WIDTH).map(move |u| beam(u, v)));
        let (rule, sensor) = rule_of(points, SensorPose::IDENTITY);
        assert!(matches!(rule, RangeRule::Distance { .. }), "{rule:?}");
        assert_eq!(sensor, DVec3::ZERO);
    }

    #[test]
    fn a_grid_around_the_origin_or_far_from_it_is_seen_from_above() {
        let terrain = |offset: DVec3| {
            let height = |u: usize, v: usize| 0.2 * (0.1 * u as f64).sin() + 0.01 * v as f64;
            let point = move |u: usize, v: usize| {
                offset + DVec3::new(0.5 * (u as f64 - 32.0), 0.5 * (v as f64 - 24.0), height(u, v))
            };
            (0..HEIGHT).flat_map(move |v| (0..WIDTH).map(move |u| point(u, v)))
        };
        let (rule, sensor) = rule_of(terrain(DVec3::ZERO), SensorPose::IDENTITY);
        let RangeRule::Constant { spacing_m } = rule else { panic!("{rule:?}") };
        assert!((spacing_m - 0.5).abs() < 0.01 && sensor.z > 5.0, "{spacing_m} {sensor}");
        // At its corner, at a height, and with values that stand for no data.
        let (beside, sensor) = rule_of(terrain(DVec3::new(20.0, 15.0, 0.0)), SensorPose::IDENTITY);
        assert!(!matches!(beside, RangeRule::Depth { .. }) && sensor.z >= 0.0, "{beside:?} {sensor}");
        let northwards = |p: DVec3| DVec3::new(p.x, -p.y, p.z);
        let (high, _) = rule_of(terrain(DVec3::new(-100.0, -75.0, 100.0)).map(northwards), SensorPose::IDENTITY);
        assert!(!matches!(high, RangeRule::Depth { .. }), "{high:?}");
        let nodata = |(i, p): (usize, DVec3)| if i % 600 == 7 { DVec3::new(p.x, p.y, -3.4e38) } else { p };
        let (holed, sensor) = rule_of(terrain(DVec3::ZERO).enumerate().map(nodata), SensorPose::IDENTITY);
        assert!(matches!(holed, RangeRule::Constant { .. }) && (5.0..100.0).contains(&sensor.z), "{holed:?} {sensor}");
        let (far, sensor) = rule_of(terrain(DVec3::new(3.2e5, 5.6e5, 120.0)), SensorPose::IDENTITY);
        assert!(matches!(far, RangeRule::Constant { .. }) && sensor.z > 120.0, "{far:?} {sensor}");
    }

    #[test]
    fn pitch_is_estimated_to_a_part_in_a_thousand_on_a_tilted_noisy_plane() {
        let depth_m = (0..480 * 640).map(|i| 1.0 + 0.001 * (i % 640) as f32 + 0.002 * (i % 7) as f32);
        let mut positions = Camera::kinect_v1().deproject_m(depth_m);
        positions.z.iter_mut().step_by(11).for_each(|z| *z = f32::NAN);
        let cloud = OrganizedCloud::from_positions(640, 480, positions).unwrap();
        let pitch = cloud.pixel_pitch_at_1m().unwrap();
        assert!((pitch * 525.0 - 1.0).abs() < 1e-3, "{pitch}");
    }

    #[test]
    fn what_says_nothing_is_taken_for_a_camera() {
        for points in [vec![DVec3::NAN; WIDTH * HEIGHT], vec![DVec3::ZERO; WIDTH * HEIGHT]] {
            let (rule, _) = rule_of(points, SensorPose::IDENTITY);
            assert_eq!(rule, RangeRule::Depth { pitch_at_1m: None });
        }
    }
}
