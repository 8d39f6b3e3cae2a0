//! The camera and sensor of a video frame, and the ranges of its points.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use crate::camera::Camera;
use crate::error::Error;
use crate::frame::{FrameGeometry, RangeRule};
use crate::outputs::Outputs;
use crate::pose::SensorPose;
use crate::sensor::SensorModel;
use crate::smoothed::Smoothed;
use crate::status::Status;
use crate::temporal::{CameraMotion, Surface, SurfaceRef, TemporalFilter, TemporalParams, Tracker};

/// Number of pixels per task.
const TASK: usize = 1 << 14;

/// The camera, sensor and geometry of a video frame, and the parameters with which it is smoothed over time.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    pub(super) geometry: FrameGeometry,
    pub(super) sensor: SensorModel,
    /// The camera that the frame states, if any.
    pub(super) camera: Option<Camera>,
    /// The requested outputs.
    pub(super) outputs: Outputs,
    pub(super) shape: (usize, usize),
    /// Parameters of smoothing over time.
    pub(super) params: TemporalParams,
    /// Number of the video that the frame belongs to.
    pub(super) video: u64,
    /// The camera's pose in the world (world_from_camera), if known.
    pub(super) pose: Option<SensorPose>,
    /// Whether the frame itself states the pose.
    pub(super) is_pose_of_file: bool,
    /// Whether the motion of the camera is estimated if its pose is not known.
    pub(super) is_tracked: bool,
}

/// A pose, and whether the frame itself states it.
pub(super) type StatedPose = Option<(SensorPose, bool)>;

impl Sight {
    /// Returns true if the frame of `sight` belongs to the video that the frame of `self` begins. `knows_camera`
    /// states whether the camera of that video is known.
    pub(super) fn goes_on_with(&self, sight: &Self, knows_camera: bool) -> bool {
        let has_transform = |sight: &Self| sight.geometry.cloud_from_sensor.is_some();
        // A sensor that moves is followed if its motion can be compensated.
        let is_followed = knows_camera && self.pose.is_some() && sight.pose.is_some();
        let is_same_place = self.geometry.cloud_from_sensor == sight.geometry.cloud_from_sensor
            || (is_followed && has_transform(self) == has_transform(sight));
        let is_same_camera = self.shape == sight.shape && self.camera == sight.camera && self.sensor == sight.sensor;
        self.video == sight.video && self.params == sight.params && is_same_camera && is_same_place
    }

    /// Returns the motion of the camera since the previous frame, if the poses of both frames are known, and stores
    /// this frame's pose in `last`.
    pub(super) fn motion_since(
        &self,
        last: &mut StatedPose,
        camera: Option<&Camera>,
    ) -> Result<Option<CameraMotion>, Error> {
        let last = std::mem::replace(last, self.pose.map(|pose| (pose, self.is_pose_of_file)));
        let (Some((previous, was_of_file)), Some(current), Some(camera)) = (last, self.pose, camera) else {
            return Ok(None);
        };
        // Poses from the caller and from files may refer to different worlds. Many writers store the same pose with
        // every frame, wherever the camera is.
        let is_known = was_of_file == self.is_pose_of_file && !(self.is_pose_of_file && previous == current);
        Ok(if is_known { Some(CameraMotion::between(*camera, &previous, &current)?) } else { None })
    }

    /// Returns the camera without distortion whose pixels the points are on; `None` if no such camera fits.
    pub(super) fn camera_of(&self, smoothed: &Smoothed) -> Option<Camera> {
        let mut surface = Surface::default();
        self.keep(smoothed, &mut surface);
        Camera::of_points((smoothed.width, smoothed.height), &surface.points)
    }

    /// Estimates the motion of the camera since the previous frame; `None` for the first frame, or if the estimate
    /// fails.
    pub(super) fn track(
        &self,
        tracker: &mut Tracker,
        previous: &mut Surface,
        smoothed: &Smoothed,
    ) -> Option<CameraMotion> {
        if previous.points.is_empty() {
            return None;
        }
        let mut moved = Surface::default();
        let current = match (&self.geometry.cloud_from_sensor, &smoothed.normals) {
            (None, Some(normals)) => SurfaceRef { points: &smoothed.points, normals },
            _ => {
                self.keep(smoothed, &mut moved);
                moved.borrow()
            }
        };
        let motion = tracker.track(previous, current)?;
        let previous_from_current = SensorPose::from_transform(&motion);
        Some(CameraMotion { camera: tracker.camera(), previous_from_current })
    }

