//! The position of a frame's sensor and the range of a point (docs/method.md, section 11).
//!
//! In the sensor's frame, the sensor is at the origin and looks along +z.

use glam::DVec3;

use super::range_rule::{FrameGeometry, RangeRule};
use super::sample::{
    CLEARLY_LESS, Extent, GeometryScratch, LAG_PX, MAX_TURNED, NeighbourPair, Sample, quantile, spread,
};
use super::{Frame, PointsView};
use crate::cloud::OrganizedCloud;
use crate::pose::RigidTransform;

/// Spread below which the angles between neighbours count as equal: the angles of lenses and scanners vary by a
/// factor of 1.6.
const SMALL_SPREAD: f64 = 0.5;
/// Maximum distance from a cloud's centre at which the origin of coordinates may be its sensor, in extents of the
/// cloud.
const MAX_EXTENTS: f64 = 1000.0;
/// Maximum distance in metres of an unorganized cloud's centre from the origin at which the origin may be its sensor.
/// Larger coordinates are taken to be map coordinates.
const MAX_ORIGIN_M: f64 = 20_000.0;
/// Maximum distance of the origin from a cloud's centre, in extents of the cloud, at which the origin may be its sensor
/// although it is not clearly on one side of the cloud's plane.
const BESIDE_EXTENTS: f64 = 5.0;
/// Range of the distance ratios that show that the origin is on the surface. On a surface, the 60th nearest of the
/// sampled points is about 3.2 times as far away as the 6th, and likewise for the other [`NEAR_NEIGHBOURS`].
const SURFACE_RATIOS: [f64; 2] = [2.4, 4.2];
/// Values of n for which the distance to the 10n-th nearest point is compared with the distance to the n-th. They are
/// limited so that 10n is at most a quarter of the sample.
const NEAR_NEIGHBOURS: [usize; 3] = [6, 24, 96];
/// Maximum number of sampled points of an unorganized cloud.
const GENERAL_SAMPLE: usize = 4096;

impl FrameGeometry {
    /// Finds the geometry of a frame. The pitch of an unknown camera is estimated only if the engine needs ranges.
    pub(crate) fn of(frame: Frame<'_>, needs_range: bool, scratch: &mut GeometryScratch) -> Self {
        match frame {
            Frame::Depth(depth) => {
                let rule = RangeRule::Depth { pitch_at_1m: Some(1.0 / depth.camera().fx) };
                Self { cloud_from_sensor: None, rule }
            }
            Frame::Points(points) if points.grid().is_none() => Self::of_general(&points, scratch),
            Frame::Points(points) => Self::of_points(&points, needs_range, scratch),
        }
    }

    /// Finds the geometry of points without a grid.
    fn of_general(points: &PointsView<'_>, scratch: &mut GeometryScratch) -> Self {
        // A part of a cloud uses the pose that was assumed for the whole cloud.
        let assumed = points.extent_m().is_none().then(|| assumed_transform(points, scratch)).flatten();
        let transform = assumed.unwrap_or_else(|| points.transform());
        Self::new(transform, RangeRule::Depth { pitch_at_1m: None })
    }

    /// Finds the geometry of points on a grid.
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

        // The sensor position is not stated. Seen from the sensor, neighbours are equal angles apart, however far away
        // they are.
        let pairs = if horizontal.is_empty() { vertical } else { horizontal };
        let of_angle = spread(pairs.iter().map(|pair| pair.angle), pitches);
        let of_spacing = spread(pairs.iter().map(|pair| pair.spacing_m), pitches);
        let Some(extent) = Extent::of_grid(&sample, extent) else { return distance };
        let to_origin_m = (extent.centre - assumed.sensor_position()).length();
        let has_even_angles = of_angle < SMALL_SPREAD || of_angle < CLEARLY_LESS * of_spacing;
        // A sensor sees every surface from the front, so all pixel corners have the same orientation.
        let [one, other] = sample.turns();
        let sees_one_side = f64::from(one.min(other)) <= MAX_TURNED * f64::from(one + other);
        if has_even_angles && sees_one_side && to_origin_m <= MAX_EXTENTS * extent.radius_m {
            return distance;
        }
        let origin = (to_origin_m <= MAX_EXTENTS * extent.radius_m).then(|| assumed.sensor_position());
        Self::new(extent.sensor_beside(origin), RangeRule::Constant { spacing_m })
    }
}

/// Returns the assumed sensor pose of an unorganized cloud; `None` if the cloud states a pose, or if the sensor may
/// have been at the origin.
pub(super) fn assumed_transform(points: &PointsView<'_>, scratch: &mut GeometryScratch) -> Option<RigidTransform> {
    if !points.pose().is_identity() {
        return None;
    }
    let sample = &mut scratch.extent;
    sample.clear();
    sample.extend(
        (0..points.len())
            .step_by(sampling_step(points.len()))
            .map(|i| points.point(i))
            .filter(|point| point.is_finite()),
    );
    assumed_sensor(sample, points.origin_transform().translation)
}

