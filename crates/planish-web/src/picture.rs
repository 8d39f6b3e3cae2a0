//! Pictures as RGBA, for a canvas.

use planish::render::{colours, difference_normals, normals_of, relief};
use planish::{OrganizedCloud, PointCloud, Xyz};

use crate::request::PictureKind;

const HOLE: [u8; 3] = [0; 3];

/// Returns the depths between which colours vary: the 1st and 99th percentiles of z.
pub(crate) fn depth_range(points: &Xyz) -> [f32; 2] {
    let mut z: Vec<f32> = points.z().iter().copied().filter(|z| z.is_finite()).collect();
    if z.is_empty() {
        return [0.0, 1.0];
    }
    let mut at = |share: f64| {
        let index = ((z.len() - 1) as f64 * share) as usize;
        *z.select_nth_unstable_by(index, f32::total_cmp).1
    };
    let [near, far] = [at(0.01), at(0.99)];
    [near, far.max(near + 1e-6 * near.abs().max(1.0))]
}

/// Returns the colour of a depth: from red (near) to blue (far), in hues of even brightness. The hue of positive
/// depths is linear in their inverse, since near depths fill most pixels and are measured most finely.
fn depth_colour(z: f32, [near, far]: [f32; 2]) -> [u8; 3] {
    if !z.is_finite() {
        return HOLE;
    }
    let scale = |z: f32| if near > 0.0 { -1.0 / z.clamp(near, far) } else { z };
    let share = ((scale(z) - scale(near)) / (scale(far) - scale(near))).clamp(0.0, 1.0);
    // At hues below 0.5 or above 3.5, the colour would be constant.
    let hue = 0.5 + 3.0 * share;
    let part = |centre: f32| (1.5 - (hue - centre).abs()).clamp(0.0, 1.0);
    [part(0.5), part(2.0), part(3.5)].map(|part| (255.0 * (0.1 + 0.85 * part)) as u8)
}

fn normal_colour(normal: [f32; 3]) -> [u8; 3] {
    if normal.iter().any(|n| !n.is_finite()) {
        return HOLE;
    }
    // Normals towards the sensor are blue, as in normal maps.
    let [x, y, z] = normal;
    [x, -y, -z].map(|n| (127.5 * (n + 1.0)) as u8)
}

/// Returns the colours of all points of a grid, row by row.
pub(crate) fn colours_of(
    cloud: &OrganizedCloud,
    normals: Option<&Xyz>,
    kind: PictureKind,
    range: [f32; 2],
    is_general: bool,
) -> Vec<[u8; 3]> {
    let (width, height) = (cloud.width(), cloud.height());
    // The grid made from an unorganized cloud contains the cloud's normals as fields.
    let between_pixels = || match cloud.points.attribute("normal_x") {
        Some(_) if is_general => normals_of(cloud),
        _ => difference_normals(width, height, cloud.positions()),
    };
    let pixels = |rgb: Vec<u8>| rgb.chunks_exact(3).map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    match kind {
        PictureKind::Depth => cloud.positions().z().iter().map(|&z| depth_colour(z, range)).collect(),
        PictureKind::Normals => match normals {
            Some(normals) => normals.iter().map(normal_colour).collect(),
            None => between_pixels().iter().map(normal_colour).collect(),
        },
        PictureKind::Colour => match colours(cloud) {
            Some(picture) => pixels(picture.rgb),
            None => pixels(relief(width, height, &between_pixels()).rgb),
        },
        PictureKind::Relief => pixels(relief(width, height, &between_pixels()).rgb),
    }
}

/// Returns the colours of the points of an unorganized cloud. A relief replaces missing colours, and colours replace
/// a relief without normals. If a cloud lacks both, its colours show z.
pub(crate) fn colours_of_general(
    cloud: &PointCloud,
    normals: Option<&Xyz>,
    kind: PictureKind,
    range: [f32; 2],
) -> Vec<[u8; 3]> {
    let lit =
        |normals: &Xyz| relief(normals.len(), 1, normals).rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    match (kind, cloud.rgb(), normals) {
        (PictureKind::Colour, Some(rgb), _) => rgb,
        (PictureKind::Normals, _, Some(normals)) => normals.iter().map(normal_colour).collect(),
        (PictureKind::Relief | PictureKind::Colour, _, Some(normals)) => {
            // Surfaces are lit from above, whichever side they show.
            lit(&normals.iter().map(|n| if n[2] > 0.0 { n.map(|value| -value) } else { n }).collect())
        }
        (PictureKind::Relief, Some(rgb), None) => rgb,
        _ => cloud.positions.z().iter().map(|&z| depth_colour(z, range)).collect(),
    }
}

/// Adds alpha: opaque for points, transparent for holes.
pub(crate) fn rgba(colours: &[[u8; 3]], points: &Xyz) -> Vec<u8> {
    let pixel = |(i, &[red, green, blue]): (usize, &[u8; 3])| {
        let alpha = if points.is_finite(i) { 255 } else { 0 };
        [red, green, blue, alpha]
    };
    colours.iter().enumerate().flat_map(pixel).collect()
}
