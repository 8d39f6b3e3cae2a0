//! Pictures of unorganized clouds: orthographic views from a given direction.

use glam::{DMat3, DVec3};

use planish_core::{FrameError, OrganizedCloud, ParamError, PointCloud, Xyz};

/// Share of the points ignored at each side when the extent of the picture is determined.
const STRAY_SHARE: f64 = 0.002;
/// Width of the empty margin around the points, as a share of the picture.
const MARGIN: f64 = 0.02;
/// Maximum difference in depth between a pixel's nearest point and other points of the same surface, in pixel widths,
/// or in spacings of the points if these are wider. The picture shows the mean depth of the surface's points.
const SURFACE_PIXELS: f32 = 3.0;
const NORMALS: [&str; 3] = ["normal_x", "normal_y", "normal_z"];
/// Maximum distance, in pixels, to which a point of a sparse cloud covers pixels around its own.
const MOST_SPREAD: i64 = 8;
/// Maximum number of pixels per point, so that a picture of few points is small.
const PIXELS_A_POINT: f64 = 40.0;

/// Projects a cloud orthographically along a direction (from the points towards the viewer) onto a grid of points in
/// the viewer's frame: x to the right, y down, z away, in metres.
///
/// The longer side has at most `longest_side` pixels. Each pixel has the weighted mean depth of the front surface's
/// points, and the fields of the point nearest to the pixel. `normal_x`, `normal_y` and `normal_z` are those of the
/// cloud if it has normals; otherwise they are computed from the picture's positions.
///
/// # Errors
/// If the direction is zero or not finite, or the cloud is empty.
pub fn seen_from(cloud: &PointCloud, direction: [f64; 3], longest_side: usize) -> Result<OrganizedCloud, FrameError> {
    DistantView::of(cloud, direction, longest_side)?.see(cloud)
}

/// An orthographic view framed on one cloud. Other clouds with the same origin are shown at their true position in it.
#[derive(Debug, Clone, PartialEq)]
pub struct DistantView {
    viewer_from_cloud: DMat3,
    /// Upper left corner of the picture in the viewer's frame, in metres.
    left: [f64; 2],
    pixel_m: f64,
    width: usize,
    height: usize,
}

impl DistantView {
    /// Creates the view of a cloud from a direction; see [`seen_from`].
    ///
    /// # Errors
    /// If the direction is zero or not finite, or the cloud is empty.
    pub fn of(cloud: &PointCloud, direction: [f64; 3], longest_side: usize) -> Result<Self, FrameError> {
        let towards = DVec3::from_array(direction).try_normalize().ok_or_else(|| {
            let allowed = "a direction is three finite numbers, not all zero";
            FrameError::BadPose(ParamError { field: "from", value: format!("{direction:?}"), allowed })
        })?;
        let away = -towards;
        // z points up in the picture, or y if the view is along z.
        let up = if away.z.abs() > 0.9 { DVec3::Y } else { DVec3::Z };
        let right = away.cross(up).normalize();
        let viewer_from_cloud = DMat3::from_cols(right, away.cross(right), away).transpose();
        let seen = in_frame(&viewer_from_cloud, cloud);
        let valid: Vec<usize> = (0..seen.len()).filter(|&i| cloud.positions.is_finite(i)).collect();
        let range = |axis: usize| {
            let mut values: Vec<f32> = valid.iter().map(|&i| seen[i][axis]).collect();
            values.sort_by(f32::total_cmp);
            let stray = (STRAY_SHARE * values.len() as f64) as usize;
            Some([f64::from(*values.get(stray)?), f64::from(*values.get(values.len().checked_sub(1 + stray)?)?)])
        };
        let (Some(xs), Some(ys)) = (range(0), range(1)) else {
            return Err(FrameError::NoPoints);
        };
        let longest = (xs[1] - xs[0]).max(ys[1] - ys[0]).max(1e-9);
        let sheet_m2 = (xs[1] - xs[0]).max(1e-9) * (ys[1] - ys[0]).max(1e-9);
        let finest_m = (sheet_m2 / (PIXELS_A_POINT * valid.len() as f64)).sqrt();
        let pixel_m = (longest * (1.0 + 2.0 * MARGIN) / longest_side.max(16) as f64).max(finest_m);
        let pixels =
            |[low, high]: [f64; 2]| (((high - low) / pixel_m + 2.0 * MARGIN * longest / pixel_m) as usize).max(1);
        let (width, height) = (pixels(xs), pixels(ys));
        let left = [xs[0], ys[0]].map(|low| low - MARGIN * longest);
        Ok(Self { viewer_from_cloud, left, pixel_m, width, height })
    }