/// Returns the assumed sensor pose for a sample of the points; `None` if the sensor may have been at `origin`, the
/// origin of coordinates.
fn assumed_sensor(sample: &mut Vec<DVec3>, origin: DVec3) -> Option<RigidTransform> {
    let is_on_surface = is_on_surface(sample, origin);
    let extent = Extent::of(sample)?;
    let to_origin_m = (extent.centre - origin).length();
    let is_near = to_origin_m <= MAX_EXTENTS * extent.radius_m && to_origin_m <= MAX_ORIGIN_M;
    let is_far_beside = to_origin_m > BESIDE_EXTENTS * extent.radius_m && !extent.is_clearly_off(origin);
    let may_be_sensor = is_near && !is_far_beside && !is_on_surface;
    (!may_be_sensor).then(|| extent.sensor_beside(None))
}

/// Returns true if a position is on the surface of the sampled points, that is, if the number of points within a given
/// distance of it grows with the square of the distance. Around a sensor, by contrast, even the nearest points are some
/// distance away.
fn is_on_surface(sample: &[DVec3], place: DVec3) -> bool {
    // Zeros encode missing data.
    let squares = sample.iter().map(|point| point.distance_squared(place)).filter(|square| *square > 0.0);
    let mut squares: Vec<f64> = squares.collect();
    squares.sort_by(f64::total_cmp);
    let ratio = |near: usize| squares[10 * near - 1] / squares[near - 1];
    let (low, high) = (SURFACE_RATIOS[0].powi(2), SURFACE_RATIOS[1].powi(2));
    // Stray points near a sensor may imitate a surface at one of these ranks, but not at all of them.
    let reached = NEAR_NEIGHBOURS.into_iter().filter(|near| 40 * near <= squares.len());
    squares.len() >= 40 * NEAR_NEIGHBOURS[0] && reached.map(ratio).all(|ratio| (low..high).contains(&ratio))
}

/// Returns the sampling step n for an unorganized cloud: the sample consists of the points whose index is a multiple
/// of n.
pub fn sampling_step(points: usize) -> usize {
    points.div_ceil(GENERAL_SAMPLE).max(1)
}

/// Same as [`PointsView::assumed_sensor_m`], for a sample of a file's points.
pub fn assumed_sensor_of_sample(sample: &[[f64; 3]]) -> Option<[f64; 3]> {
    let mut sample: Vec<DVec3> = sample.iter().copied().map(DVec3::from_array).collect();
    assumed_sensor(&mut sample, DVec3::ZERO).map(|transform| transform.translation.to_array())
}

impl PointsView<'_> {
    /// Returns the rule by which ranges are measured in this frame, with the pitch of its pixels (docs/method.md,
    /// section 11).
    pub fn range_rule(&self) -> RangeRule {
        self.geometry(&mut GeometryScratch::default()).rule
    }

    /// Returns the sensor's position in the frame of the points, and whether this frame is the sensor's own, where z
    /// is depth. `None` if the position is unknown (docs/method.md, section 11).
    pub fn seen_from(&self) -> Option<(DVec3, bool)> {
        let geometry = self.geometry(&mut GeometryScratch::default());
        let is_depth = geometry.cloud_from_sensor.is_none() && matches!(geometry.rule, RangeRule::Depth { .. });
        let is_known = !matches!(geometry.rule, RangeRule::Constant { .. });
        is_known.then(|| (geometry.sensor_position(), is_depth))
    }

    /// Returns the assumed sensor position of an unorganized cloud in the frame of the file; normals face it. `None`
    /// for organized points, if the cloud states a pose, or if the sensor may have been at the origin
    /// (docs/method.md, section 11).
    pub fn assumed_sensor_m(&self) -> Option<[f64; 3]> {
        let is_general = self.grid().is_none();
        let assumed = is_general.then(|| assumed_transform(self, &mut GeometryScratch::default())).flatten();
        assumed.map(|transform| (transform.translation + DVec3::from_array(self.origin_m())).to_array())
    }

    /// Returns the range of every point in metres, NaN for holes.
    pub fn ranges_m(&self) -> Vec<f64> {
        let geometry = self.geometry(&mut GeometryScratch::default());
        (0..self.len()).map(|i| geometry.range_m(self.point_in_sensor(i, &geometry))).collect()
    }

    pub(crate) fn geometry(&self, scratch: &mut GeometryScratch) -> FrameGeometry {
        FrameGeometry::of_points(self, true, scratch)
    }

    /// Returns point `i` in the sensor's frame.
    pub(crate) fn point_in_sensor(&self, i: usize, geometry: &FrameGeometry) -> DVec3 {
        match geometry.cloud_from_sensor {
            None => self.point(i),
            Some(transform) => transform.to_sensor(self.point(i)),
        }
    }
}

