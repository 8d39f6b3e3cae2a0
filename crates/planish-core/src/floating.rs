//! Removes pixels that float between two surfaces, a sensor artefact at depth steps. This optional step runs before
//! the engines.

use rayon::prelude::*;

use crate::cloud::OrganizedCloud;
use crate::frame::{DepthFrame, PointsView};
use crate::sensor::SensorModel;

/// Maximum range difference between a pixel and a neighbour that supports it, in standard deviations of the noise.
const SUPPORT_DEVIATIONS: f64 = 6.0;
/// Range difference up to which a neighbour always supports a pixel, as a share of the range. It allows for surface
/// slopes of up to 69° at a focal length of 170 pixels, and 83° at 525 pixels.
const SUPPORT_SHARE: f64 = 0.015;
/// Number of supporting neighbours, of eight, below which a pixel may float. A pixel on a straight edge has four, one
/// on a wire has two, and one at the end of a wire has one.
const MIN_SUPPORT: u8 = 2;
/// Number of supporting neighbours from which a pixel is part of a surface.
const SURFACE_SUPPORT: u8 = 3;
/// Maximum distance in pixels between a floating pixel and each of the two surfaces.
const NEAR_PX: usize = 2;
/// Maximum distance in pixels between a floating pixel and one of the two surfaces if the pixel is next to [`HOLES`]
/// or more holes, which often separate surfaces.
const BEHIND_HOLES_PX: usize = 12;
/// Minimum number of adjacent holes for which a surface may be [`BEHIND_HOLES_PX`] away.
const HOLES: usize = 2;
/// Distance in pixels within which a surface at the same range shows that a single pixel is on a frayed edge. Without
/// such a surface, the pixel is a speck, even if it is not between two surfaces.
const SPECK_PX: usize = 4;
/// Maximum number of holes adjacent to a speck.
const SPECK_HOLES: usize = 3;

/// Finds floating pixels by their ranges: fewer than two of their eight neighbours support them, and they are either
/// between a nearer and a farther surface, or specks.
fn floating(width: usize, ranges_m: &[f64], sensor: &SensorModel) -> Vec<bool> {
    let width = width.max(1);
    let image = Image { width, height: ranges_m.len() / width, ranges_m, sensor };
    let pixels = 0..width * image.height;
    let support: Vec<u8> = pixels.clone().into_par_iter().with_min_len(width).map(|i| image.support(i)).collect();
    pixels.into_par_iter().with_min_len(width).map(|i| image.floats(i, &support)).collect()
}

struct Image<'a> {
    width: usize,
    height: usize,
    ranges_m: &'a [f64],
    sensor: &'a SensorModel,
}

impl Image<'_> {
    /// Returns the largest difference in metres at which two ranges count as the same surface.
    fn same_m(&self, range_m: f64) -> f64 {
        (SUPPORT_DEVIATIONS * self.sensor.sigma_m(range_m)).max(SUPPORT_SHARE * range_m)
    }

    /// Returns the pixels that are at most `distance_px` rows and columns away from pixel `i`, including `i` itself.
    fn around(&self, i: usize, distance_px: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, (u, v)) = (self.width, (i % self.width, i / self.width));
        let columns = u.saturating_sub(distance_px)..(u + distance_px + 1).min(width);
        let rows = v.saturating_sub(distance_px)..(v + distance_px + 1).min(self.height);
        rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
    }

    /// Returns the number of neighbours that support a pixel; 0 for a hole.
    fn support(&self, i: usize) -> u8 {
        let range_m = self.ranges_m[i];
        let same_m = self.same_m(range_m);
        // False for holes. The pixel counts itself.
        let supports = |j: &usize| (self.ranges_m[*j] - range_m).abs() <= same_m;
        (self.around(i, 1).filter(supports).count() as u8).saturating_sub(1)
    }

    fn floats(&self, i: usize, support: &[u8]) -> bool {
        let range_m = self.ranges_m[i];
        if !range_m.is_finite() || support[i] >= MIN_SUPPORT {
            return false;
        }
        let same_m = self.same_m(range_m);
        let surfaces = |distance_px: usize| {
            self.around(i, distance_px).filter(|&j| support[j] >= SURFACE_SUPPORT).map(|j| self.ranges_m[j])
        };
        // Whether there is a surface nearer than the pixel, and one farther away.
        let sides = |distance_px: usize| {
            surfaces(distance_px).fold([false; 2], |[nearer, farther], other_m| {
                [nearer || other_m < range_m - same_m, farther || other_m > range_m + same_m]
            })
        };
        let holes = self.around(i, 1).filter(|&j| !self.ranges_m[j].is_finite()).count();
        let (near, is_beside_holes) = (sides(NEAR_PX), holes >= HOLES);
        let is_between = match near {
            [true, true] => true,
            [false, false] => false,
            // One surface is near; the other may be beyond the holes.
            _ => is_beside_holes && sides(BEHIND_HOLES_PX) == [true, true],
        };
        let is_speck = || {
            let is_same = |other_m: f64| (other_m - range_m).abs() <= same_m;
            support[i] == 0 && holes <= SPECK_HOLES && !surfaces(SPECK_PX).any(is_same)
        };
        is_between || is_speck()
    }
}

