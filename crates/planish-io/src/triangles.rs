//! Triangles between the pixels of a smoothed frame.
//!
//! Two adjacent pixels are connected if their tangent planes meet between them. The better of the two planes must
//! predict the other pixel's range. The tolerance is the sensor's noise plus half the difference of the two slopes,
//! which is the error at a crease. Steps are left open.

use glam::DVec3;
use planish_core::{FrameError, OrganizedCloud, PointsView, SensorModel, Xyz};

/// Tolerance of predicted ranges, in standard deviations of the sensor's noise.
const DEVIATIONS: f64 = 3.0;

/// Additional tolerance of the better of two predicted ranges, as a fraction of the difference between the two pixels'
/// slopes. At a crease between two pixels, the error is half this difference.
const SHARE_OF_SLOPES: f64 = 0.5;

/// Minimum cosine of the angle between a normal and a ray for which the tangent plane is used to predict a range.
const GRAZING_COSINE: f64 = 0.03;

/// A triangle mesh.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct TriangleMesh {
    /// Vertices in metres, relative to `origin_m`.
    pub positions: Xyz,
    /// Offset of all vertices in metres.
    pub origin_m: [f64; 3],
    /// Unit normals of the vertices, towards the sensor.
    pub normals: Xyz,
    /// Red, green and blue of each vertex; `None` if the frame has no colours.
    pub colours: Option<Vec<[u8; 3]>>,
    /// Texture coordinates of each vertex: its position in the image, from 0 to 1, starting at the upper left corner.
    pub texture: Vec<[f32; 2]>,
    /// Three vertex indices per triangle, counterclockwise as seen from the sensor.
    pub triangles: Vec<[u32; 3]>,
}

/// The points and normals of a frame, and the position and noise of the sensor.
struct Seen<'a> {
    positions: &'a Xyz,
    normals: &'a Xyz,
    sensor: DVec3,
    noise: SensorModel,
}

impl Seen<'_> {
    fn point(&self, i: usize) -> DVec3 {
        DVec3::from_array(self.positions.get(i).map(f64::from)) - self.sensor
    }

    /// Returns the range in metres at which the tangent plane of point `i` meets `ray`; `None` at grazing angles or
    /// without a normal.
    fn predicted_m(&self, i: usize, ray: DVec3) -> Option<f64> {
        let normal = DVec3::from_array(self.normals.get(i).map(f64::from));
        let along = normal.dot(ray);
        // False if the normal is NaN.
        (along < -GRAZING_COSINE).then(|| normal.dot(self.point(i)) / along)
    }

    /// Returns true if two adjacent points are on the same surface.
    fn is_connected(&self, i: usize, j: usize) -> bool {
        let (p, q) = (self.point(i), self.point(j));
        let (range_p, range_q) = (p.length(), q.length());
        let noise_m = DEVIATIONS * self.noise.sigma_m(range_p.min(range_q));
        if !(range_p > 0.0 && range_q > 0.0) {
            return false;
        }
        match (self.predicted_m(i, q / range_q), self.predicted_m(j, p / range_p)) {
            (Some(at_q), Some(at_p)) => {
                let slopes = ((at_q - range_p) - (range_q - at_p)).abs();
                let off = (at_q - range_q).abs().min((at_p - range_p).abs());
                off <= noise_m + SHARE_OF_SLOPES * slopes.min(2.0 * (p - q).length())
                    && (at_q - range_q).abs().max((at_p - range_p).abs()) <= noise_m + slopes
            }
            _ => (range_p - range_q).abs() <= noise_m,
        }
    }
}

impl TriangleMesh {
    /// Connects the points of a smoothed frame to form triangles, given the normals and the sensor's noise.
    ///
    /// # Errors
    /// If the number of normals differs from the number of points, or the sensor's position is unknown.
    pub fn of(cloud: &OrganizedCloud, normals: &Xyz, noise: SensorModel) -> Result<Self, FrameError> {
        normals.check_len("the normals", cloud.points.len())?;
        let view = PointsView::from_organized(cloud)?;
        let (sensor, _) = view.seen_from().ok_or(FrameError::UnknownSensor)?;
        let positions = &cloud.points.positions;
        // Normals are turned towards the sensor, whatever the file's convention.
        let facing = |i: usize| {
            let [normal, point] = [normals, positions].map(|of| DVec3::from_array(of.get(i).map(f64::from)));
            let turned = if normal.dot(point - sensor) > 0.0 { -normal } else { normal };
            turned.as_vec3().to_array()
        };
        let normals = &(0..positions.len()).map(facing).collect::<Xyz>();
        let seen = Seen { positions, normals, sensor, noise };
        let (width, height) = (cloud.width(), cloud.height());
        let mut of_pixels: Vec<[usize; 3]> = Vec::new();
        for v in 1..height {
            for u in 1..width {
                let [d, c] = [v * width + u, v * width + u - 1];
                let [b, a] = [d - width, c - width];
                of_pixels.extend(seen.triangles([a, b, c, d]));
            }
        }
        // Keep only the vertices in use, in the order of the pixels.
        let mut index = vec![u32::MAX; positions.len()];
        for &pixel in of_pixels.iter().flatten() {
            index[pixel] = 0;
        }
        let used: Vec<usize> = (0..index.len()).filter(|&pixel| index[pixel] == 0).collect();
        for (number, &pixel) in (0..).zip(&used) {
            index[pixel] = number;
        }
        let select = |of: &Xyz| used.iter().map(|&pixel| of.get(pixel)).collect::<Xyz>();
        let triangles: Vec<[u32; 3]> = of_pixels.into_iter().map(|pixels| pixels.map(|pixel| index[pixel])).collect();
        let positions = select(positions);
        let normals = with_normals_of_triangles(select(normals), &positions, &triangles);
        let colours = cloud.points.shown_rgb();
        let place = |pixel: usize| {
            let (u, v) = ((pixel % width) as f32, (pixel / width) as f32);
            [(u + 0.5) / width as f32, (v + 0.5) / height as f32]
        };
        Ok(Self {
            positions,
            origin_m: cloud.points.origin_m,
            normals,
            colours: colours.map(|colours| used.iter().map(|&pixel| colours[pixel]).collect()),
            texture: used.iter().map(|&pixel| place(pixel)).collect(),
            triangles,
        })
    }
}

