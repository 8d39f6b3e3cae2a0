//! A surface by itself, where no truth is known: how flat it is piece by piece.

use glam::DVec3;
use serde::Serialize;

use super::evaluation::plane;
use crate::cloud::{OrganizedCloud, Xyz};

/// Side of a tile in pixels: 64 in each.
const TILE_PX: usize = 8;

/// Planes fitted to tiles of 64 pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TileReport {
    /// Tiles without a hole that have no depth step in them.
    pub tiles: usize,
    /// Median over the tiles of the RMS distance from their plane, in millimetres.
    pub rms_mm: f64,
    /// Mean over the tiles of the mean angle between a point's normal and the tile's, in degrees.
    pub normal_deg: f64,
}

/// Fits a plane to every tile of 8x8 pixels that has all its points in `measured`, which says where tiles are: the same for
/// every method. Tiles that span more than a twentieth of their range in z are left out.
pub fn tile_planes(measured: &OrganizedCloud, points: &Xyz, normals: &Xyz) -> TileReport {
    let (width, height) = (measured.width(), measured.height());
    let (mut rms_m, mut angles_deg) = (Vec::new(), Vec::new());
    for v0 in (0..height.saturating_sub(TILE_PX - 1)).step_by(TILE_PX) {
        for u0 in (0..width.saturating_sub(TILE_PX - 1)).step_by(TILE_PX) {
            let pixels: Vec<usize> =
                (0..TILE_PX * TILE_PX).map(|k| (v0 + k / TILE_PX) * width + u0 + k % TILE_PX).collect();
            let depths = || pixels.iter().map(|&i| measured.positions().z[i]);
            let (near, far) = depths().fold((f32::INFINITY, 0f32), |(near, far), z| (near.min(z), far.max(z)));
            if !pixels.iter().all(|&i| measured.positions().is_finite(i)) || far - near > 0.05 * near {
                continue;
            }
            let at = |of: &Xyz, i: usize| DVec3::from_array(of.get(i).map(f64::from));
            let there = || pixels.iter().copied().filter(|&i| points.is_finite(i));
            let Some((normal, rms)) = plane(there().map(|i| at(points, i)).collect()) else { continue };
            rms_m.push(rms);
            let angles = there().filter(|&i| normals.is_finite(i)).map(|i| at(normals, i).dot(normal).clamp(-1.0, 1.0));
            let (sum, count) = angles.fold((0.0, 0usize), |(sum, count), cosine| (sum + cosine.acos(), count + 1));
            if count > 0 {
                angles_deg.push((sum / count as f64).to_degrees());
            }
        }
    }
    rms_m.sort_by(f64::total_cmp);
    TileReport {
        tiles: rms_m.len(),
        rms_mm: rms_m.get(rms_m.len() / 2).map_or(f64::NAN, |rms| 1e3 * rms),
        normal_deg: angles_deg.iter().sum::<f64>() / angles_deg.len() as f64,
    }
}
