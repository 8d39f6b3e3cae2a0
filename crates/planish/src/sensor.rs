//! What can be seen of a sensor in a frame of it.

use crate::cloud::OrganizedCloud;
use crate::params::Sensor;

/// Pixels between the three depths of a second difference: far enough that noise is hardly correlated, near enough that most
/// surfaces are straight.
const LAG_PX: usize = 4;
/// For independent normal noise the median of the absolute second difference is this many deviations: 0.6745 sqrt(6).
const MEDIAN_DEVIATIONS: f64 = 1.652;
/// A Kinect's noise in units of its depth step; a sensor's step is taken as at least this much of its noise, since the radius
/// must reach over it.
const NOISE_IN_STEPS: f64 = 0.63;
/// Fewer second differences than this say nothing.
const MIN_SAMPLES: usize = 1000;

impl Sensor {
    /// Estimates the sensor from a frame: its step from the gaps between the depths that occur, its noise from how much depths
    /// in a row differ from a straight line. `None` where too little is seen.
    ///
    /// Both are medians over the frame: a scene of nothing but leaves is taken for noise.
    pub fn estimate(cloud: &OrganizedCloud) -> Option<Self> {
        let z = &cloud.positions().z;
        let mut bends: Vec<f64> = Vec::new();
        for row in z.chunks_exact(cloud.width()) {
            for u in LAG_PX..row.len().saturating_sub(LAG_PX) {
                let [before, at, behind] = [row[u - LAG_PX], row[u], row[u + LAG_PX]].map(f64::from);
                let bend = (before - 2.0 * at + behind).abs() / (at * at);
                if bend.is_finite() {
                    bends.push(bend);
                }
            }
        }
        if bends.len() < MIN_SAMPLES {
            return None;
        }
        let noise = median(&mut bends) / MEDIAN_DEVIATIONS;

        let mut depths: Vec<f32> = z.iter().copied().filter(|z| z.is_finite() && *z > 0.0).collect();
        depths.sort_by(f32::total_cmp);
        depths.dedup();
        let gap = |pair: &[f32]| f64::from(pair[1] - pair[0]) / f64::from(pair[1] * pair[1]);
        let mut gaps: Vec<f64> = depths.windows(2).map(gap).collect();
        let step = if gaps.is_empty() { 0.0 } else { median(&mut gaps) };
        // Rounding to the step is noise too.
        let noise = noise.max(step / 12f64.sqrt());
        // A frame of one wall at one depth has no gap to speak of, and one of noise has few depths: bounds keep either usable.
        let noise = noise.min(0.1);
        Some(Self { depth_step_at_1m: step.max(noise / NOISE_IN_STEPS).min(0.2) as f32, noise_at_1m: noise as f32 })
    }
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::simulate::{KinectNoise, KinectSimulator, Scene};

    fn estimate(noise: KinectNoise, seed: u64) -> Sensor {
        let camera = Camera::kinect_v1();
        let (scene, pose) = Scene::room(seed);
        let truth = scene.render(&camera, &pose);
        let frame = KinectSimulator::new(noise, camera, seed).frame(&truth, 0).unwrap();
        Sensor::estimate(&frame.deproject().unwrap()).unwrap()
    }

    #[test]
    fn a_simulated_kinect_is_found_to_be_one_and_a_perfect_camera_to_be_perfect() {
        for seed in 1..4 {
            let Sensor { depth_step_at_1m, noise_at_1m } = estimate(KinectNoise::default(), seed);
            let kinect = Sensor::KINECT_V1;
            assert!((0.7..1.5).contains(&(depth_step_at_1m / kinect.depth_step_at_1m)), "{depth_step_at_1m}");
            assert!((0.6..1.4).contains(&(noise_at_1m / kinect.noise_at_1m)), "{noise_at_1m}");
            let perfect = estimate(KinectNoise::NONE, seed);
            assert!(perfect.noise_at_1m < 1.5e-4, "{perfect:?}");
        }
        let nothing = OrganizedCloud::from_positions(4, 4, crate::Xyz::filled(16, f32::NAN)).unwrap();
        assert_eq!(Sensor::estimate(&nothing), None);
    }
}
