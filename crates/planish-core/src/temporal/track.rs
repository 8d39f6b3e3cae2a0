//! Estimates the motion of the camera since the previous frame: point-to-plane alignment by projection
//! (docs/method.md, section 16, "Tracking").
//!
//! Points of the current frame are projected into the previous frame, where the point and the normal of each pixel
//! define a plane. Gauss-Newton steps with robust weights minimise the distances, on every eighth pixel, then every
//! fourth, then every second. Directions that the scene does not determine, such as along a wall, stay as predicted.

use fearless_simd::{Level, Simd, dispatch};
use glam::{DMat3, DVec3, Mat3, Vec3};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::eigen::symmetric_eigen_of;
use crate::pose::RigidTransform;
use crate::sensor::SensorModel;
use crate::xyz::Xyz;

/// Levels of the alignment: distance between the used pixels, maximum number of steps, and step size (radians and
/// metres) below which the level ends.
const LEVELS: [(usize, usize, f64); 3] = [(8, 8, 2e-4), (4, 5, 5e-5), (2, 3, 2e-5)];
/// Number of rows of a level per task.
const TASK_ROWS: usize = 8;
/// Maximum difference in depth between matching points, relative to the depth.
const NEAR: f32 = 0.1;
/// Minimum cosine of the angle between matching normals.
const ALIKE: f32 = 0.85;
/// Minimum residual scale, in sigmas.
const LEAST_SCALE: f64 = 0.3;
/// Residual whose weight is one half, in residual scales.
const CAUCHY: f64 = 2.0;
/// Minimum information along a direction that is corrected, relative to that along the best-determined direction.
const LEAST_INFORMATION: f64 = 1e-3;
/// Distance between the pixels that verify the motion, in pixels.
const CHECKED: usize = 4;
/// Minimum number of matches of a trusted motion.
const LEAST_MATCHES: usize = 25;
/// Minimum share of the points that have a match under a trusted motion.
const LEAST_MATCHED: f64 = 0.5;
/// Maximum residual scale of a trusted motion, in sigmas.
const MOST_SCALE: f64 = 3.0;

/// Points and normals of a frame, in the camera's coordinates.
#[derive(Debug, Default)]
pub(crate) struct Surface {
    pub(crate) points: Xyz,
    pub(crate) normals: Xyz,
}

/// A borrowed [`Surface`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfaceRef<'a> {
    pub(crate) points: &'a Xyz,
    pub(crate) normals: &'a Xyz,
}

impl Surface {
    pub(crate) fn borrow(&self) -> SurfaceRef<'_> {
        SurfaceRef { points: &self.points, normals: &self.normals }
    }
}

/// The quality of the alignment of two frames by a motion.
#[derive(Debug, Clone, Copy)]
struct Alignment {
    /// Number of points with a match.
    matched: usize,
    /// Number of points.
    points: usize,
    /// Robust deviation of the residuals, in sigmas.
    scale: f64,
}

/// A point of the current frame and the plane that it should be on, in the previous camera's coordinates.
#[derive(Clone, Copy)]
struct Match {
    point: Vec3,
    normal: Vec3,
    /// Signed distance from the plane in metres.
    residual_m: f32,
    /// Standard deviation of the distance in metres.
    sigma_m: f32,
}

/// Sums of the normal equations: the 21 entries of the upper triangle of A, then the 6 of g.
type Sums = [f64; 27];

/// Aligns frames of one camera.
#[derive(Debug)]
pub(crate) struct Tracker {
    camera: Camera,
    sensor: SensorModel,
    level: Level,
    /// The last motion, which predicts the next.
    last: RigidTransform,
}

impl Tracker {
    pub(crate) fn new(camera: Camera, sensor: SensorModel) -> Self {
        Self { camera, sensor, level: Level::new(), last: RigidTransform::IDENTITY }
    }