    /// Renders the visible points of a cloud.
    ///
    /// # Errors
    /// If a field's length does not match the number of points.
    pub fn see(&self, cloud: &PointCloud) -> Result<OrganizedCloud, FrameError> {
        let Self { viewer_from_cloud, left, pixel_m, width, height } = *self;
        let seen = in_frame(&viewer_from_cloud, cloud);
        let valid: Vec<usize> = (0..seen.len()).filter(|&i| cloud.positions.is_finite(i)).collect();
        // Coordinates far outside the picture are clamped so that they fit an integer; they are not drawn.
        let pixel = |place: f64| place.floor().clamp(-1e9, 1e9) as i64;
        let pixel_of = |i: usize| [0, 1].map(|axis| pixel((f64::from(seen[i][axis]) - left[axis]) / pixel_m));

        // The distance between the points if they were spread evenly over the picture, in pixels.
        let spacing = ((width * height) as f64 / valid.len().max(1) as f64).sqrt();
        let spread = ((1.25 * spacing) as i64).min(MOST_SPREAD);
        let mut front = vec![f32::INFINITY; width * height];
        let covered = |i: usize| {
            let [u, v] = pixel_of(i);
            let inside = |u: i64, v: i64| (0..width as i64).contains(&u) && (0..height as i64).contains(&v);
            let around = (-spread..=spread).flat_map(move |dv| (-spread..=spread).map(move |du| (du, dv)));
            // The weight of a point decreases with its distance from the pixel.
            let pixel = move |(du, dv): (i64, i64)| {
                let weight = (1.0 - ((du * du + dv * dv) as f64).sqrt() / (spread as f64 + 1.0)).max(1e-3).powi(2);
                inside(u + du, v + dv).then(|| ((v + dv) as usize * width + (u + du) as usize, weight))
            };
            around.filter_map(pixel)
        };
        for &i in &valid {
            for (pixel, _) in covered(i) {
                front[pixel] = front[pixel].min(seen[i][2]);
            }
        }
        let behind = SURFACE_PIXELS * (pixel_m * spacing.max(1.0)) as f32;
        // `sums`: sums of weighted depths and of weights, per pixel. `shown`: the point with the largest weight, and
        // this weight, per pixel.
        let mut sums = vec![(0.0f64, 0.0f64); width * height];
        let mut shown = vec![(cloud.len(), 0.0f64); width * height];
        for &i in &valid {
            for (pixel, weight) in covered(i).filter(|&(pixel, _)| seen[i][2] <= front[pixel] + behind) {
                sums[pixel].0 += weight * f64::from(seen[i][2]);
                sums[pixel].1 += weight;
                if weight > shown[pixel].1 {
                    shown[pixel] = (i, weight);
                }
            }
        }
        let position = |(pixel, &(sum, weight)): (usize, &(f64, f64))| {
            let centre = |axis: usize, at: usize| left[axis] + (at as f64 + 0.5) * pixel_m;
            let p = [centre(0, pixel % width), centre(1, pixel / width), sum / weight];
            if weight > 0.0 { p.map(|value| value as f32) } else { [f32::NAN; 3] }
        };
        let shown: Vec<usize> = shown.into_iter().map(|(i, _)| i).collect();
        let mut points = cloud.with_an_empty_point().select(&shown);
        points.positions = sums.iter().enumerate().map(position).collect();
        points.origin_m = [0.0; 3];
        points.pose = planish_core::SensorPose::IDENTITY;
        let normals = own_normals(&points, viewer_from_cloud)
            .unwrap_or_else(|| super::difference_normals(width, height, &points.positions));
        // All rays are parallel: visible surfaces face -z.
        let facing: Xyz = normals.iter().map(|n| if n[2] > 0.0 { n.map(|value| -value) } else { n }).collect();
        for (name, values) in NORMALS.into_iter().zip(facing.into_arrays()) {
            points.set_attribute(name, values);
        }
        OrganizedCloud::new(width, height, points)
    }
}

