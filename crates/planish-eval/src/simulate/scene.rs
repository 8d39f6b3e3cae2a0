//! Scenes of simple shapes and their noise-free images. Lengths are in metres. World and camera axes are x right, y
//! down, z forward.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use planish_core::{Camera, FrameError, ParamError, SensorPose, Xyz};

/// The object id of a pixel whose ray hits nothing.
pub const NO_OBJECT: u16 = u16::MAX;

/// A solid or a plane, in world coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Shape {
    /// An infinite plane through a point.
    Plane {
        /// Any point on it, in metres.
        point_m: [f64; 3],
        /// Its unit normal, with either sign.
        normal: [f64; 3],
    },
    /// A sphere.
    Sphere {
        /// Its centre in metres.
        centre_m: [f64; 3],
        /// Its radius in metres.
        radius_m: f64,
    },
    /// A box.
    Cuboid {
        /// Its centre in metres.
        centre_m: [f64; 3],
        /// Half its extent along each of its axes, in metres.
        half_extent_m: [f64; 3],
        /// Its axes in world coordinates: three orthogonal unit vectors.
        axes: [[f64; 3]; 3],
    },
    /// A cylinder with flat ends.
    Cylinder {
        /// The middle of its axis, in metres.
        centre_m: [f64; 3],
        /// Unit direction of its axis.
        axis: [f64; 3],
        /// Its radius in metres.
        radius_m: f64,
        /// Half its length in metres.
        half_height_m: f64,
    },
    /// A ring: a disc swept along a circle.
    Torus {
        /// Its centre in metres.
        centre_m: [f64; 3],
        /// Unit direction of its axis.
        axis: [f64; 3],
        /// Radius of the circle in metres.
        radius_m: f64,
        /// Radius of the disc in metres.
        tube_radius_m: f64,
    },
    /// The part of the saddle z = (x² - y²)/(2 r) up to `extent_m` from its centre, where x, y and z are parallel to
    /// the world axes.
    Saddle {
        /// Its centre in metres.
        centre_m: [f64; 3],
        /// r, its radius of curvature along both axes, in metres.
        radius_m: f64,
        /// Maximum distance from the centre in metres.
        extent_m: f64,
    },
}

/// Intersection of a ray and a surface: the distance in units of the direction vector's length, and the surface normal
/// with either sign.
type Hit = (f64, DVec3);

