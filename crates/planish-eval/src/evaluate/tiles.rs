//! Metrics without ground truth: the flatness of a surface in tiles, and the largest plane of a frame.

use glam::DVec3;
use serde::Serialize;

use super::evaluation::{SPECK_DEG, facet};
use super::geometry::{angle_deg, plane};
use crate::simulate::Random;
use planish_core::{OrganizedCloud, SensorModel, Xyz};

/// Side length of a tile in pixels; a tile has 64 pixels.
const TILE_PX: usize = 8;

/// Scores of planes fitted to tiles of 64 pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct TileReport {
    /// Number of tiles without holes or depth steps.
    pub tiles: usize,
    /// Median over the tiles of the RMS distance of a tile's points from its plane, in millimetres.
    pub rms_mm: f64,
    /// Mean over the tiles of the mean angle between the points' normals and the normal of the tile's plane, in
    /// degrees.
    pub normal_deg: f64,
    /// Mean over the tiles of the mean angle between the facets of adjacent points and the tile's plane, in degrees.
    pub facet_deg: f64,
    /// Share of specks: facets that are off the tile's plane by more than 30°.
    pub speck_share: f64,
}

/// Fits a plane to the `points` of every tile of 8x8 pixels that has no hole in `measured`, so that all methods are
/// scored on the same tiles. Tiles in which the depth varies by more than 5 % are skipped.
pub fn tile_planes(measured: &OrganizedCloud, points: &Xyz, normals: &Xyz) -> TileReport {
    let (width, height) = (measured.width(), measured.height());
    let (mut rms_m, mut angles_deg, mut facets_deg) = (Vec::new(), Vec::new(), Vec::new());
    let (mut facets, mut specks) = (0usize, 0usize);
    let mut in_tile = vec![false; width * height];
    for v0 in (0..height.saturating_sub(TILE_PX - 1)).step_by(TILE_PX) {
        for u0 in (0..width.saturating_sub(TILE_PX - 1)).step_by(TILE_PX) {
            let pixels: Vec<usize> =
                (0..TILE_PX * TILE_PX).map(|k| (v0 + k / TILE_PX) * width + u0 + k % TILE_PX).collect();
            let depths = || pixels.iter().map(|&i| measured.positions().z()[i]);
            let (near, far) = depths().fold((f32::INFINITY, 0f32), |(near, far), z| (near.min(z), far.max(z)));
            if !pixels.iter().all(|&i| measured.positions().is_finite(i)) || far - near > 0.05 * near {
                continue;
            }
            let there = || pixels.iter().copied().filter(|&i| points.is_finite(i));
            let Some((normal, _, rms)) = plane(there().map(|i| points.vector(i)).collect()) else { continue };
            rms_m.push(rms);
            let angles =
                there().filter(|&i| normals.is_finite(i)).map(|i| normals.vector(i).dot(normal).clamp(-1.0, 1.0));
            let (sum, count) = angles.fold((0.0, 0usize), |(sum, count), cosine| (sum + cosine.acos(), count + 1));
            if count > 0 {
                angles_deg.push((sum / count as f64).to_degrees());
            }
            pixels.iter().for_each(|&i| in_tile[i] = true);
            let of_facets: Vec<f64> = pixels
                .iter()
                .filter_map(|&i| facet(points, &in_tile, i, width))
                .map(|n| angle_deg(n, normal))
                .collect();
            pixels.iter().for_each(|&i| in_tile[i] = false);
            facets += of_facets.len();
            specks += of_facets.iter().filter(|&&deg| deg > f64::from(SPECK_DEG)).count();
            if !of_facets.is_empty() {
                facets_deg.push(of_facets.iter().sum::<f64>() / of_facets.len() as f64);
            }
        }
    }
    rms_m.sort_by(f64::total_cmp);
    TileReport {
        tiles: rms_m.len(),
        rms_mm: rms_m.get(rms_m.len() / 2).map_or(f64::NAN, |rms| 1e3 * rms),
        normal_deg: mean(&angles_deg),
        facet_deg: mean(&facets_deg),
        speck_share: specks as f64 / facets as f64,
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Number of candidate planes that are tried.
const TRIALS: usize = 400;
/// Number of points against which each candidate plane is scored.
const TRIED_POINTS: usize = 2000;
/// Number of times that the plane is refitted to its inliers.
const REFITS: usize = 4;
/// Maximum distance of an inlier from the plane, in standard deviations of a Kinect v1's noise.
const ON_PLANE_DEVIATIONS: f64 = 3.0;

/// Radius, in pixels, of the neighbourhood that must consist of inliers for a pixel to belong to the plane. This
/// excludes other objects that cross the plane.
const INNER_PX: usize = 2;

/// The plane with the most inliers in a frame.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct LargestPlane {
    /// Indices of the pixels in its largest connected piece, in ascending order.
    pub pixels: Vec<usize>,
}

impl LargestPlane {
    /// Returns the variance, in m², of the points at the plane's pixels about their best-fitting plane; NaN for too
    /// few points.
    pub fn variance_m2(&self, points: &Xyz) -> f64 {
        let there = self.pixels.iter().copied().filter(|&i| points.is_finite(i));
        let points = there.map(|i| points.vector(i)).collect();
        plane(points).map_or(f64::NAN, |(.., rms_m)| rms_m * rms_m)
    }
}

/// Finds the plane with the most inliers by random sample consensus, deterministically. Returns `None` if the cloud
/// has fewer than 100 points, or the plane's largest connected piece fewer than 12 pixels.
pub fn largest_plane(cloud: &OrganizedCloud) -> Option<LargestPlane> {
    let (width, height, points) = (cloud.width(), cloud.height(), cloud.positions());
    let valid: Vec<usize> = (0..points.len()).filter(|&i| points.is_finite(i)).collect();
    if valid.len() < 100 {
        return None;
    }
    let at = |i: usize| points.vector(i);
    let on = |p: DVec3, (normal, foot): (DVec3, DVec3)| {
        let noise_m = SensorModel::KINECT_V1.sigma_m(p.z);
        (p - foot).dot(normal).abs() <= ON_PLANE_DEVIATIONS * noise_m
    };
    let mut random = Random::new(1, 7);
    let mut pick = || at(valid[((random.uniform() * valid.len() as f64) as usize).min(valid.len() - 1)]);
    let tried: Vec<DVec3> = (0..TRIED_POINTS).map(|_| pick()).collect();
    let mut best = (0, (DVec3::Z, DVec3::ZERO));
    for _ in 0..TRIALS {
        let (a, b, c) = (pick(), pick(), pick());
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let count = tried.iter().filter(|&&p| normal != DVec3::ZERO && on(p, (normal, a))).count();
        if count > best.0 {
            best = (count, (normal, a));
        }
    }
    // Three points give a rough plane; its inliers give a better one.
    let mut found = best.1;
    for _ in 0..REFITS {
        let (normal, centre, _) = plane(valid.iter().map(|&i| at(i)).filter(|&p| on(p, found)).collect())?;
        found = (normal, centre);
    }
    let is_on: Vec<bool> = (0..points.len()).map(|i| points.is_finite(i) && on(at(i), found)).collect();
    let is_inner = |i: usize| {
        let (u, v) = (i % width, i / width);
        let (across, down) = (u + 1 + INNER_PX, v + 1 + INNER_PX);
        (v.saturating_sub(INNER_PX)..down.min(height))
            .all(|v| (u.saturating_sub(INNER_PX)..across.min(width)).all(|u| is_on[v * width + u]))
    };
    let mut open: Vec<bool> = (0..points.len()).map(is_inner).collect();
    // An infinite plane also cuts through other objects; only the largest connected piece is taken as the surface.
    let mut pixels = Vec::new();
    for first in 0..open.len() {
        let mut piece = Vec::new();
        let mut reached = if std::mem::take(&mut open[first]) { vec![first] } else { Vec::new() };
        while let Some(i) = reached.pop() {
            piece.push(i);
            let (u, v) = (i % width, i / width);
            let beside =
                [(u > 0, -1), (u + 1 < width, 1), (v > 0, -(width as isize)), (v + 1 < height, width as isize)];
            for (_, step) in beside.into_iter().filter(|(is_inside, _)| *is_inside) {
                let j = i.wrapping_add_signed(step);
                if std::mem::take(&mut open[j]) {
                    reached.push(j);
                }
            }
        }
        if piece.len() > pixels.len() {
            pixels = piece;
        }
    }
    pixels.sort_unstable();
    (pixels.len() >= 12).then_some(LargestPlane { pixels })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::{DepthNoise, DepthSimulator, Pose, Scene, Shape};
    use planish_core::Camera;

    #[test]
    fn the_largest_plane_and_the_tiles_of_a_noisy_wall_have_its_noise() {
        let camera = Camera::new((160, 120), [131.0; 2], [79.5, 59.5]);
        let wall = Shape::Plane { point_m: [0.0, 0.0, 2.0], normal: DVec3::new(0.2, 0.1, 1.0).normalize().to_array() };
        let ball = Shape::Sphere { centre_m: [0.3, 0.0, 1.2], radius_m: 0.15 };
        let scene = Scene { objects: vec![wall, ball] };
        let truth = scene.render(&camera, &Pose::looking([0.0; 3], 0.0, 0.0));
        let frame = DepthSimulator::new(DepthNoise::default(), camera, 1).frame(&truth, 0).unwrap();
        let cloud = frame.deproject().unwrap();
        let found = largest_plane(&cloud).unwrap();
        let of_wall = found.pixels.iter().filter(|&&i| truth.objects[i] == 0).count();
        let walls =
            (0..truth.objects.len()).filter(|&i| truth.objects[i] == 0 && cloud.positions().is_finite(i)).count();
        assert!(of_wall > walls * 3 / 4 && of_wall * 1000 > found.pixels.len() * 999, "{of_wall} of {walls}");
        let rms_m = found.variance_m2(cloud.positions()).sqrt();
        let noise_m = SensorModel::KINECT_V1.sigma_m(2.0);
        assert!((0.6..1.2).contains(&(rms_m / noise_m)), "{rms_m} {noise_m}");
        let on_wall = found.pixels.iter().copied().filter(|&i| truth.objects[i] == 0).collect();
        assert!(LargestPlane { pixels: on_wall }.variance_m2(&truth.points) < 1e-12);
        let holes = OrganizedCloud::from_positions(10, 5, Xyz::filled(50, f32::NAN)).unwrap();
        assert_eq!(largest_plane(&holes), None);

        let tiles = tile_planes(&cloud, cloud.positions(), &truth.normals);
        assert!(tiles.tiles > 100 && (0.5e3 * noise_m..1.2e3 * noise_m).contains(&tiles.rms_mm), "{tiles:?}");
        let exact = tile_planes(&cloud, &truth.points, &truth.normals);
        assert!(exact.rms_mm < 1e-3 && exact.normal_deg < 1.0 && exact.tiles == tiles.tiles, "{exact:?}");
    }
}
