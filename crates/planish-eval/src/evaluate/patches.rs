//! A metric for unorganized clouds without ground truth: the flatness of the surface in patches.

use glam::{DMat3, DVec3};
use serde::Serialize;

use super::geometry::{angle_deg, plane};
use planish_core::{
    Error, PointCloud, Xyz,
    internal::{NeighbourSearch, symmetric_eigen},
};

/// Number of points per patch.
const PATCH_POINTS: usize = 64;
/// Maximum number of patches.
const MOST_PATCHES: usize = 10_000;
/// Maximum variance of a patch along its normal, as a share of its total variance. Above it, the points are not on a
/// surface, or on several surfaces.
const LARGEST_VARIATION: f64 = 0.1;
/// Minimum ratio between the second largest and the largest variance of a patch. Below it, the points are on a line,
/// such as a scan line, whose normal is arbitrary.
const LEAST_WIDTH: f64 = 0.01;

/// Scores of planes fitted to patches of 64 points.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct PatchReport {
    /// Number of patches whose points are on one surface.
    pub patches: usize,
    /// Median over the patches of the RMS distance of a patch's points from its plane, in millimetres.
    pub rms_mm: f64,
    /// Mean over the patches of the mean angle between the points' normals and the normal of the patch's plane,
    /// ignoring signs, in degrees; NaN without normals.
    pub normal_deg: f64,
}

/// Fits planes to patches of 64 points. A patch is a seed with its nearest points; the seeds are spread evenly over
/// the file. The `measured` positions determine which points form a patch and whether they are on one surface, so
/// every method is scored on the same patches. A patch is skipped for a method that returns fewer than 12 of its
/// points. `points` and `normals` correspond to `measured` one to one.
///
/// # Errors
/// [`EngineError::Unavailable`](planish_core::EngineError::Unavailable) for more points than the search supports.
pub fn patch_planes(measured: &PointCloud, points: &Xyz, normals: Option<&Xyz>) -> Result<PatchReport, Error> {
    let all: Vec<DVec3> = (0..measured.len()).map(|i| measured.positions.vector(i)).collect();
    let search = NeighbourSearch::new(&all)?;
    let step = all.len().div_ceil(MOST_PATCHES).max(PATCH_POINTS / 4);
    let (mut rms_m, mut angles_deg) = (Vec::new(), Vec::new());
    for i in (0..all.len()).step_by(step).filter(|&i| all[i].is_finite()) {
        let patch = search.nearest(all[i], PATCH_POINTS);
        if !lies_on_one_surface(&patch.iter().map(|&i| all[i]).collect::<Vec<_>>()) {
            continue;
        }
        let there = || patch.iter().copied().filter(|&i| points.is_finite(i));
        let Some((normal, _, rms)) = plane(there().map(|i| points.vector(i)).collect()) else { continue };
        rms_m.push(rms);
        let of_normals: Vec<f64> = normals.map_or_else(Vec::new, |normals| {
            let either_way = |deg: f64| deg.min(180.0 - deg);
            there()
                .filter(|&i| normals.is_finite(i))
                .map(|i| either_way(angle_deg(normals.vector(i), normal)))
                .collect()
        });
        if !of_normals.is_empty() {
            angles_deg.push(of_normals.iter().sum::<f64>() / of_normals.len() as f64);
        }
    }
    rms_m.sort_by(f64::total_cmp);
    Ok(PatchReport {
        patches: rms_m.len(),
        rms_mm: rms_m.get(rms_m.len() / 2).map_or(f64::NAN, |rms| 1e3 * rms),
        normal_deg: angles_deg.iter().sum::<f64>() / angles_deg.len() as f64,
    })
}

fn lies_on_one_surface(points: &[DVec3]) -> bool {
    let count = points.len() as f64;
    let centre = points.iter().sum::<DVec3>() / count;
    let mut covariance = DMat3::ZERO;
    for d in points.iter().map(|&p| p - centre) {
        covariance += DMat3::from_cols(d * d.x, d * d.y, d * d.z) * (1.0 / count);
    }
    let ([across, middle, along], _) = symmetric_eigen(covariance);
    middle >= LEAST_WIDTH * along && across.max(0.0) <= LARGEST_VARIATION * (across + middle + along) && along > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::Random;

    /// Returns the two walls of a corner, with noise of standard deviation `noise_m` along their normals.
    fn corner(noise_m: f32) -> PointCloud {
        let mut random = Random::new(3, 0);
        let mut point = |i: usize| {
            let (a, b, noise) = (
                random.uniform() as f32,
                random.uniform() as f32,
                noise_m * (random.uniform() as f32 - 0.5) * 12f32.sqrt(),
            );
            if i.is_multiple_of(2) { [a, b, noise] } else { [-noise, b, a] }
        };
        PointCloud::new((0..8000).map(&mut point).collect())
    }

    #[test]
    fn patches_have_the_noise_of_their_walls() {
        let (noisy, exact) = (corner(0.002), corner(0.0));
        let normals: Xyz =
            (0..8000usize).map(|i| if i.is_multiple_of(2) { [0.0, 0.0, 1.0] } else { [-1.0, 0.0, 0.0] }).collect();
        let raw = patch_planes(&noisy, &noisy.positions, None).unwrap();
        assert!((1.7..2.1).contains(&raw.rms_mm) && raw.normal_deg.is_nan() && raw.patches > 400, "{raw:?}");
        let smooth = patch_planes(&noisy, &exact.positions, Some(&normals)).unwrap();
        assert!(smooth.rms_mm < 1e-3 && smooth.patches == raw.patches && smooth.normal_deg < 3.0, "{smooth:?}");
    }

    #[test]
    fn clouds_without_a_surface_have_no_patches() {
        let mut random = Random::new(5, 0);
        let gas = PointCloud::new((0..4000).map(|_| [0; 3].map(|_| random.uniform() as f32)).collect());
        let line = PointCloud::new((0..4000).map(|i| [i as f32, 0.0, 0.0]).collect());
        let lone = PointCloud::new([[0.0, 0.0, f32::NAN]].into_iter().collect());
        for (cloud, most) in [(gas, 25), (line, 0), (lone, 0)] {
            let report = patch_planes(&cloud, &cloud.positions, None).unwrap();
            assert!(report.patches <= most, "{report:?}");
        }
    }
}