impl Shape {
    /// Returns the first hit of the ray in front of its origin.
    fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        match *self {
            Self::Plane { point_m, normal } => {
                let (point, normal) = (DVec3::from(point_m), DVec3::from(normal));
                let t = (point - origin).dot(normal) / direction.dot(normal);
                in_front(t).then_some((t, normal))
            }
            Self::Sphere { centre_m, radius_m } => {
                let from_centre = origin - DVec3::from(centre_m);
                let a = direction.length_squared();
                let b = from_centre.dot(direction);
                let c = from_centre.length_squared() - radius_m * radius_m;
                let root = (b * b - a * c).sqrt();
                let t = (-b - root) / a;
                in_front(t).then(|| (t, (from_centre + t * direction) / radius_m))
            }
            Self::Cuboid { centre_m, half_extent_m, axes } => {
                let world_from_box = DMat3::from_cols_array_2d(&axes);
                let box_from_world = world_from_box.transpose();
                let (o, d) = (box_from_world * (origin - DVec3::from(centre_m)), box_from_world * direction);
                let (mut enter, mut leave, mut entered) = (f64::NEG_INFINITY, f64::INFINITY, 0);
                for axis in 0..3 {
                    let t0 = (-half_extent_m[axis] - o[axis]) / d[axis];
                    let t1 = (half_extent_m[axis] - o[axis]) / d[axis];
                    if t0.min(t1) > enter {
                        (enter, entered) = (t0.min(t1), axis);
                    }
                    leave = leave.min(t0.max(t1));
                }
                (enter <= leave && in_front(enter)).then(|| (enter, world_from_box.col(entered)))
            }
            Self::Cylinder { centre_m, axis, radius_m, half_height_m } => {
                let (from_centre, axis) = (origin - DVec3::from(centre_m), DVec3::from(axis));
                let across = |x: DVec3| x - x.dot(axis) * axis;
                let (o, d) = (across(from_centre), across(direction));
                let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - radius_m * radius_m);
                let t = (-b - (b * b - a * c).sqrt()) / a;
                let point = from_centre + t * direction;
                if in_front(t) && point.dot(axis).abs() <= half_height_m {
                    return Some((t, across(point) / radius_m));
                }
                let end = -half_height_m * direction.dot(axis).signum();
                let t = (end - from_centre.dot(axis)) / direction.dot(axis);
                let on_end = across(from_centre + t * direction).length() <= radius_m;
                (in_front(t) && on_end).then_some((t, axis))
            }
            Self::Torus { centre_m, axis, radius_m, tube_radius_m } => {
                let (from_centre, axis) = (origin - DVec3::from(centre_m), DVec3::from(axis));
                // The vector from the nearest point on the circle to `point`.
                let off_circle = |point: DVec3| {
                    let across = point - point.dot(axis) * axis;
                    point - radius_m * across.normalize_or(axis.any_orthonormal_vector())
                };
                let distance = |point: DVec3| off_circle(point).length() - tube_radius_m;
                // A step as long as the distance to the surface cannot pass through the surface.
                let (length, mut t) = (direction.length(), 0.0);
                let farthest = (from_centre.length() + radius_m + tube_radius_m) / length;
                for _ in 0..MOST_STEPS {
                    let left = distance(from_centre + t * direction);
                    if left < 1e-10 {
                        return in_front(t).then(|| (t, off_circle(from_centre + t * direction) / tube_radius_m));
                    }
                    t += left / length;
                    if t > farthest {
                        return None;
                    }
                }
                None
            }
            Self::Saddle { centre_m, radius_m, extent_m } => {
                let (o, d) = (origin - DVec3::from(centre_m), direction);
                // x² - y² - 2 r z = 0 along the ray.
                let a = d.x * d.x - d.y * d.y;
                let b = o.x * d.x - o.y * d.y - radius_m * d.z;
                let c = o.x * o.x - o.y * o.y - 2.0 * radius_m * o.z;
                // The numerically stable roots of a t² + 2 b t + c.
                let q = -b - b.signum() * (b * b - a * c).sqrt();
                let within = |&t: &f64| in_front(t) && (o + t * d).length() <= extent_m;
                let t = [c / q, q / a].into_iter().filter(within).min_by(f64::total_cmp)?;
                let point = o + t * d;
                Some((t, DVec3::new(point.x, -point.y, -radius_m).normalize()))
            }
        }
    }
}

/// Maximum number of steps along a ray towards a torus. A ray that has not hit the torus by then at most grazes it,
/// and counts as a miss.
const MOST_STEPS: usize = 1000;

/// Returns true if a hit at distance `t` is in front of the ray's origin; false for NaN, which means a miss.
fn in_front(t: f64) -> bool {
    t > 1e-3 && t.is_finite()
}

/// Pose of the camera in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Position of the camera in the world, in metres.
    pub(crate) position: DVec3,
    /// Rotation from camera to world axes.
    pub(crate) world_from_camera: DMat3,
}

impl Pose {
    /// Returns the pose of a camera at `position_m`, turned by `yaw_rad` to the right and then by `pitch_rad`
    /// downwards.
    pub fn looking(position_m: [f64; 3], yaw_rad: f64, pitch_rad: f64) -> Self {
        let world_from_camera = DMat3::from_rotation_y(yaw_rad) * DMat3::from_rotation_x(-pitch_rad);
        Self { position: position_m.into(), world_from_camera }
    }

    /// Returns the pose moved by `offset_m`, an offset in camera coordinates.
    pub fn moved(self, offset_m: [f64; 3]) -> Self {
        Self { position: self.position + self.world_from_camera * DVec3::from(offset_m), ..self }
    }

    /// Transforms a point from the camera's frame to the world, in metres.
    pub fn to_world(&self, point_m: [f64; 3]) -> [f64; 3] {
        (self.world_from_camera * DVec3::from(point_m) + self.position).to_array()
    }

