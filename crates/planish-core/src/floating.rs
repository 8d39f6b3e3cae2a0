//! Pixels that float between two surfaces, a sensor artefact at depth steps: an optional stage before the engines.

use crate::cloud::OrganizedCloud;
use crate::frame::{DepthFrame, PointsView};
use crate::sensor::SensorModel;

/// A neighbour supports a pixel if their depths differ by at most this many standard deviations of the noise.
const SUPPORT_DEVIATIONS: f64 = 6.0;
/// And by at least this share of the depth, since surfaces slope: 60° at a focal length of 170 pixels, 80° at one of
/// 525.
const SUPPORT_SHARE: f64 = 0.01;
/// A pixel supported by fewer of its eight neighbours floats. A straight edge has four, a wire two, and its end one.
const MIN_SUPPORT: usize = 2;

/// Finds floating pixels by their ranges: fewer than two of their eight neighbours are within six deviations of the
/// noise, or a hundredth of the range.
fn floating(width: usize, ranges_m: &[f64], sensor: &SensorModel) -> Vec<bool> {
    let width = width.max(1);
    let height = ranges_m.len() / width;
    let floats = |i: usize| {
        let (u, v) = (i % width, i / width);
        let range_m = ranges_m[i];
        let near_m = (SUPPORT_DEVIATIONS * sensor.sigma_m(range_m)).max(SUPPORT_SHARE * range_m);
        let mut support = 0;
        for y in v.saturating_sub(1)..(v + 2).min(height) {
            for x in u.saturating_sub(1)..(u + 2).min(width) {
                // False for a hole.
                support += usize::from((ranges_m[y * width + x] - range_m).abs() <= near_m);
            }
        }
        // The pixel counts itself.
        range_m.is_finite() && support < MIN_SUPPORT + 1
    };
    (0..ranges_m.len()).map(floats).collect()
}

impl DepthFrame {
    /// Turns pixels that float between two surfaces into holes; returns how many.
    pub fn remove_floating(&mut self, sensor: &SensorModel) -> usize {
        let ranges_m: Vec<f64> = self.raw.iter().map(|&raw| f64::from(self.camera.depth_m(raw))).collect();
        let floating = floating(self.camera.width, &ranges_m, sensor);
        for (raw, _) in self.raw.iter_mut().zip(&floating).filter(|(_, floats)| **floats) {
            *raw = 0;
        }
        floating.into_iter().filter(|&floats| floats).count()
    }
}

impl OrganizedCloud {
    /// Turns pixels that float between two surfaces into holes; returns how many.
    pub fn remove_floating(&mut self, sensor: &SensorModel) -> usize {
        // A malformed cloud is refused by the smoother.
        let Ok(ranges_m) = PointsView::from_organized(self).map(|view| view.ranges_m()) else { return 0 };
        let floating = floating(self.width(), &ranges_m, sensor);
        let mut count = 0;
        for i in (0..floating.len()).filter(|&i| floating[i]) {
            self.points.positions.set(i, [f32::NAN; 3]);
            count += 1;
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::xyz::Xyz;

    #[test]
    fn what_floats_goes_and_edges_wires_and_slopes_stay() {
        let camera = Camera::new((40, 30), [525.0; 2], [20.0, 15.0]);
        // A wall at 2 m, a box at 1 m, a wire of one pixel at 1.5 m, a slope to the right.
        let depth = |u: usize, v: usize| match (u, v) {
            (0..12, _) => 1000,
            (20, _) => 1500,
            (30.., _) => 2000 + 15 * (u - 30) as u16,
            _ => 2000,
        };
        let mut raw: Vec<u16> = (0..1200).map(|i| depth(i % 40, i / 40)).collect();
        let clean = DepthFrame::new(camera, raw.clone()).unwrap();
        let floating = [12 + 40 * 5, 12 + 40 * 11, 25 + 40 * 20];
        for (k, i) in floating.into_iter().enumerate() {
            raw[i] = 1300 + 150 * k as u16;
        }
        let ends_of_the_wire = [20, 20 + 40 * 29];
        let removed = [&floating[..], &ends_of_the_wire].concat();
        let mut frame = DepthFrame::new(camera, raw).unwrap();
        let mut cloud = frame.deproject().unwrap();
        assert_eq!(frame.remove_floating(&SensorModel::KINECT_V1), 5);
        for (i, (&found, &before)) in frame.raw.iter().zip(&clean.raw).enumerate() {
            assert_eq!(found, if removed.contains(&i) { 0 } else { before }, "pixel {i}");
        }
        assert_eq!(cloud.remove_floating(&SensorModel::KINECT_V1), 5);
        assert!(removed.iter().all(|&i| !cloud.positions().is_finite(i)));
        let mut holes = OrganizedCloud::from_positions(3, 2, Xyz::filled(6, f32::NAN)).unwrap();
        assert_eq!(holes.remove_floating(&SensorModel::KINECT_V1), 0);
    }
}