impl DepthFrame {
    /// Turns floating pixels into holes and returns their number.
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
    /// Turns floating pixels into holes and returns their number.
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
        let mut frame = DepthFrame::new(camera, raw).unwrap();
        let mut cloud = frame.deproject().unwrap();
        assert_eq!(frame.remove_floating(&SensorModel::KINECT_V1), 3);
        for (i, (&found, &before)) in frame.raw.iter().zip(&clean.raw).enumerate() {
            assert_eq!(found, if floating.contains(&i) { 0 } else { before }, "pixel {i}");
        }
        assert_eq!(cloud.remove_floating(&SensorModel::KINECT_V1), 3);
        assert!(floating.iter().all(|&i| !cloud.positions().is_finite(i)));
        let mut holes = OrganizedCloud::from_positions(3, 2, Xyz::filled(6, f32::NAN)).unwrap();
        assert_eq!(holes.remove_floating(&SensorModel::KINECT_V1), 0);
    }

    #[test]
    fn beside_a_shadow_the_far_surface_may_be_beyond_the_holes() {
        let camera = Camera::new((40, 30), [525.0; 2], [20.0, 15.0]);
        // A box, a column that floats, a shadow, and a wall.
        let row = |u: usize| match u {
            0..15 => 1000,
            15 => 1300,
            16..24 => 0,
            _ => 2000,
        };
        let mut raw: Vec<u16> = (0..1200).map(|i| row(i % 40)).collect();
        // The depths differ, since equal depths would be a surface.
        (0..30).for_each(|v| raw[15 + 40 * v] += 80 * (v as u16 % 7));
        let mut frame = DepthFrame::new(camera, raw).unwrap();
        assert!(frame.remove_floating(&SensorModel::KINECT_V1) >= 28);
        assert!((0..30).all(|v| frame.raw[14 + 40 * v] == 1000 && frame.raw[24 + 40 * v] == 2000));
    }

    #[test]
    fn poles_and_wires_survive_the_noise_of_every_sensor() {
        let camera = Camera::new((160, 120), [525.0; 2], [79.5, 59.5]);
        for (name, sensor) in SensorModel::NAMED {
            for (width_px, range_m) in [(2, 0.8), (2, 2.5), (3, 1.5), (4, 3.5)] {
                let mut state = 1u32;
                // About normal: the sum of four uniform values.
                let mut normal = || {
                    let mut uniform = || {
                        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                        f64::from(state) / f64::from(u32::MAX) - 0.5
                    };
                    (0..4).map(|_| uniform()).sum::<f64>() * 3.0f64.sqrt()
                };
                // A vertical, a horizontal and a diagonal pole before a wall 1 m behind.
                let is_pole = |u: usize, v: usize| {
                    (40..40 + width_px).contains(&u)
                        || (20..20 + width_px).contains(&v)
                        || (u + v).abs_diff(150) < width_px
                };
                let depth = |i: usize| {
                    let true_m = if is_pole(i % 160, i / 160) { range_m } else { range_m + 1.0 };
                    camera.raw_depth((true_m + sensor.sigma_m(true_m) * normal()) as f32)
                };
                let mut frame = DepthFrame::new(camera, (0..160 * 120).map(depth).collect()).unwrap();
                frame.remove_floating(&sensor);
                let pole: Vec<usize> = (0..160 * 120).filter(|i| is_pole(i % 160, i / 160)).collect();
                let lost = pole.iter().filter(|&&i| frame.raw[i] == 0).count();
                assert!(lost * 200 <= pole.len(), "{name}, {width_px} px at {range_m} m: {lost} of {}", pole.len());
            }
        }
    }
}