/// Sets each missing normal to the area-weighted mean normal of the triangles at its vertex.
fn with_normals_of_triangles(mut normals: Xyz, positions: &Xyz, triangles: &[[u32; 3]]) -> Xyz {
    let is_missing: Vec<bool> = (0..normals.len()).map(|i| !normals.is_finite(i)).collect();
    let mut sums = vec![DVec3::ZERO; normals.len()];
    for triangle in triangles.iter().filter(|triangle| triangle.iter().any(|&i| is_missing[i as usize])) {
        let [a, b, c] = triangle.map(|i| DVec3::from_array(positions.get(i as usize).map(f64::from)));
        triangle.iter().for_each(|&i| sums[i as usize] += (b - a).cross(c - a));
    }
    for i in (0..normals.len()).filter(|&i| is_missing[i]) {
        normals.set(i, sums[i].normalize_or(DVec3::NEG_Z).as_vec3().to_array());
    }
    normals
}

impl Seen<'_> {
    /// Returns the triangles in a square of four pixels, given as upper left, upper right, lower left, lower right.
    fn triangles(&self, [a, b, c, d]: [usize; 4]) -> impl Iterator<Item = [usize; 3]> + use<> {
        let has_point = |i: usize| self.positions.is_finite(i);
        let along_ad = self.point(a).distance_squared(self.point(d));
        let along_bc = self.point(b).distance_squared(self.point(c));
        let by_ad = [[a, c, d], [a, d, b]];
        let by_bc = [[a, c, b], [b, c, d]];
        // If a hole makes one diagonal NaN, the other is tried first.
        let first_is_ad = along_ad <= along_bc || along_bc.is_nan();
        let (first, second) = if first_is_ad { (by_ad, by_bc) } else { (by_bc, by_ad) };
        let is_whole = |&[i, j, k]: &[usize; 3]| {
            let has_points = [i, j, k].into_iter().all(has_point);
            has_points && self.is_connected(i, j) && self.is_connected(j, k) && self.is_connected(k, i)
        };
        let of_first: Vec<[usize; 3]> = first.into_iter().filter(is_whole).collect();
        // If neither triangle along the first diagonal is valid, one along the second may be.
        let found =
            if of_first.is_empty() { second.into_iter().filter(is_whole).collect::<Vec<_>>() } else { of_first };
        found.into_iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the mesh of an 8x8 frame with the given depth in metres; pixels are 5 mm apart at 1 m.
    fn frame(depth_m: impl Fn(usize, usize) -> f32, normal: [f32; 3]) -> TriangleMesh {
        let point = |i: usize| {
            let (u, v) = (i % 8, i / 8);
            let z = depth_m(u, v);
            [0.005 * (u as f32 - 3.5) * z, 0.005 * (v as f32 - 3.5) * z, z]
        };
        let cloud = OrganizedCloud::from_positions(8, 8, (0..64).map(point).collect()).unwrap();
        TriangleMesh::of(&cloud, &(0..64).map(|_| normal).collect(), SensorModel::KINECT_V1).unwrap()
    }

    #[test]
    fn planes_are_whole_and_face_the_sensor() {
        let mesh = frame(|_, _| 1.0, [0.0, 0.0, -1.0]);
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (64, 98));
        for &[i, j, k] in &mesh.triangles {
            let [i, j, k] = [i, j, k].map(|i| DVec3::from_array(mesh.positions.get(i as usize).map(f64::from)));
            assert!((j - i).cross(k - i).z < 0.0);
        }
        assert_eq!(mesh.texture[0], [0.0625, 0.0625]);
    }

    #[test]
    fn steps_and_holes_are_left_open_and_creases_are_not() {
        // A step of 5 cm, which is 30 standard deviations.
        let step = frame(|u, _| if u < 4 { 1.0 } else { 1.05 }, [0.0, 0.0, -1.0]);
        assert_eq!(step.triangles.len(), 98 - 14);
        let hole = frame(|u, v| if (u, v) == (3, 3) { f32::NAN } else { 1.0 }, [0.0, 0.0, -1.0]);
        assert_eq!((hole.positions.len(), hole.triangles.len()), (63, 98 - 8 + 4));
        // A roof of 45 degrees on both sides of a ridge along v.
        let roof = |u: usize| 1.0 + (u as f32 - 3.5).abs() * 0.005;
        let point = |i: usize| [0.005 * ((i % 8) as f32 - 3.5), 0.005 * ((i / 8) as f32 - 3.5), roof(i % 8)];
        let cloud = OrganizedCloud::from_positions(8, 8, (0..64).map(point).collect()).unwrap();
        let s = std::f32::consts::FRAC_1_SQRT_2;
        let normals: Xyz = (0..64).map(|i| if i % 8 < 4 { [-s, 0.0, -s] } else { [s, 0.0, -s] }).collect();
        let mesh = TriangleMesh::of(&cloud, &normals, SensorModel::KINECT_V1).unwrap();
        assert_eq!(mesh.triangles.len(), 98);
    }
}
