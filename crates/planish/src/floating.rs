//! Pixels that float between two surfaces, as sensors make them beside steps: an optional stage before the engines.

use crate::cloud::OrganizedCloud;
use crate::frame::DepthFrame;

/// A neighbour supports a pixel if their depths differ by no more than so many deviations of the noise.
const SUPPORT_DEVIATIONS: f32 = 6.0;
/// And by at least this share of the depth, since surfaces slope: 60° at a focal length of 170 pixels, 80° at one of 525.
const SUPPORT_SHARE: f32 = 0.01;
/// A pixel with fewer of its eight neighbours in support floats. A straight edge gives four, a wire two, and its end one.
const MIN_SUPPORT: usize = 2;

/// Which pixels float: fewer than two of their eight neighbours are within six deviations of the noise in depth, or a hundredth of it.
/// `noise_at_1m` is the standard deviation of depth at 1 m in metres; it grows with z².
fn floating(width: usize, z: &[f32], noise_at_1m: f32) -> Vec<bool> {
    let height = z.len() / width;
    let floats = |i: usize| {
        let (u, v) = (i % width, i / width);
        let near = (SUPPORT_DEVIATIONS * noise_at_1m * z[i] * z[i]).max(SUPPORT_SHARE * z[i].abs());
        let mut support = 0;
        for y in v.saturating_sub(1)..(v + 2).min(height) {
            for x in u.saturating_sub(1)..(u + 2).min(width) {
                // A hole is within nothing.
                support += usize::from((z[y * width + x] - z[i]).abs() <= near);
            }
        }
        // It is within its own distance.
        z[i].is_finite() && support < MIN_SUPPORT + 1
    };
    (0..z.len()).map(floats).collect()
}

impl DepthFrame {
    /// Turns pixels that float between two surfaces into holes; says how many.
    pub fn remove_floating(&mut self, noise_at_1m: f32) -> usize {
        let z: Vec<f32> = self.raw.iter().map(|&raw| self.camera.depth_m(raw)).collect();
        let floating = floating(self.camera.width.max(1), &z, noise_at_1m);
        for (raw, _) in self.raw.iter_mut().zip(&floating).filter(|(_, floats)| **floats) {
            *raw = 0;
        }
        floating.into_iter().filter(|&floats| floats).count()
    }
}

impl OrganizedCloud {
    /// Turns pixels that float between two surfaces into holes; says how many.
    pub fn remove_floating(&mut self, noise_at_1m: f32) -> usize {
        let floating = floating(self.width(), &self.positions().z, noise_at_1m);
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
    use crate::cloud::Xyz;

    #[test]
    fn what_floats_goes_and_edges_wires_and_slopes_stay() {
        let camera = Camera { width: 40, height: 30, fx: 525.0, fy: 525.0, cx: 20.0, cy: 15.0, ..Camera::kinect_v1() };
        // A wall at 2 m, a box at 1 m, a wire of one pixel at 1.5 m, a slope to the right.
        let depth = |u: usize, v: usize| match (u, v) {
            (0..12, _) => 1000,
            (20, _) => 1500,
            (30.., _) => 2000 + 15 * (u - 30) as u16,
            _ => 2000,
        };
        let mut raw: Vec<u16> = (0..1200).map(|i| depth(i % 40, i / 40)).collect();
        let clean = DepthFrame { camera, raw: raw.clone(), rgb: None, timestamp_s: None };
        let floating = [12 + 40 * 5, 12 + 40 * 11, 25 + 40 * 20];
        for (k, i) in floating.into_iter().enumerate() {
            raw[i] = 1300 + 150 * k as u16;
        }
        let ends_of_the_wire = [20, 20 + 40 * 29];
        let removed = [&floating[..], &ends_of_the_wire].concat();
        let mut frame = DepthFrame { camera, raw, rgb: None, timestamp_s: None };
        let mut cloud = frame.deproject().unwrap();
        assert_eq!(frame.remove_floating(1.8e-3), 5);
        for (i, (&found, &before)) in frame.raw.iter().zip(&clean.raw).enumerate() {
            assert_eq!(found, if removed.contains(&i) { 0 } else { before }, "pixel {i}");
        }
        assert_eq!(cloud.remove_floating(1.8e-3), 5);
        assert!(removed.iter().all(|&i| !cloud.positions().is_finite(i)));
        let mut holes = OrganizedCloud::from_positions(3, 2, Xyz::filled(6, f32::NAN)).unwrap();
        assert_eq!(holes.remove_floating(1.8e-3), 0);
    }
}