    /// Copies points and normals to `surface`, transformed into the sensor's frame.
    pub(super) fn keep(&self, smoothed: &Smoothed, surface: &mut Surface) {
        surface.points.clone_from(&smoothed.points);
        match &smoothed.normals {
            Some(normals) => surface.normals.clone_from(normals),
            None => surface.normals = crate::xyz::Xyz::default(),
        }
        if let Some(transform) = &self.geometry.cloud_from_sensor {
            let to_sensor = |point: [f32; 3]| transform.to_sensor(glam::Vec3::from_array(point).as_dvec3());
            let turned = |normal: [f32; 3]| transform.rotation.transpose() * glam::Vec3::from_array(normal).as_dvec3();
            surface.points = surface.points.iter().map(|point| to_sensor(point).as_vec3().to_array()).collect();
            surface.normals = surface.normals.iter().map(|normal| turned(normal).as_vec3().to_array()).collect();
        }
    }

    /// Measures the ranges of all points; leaves `ranges_m` empty if ranges are the magnitudes of z.
    pub(super) fn measure(&self, smoothed: &Smoothed, ranges_m: &mut Vec<f32>) {
        if self.geometry.cloud_from_sensor.is_none() && matches!(self.geometry.rule, RangeRule::Depth { .. }) {
            ranges_m.clear();
            return;
        }
        ranges_m.resize(smoothed.points.len(), 0.0);
        ranges_m.par_chunks_mut(TASK).enumerate().for_each(|(task, ranges_m)| {
            for (k, range_m) in ranges_m.iter_mut().enumerate() {
                let point = glam::Vec3::from_array(smoothed.points.get(TASK * task + k)).as_dvec3();
                let seen = self.geometry.cloud_from_sensor.map_or(point, |transform| transform.to_sensor(point));
                *range_m = self.geometry.range_m(seen) as f32;
            }
        });
    }

    /// Moves every point along its ray, from its range in the single frame to the filter's range over time.
    pub(super) fn apply(&self, filter: &mut TemporalFilter, ranges_m: &[f32], smoothed: &mut Smoothed) {
        let (width, level) = (smoothed.width, filter.level());
        let sensor = self.geometry.sensor_position().as_vec3().to_array();
        let (over_time_m, carried) = filter.rows_mut();
        let statuses = smoothed.status.as_deref_mut().unwrap_or_default().par_chunks_mut(width);
        let [x, y, z] = smoothed.points.as_mut_slices();
        let points = x.par_chunks_mut(width).zip(y.par_chunks_mut(width)).zip(z.par_chunks_mut(width));
        points.zip(statuses).zip(over_time_m).enumerate().for_each(|(v, (((xy, z), statuses), ratios))| {
            let ratios = &mut ratios[..width];
            let single_m = ranges_m.get(v * width..(v + 1) * width);
            // Compiled for each instruction set.
            dispatch!(level, _simd => set_ratios(ratios, single_m, z));
            for u in carried.columns(v) {
                match statuses[u].has_normal() {
                    true => statuses[u] = Status::Carried,
                    // The status `Carried` implies a normal, so a point without one stays as measured.
                    false => ratios[u] = 1.0,
                }
            }
            let points = [xy.0, xy.1, z];
            dispatch!(level, _simd => scale(ratios, points, sensor));
        });
        let Some(depth_m) = &mut smoothed.depth_m else { return };
        let (ratios, _) = filter.rows_mut();
        depth_m.par_chunks_mut(width).zip(ratios).for_each(|(depth_m, ratios)| {
            dispatch!(level, _simd => scale(&ratios[..width], [depth_m, &mut [], &mut []], [0.0; 3]));
        });
    }

    /// Adds the outputs derived from others: raw depth, and the number of frames that each point averages.
    pub(super) fn finish(&self, smoothed: &mut Smoothed, filter: Option<&TemporalFilter>) {
        if let (true, Some(camera), Some(depth_m)) = (self.outputs.depth, &self.camera, &smoothed.depth_m) {
            let raw = smoothed.depth.get_or_insert_default();
            raw.resize(depth_m.len(), 0);
            raw.par_chunks_mut(TASK).zip(depth_m.par_chunks(TASK)).for_each(|(raw, depth_m)| {
                dispatch!(Level::new(), _simd => to_raw(camera, depth_m, raw));
            });
        }
        if let (true, Some(statuses)) = (self.outputs.frames, &smoothed.status) {
            let frames = smoothed.frames.get_or_insert_default();
            frames.resize(statuses.len(), 0.0);
            frames.par_chunks_mut(TASK).zip(statuses.par_chunks(TASK)).enumerate().for_each(
                |(task, (frames, statuses))| {
                    for (k, (frames, status)) in frames.iter_mut().zip(statuses).enumerate() {
                        // If the filter carried over a point without a normal, the result has only the frame's own
                        // value.
                        let of_filter =
                            filter.filter(|filter| status.has_normal() || !filter.is_carried(TASK * task + k));
                        let averaged = of_filter.map_or(1.0, |filter| filter.frames(TASK * task + k).max(1.0));
                        *frames = if status.has_point() { averaged } else { 0.0 };
                    }
                },
            );
        }
    }
}