    /// Estimates the motion as previous_from_current. Returns `None` if the alignment is not trusted.
    pub(crate) fn track(&mut self, previous: &Surface, current: SurfaceRef<'_>) -> Option<RigidTransform> {
        // Starts with the better prediction: no motion, or the last motion again.
        let (step, ..) = LEVELS[0];
        let score = |motion: &RigidTransform| {
            let (alignment, _) = self.align(previous, current, motion, step);
            alignment.scale * alignment.points as f64 / alignment.matched.max(1) as f64
        };
        let mut motion = RigidTransform::IDENTITY;
        if !self.last.is_identity() && score(&self.last) < score(&motion) {
            motion = self.last;
        }
        for (step, steps, small) in LEVELS {
            for _ in 0..steps {
                let (found, matches) = self.align(previous, current, &motion, step);
                let Some(change) = solve(self.level, &matches, found.scale) else { break };
                motion = RigidTransform { rotation: change.rotation, translation: change.translation }.after(motion);
                let angle =
                    (change.rotation - DMat3::IDENTITY).to_cols_array().iter().fold(0.0f64, |a, b| a.max(b.abs()));
                if angle < small && change.translation.abs().max_element() < small {
                    break;
                }
            }
        }
        let (alignment, _) = self.align(previous, current, &motion, CHECKED);
        let is_sure = alignment.matched as f64 >= LEAST_MATCHED * alignment.points as f64
            && alignment.matched >= LEAST_MATCHES
            && alignment.scale <= MOST_SCALE;
        self.last = if is_sure { motion } else { RigidTransform::IDENTITY };
        is_sure.then_some(motion)
    }

    pub(crate) fn camera(&self) -> Camera {
        self.camera
    }

    /// Matches every `step`th pixel along both axes and measures the alignment.
    fn align(
        &self,
        previous: &Surface,
        current: SurfaceRef<'_>,
        motion: &RigidTransform,
        step: usize,
    ) -> (Alignment, Vec<Match>) {
        let height = self.camera.height;
        let rows: Vec<usize> = (0..height).step_by(step).collect();
        // This loop is compiled for each instruction set, because without SSE4.1 rounding is a function call.
        let tasks: Vec<(usize, Vec<Match>)> = rows
            .par_chunks(TASK_ROWS)
            .map(|rows| dispatch!(self.level, simd => self.find_rows(simd, previous, current, motion, (rows, step))))
            .collect();
        let points = tasks.iter().map(|(points, _)| points).sum();
        let matches: Vec<Match> = tasks.into_iter().flat_map(|(_, matches)| matches).collect();
        let mut ratios: Vec<f32> = matches.iter().map(|found| (found.residual_m / found.sigma_m).abs()).collect();
        let middle = ratios.len() / 2;
        let median =
            if ratios.is_empty() { f32::INFINITY } else { *ratios.select_nth_unstable_by(middle, f32::total_cmp).1 };
        let scale = LEAST_SCALE.max(1.4826 * f64::from(median));
        (Alignment { matched: matches.len(), points, scale }, matches)
    }

    /// Matches every `step`th pixel of the given rows. Returns the number of points and the matches.
    #[inline(always)]
    fn find_rows<S: Simd>(
        &self,
        _: S,
        previous: &Surface,
        current: SurfaceRef<'_>,
        motion: &RigidTransform,
        (rows, step): (&[usize], usize),
    ) -> (usize, Vec<Match>) {
        let width = self.camera.width;
        let (rotation, translation) = (motion.rotation.as_mat3(), motion.translation.as_vec3());
        let (mut points, mut matches) = (0, Vec::with_capacity(rows.len() * width.div_ceil(step)));
        for &v in rows {
            for i in (v * width..(v + 1) * width).step_by(step) {
                if current.points.is_finite(i) && current.normals.is_finite(i) {
                    points += 1;
                    matches.extend(self.find(previous, current, rotation, translation, i));
                }
            }
        }
        (points, matches)
    }

