//! Pictures of clouds: relief shading by normals, colours, and errors against a ground truth.

mod general;

use glam::Vec3;

use crate::simulate::{NO_OBJECT, Truth};
use planish_core::{AttributeValues, OrganizedCloud, Xyz};
use planish_io::RgbImage;

pub use general::{DistantView, seen_from};

/// Returns normals computed from differences between neighbouring pixels, pointing towards the sensor. They show every
/// bump of the points.
///
/// A normal is NaN for a hole, and for a pixel without a valid neighbour along x or along y.
pub fn difference_normals(width: usize, height: usize, positions: &Xyz) -> Xyz {
    let point = |u: usize, v: usize| Vec3::from_array(positions.get(v * width + u));
    // Difference between the next and the previous neighbour; at borders and next to holes, the pixel itself replaces
    // the missing one.
    let difference = |before: Option<Vec3>, at: Vec3, behind: Option<Vec3>| {
        let (before, behind) = (before.filter(|p| p.is_finite()), behind.filter(|p| p.is_finite()));
        behind.unwrap_or(at) - before.unwrap_or(at)
    };
    let normal = |i: usize| {
        let (u, v) = (i % width, i / width);
        let at = point(u, v);
        if !at.is_finite() {
            return [f32::NAN; 3];
        }
        let left = (u > 0).then(|| point(u - 1, v));
        let right = (u + 1 < width).then(|| point(u + 1, v));
        let above = (v > 0).then(|| point(u, v - 1));
        let below = (v + 1 < height).then(|| point(u, v + 1));
        let normal = difference(above, at, below).cross(difference(left, at, right)).normalize_or(Vec3::NAN);
        if normal.dot(at) > 0.0 { -normal } else { normal }.to_array()
    };
    (0..width * height).map(normal).collect()
}

/// Returns the cloud's own normals (fields `normal_x`, `normal_y`, `normal_z`) if it has any, otherwise
/// [`difference_normals`].
pub fn normals_of(cloud: &OrganizedCloud) -> Xyz {
    let field = |name: &str| match cloud.points.attribute(name).map(|attribute| &attribute.values) {
        Some(AttributeValues::F32(values)) if values.len() == cloud.points.len() => Some(values.clone()),
        _ => None,
    };
    let fields = || Xyz::from_arrays([field("normal_x")?, field("normal_y")?, field("normal_z")?]).ok();
    fields().unwrap_or_else(|| difference_normals(cloud.width(), cloud.height(), cloud.positions()))
}

/// Renders relief: each pixel is lit from the upper left according to its normal, and black if it has none.
pub fn relief(width: usize, height: usize, normals: &Xyz) -> RgbImage {
    let light = Vec3::new(-0.5, -0.6, -0.6).normalize();
    let shade = |normal: [f32; 3]| {
        let n = Vec3::from_array(normal);
        if !n.is_finite() {
            return [0; 3];
        }
        let (lit, facing) = (n.dot(light).max(0.0), -n.z.min(0.0));
        let brightness = 0.12 + 0.68 * lit + 0.2 * facing;
        [(255.0 * brightness.clamp(0.0, 1.0)) as u8; 3]
    };
    RgbImage { width, height, rgb: normals.iter().flat_map(shade).collect() }
}

/// Renders the colours of a cloud; `None` for a cloud without colours.
pub fn colours(cloud: &OrganizedCloud) -> Option<RgbImage> {
    let rgb = cloud.points.shown_rgb()?.into_iter().flatten().collect();
    Some(RgbImage { width: cloud.width(), height: cloud.height(), rgb })
}

/// Renders the distance of the points from the true surface along its normal: white on the surface, blue in front of
/// it, red behind it, saturated at `full_scale_m`; black for holes.
pub fn error_map(truth: &Truth, points: &Xyz, full_scale_m: f32) -> RgbImage {
    let colour = |i: usize| {
        if truth.objects[i] == NO_OBJECT || !points.is_finite(i) {
            return [0; 3];
        }
        let off = Vec3::from_array(points.get(i)) - Vec3::from_array(truth.points.get(i));
        // The normal points towards the camera.
        let behind = (-off.dot(Vec3::from_array(truth.normals.get(i))) / full_scale_m).clamp(-1.0, 1.0);
        let fade = (255.0 * (1.0 - behind.abs())) as u8;
        if behind > 0.0 { [255, fade, fade] } else { [fade, fade, 255] }
    };
    RgbImage {
        width: truth.camera.width,
        height: truth.camera.height,
        rgb: (0..truth.objects.len()).flat_map(colour).collect(),
    }
}