/// Replaces each range over time by its ratio to the range in the single frame: `single_m`, or the magnitude of `z`.
/// Holes get a ratio of 1, and so stay holes.
#[inline(always)]
fn set_ratios(over_time_m: &mut [f32], single_m: Option<&[f32]>, z: &[f32]) {
    let set = |ratio: &mut f32, single_m: f32| {
        *ratio /= single_m;
        *ratio = if ratio.is_finite() { *ratio } else { 1.0 };
    };
    match single_m {
        Some(single_m) => over_time_m.iter_mut().zip(single_m).for_each(|(ratio, &single_m)| set(ratio, single_m)),
        None => over_time_m.iter_mut().zip(z).for_each(|(ratio, z)| set(ratio, z.abs())),
    }
}

#[inline(always)]
fn to_raw(camera: &Camera, depth_m: &[f32], raw: &mut [u16]) {
    raw.iter_mut().zip(depth_m).for_each(|(raw, depth_m)| *raw = camera.raw_depth(*depth_m));
}

/// Multiplies the distance of each point from the sensor by its ratio.
#[inline(always)]
fn scale(ratios: &[f32], points: [&mut [f32]; 3], sensor: [f32; 3]) {
    for (values, sensor) in points.into_iter().zip(sensor) {
        if sensor == 0.0 {
            values.iter_mut().zip(ratios).for_each(|(value, ratio)| *value *= ratio);
        } else {
            values.iter_mut().zip(ratios).for_each(|(value, ratio)| *value = sensor + (*value - sensor) * ratio);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xyz::Xyz;

    /// Smooths six frames of 8x8 pixels at 2 m, the last with another range at one pixel, and returns the last
    /// result.
    fn last_of_video(status: Status, last_m: f32) -> Smoothed {
        let geometry = FrameGeometry { cloud_from_sensor: None, rule: RangeRule::Depth { pitch_at_1m: None } };
        let outputs = Outputs::POINTS;
        let sight = Sight {
            shape: (8, 8),
            params: TemporalParams::STEADY,
            geometry,
            sensor: SensorModel::KINECT_V1,
            camera: None,
            outputs,
            video: 0,
            pose: None,
            is_pose_of_file: false,
            is_tracked: false,
        };
        let mut filter = TemporalFilter::new(TemporalParams::STEADY, SensorModel::KINECT_V1).unwrap();
        let mut last = Smoothed::default();
        for t in 0..6 {
            let range_m = |i: usize| if t == 5 && i == 27 { last_m } else { 2.0 };
            let points: Xyz = (0..64).map(|i| [0.1 * range_m(i), -0.2 * range_m(i), range_m(i)]).collect();
            last = Smoothed { width: 8, height: 8, points, status: Some(vec![status; 64]), ..Smoothed::default() };
            let z = last.points.z();
            filter.smooth_rows(None, (8, 8), |v, row| row.copy_from_slice(&z[8 * v..8 * v + 8])).unwrap();
            sight.apply(&mut filter, &[], &mut last);
        }
        last
    }

    #[test]
    fn a_value_that_was_carried_over_says_so() {
        let last = last_of_video(Status::Polynomial2, 1.5);
        let status = last.status.as_ref().unwrap();
        assert_eq!((status[27], status[26]), (Status::Carried, Status::Polynomial2));
        assert!(last.points.get(27).iter().zip([0.2, -0.4, 2.0]).all(|(a, b)| (a - b).abs() < 1e-6));
        // The status cannot express both, so the point is not carried over.
        let last = last_of_video(Status::Degenerate, 1.5);
        assert_eq!(last.status.as_ref().unwrap()[27], Status::Degenerate);
        assert_eq!(last.points.get(27)[2], 1.5);
        // A hole stays a hole.
        let last = last_of_video(Status::Hole, f32::NAN);
        assert!(last.points.get(27)[2].is_nan() && last.status.as_ref().unwrap()[27] == Status::Hole);
    }
}