    #[inline(always)]
    fn find(
        &self,
        previous: &Surface,
        current: SurfaceRef<'_>,
        rotation: Mat3,
        translation: Vec3,
        i: usize,
    ) -> Option<Match> {
        let point = rotation * Vec3::from_array(current.points.get(i)) + translation;
        let turned = rotation * Vec3::from_array(current.normals.get(i));
        if point.z.is_nan() || point.z <= 0.0 {
            return None;
        }
        let [u, v] = self.camera.project_ray([point.x / point.z, point.y / point.z]).map(|at| (at + 0.5).floor());
        let is_inside = u >= 0.0 && v >= 0.0 && u < self.camera.width as f32 && v < self.camera.height as f32;
        let j = is_inside.then(|| v as usize * self.camera.width + u as usize)?;
        let (plane, normal) = (Vec3::from_array(previous.points.get(j)), Vec3::from_array(previous.normals.get(j)));
        // False for holes.
        let is_match = (plane.z - point.z).abs() < NEAR * point.z && normal.dot(turned) > ALIKE;
        is_match.then(|| {
            let sigma_m = self.sensor.sigma_m(f64::from(point.z)) as f32 * normal.z.abs().max(0.2);
            Match { point, normal, residual_m: (point - plane).dot(normal), sigma_m: sigma_m.max(1e-6 * point.z) }
        })
    }
}

/// Returns the Gauss-Newton step of the matches, to be applied after the current estimate; `None` for fewer than six
/// matches, or if the step is not finite.
fn solve(level: Level, matches: &[Match], scale: f64) -> Option<RigidTransform> {
    if matches.len() < 6 {
        return None;
    }
    // Rotations about the points' centre, multiplied by the points' extent, are comparable with translations.
    let count = matches.len() as f64;
    let centre = matches.iter().map(|found| found.point.as_dvec3()).sum::<DVec3>() / count;
    let extent_m = (matches.iter().map(|found| found.point.as_dvec3().distance_squared(centre)).sum::<f64>() / count)
        .sqrt()
        .max(1e-3);
    // Parts of fixed size, summed in order, make the result independent of the number of threads.
    let parts: Vec<Sums> = matches
        .par_chunks(4096)
        .map(|matches| dispatch!(level, simd => partial_sums(simd, matches, scale, centre, extent_m)))
        .collect();
    let sums = parts.into_iter().fold([0.0; 27], |mut sums, part| {
        sums.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
        sums
    });
    // Row `a` of the upper triangle begins after the `a` longer rows above it.
    let entry = |a: usize, b: usize| sums[a * 6 - a * (a + 1) / 2 + b];
    let information: [[f64; 6]; 6] = std::array::from_fn(|a| std::array::from_fn(|b| entry(a.min(b), a.max(b))));
    let (values, vectors) = symmetric_eigen_of(information);
    let largest = values.iter().copied().fold(0.0, f64::max);
    let mut step = [0.0; 6];
    for (value, vector) in values.iter().zip(&vectors) {
        if *value > LEAST_INFORMATION * largest {
            let along: f64 = vector.iter().zip(&sums[21..]).map(|(a, b)| a * b).sum();
            step.iter_mut().zip(vector).for_each(|(step, direction)| *step -= along / value * direction);
        }
    }
    let [turn_x, turn_y, turn_z, x, y, z] = step;
    let turn = DVec3::new(turn_x, turn_y, turn_z) / extent_m;
    let rotation = DMat3::from_quat(glam::DQuat::from_scaled_axis(turn));
    let translation = DVec3::new(x, y, z) + centre - rotation * centre;
    let is_finite = rotation.is_finite() && translation.is_finite();
    is_finite.then_some(RigidTransform { rotation, translation })
}