impl OrganizedCloud {
    /// Returns the distance between neighbouring pixels at a range of 1 m, in metres (1/fx of a camera). It is
    /// computed from the camera if known, otherwise from the points. `None` if unknown.
    pub fn pixel_pitch_at_1m(&self) -> Option<f64> {
        PointsView::from_organized(self).ok()?.range_rule().known_pitch_at_1m()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::pose::SensorPose;
    use crate::xyz::Xyz;

    const WIDTH: usize = 64;
    const HEIGHT: usize = 48;

    /// Returns a slanted wall with a step, seen by a small camera, in its frame.
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

    /// The pose of a camera in a robot's base frame: x forward, y left, z up.
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
        // With the origin beside a corner, with the origin far below, and with values that encode missing data.
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
        positions.as_mut_slices()[2].iter_mut().step_by(11).for_each(|z| *z = f32::NAN);
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
    #[test]
    fn general_clouds_are_seen_from_above_where_the_origin_cannot_be_the_sensor() {
        // A slope of 400 m, and a wall of 40 m.
        let slope = |i: usize| DVec3::new(20.0 * (i % 20) as f64, 20.0 * (i / 20) as f64, 3.0 * (i % 20) as f64);
        let wall = |i: usize| DVec3::new(2.0 * (i % 20) as f64, 0.1 * (i % 7) as f64, (i / 20) as f64);
        let seen_from = |at: &dyn Fn(usize) -> DVec3, moved: DVec3, pose: SensorPose| {
            let points: Vec<[f64; 3]> = (0..400).map(|i| (at(i) + moved).to_array()).collect();
            let view = PointsView::from_rows_f64(&points).unwrap().with_pose(pose).unwrap();
            let view = view.with_origin((moved + DVec3::ONE).to_array()).unwrap();
            let geometry = FrameGeometry::of(Frame::Points(view), true, &mut GeometryScratch::default());
            let position = geometry.sensor_position() + moved + DVec3::ONE;
            let assumed = view.assumed_sensor_m().map(DVec3::from_array);
            assert!(assumed.is_none_or(|assumed| assumed.distance(position) < 1e-6), "{assumed:?} {position}");
            (position, assumed.is_some())
        };
        let map = DVec3::new(532_000.0, 5_263_000.0, 812.0);
        let (above, is_assumed) = seen_from(&slope, map, SensorPose::IDENTITY);
        assert!(is_assumed && above.z > map.z + 400.0 && above.distance(map) < 1500.0, "{above}");
        let (beside, _) = seen_from(&wall, map, SensorPose::IDENTITY);
        let off = beside - map - DVec3::new(19.0, 0.3, 9.5);
        assert!(off.y.abs() > 0.95 * off.length(), "{off}");
        // In site coordinates, and with the origin near the middle of the slope.
        for moved in [DVec3::new(900.0, -2500.0, 10.0), DVec3::new(-200.0, -200.0, -30.0)] {
            let (position, is_assumed) = seen_from(&slope, moved, SensorPose::IDENTITY);
            assert!(is_assumed && position.z > moved.z + 400.0, "{position}");
        }
        // Around a sensor, with strays close to it and zeros for missing measurements.
        let room = |i: usize| match i % 100 {
            0 => DVec3::ZERO,
            1 => DVec3::new(0.3, 0.1, 0.01 * i as f64),
            _ => {
                let turn = 2.4 * i as f64;
                DVec3::new(4.0 * turn.cos(), 4.0 * turn.sin(), 0.015 * (i % 200) as f64 - 1.5)
            }
        };
        let (position, is_assumed) = seen_from(&room, DVec3::ZERO, SensorPose::IDENTITY);
        assert!(!is_assumed && position.length() < 1e-6, "{position}");
        // In front of a sensor and to its side.
        let steep = DVec3::new(-200.0, -200.0, -150.0);
        for (at, moved) in [(&slope as &dyn Fn(usize) -> DVec3, steep), (&wall, DVec3::new(-19.0, 15.0, -9.0))] {
            let (position, is_assumed) = seen_from(at, moved, SensorPose::IDENTITY);
            assert!(!is_assumed && position.length() < 1e-6, "{position}");
        }
        let stated = SensorPose { position_m: map.to_array(), ..SensorPose::IDENTITY };
        let (position, is_assumed) = seen_from(&slope, map, stated);
        assert!(!is_assumed && position.distance(map) < 1e-6, "{position}");
    }
}
