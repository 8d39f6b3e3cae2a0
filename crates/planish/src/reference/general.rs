//! General clouds: all points within the radius are neighbours, found in a k-d tree (docs/method.md, section 8).

use glam::DVec3;
use rayon::prelude::*;

use super::window::{fading_gate, reach_m};
use super::{PointResult, Surface, smooth_point};
use crate::error::Error;
use crate::frame::FrameGeometry;
use crate::neighbours::NeighbourSearch;
use crate::params::{Radius, SmoothParams};
use crate::threads::Threads;

/// Smooths every point of the cloud; order and number are kept. Displacements and normals are in the sensor's frame.
pub(super) fn smooth(
    params: &SmoothParams,
    threads: &Threads,
    points: &[DVec3],
    geometry: &FrameGeometry,
) -> Result<Vec<PointResult>, Error> {
    // General clouds always have a fixed radius: `Smoother::open` refuses any other.
    let Radius::Fixed { radius_m } = params.radius else { return Ok(vec![PointResult::hole(); points.len()]) };
    let radius_m = f64::from(radius_m);
    // Turned like the sensor, but not moved: it may stand so far away that moved points would lose digits.
    let turn = |p: DVec3| geometry.cloud_from_sensor.map_or(p, |transform| transform.rotation.transpose() * p);
    let sensor = turn(geometry.sensor_position());
    let points: Vec<DVec3> = points.iter().map(|&p| turn(p)).collect();
    let search = NeighbourSearch::new(&points)?;

    let smooth = |neighbours: &mut Vec<usize>, &p: &DVec3| {
        if !p.is_finite() {
            return PointResult::hole();
        }
        search.within(p, reach_m(radius_m), neighbours);
        let offsets = neighbours.iter().map(|&i| points[i] - p);
        let offsets: Vec<DVec3> = offsets.filter(|&offset| fading_gate(offset, radius_m) > 0.0).collect();
        let surface = Surface::own(&offsets, radius_m, p - sensor);
        smooth_point(p, sensor, &offsets, radius_m, params, &surface, false)
    };
    Ok(threads.install(|| points.par_iter().map_init(Vec::new, smooth).collect()))
}
