//! General clouds: all points within the radius are neighbours, found in a k-d tree (docs/method.md, section 8).

use glam::DVec3;
use rayon::prelude::*;

use super::{PointResult, smooth_point, store};
use crate::cloud::PointCloud;
use crate::error::Error;
use crate::params::SmoothParams;
use crate::smoothed::{Outputs, Smoothed};
use crate::threads::Threads;
use crate::unorganized::NeighbourSearch;

/// Smooths every point of the cloud; order and number are kept.
pub(crate) fn smooth_general(
    cloud: &PointCloud,
    params: SmoothParams,
    radius_m: f32,
    outputs: Outputs,
    threads: Option<usize>,
    out: &mut Smoothed,
) -> Result<(), Error> {
    let radius_m = f64::from(radius_m);
    let sensor = DVec3::from_array(std::array::from_fn(|axis| cloud.viewpoint[axis] - cloud.origin_m[axis]));
    let points: Vec<DVec3> = cloud.positions.iter().map(|p| DVec3::from_array(p.map(f64::from))).collect();
    let search = NeighbourSearch::new(&points)?;

    let smooth = |neighbours: &mut Vec<usize>, &p: &DVec3| {
        if !p.is_finite() {
            return PointResult::hole();
        }
        search.within(p, radius_m, neighbours);
        let offsets: Vec<DVec3> = neighbours.iter().map(|&i| points[i] - p).collect();
        smooth_point(p, sensor, &offsets, radius_m, &params)
    };
    let results: Vec<_> = Threads::open(threads)?.install(|| points.par_iter().map_init(Vec::new, smooth).collect());
    out.prepare(points.len(), 1, outputs);
    store(results.into_iter(), out);
    Ok(())
}