    /// Converts to the pose type used by clouds and rigs; their frame is then the world's.
    ///
    /// # Errors
    /// If the matrix is not a rotation, or the position is not finite.
    pub fn sensor_pose(&self) -> Result<SensorPose, FrameError> {
        let rows = self.world_from_camera.transpose().to_cols_array_2d();
        SensorPose::from_rotation(self.position.to_array(), rows).ok_or_else(|| {
            let value = format!("{self:?}");
            FrameError::BadPose(ParamError { field: "pose", value, allowed: "a rotation and a finite position" })
        })
    }
}

/// Shapes in the world; the id of an object is its index.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Scene {
    /// The shapes.
    pub objects: Vec<Shape>,
}

/// Noise-free image of a scene, row by row, in camera coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// The camera.
    pub camera: Camera,
    /// Position of the surface at the centre of each pixel, in metres; NaN for pixels that see no surface.
    pub points: Xyz,
    /// Unit normals towards the camera; NaN for pixels that see no surface.
    pub normals: Xyz,
    /// Index of the object that each pixel sees, or [`NO_OBJECT`].
    pub objects: Vec<u16>,
}

impl Scene {
    /// Ray-casts the scene.
    pub fn render(&self, camera: &Camera, pose: &Pose) -> Truth {
        let pixels: Vec<_> = (0..camera.width * camera.height)
            .into_par_iter()
            .with_min_len(camera.width)
            .map(|i| self.cast(camera, pose, i % camera.width, i / camera.width))
            .collect();
        Truth {
            camera: *camera,
            points: pixels.iter().map(|p| p.0.as_vec3().to_array()).collect(),
            normals: pixels.iter().map(|p| p.1.as_vec3().to_array()).collect(),
            objects: pixels.iter().map(|p| p.2).collect(),
        }
    }

    /// Returns the point, the normal and the object that one pixel sees.
    fn cast(&self, camera: &Camera, pose: &Pose, u: usize, v: usize) -> (DVec3, DVec3, u16) {
        // With z = 1 the distance along the ray is the depth.
        let ray = DVec3::new((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy, 1.0);
        let direction = pose.world_from_camera * ray;
        let nearest = (0u16..)
            .zip(&self.objects)
            .filter_map(|(id, shape)| shape.intersect(pose.position, direction).map(|(t, n)| (t, n, id)))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((depth, normal, id)) = nearest else { return (DVec3::NAN, DVec3::NAN, NO_OBJECT) };
        let normal = pose.world_from_camera.transpose() * normal;
        (depth * ray, if normal.dot(ray) > 0.0 { -normal } else { normal }, id)
    }
}

impl Truth {
    /// Returns the cosine of the angle between the surface's normal and the ray, 0 to 1; NaN without a surface.
    pub fn incidence_cosine(&self, i: usize) -> f64 {
        let p = self.points.vector(i);
        let n = self.normals.vector(i);
        -n.dot(p) / p.length()
    }

