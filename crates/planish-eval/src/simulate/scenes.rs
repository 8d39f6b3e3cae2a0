//! Scenes generated from seeds: a table with objects seen from above, a room, and shapes of known size.

use glam::{DMat3, DVec3};

use super::random::Random;
use super::scene::{Pose, Scene, Shape};

/// Height of the table above the floor, in metres.
const TABLE_HEIGHT_M: f64 = 0.75;
/// Height of the camera above the table, in metres.
const CAMERA_OVER_TABLE_M: f64 = 0.45;

impl Scene {
    /// Returns a table 0.6 to 1.5 m away, with spheres, boxes and cylinders on it, in front of a wall. The camera
    /// looks down on it.
    pub fn tabletop(seed: u64) -> (Self, Pose) {
        let mut random = Random::new(seed, 1);
        let floor_y = TABLE_HEIGHT_M + CAMERA_OVER_TABLE_M;
        let table_y = CAMERA_OVER_TABLE_M;
        let yaw = random.between(-0.15, 0.15);
        let mut objects = vec![
            Shape::Plane { point_m: [0.0, floor_y, 0.0], normal: DVec3::Y.to_array() },
            Shape::Plane {
                point_m: [0.0, 0.0, random.between(2.2, 2.8)],
                normal: (DMat3::from_rotation_y(yaw) * DVec3::Z).to_array(),
            },
            Shape::Cuboid {
                centre_m: [0.0, table_y + 0.02, 1.05],
                half_extent_m: [0.7, 0.02, 0.45],
                axes: DMat3::from_rotation_y(random.between(-0.1, 0.1)).to_cols_array_2d(),
            },
        ];
        // One object per cell of a 4 x 2 grid, so that objects do not touch and hardly occlude each other.
        for cell in 0..8 {
            let x = -0.45 + 0.3 * f64::from(cell % 4) + random.between(-0.05, 0.05);
            let z = 0.85 + 0.32 * f64::from(cell / 4) + random.between(-0.05, 0.05);
            objects.push(standing_object(&mut random, DVec3::new(x, table_y, z), 1.0));
        }
        let pose = Pose::looking([0.0; 3], random.between(-0.05, 0.05), random.between(0.45, 0.55));
        (Self { objects }, pose)
    }

    /// Returns a room about 4 m wide and deep, with boxes, pillars and balls 1.2 to 3.5 m away. The camera is 1.2 m
    /// above the floor.
    pub fn room(seed: u64) -> (Self, Pose) {
        let mut random = Random::new(seed, 2);
        let floor_y = 1.2;
        let mut objects = vec![
            Shape::Plane { point_m: [0.0, floor_y, 0.0], normal: DVec3::Y.to_array() },
            Shape::Plane { point_m: [0.0, 0.0, random.between(3.6, 4.2)], normal: DVec3::Z.to_array() },
            Shape::Plane { point_m: [random.between(-2.2, -1.6), 0.0, 0.0], normal: DVec3::X.to_array() },
            Shape::Plane { point_m: [random.between(1.6, 2.2), 0.0, 0.0], normal: DVec3::X.to_array() },
        ];
        for cell in 0..6 {
            let x = -1.0 + f64::from(cell % 3) + random.between(-0.2, 0.2);
            let z = 1.8 + 1.1 * f64::from(cell / 3) + random.between(-0.3, 0.3);
            objects.push(standing_object(&mut random, DVec3::new(x, floor_y, z), 4.0));
        }
        (Self { objects }, Pose::looking([0.0; 3], random.between(-0.2, 0.2), random.between(0.1, 0.25)))
    }

    /// Returns shapes of known size in front of a wall: the 90° edge of a box at 1 m, and a sphere and a cylinder with
    /// radii of 60 to 100 mm at 0.8 to 1.4 m. The camera is at the origin and looks along z.
    pub fn gauges(seed: u64) -> (Self, Pose, Gauge) {
        let mut random = Random::new(seed, u64::MAX);
        let turn = std::f64::consts::FRAC_PI_4 + random.between(-0.2, 0.2);
        let lean = DMat3::from_rotation_z(random.between(-0.15, 0.15));
        let world_from_box = lean * DMat3::from_rotation_y(turn);
        let half_m = 0.12;
        // Because the box is turned by about 45°, this is the edge nearest to the camera.
        let to_edge = world_from_box * DVec3::new(half_m, 0.0, -half_m);
        let wedge = Shape::Cuboid {
            centre_m: (DVec3::new(0.0, 0.0, 1.0) - to_edge).to_array(),
            half_extent_m: [half_m, 0.25, half_m],
            axes: world_from_box.to_cols_array_2d(),
        };
        let (sphere_radius_m, cylinder_radius_m) = (random.between(0.06, 0.1), random.between(0.06, 0.1));
        let (sphere_z, cylinder_z) = (random.between(0.8, 1.4), random.between(0.8, 1.4));
        let sphere_centre = DVec3::new(-0.38 * sphere_z, random.between(-0.1, 0.1), sphere_z);
        let cylinder_centre = DVec3::new(0.38 * cylinder_z, 0.0, cylinder_z);
        let cylinder_axis = (DVec3::Y + random.between(-0.3, 0.3) * DVec3::Z).normalize();
        let objects = vec![
            Shape::Plane { point_m: [0.0, 0.0, random.between(1.8, 2.4)], normal: DVec3::Z.to_array() },
            wedge,
            Shape::Sphere { centre_m: sphere_centre.to_array(), radius_m: sphere_radius_m },
            Shape::Cylinder {
                centre_m: cylinder_centre.to_array(),
                axis: cylinder_axis.to_array(),
                radius_m: cylinder_radius_m,
                half_height_m: 0.2,
            },
        ];
        let gauge = Gauge {
            wedge: 1,
            sphere: 2,
            sphere_centre,
            sphere_radius_m,
            cylinder: 3,
            cylinder_centre,
            cylinder_axis,
            cylinder_radius_m,
        };
        (Self { objects }, Pose::looking([0.0; 3], 0.0, 0.0), gauge)
    }
}

