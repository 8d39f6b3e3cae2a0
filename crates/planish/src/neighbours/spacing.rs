//! The point spacing of a general cloud, and a radius derived from it.

use glam::DVec3;

use super::NeighbourSearch;
use crate::frame::{Frame, IntoFrame};

/// Number of sampled points.
const SAMPLE: usize = 1000;
/// On a surface with even spacing d the 8th neighbour is about 1.4 to 1.6 d away.
const NEIGHBOUR: usize = 8;
/// Times that distance: a disc of some 50 points, as many as a window of 7x7 pixels.
const FACTOR: f64 = 2.5;

/// A radius in metres that gives most points some 50 neighbours: 2.5 times the median distance to the 8th neighbour.
///
/// `None` if there are fewer than 9 finite points, or they coincide, or it is a depth image.
pub fn estimate_radius_m<'a>(cloud: impl IntoFrame<'a>) -> Option<f32> {
    let Ok(Frame::Points(view)) = cloud.into_frame() else { return None };
    let points: Vec<DVec3> = (0..view.len()).map(|i| view.point(i)).filter(|p| p.is_finite()).collect();
    let search = NeighbourSearch::new(&points).ok()?;
    let step = points.len().div_ceil(SAMPLE).max(1);
    let mut distances: Vec<f64> =
        points.iter().step_by(step).filter_map(|&p| search.distance_to_nth(p, NEIGHBOUR)).collect();
    if distances.is_empty() {
        return None;
    }
    let middle = distances.len() / 2;
    let radius_m = (FACTOR * *distances.select_nth_unstable_by(middle, f64::total_cmp).1) as f32;
    (radius_m > 0.0).then_some(radius_m.clamp(1e-6, 1e3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::PointCloud;
    use crate::xyz::Xyz;

    #[test]
    fn a_grid_gets_a_radius_of_a_few_spacings() {
        let grid: Xyz = (0..2500).map(|i| [(i % 50) as f32 * 0.01, (i / 50) as f32 * 0.01, 2.0]).collect();
        let radius_m = estimate_radius_m(&PointCloud::new(grid)).unwrap();
        assert!((0.03..0.045).contains(&radius_m), "{radius_m}");
        assert_eq!(estimate_radius_m(&PointCloud::new(Xyz::filled(100, 1.0))), None);
        assert_eq!(estimate_radius_m(&PointCloud::new(Xyz::filled(100, f32::NAN))), None);
        assert_eq!(estimate_radius_m(&PointCloud::new(Xyz::default())), None);
    }
}
