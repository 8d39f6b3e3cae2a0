//! Recognition of a Kinect v1 by the depth steps of an unorganized cloud.

use super::SensorModel;
use super::estimate::median;
use crate::frame::PointsView;

/// Maximum number of points that are examined.
const SAMPLE: usize = 200_000;
/// Minimum number of sampled points at the same depth. Other depths do not count: they are means of several steps, as
/// in a cloud that was thinned to voxels.
const AT_A_LEVEL: usize = 10;
/// Maximum difference between equal depths in depth steps, for the rounding of coordinates.
const EQUAL: f64 = 0.01;
/// Minimum share of the sampled points that are on a level.
const ON_LEVELS: f64 = 0.5;
/// Minimum number of levels.
const LEVELS: usize = 20;
/// Number of the model's depth steps from which a gap between two levels is one between surfaces.
const WIDEST_GAP: f64 = 2.5;
/// Maximum relative difference between the typical depth step and that of the model, for the nearer and for the farther
/// half of the levels.
const SIMILAR: f64 = 0.15;
/// Maximum distance from the sensor's axis, as a ratio to the depth: slightly more than a Kinect v1 sees.
const VIEW: f64 = 0.65;
/// Minimum share of the sampled points within this view.
const IN_VIEW: f64 = 0.99;

impl SensorModel {
    /// Returns the model of a Kinect v1 if the depths of an unorganized cloud, seen from its pose, are in its steps of
    /// 2.85e-3 z²; otherwise `None`. Thinned clouds are recognized too. Merged clouds are not, and neither are clouds
    /// that were turned or moved away without stating the pose, since their points have no common depths.
    pub fn recognize(cloud: &PointsView<'_>) -> Option<Self> {
        if cloud.len() < LEVELS * AT_A_LEVEL {
            return None;
        }
        let transform = cloud.transform();
        let step = cloud.len().div_ceil(SAMPLE);
        let seen = (0..cloud.len()).step_by(step).map(|i| transform.to_sensor(cloud.point(i)));
        let seen: Vec<_> = seen.filter(|point| point.is_finite() && point.z != 0.0).collect();
        let in_view = seen.iter().filter(|point| point.x.abs().max(point.y.abs()) <= VIEW * point.z.abs()).count();
        if (in_view as f64) < IN_VIEW * seen.len() as f64 {
            return None;
        }
        let mut depths: Vec<f64> = seen.into_iter().map(|point| point.z.abs()).collect();
        depths.sort_unstable_by(f64::total_cmp);
        let runs = depths.chunk_by(|a, b| b - a < EQUAL * Self::KINECT_V1.step_m(*a));
        let of_levels = runs.filter(|run| run.len() >= AT_A_LEVEL).map(|run| (run[run.len() / 2], run.len()));
        let (levels, counts): (Vec<f64>, Vec<usize>) = of_levels.unzip();
        let on_levels: usize = counts.iter().sum();
        if levels.len() < LEVELS || (on_levels as f64) < ON_LEVELS * depths.len() as f64 {
            return None;
        }
        let (near, far) = levels.split_at(levels.len() / 2);
        let (step_near, step_far) = (typical_step(near)?, typical_step(far)?);
        let is_similar = |step: f64| (step - 1.0).abs() < SIMILAR;
        // Depths that were only rounded have the same step at every range, so that the ratio falls with z².
        let grows = step_far * far[far.len() / 2] > step_near * near[near.len() / 2];
        let found = is_similar(step_near) && is_similar(step_far) && grows;
        (found && cloud.assumed_sensor_m().is_none()).then_some(Self::KINECT_V1)
    }
}

/// Returns the mean or the median gap between levels, in steps of a Kinect v1; `None` if no levels are adjacent. It
/// returns the one that is nearer to 1: rounding to millimetres changes the median of small steps, and levels between
/// two steps, from means of their points, change the mean.
fn typical_step(levels: &[f64]) -> Option<f64> {
    let gaps = levels.windows(2).map(|pair| (pair[1] - pair[0]) / SensorModel::KINECT_V1.step_m(pair[0]));
    let mut steps: Vec<f64> = gaps.filter(|gap| *gap < WIDEST_GAP).collect();
    if steps.is_empty() {
        return None;
    }
    let (mean, median) = (steps.iter().sum::<f64>() / steps.len() as f64, median(&mut steps));
    Some(if (mean - 1.0).abs() < (median - 1.0).abs() { mean } else { median })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::pose::SensorPose;
    use crate::testing::{DepthNoise, Scene, simulated};

    #[test]
    fn a_kinect_is_recognized_by_its_steps_also_in_a_thinned_cloud() {
        let points = |noise: DepthNoise| -> Vec<[f32; 3]> {
            let frame = simulated(Scene::room(3), noise, Camera::kinect_v1(), 3).deproject().unwrap();
            frame.positions().iter().filter(|point| point[2].is_finite()).collect()
        };
        let recognized = |points: &[[f32; 3]]| SensorModel::recognize(&PointsView::from_rows(points).unwrap());
        let kinect = points(DepthNoise::default());
        assert_eq!(recognized(&kinect), Some(SensorModel::KINECT_V1));
        let thinned: Vec<_> = kinect.iter().copied().step_by(7).collect();
        assert_eq!(recognized(&thinned), Some(SensorModel::KINECT_V1));
        // Whole millimetres or half centimetres, another unit, another frame, too few points.
        assert_eq!(recognized(&points(DepthNoise::NONE)), None);
        let rounded = points(DepthNoise::NONE).into_iter().map(|[x, y, z]| [x, y, (200.0 * z).round() / 200.0]);
        assert_eq!(recognized(&rounded.collect::<Vec<_>>()), None);
        let aside: Vec<_> = kinect.iter().map(|&[x, y, z]| [x + 5.0, y, z]).collect();
        assert_eq!(recognized(&aside), None);
        let in_feet: Vec<_> = kinect.iter().map(|point| point.map(|value| value / 0.3048)).collect();
        assert_eq!(recognized(&in_feet), None);
        let turned: Vec<_> = kinect.iter().map(|&[x, y, z]| [0.8 * x + 0.6 * z, y, 0.8 * z - 0.6 * x]).collect();
        assert_eq!(recognized(&turned), None);
        assert_eq!(recognized(&kinect[..150]), None);
        // Viewpoints of PCL's Kinect frames, and one far away.
        let seen_from = |viewpoint: [f64; 7]| {
            let view =
                PointsView::from_rows(&kinect).unwrap().with_pose(SensorPose::from_viewpoint(viewpoint)).unwrap();
            SensorModel::recognize(&view)
        };
        assert_eq!(seen_from([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]), Some(SensorModel::KINECT_V1));
        assert_eq!(seen_from([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]), None);
        let about_y = [0.0, 0.0, 0.0, (0.1_f64).sqrt(), 0.0, (0.9_f64).sqrt(), 0.0];
        assert_eq!(seen_from(about_y), None);
        // Turned by the quaternion of the given pose, 0.8 and 0.6 being cosine and sine.
        let pose = SensorPose::from_viewpoint([0.0, 0.0, 0.0, (0.9_f64).sqrt(), 0.0, (0.1_f64).sqrt(), 0.0]);
        let view = PointsView::from_rows(&turned).unwrap().with_pose(pose).unwrap();
        assert_eq!(SensorModel::recognize(&view), Some(SensorModel::KINECT_V1));
    }
}