/// Returns the sums of the normal equations over some matches, with rotations about `centre` multiplied by
/// `extent_m`.
#[inline(always)]
fn partial_sums<S: Simd>(_: S, matches: &[Match], scale: f64, centre: DVec3, extent_m: f64) -> Sums {
    let mut sums = [0.0; 27];
    for found in matches {
        let (normal, residual_m) = (found.normal.as_dvec3(), f64::from(found.residual_m));
        let sigma_m = scale * f64::from(found.sigma_m);
        let ratio = residual_m / (CAUCHY * sigma_m);
        let weight = 1.0 / ((1.0 + ratio * ratio) * (sigma_m * sigma_m));
        let turn = (found.point.as_dvec3() - centre).cross(normal) / extent_m;
        let jacobian = [turn.x, turn.y, turn.z, normal.x, normal.y, normal.z];
        let weighted = jacobian.map(|value| weight * value);
        let mut k = 0;
        for (row, weighted) in weighted.into_iter().enumerate() {
            for value in &jacobian[row..] {
                sums[k] += weighted * value;
                k += 1;
            }
            sums[21 + row] += weighted * residual_m;
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the surface of planes, each a normal and a distance, as seen by a camera.
    fn surface(camera: &Camera, world_from_camera: &RigidTransform, planes: &[(DVec3, f64)]) -> Surface {
        let pixel = |i: usize| {
            let (u, v) = ((i % camera.width) as f64, (i / camera.width) as f64);
            let ray = DVec3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
            let (from, towards) = (world_from_camera.translation, world_from_camera.rotation * ray);
            let hit = |(normal, distance): &(DVec3, f64)| {
                let t = (distance - normal.dot(from)) / normal.dot(towards);
                (t > 0.0).then_some((t, *normal))
            };
            let (t, normal) = planes.iter().filter_map(hit).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
            let normal = world_from_camera.rotation.transpose() * normal;
            let facing = if normal.dot(ray) > 0.0 { -normal } else { normal };
            ((t * ray).as_vec3().to_array(), facing.as_vec3().to_array())
        };
        let (points, normals): (Vec<_>, Vec<_>) = (0..camera.width * camera.height).map(pixel).unzip();
        Surface { points: points.into_iter().collect(), normals: normals.into_iter().collect() }
    }

    fn moved() -> RigidTransform {
        let rotation = DMat3::from_rotation_y(0.012) * DMat3::from_rotation_x(-0.007);
        RigidTransform { rotation, translation: DVec3::new(0.012, -0.006, 0.009) }
    }

    const CORNER: [(DVec3, f64); 3] =
        [(DVec3::new(0.6, 0.0, 0.8), 2.0), (DVec3::new(-0.8, 0.0, 0.6), 2.0), (DVec3::new(0.0, 1.0, 0.0), 0.7)];

    #[test]
    fn a_corner_shows_the_whole_motion() {
        let camera = Camera::new((320, 240), [262.0; 2], [159.5, 119.5]);
        let previous = surface(&camera, &RigidTransform::IDENTITY, &CORNER);
        let current = surface(&camera, &moved(), &CORNER);
        let mut tracker = Tracker::new(camera, SensorModel::KINECT_V1);
        let found = tracker.track(&previous, current.borrow()).unwrap();
        assert!((found.translation - moved().translation).length() < 1e-4, "{found:?}");
        let turn = found.rotation.transpose() * moved().rotation - DMat3::IDENTITY;
        assert!(turn.to_cols_array().iter().all(|value| value.abs() < 5e-5), "{turn:?}");
    }

    #[test]
    fn along_a_wall_nothing_moves_and_without_matches_nothing_is_certain() {
        let camera = Camera::new((320, 240), [262.0; 2], [159.5, 119.5]);
        let wall = [(DVec3::Z, 1.5)];
        let previous = surface(&camera, &RigidTransform::IDENTITY, &wall);
        let current = surface(&camera, &moved(), &wall);
        let mut tracker = Tracker::new(camera, SensorModel::KINECT_V1);
        let found = tracker.track(&previous, current.borrow()).unwrap();
        // The wall determines one distance and two rotations.
        assert!((found.translation.z - moved().translation.z).abs() < 1e-3, "{found:?}");
        assert!(found.translation.truncate().length() < 0.03, "{found:?}");
        let far = surface(&camera, &RigidTransform::IDENTITY, &[(DVec3::Z, 3.0)]);
        assert_eq!(tracker.track(&previous, far.borrow()), None);
    }
}