    /// Returns true if the surface jumps between two pixels: each is off the other's tangent plane by more than 1 % of
    /// the smaller depth, or only one of them has a surface.
    pub fn is_step(&self, i: usize, j: usize) -> bool {
        let seen = |k: usize| self.objects[k] != NO_OBJECT;
        if !(seen(i) && seen(j)) {
            return seen(i) != seen(j);
        }
        let off_plane = |a: usize, b: usize| {
            let (pa, pb, n) = (self.points.get(a), self.points.get(b), self.normals.get(a));
            (0..3).map(|k| (pb[k] - pa[k]) * n[k]).sum::<f32>().abs()
        };
        off_plane(i, j).min(off_plane(j, i)) > 0.01 * self.points.z()[i].min(self.points.z()[j])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::CURVES_RANGES_M;

    /// Returns the point and the normal where a ray from the origin hits the shape.
    fn probe(shape: Shape, direction: DVec3) -> Option<(DVec3, DVec3)> {
        shape.intersect(DVec3::ZERO, direction).map(|(t, n)| (t * direction, n))
    }

    #[test]
    fn rays_meet_shapes_where_geometry_says() {
        let centre_m = [0.0, 0.0, 2.0];
        let sphere = Shape::Sphere { centre_m, radius_m: 0.5 };
        assert_eq!(probe(sphere, DVec3::Z), Some((DVec3::new(0.0, 0.0, 1.5), -DVec3::Z)));
        assert_eq!(probe(sphere, DVec3::X), None);
        let axes = DMat3::IDENTITY.to_cols_array_2d();
        let cuboid = Shape::Cuboid { centre_m, half_extent_m: [1.0, 1.0, 0.25], axes };
        assert_eq!(probe(cuboid, DVec3::Z).map(|hit| hit.0.z), Some(1.75));
        assert_eq!(probe(cuboid, DVec3::new(1.0, 0.0, 1.0)), None);
        let cylinder = Shape::Cylinder { centre_m, axis: [0.0, 1.0, 0.0], radius_m: 0.5, half_height_m: 0.1 };
        assert_eq!(probe(cylinder, DVec3::Z).map(|hit| hit.0.z), Some(1.5));
        // From above, through the flat end.
        let end = probe(cylinder, DVec3::new(0.0, 0.1, 1.9));
        assert!(end.is_none_or(|(p, _)| p.y.abs() <= 0.1 + 1e-12));
        let plane = Shape::Plane { point_m: centre_m, normal: [0.0, 0.0, 1.0] };
        assert_eq!(probe(plane, -DVec3::Z), None);
        assert_eq!(probe(plane, DVec3::new(0.5, 0.0, 1.0)).map(|hit| hit.0), Some(DVec3::new(1.0, 0.0, 2.0)));
    }

    #[test]
    fn every_hit_of_a_scene_lies_on_its_object_and_faces_the_camera() {
        let camera = Camera::new((80, 60), [66.0; 2], [39.5, 29.5]);
        let tables = (0..4).map(Scene::tabletop);
        let curves = CURVES_RANGES_M.map(|range_m| {
            let (scene, pose, _) = Scene::curves(0, range_m);
            (scene, pose)
        });
        for (scene, pose) in tables.chain(curves) {
            let truth = scene.render(&camera, &pose);
            for i in 0..truth.objects.len() {
                if truth.objects[i] == NO_OBJECT {
                    assert!(!truth.points.is_finite(i));
                    continue;
                }
                let cosine = truth.incidence_cosine(i);
                assert!((0.0..=1.0 + 1e-6).contains(&cosine), "{cosine}");
                let p = truth.points.vector(i);
                let world = pose.world_from_camera * p + pose.position;
                let distance = match scene.objects[truth.objects[i] as usize] {
                    Shape::Plane { point_m, normal } => (world - DVec3::from(point_m)).dot(normal.into()),
                    Shape::Sphere { centre_m, radius_m } => (world - DVec3::from(centre_m)).length() - radius_m,
                    Shape::Cuboid { centre_m, half_extent_m, axes } => {
                        let box_from_world = DMat3::from_cols_array_2d(&axes).transpose();
                        let local = (box_from_world * (world - DVec3::from(centre_m))).abs();
                        (local - DVec3::from(half_extent_m)).max_element()
                    }
                    Shape::Cylinder { centre_m, axis, radius_m, half_height_m } => {
                        let (offset, axis) = (world - DVec3::from(centre_m), DVec3::from(axis));
                        let along = offset.dot(axis);
                        let across = (offset - along * axis).length();
                        (across - radius_m).max(along.abs() - half_height_m)
                    }
                    Shape::Torus { centre_m, axis, radius_m, tube_radius_m } => {
                        let (offset, axis) = (world - DVec3::from(centre_m), DVec3::from(axis));
                        let along = offset.dot(axis);
                        let across = (offset - along * axis).length();
                        (across - radius_m).hypot(along) - tube_radius_m
                    }
                    Shape::Saddle { centre_m, radius_m, .. } => {
                        let offset = world - DVec3::from(centre_m);
                        offset.z - (offset.x * offset.x - offset.y * offset.y) / (2.0 * radius_m)
                    }
                };
                assert!(distance.abs() < 1e-6, "{distance}");
            }
        }
    }
}