/// The ranges in metres at which curved surfaces are measured.
pub const CURVES_RANGES_M: [f64; 3] = [0.8, 1.2, 2.0];

/// A curved surface of known size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Curve {
    /// Index of the surface in the scene.
    pub object: u16,
    /// `cylinder`, `sphere`, `torus`, `saddle`, or, for comparison, the flat `board`.
    pub name: &'static str,
    /// Smallest radius of curvature of the surface, in metres; infinite for the board.
    pub radius_m: f64,
}

impl Scene {
    /// Returns curved surfaces of known radius in front of a wall: cylinders of 1.5 to 10 cm, spheres of 3 to 10 cm, a
    /// torus, a saddle, and a flat board. Their centres are at depth `range_m`. The camera is at the origin and looks
    /// along z.
    pub fn curves(seed: u64, range_m: f64) -> (Self, Pose, Vec<Curve>) {
        let mut random = Random::new(seed, 3);
        let mut objects = vec![Shape::Plane { point_m: [0.0, 0.0, range_m + 0.5], normal: DVec3::Z.to_array() }];
        let mut curves = Vec::new();
        let mut add = |name, radius_m, shape| {
            curves.push(Curve { object: objects.len() as u16, name, radius_m });
            objects.push(shape);
        };
        let (above_m, below_m) = (-0.17, 0.17);
        // A randomly shifted position at this offset from the camera's axis.
        let mut place = |x_m: f64, y_m: f64| {
            let jitter_m = [random.between(-0.004, 0.004), random.between(-0.004, 0.004)];
            DVec3::new(x_m + jitter_m[0], y_m + jitter_m[1], range_m)
        };
        for (x_m, radius_m) in [(-0.40, 0.015), (-0.32, 0.03), (-0.20, 0.05), (-0.01, 0.1)] {
            let axis = DVec3::new(0.04, 1.0, 0.15).normalize();
            let shape = Shape::Cylinder {
                centre_m: place(x_m, above_m).to_array(),
                axis: axis.to_array(),
                radius_m,
                half_height_m: 0.14,
            };
            add("cylinder", radius_m, shape);
        }
        let torus = Shape::Torus {
            centre_m: place(0.27, above_m).to_array(),
            axis: DVec3::new(0.1, 0.5, -1.0).normalize().to_array(),
            radius_m: 0.1,
            tube_radius_m: 0.045,
        };
        add("torus", 0.045, torus);
        for (x_m, radius_m) in [(-0.42, 0.03), (-0.31, 0.05), (-0.13, 0.1)] {
            add("sphere", radius_m, Shape::Sphere { centre_m: place(x_m, below_m).to_array(), radius_m });
        }
        let saddle_m = 0.15;
        let saddle = Shape::Saddle { centre_m: place(0.11, below_m).to_array(), radius_m: saddle_m, extent_m: 0.11 };
        add("saddle", saddle_m, saddle);
        let board = Shape::Cuboid {
            centre_m: place(0.34, below_m).to_array(),
            half_extent_m: [0.09, 0.11, 0.01],
            axes: DMat3::from_rotation_y(0.3).to_cols_array_2d(),
        };
        add("board", f64::INFINITY, board);
        (Self { objects }, Pose::looking([0.0; 3], 0.0, 0.0), curves)
    }
}

/// The shapes of [`Scene::gauges`], in camera coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gauge {
    /// Index of the object with the 90° edge, which is upright and 1 m in front of the camera.
    pub wedge: u16,
    /// Index of the sphere.
    pub sphere: u16,
    /// Centre of the sphere in metres.
    pub(crate) sphere_centre: DVec3,
    /// Radius of the sphere in metres.
    pub sphere_radius_m: f64,
    /// Index of the cylinder.
    pub cylinder: u16,
    /// A point on the cylinder's axis in metres.
    pub(crate) cylinder_centre: DVec3,
    /// Unit direction of the cylinder's axis.
    pub(crate) cylinder_axis: DVec3,
    /// Radius of the cylinder in metres.
    pub cylinder_radius_m: f64,
}

/// Returns a sphere, box or cylinder standing on `base`, with a size of a few centimetres times `scale`.
fn standing_object(random: &mut Random, base: DVec3, scale: f64) -> Shape {
    let radius_m = scale * random.between(0.05, 0.08);
    let half_height_m = scale * random.between(0.05, 0.11);
    let above = |height: f64| (base - DVec3::new(0.0, height, 0.0)).to_array();
    match random.uniform() {
        kind if kind < 0.35 => Shape::Sphere { centre_m: above(radius_m), radius_m },
        kind if kind < 0.7 => Shape::Cuboid {
            centre_m: above(half_height_m),
            half_extent_m: [radius_m, half_height_m, scale * random.between(0.04, 0.07)],
            axes: DMat3::from_rotation_y(random.between(-0.8, 0.8)).to_cols_array_2d(),
        },
        _ => Shape::Cylinder { centre_m: above(half_height_m), axis: DVec3::Y.to_array(), radius_m, half_height_m },
    }
}
