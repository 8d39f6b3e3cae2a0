//! Halos of the parts of a cloud. Together with the surrounding points in its halo, the points of a part get the same
//! results as in the whole cloud.
//!
//! A fixed radius determines the width of the halo. Radii by density are known only after they have been computed,
//! and are too large if neighbours are missing. If too many points of a part reach beyond its halo, the part is
//! computed again with a wider halo.

use rayon::prelude::*;

use crate::constants::PLANE_REACH;
use crate::params::{CloudParams, Edges, EngineParams, Radius};

/// Assumed share of a part's own points among all of its points, including the halo, for planning parts.
pub const OWN_SHARE: f64 = 0.6;
/// Reach of the gate, in radii.
const GATE_REACH: f64 = 1.02;

/// The required width of a halo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NeededHalo {
    /// Width in metres that suffices for all points except the few that reach farthest.
    pub halo_m: f64,
    /// Number of points that reach beyond the current halo.
    pub beyond: usize,
    /// True if too many points reach beyond the current halo, so that it must be widened.
    pub is_wider: bool,
}

/// Returns the distance, in radii, within which other points influence a result. With radii by density it is twice as
/// large, since a radius depends on the neighbours' radii. If edges are kept, the planes of points up to two radii
/// away count too.
pub(crate) fn reach(params: &EngineParams) -> f64 {
    let growth = if params.radius.density().is_some() { 2.0 } else { 1.0 };
    let of_planes = if params.edges == Edges::Off { 0.0 } else { growth * f64::from(PLANE_REACH) };
    GATE_REACH * (growth + of_planes)
}

/// Returns the initial halo width, in metres, of a part with `points` points spread over an area: exact for a fixed
/// radius, otherwise about twice the reach at that density.
pub(crate) fn first_halo_m(params: &EngineParams, points: u64, area_m2: f64) -> f64 {
    match params.radius {
        Radius::Fixed { radius_m } => reach(params) * f64::from(radius_m),
        Radius::Neighbours { count } | Radius::SensorAndDensity { count } => {
            let radius_m = (f64::from(count) * area_m2 / (std::f64::consts::PI * points.max(1) as f64)).sqrt();
            2.0 * reach(params) * radius_m
        }
        // Unorganized clouds never have this radius.
        Radius::Sensor => 1.0,
    }
}

/// Returns the distance, in radii, within which other points influence a result, for the parameters of a cloud.
pub fn cloud_reach(params: &CloudParams) -> f64 {
    reach(&(*params).into())
}

/// Returns the initial halo width, in metres, of a part of a cloud with the given parameters.
pub fn first_cloud_halo_m(params: &CloudParams, points: u64, area_m2: f64) -> f64 {
    first_halo_m(&(*params).into(), points, area_m2)
}

/// Returns the halo that a part needs, given the width that each of its points needs. Up to `may_reach_beyond` points
/// may reach beyond the halo.
pub fn needed_halo(halo_m: f64, needed_m: &[f64], may_reach_beyond: f64) -> NeededHalo {
    let beyond = needed_m.par_iter().filter(|needed_m| **needed_m > halo_m).count();
    let above = |least_m: f64| -> Vec<f64> {
        needed_m.par_iter().copied().filter(|needed_m| needed_m.is_finite() && *needed_m > least_m).collect()
    };
    // Most points are far from the border and need no halo; they are not counted.
    let may_be_farther = (may_reach_beyond / 2.0) as usize;
    let mut farthest_m = above(0.0);
    if farthest_m.len() <= may_be_farther {
        farthest_m = above(f64::NEG_INFINITY);
    }
    if farthest_m.is_empty() {
        return NeededHalo { halo_m, beyond, is_wider: false };
    }
    let farthest = farthest_m.len().saturating_sub(1 + may_be_farther);
    let (_, wider_m, _) = farthest_m.select_nth_unstable_by(farthest, f64::total_cmp);
    NeededHalo { halo_m: 1.05 * *wider_m, beyond, is_wider: beyond as f64 > may_reach_beyond }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_halo_is_wider_where_more_than_a_few_points_reach_beyond_it() {
        let params = EngineParams::from(CloudParams::default());
        let needed_m = |far: usize| -> Vec<f64> {
            (0..1000).map(|i| reach(&params) * if i < far { 0.5 } else { 0.1 } - 0.05).collect()
        };
        let needed = needed_halo(0.3, &needed_m(0), 10.0);
        assert_eq!((needed.beyond, needed.is_wider), (0, false));
        assert!((needed.halo_m / (1.05 * (0.204 - 0.05)) - 1.0).abs() < 1e-6, "{needed:?}");
        let few = needed_halo(0.3, &needed_m(10), 10.0);
        assert_eq!((few.beyond, few.is_wider), (10, false));
        let many = needed_halo(0.3, &needed_m(11), 10.0);
        assert!(many.is_wider && (many.halo_m / (1.05 * (1.02 - 0.05)) - 1.0).abs() < 1e-6, "{many:?}");
        assert!(!needed_halo(0.3, &[], 0.0).is_wider);
    }
}