/// Returns a cloud's positions in the viewer's frame.
fn in_frame(viewer_from_cloud: &DMat3, cloud: &PointCloud) -> Vec<[f32; 3]> {
    let seen = |p: [f32; 3]| (*viewer_from_cloud * DVec3::from_array(p.map(f64::from))).as_vec3().to_array();
    cloud.positions.iter().map(seen).collect()
}

/// Returns the points' own normals in the viewer's frame, NaN for empty pixels; `None` if there are no normals.
fn own_normals(points: &PointCloud, viewer_from_cloud: DMat3) -> Option<Xyz> {
    let values = |name: &str| points.attribute(name).filter(|field| field.count == 1).map(|field| &field.values);
    let [x, y, z] = NORMALS.map(values);
    let (x, y, z) = (x?, y?, z?);
    let turned = |i: usize| {
        let normal = viewer_from_cloud * DVec3::new(x.get_f64(i), y.get_f64(i), z.get_f64(i));
        if points.positions.is_finite(i) { normal.as_vec3().to_array() } else { [f32::NAN; 3] }
    };
    Some((0..points.len()).map(turned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::normals_of;
    use planish_core::AttributeValues;

    /// Returns a labelled sheet that rises by 1 in 2 along x, and one point far above it.
    fn sheet() -> PointCloud {
        let sheet = (0..6400).map(|i| [(i % 80) as f32 / 79.0, (i / 80) as f32 / 79.0, (i % 80) as f32 / 158.0]);
        let mut cloud = PointCloud::new(sheet.chain([[0.5, 0.5, 9.0]]).collect());
        cloud.set_attribute("label", (0..6401).map(|i| (i % 80) as u8).collect::<Vec<_>>());
        cloud
    }

    #[test]
    fn a_sheet_is_seen_with_its_slope_from_above_and_from_below() {
        for (from, expected_x) in [([0.0, 0.0, 1.0], -0.447), ([0.0, 0.0, -2.0], 0.447)] {
            let picture = seen_from(&sheet(), from, 200).unwrap();
            assert!(picture.width() <= 200 && picture.height() <= 200, "{} {}", picture.width(), picture.height());
            let normals = normals_of(&picture);
            let middle = (picture.height() / 4) * picture.width() + picture.width() / 4;
            let [x, y, z] = normals.get(middle);
            // Seen from above, x points to the right; from below, to the left. z points away.
            assert!(
                (x - expected_x * from[2].signum() as f32).abs() < 0.02 && y.abs() < 0.02 && z < -0.8,
                "{x} {y} {z}"
            );
            let AttributeValues::U8(labels) = &picture.points.attribute("label").unwrap().values else { panic!() };
            let row: Vec<u8> = labels[middle..middle + picture.width() / 2].to_vec();
            assert!(row.is_sorted() || row.iter().rev().is_sorted(), "{row:?}");
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_refused_and_one_point_is_drawn() {
        assert!(seen_from(&sheet(), [0.0; 3], 200).is_err());
        assert!(seen_from(&PointCloud::new(Xyz::filled(5, f32::NAN)), [0.0, 0.0, 1.0], 200).is_err());
        let one = seen_from(&PointCloud::new(Xyz::filled(1, 2.0)), [1.0, 1.0, 0.0], 200).unwrap();
        assert!(one.points.valid_points() > 0);
        // Two patches with a gap between them: pixels in the gap get no point's fields.
        let mut patches = sheet().select(&(0..6400).filter(|i| !(20..60).contains(&(i % 80))).collect::<Vec<_>>());
        patches.set_attribute("label", vec![7u8; patches.len()]);
        let picture = seen_from(&patches, [0.0, 0.0, 1.0], 400).unwrap();
        let AttributeValues::U8(labels) = &picture.points.attribute("label").unwrap().values else { panic!() };
        let middle = picture.height() / 2 * picture.width() + picture.width() / 2;
        assert!(!picture.positions().is_finite(middle) && labels[middle] == 0);
        assert!((0..labels.len()).all(|i| (labels[i] == 7) == picture.positions().is_finite(i)));
    }
}