/// Places pictures of the same size side by side, with a thin line between them.
pub fn side_by_side(pictures: &[RgbImage]) -> RgbImage {
    const LINE_PX: usize = 4;
    let Some(first) = pictures.first() else { return RgbImage { width: 0, height: 0, rgb: Vec::new() } };
    let (width, height) = (first.width, first.height);
    let total = pictures.len() * (width + LINE_PX) - LINE_PX;
    let mut rgb = Vec::with_capacity(3 * total * height);
    for v in 0..height {
        for (k, picture) in pictures.iter().enumerate() {
            if k > 0 {
                rgb.extend([255; 3 * LINE_PX]);
            }
            rgb.extend_from_slice(&picture.rgb[3 * v * width..3 * (v + 1) * width]);
        }
    }
    RgbImage { width: total, height, rgb }
}

/// Halves a picture in width and height: each pixel is the mean of four. An odd last column or row is dropped.
pub fn half_size(picture: &RgbImage) -> RgbImage {
    let (width, height) = (picture.width / 2, picture.height / 2);
    let mean = |i: usize| {
        let (u, v, channel) = (i / 3 % width, i / 3 / width, i % 3);
        // Pixels outside the picture are black.
        let at = |u, v| u32::from(*picture.rgb.get(3 * (v * picture.width + u) + channel).unwrap_or(&0));
        let sum = at(2 * u, 2 * v) + at(2 * u + 1, 2 * v) + at(2 * u, 2 * v + 1) + at(2 * u + 1, 2 * v + 1);
        ((sum + 2) / 4) as u8
    };
    RgbImage { width, height, rgb: (0..3 * width * height).map(mean).collect() }
}

/// Stacks two pictures of the same width, with a thin line between them.
pub fn stacked(upper: RgbImage, lower: &RgbImage) -> RgbImage {
    let mut rgb = upper.rgb;
    rgb.extend(std::iter::repeat_n(255, 3 * 4 * upper.width));
    rgb.extend_from_slice(&lower.rgb);
    RgbImage { width: upper.width, height: upper.height + 4 + lower.height, rgb }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_a_picture_has_the_means_of_four_pixels() {
        let rgb = (0..5 * 3).flat_map(|i| [i, 100, 2 * i]).collect();
        let half = half_size(&RgbImage { width: 5, height: 3, rgb });
        assert_eq!((half.width, half.height), (2, 1));
        // 0, 1, 5, 6 and 2, 3, 7, 8.
        assert_eq!(half.rgb, [3, 100, 6, 5, 100, 10]);
        let tiny = RgbImage { width: 1, height: 1, rgb: vec![1, 2, 3] };
        assert_eq!(half_size(&tiny), RgbImage { width: 0, height: 0, rgb: Vec::new() });
    }

    #[test]
    fn difference_normals_of_a_tilted_plane_face_the_camera() {
        let (width, height) = (9, 7);
        let plane: Xyz = (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as f32 * 0.01, (i / width) as f32 * 0.01);
                [x, y, 1.0 + 0.5 * x]
            })
            .collect();
        let expected = Vec3::new(0.5, 0.0, -1.0).normalize();
        for normal in difference_normals(width, height, &plane).iter() {
            assert!((Vec3::from_array(normal) - expected).length() < 1e-4, "{normal:?}");
        }
        let mut holed = plane;
        holed.set(30, [f32::NAN; 3]);
        let normals = difference_normals(width, height, &holed);
        assert!(!normals.is_finite(30));
        assert!((Vec3::from_array(normals.get(29)) - expected).length() < 1e-4);
    }
}
