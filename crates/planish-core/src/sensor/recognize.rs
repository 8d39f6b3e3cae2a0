//! Recognition of a Kinect v1 by the depth steps of an unorganized cloud.

use super::SensorModel;
use super::estimate::median;
use crate::frame::PointsView;

/// Maximum number of points that are examined.
const SAMPLE: usize = 200_000;
/// Minimum number of sampled points with exactly the same depth. Other depths do not count: they are means of several
/// steps, as in a cloud that was thinned to voxels.
const AT_A_LEVEL: usize = 10;
/// Minimum share of the sampled points that are on a level.
const ON_LEVELS: f64 = 0.5;
/// Minimum number of levels.
const LEVELS: usize = 20;
/// Number of the model's depth steps from which a gap between two levels is one between surfaces.
const WIDEST_GAP: f64 = 2.5;
/// Maximum relative difference between the mean or the median depth step and that of the model, for the nearer and for
/// the farther half of the levels. (Rounding to millimetres changes the median of small steps, and a few means of two
/// levels change the mean. Depths that are only rounded have the same step at every range.)
const SIMILAR: f64 = 0.15;
/// Minimum ratio between the median depths of the halves, if the steps may be rounded to millimetres.
const APART: f64 = 1.1;
/// Depth step in metres above which steps are not rounded to millimetres only.
const ABOVE_MILLIMETRES: f64 = 1.5e-3;

impl SensorModel {
    /// Returns the model of a Kinect v1 if the depths of an unorganized cloud are in its steps of 2.85e-3 z²; otherwise
    /// `None`. Thinned clouds are recognized too. Clouds that were merged, or turned by other than right angles, are
    /// not, since their points have no common depths.
    pub fn recognize(cloud: &PointsView<'_>) -> Option<Self> {
        if cloud.len() < LEVELS * AT_A_LEVEL {
            return None;
        }
        let transform = cloud.transform();
        let step = cloud.len().div_ceil(SAMPLE);
        let depths = (0..cloud.len()).step_by(step).map(|i| transform.to_sensor(cloud.point(i)).z.abs());
        let mut depths: Vec<f64> = depths.filter(|depth| *depth > 0.0 && depth.is_finite()).collect();
        depths.sort_unstable_by(f64::total_cmp);
        let runs = depths.chunk_by(|a, b| a == b).filter(|run| run.len() >= AT_A_LEVEL);
        let (levels, counts): (Vec<f64>, Vec<usize>) = runs.map(|run| (run[0], run.len())).unzip();
        let on_levels: usize = counts.iter().sum();
        if levels.len() < LEVELS || (on_levels as f64) < ON_LEVELS * depths.len() as f64 {
            return None;
        }
        let (near, far) = levels.split_at(levels.len() / 2);
        let is_similar = |levels: &[f64]| {
            let steps = levels.windows(2).map(|pair| (pair[1] - pair[0]) / Self::KINECT_V1.step_m(pair[0]));
            let mut steps: Vec<f64> = steps.filter(|step| *step < WIDEST_GAP).collect();
            let mean = steps.iter().sum::<f64>() / steps.len().max(1) as f64;
            !steps.is_empty() && [mean, median(&mut steps)].iter().any(|step| (step - 1.0).abs() < SIMILAR)
        };
        let nearest = near[near.len() / 2];
        let is_apart = far[far.len() / 2] > APART * nearest || Self::KINECT_V1.step_m(nearest) > ABOVE_MILLIMETRES;
        let found = is_apart && is_similar(near) && is_similar(far);
        // Depths are measured from the origin of coordinates.
        (found && cloud.assumed_sensor_m().is_none()).then_some(Self::KINECT_V1)
    }
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
        // Whole millimetres, another unit, another frame, too few points.
        assert_eq!(recognized(&points(DepthNoise::NONE)), None);
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
    }
}
