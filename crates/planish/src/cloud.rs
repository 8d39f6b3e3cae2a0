//! Point clouds: positions as a structure of arrays, and every other field of the input carried through untouched.
//!
//! Positions are f32 metres. A hole (a pixel without a measurement) is a non-finite position. An organized cloud is
//! row-major: pixel (u, v) is index v * width + u.

use crate::camera::Camera;
use crate::error::FrameError;
use crate::smoothed::{Outputs, Smoothed};

/// Largest number of pixels of a frame; an index fits u32 with room for the window's halo.
pub const MAX_PIXELS: usize = 1 << 28;

pub(crate) fn validate_shape(width: usize, height: usize) -> Result<(), FrameError> {
    let pixels = width.checked_mul(height);
    if width == 0 || height == 0 || pixels.is_none_or(|n| n > MAX_PIXELS) {
        return Err(FrameError::BadShape { width, height, allowed: "1 to 2^28 pixels, neither side zero" });
    }
    Ok(())
}

/// Vectors as three planes of f32: positions in metres or unit normals.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Xyz {
    /// The x components.
    pub x: Vec<f32>,
    /// The y components.
    pub y: Vec<f32>,
    /// The z components.
    pub z: Vec<f32>,
}

impl Xyz {
    /// `len` vectors of the one value.
    pub fn filled(len: usize, value: f32) -> Self {
        Self { x: vec![value; len], y: vec![value; len], z: vec![value; len] }
    }

    /// How many vectors there are.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// Vector `i`.
    pub fn get(&self, i: usize) -> [f32; 3] {
        [self.x[i], self.y[i], self.z[i]]
    }

    /// Sets vector `i`.
    pub fn set(&mut self, i: usize, value: [f32; 3]) {
        [self.x[i], self.y[i], self.z[i]] = value;
    }

    /// Whether all components of vector `i` are finite.
    pub fn is_finite(&self, i: usize) -> bool {
        self.x[i].is_finite() && self.y[i].is_finite() && self.z[i].is_finite()
    }

    /// All vectors in order.
    pub fn iter(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        self.x.iter().zip(&self.y).zip(&self.z).map(|((&x, &y), &z)| [x, y, z])
    }

    pub(crate) fn check_len(&self, what: &str, expected: usize) -> Result<(), FrameError> {
        for (axis, values) in [("x", &self.x), ("y", &self.y), ("z", &self.z)] {
            if values.len() != expected {
                return Err(FrameError::LengthMismatch { what: format!("{what}.{axis}"), len: values.len(), expected });
            }
        }
        Ok(())
    }
}

impl FromIterator<[f32; 3]> for Xyz {
    fn from_iter<I: IntoIterator<Item = [f32; 3]>>(points: I) -> Self {
        let mut xyz = Self::default();
        for [x, y, z] in points {
            xyz.x.push(x);
            xyz.y.push(y);
            xyz.z.push(z);
        }
        xyz
    }
}

macro_rules! attribute_values {
    ($($variant:ident($scalar:ty), $doc:literal;)*) => {
        /// The values of a field, in the type the file has them in.
        #[derive(Debug, Clone, PartialEq)]
        pub enum AttributeValues {
            $(#[doc = $doc] $variant(Vec<$scalar>),)*
        }

        impl AttributeValues {
            /// How many values there are: points times values a point.
            pub fn len(&self) -> usize {
                match self { $(Self::$variant(values) => values.len(),)* }
            }

            /// Bytes of one value.
            pub fn scalar_size(&self) -> usize {
                match self { $(Self::$variant(_) => size_of::<$scalar>(),)* }
            }
        }

        $(impl From<Vec<$scalar>> for AttributeValues {
            fn from(values: Vec<$scalar>) -> Self { Self::$variant(values) }
        })*
    };
}

attribute_values! {
    I8(i8), "Signed, 8 bits.";
    U8(u8), "Unsigned, 8 bits.";
    I16(i16), "Signed, 16 bits.";
    U16(u16), "Unsigned, 16 bits.";
    I32(i32), "Signed, 32 bits.";
    U32(u32), "Unsigned, 32 bits.";
    I64(i64), "Signed, 64 bits.";
    U64(u64), "Unsigned, 64 bits.";
    F32(f32), "IEEE 754, 32 bits. Packed colours stored as F32 keep their bits.";
    F64(f64), "IEEE 754, 64 bits.";
}

impl AttributeValues {
    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// One field of a cloud beside its positions: colour, intensity, ring, label, padding.
#[derive(Debug, Clone, PartialEq)]
pub struct Attribute {
    /// The field's name in the file. Padding is called `_`, as in PCD.
    pub name: String,
    /// Values a point; 1 for a scalar field.
    pub count: usize,
    /// `count` values for each point, point after point.
    pub values: AttributeValues,
}

/// Where a file has its columns x, y and z, and how wide, so that it is written as it was read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PositionColumns {
    /// Indices of x, y and z among all columns; the attributes fill the others in order.
    pub index: [usize; 3],
    /// Whether they are f64 in the file.
    pub double: bool,
}

impl Default for PositionColumns {
    fn default() -> Self {
        Self { index: [0, 1, 2], double: false }
    }
}

/// A general point cloud: points in any order, with all their fields.
#[derive(Debug, Clone, PartialEq)]
pub struct PointCloud {
    /// Positions in metres, relative to `origin_m`. A non-finite one is a hole.
    pub positions: Xyz,
    /// What to add to every position, in f64, so that georeferenced clouds lose nothing to f32. Zero for a camera.
    pub origin_m: [f64; 3],
    /// Every field beside x, y, z, in the order of the file.
    pub attributes: Vec<Attribute>,
    /// Where x, y, z stand among the fields of the file.
    pub position_columns: PositionColumns,
    /// Sensor position (x, y, z) and orientation quaternion (w, x, y, z), as PCD's VIEWPOINT has it.
    pub viewpoint: [f64; 7],
}

/// The viewpoint of a sensor at the origin that is not turned.
pub const IDENTITY_VIEWPOINT: [f64; 7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];

impl PointCloud {
    /// A cloud of positions alone.
    pub fn new(positions: Xyz) -> Self {
        Self {
            positions,
            origin_m: [0.0; 3],
            attributes: Vec::new(),
            position_columns: PositionColumns::default(),
            viewpoint: IDENTITY_VIEWPOINT,
        }
    }

    /// How many points there are, holes included.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no points at all.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// How many points are finite.
    pub fn valid_points(&self) -> usize {
        (0..self.len()).filter(|&i| self.positions.is_finite(i)).count()
    }

    /// The field of that name.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|attribute| attribute.name == name)
    }

    /// Replaces the scalar field of that name where it stands, or adds it at the end.
    pub fn set_attribute(&mut self, name: &str, values: impl Into<AttributeValues>) {
        let attribute = Attribute { name: name.to_owned(), count: 1, values: values.into() };
        match self.attributes.iter_mut().find(|a| a.name == name) {
            Some(existing) => *existing = attribute,
            None => self.attributes.push(attribute),
        }
    }

    /// Puts the result in place of the positions and adds those of `fields` that the result has: `normal_x`, `normal_y`,
    /// `normal_z`, `curvature` (PCL's names), `status` and `neighbours`. All other fields stay as they are.
    pub fn apply(&mut self, smoothed: &Smoothed, fields: Outputs) -> Result<(), FrameError> {
        smoothed.points.check_len("the smoothed points", self.len())?;
        self.positions.clone_from(&smoothed.points);
        if let (true, Some(normals)) = (fields.normals, &smoothed.normals) {
            self.set_attribute("normal_x", normals.x.clone());
            self.set_attribute("normal_y", normals.y.clone());
            self.set_attribute("normal_z", normals.z.clone());
        }
        if let (true, Some(curvature)) = (fields.curvature, &smoothed.curvature) {
            self.set_attribute("curvature", curvature.clone());
        }
        if let (true, Some(status)) = (fields.status, &smoothed.status) {
            self.set_attribute("status", status.iter().map(|&s| s as u8).collect::<Vec<u8>>());
        }
        if let (true, Some(neighbours)) = (fields.neighbours, &smoothed.neighbours) {
            self.set_attribute("neighbours", neighbours.clone());
        }
        Ok(())
    }

    /// Refuses a cloud whose fields differ in length.
    pub fn validate(&self) -> Result<(), FrameError> {
        self.positions.check_len("positions", self.len())?;
        for attribute in &self.attributes {
            let expected = self.len() * attribute.count;
            let len = attribute.values.len();
            if len != expected {
                return Err(FrameError::LengthMismatch { what: format!("field {}", attribute.name), len, expected });
            }
        }
        Ok(())
    }
}

/// A cloud on the pixel grid of the camera that took it.
#[derive(Debug, Clone, PartialEq)]
pub struct OrganizedCloud {
    width: usize,
    height: usize,
    /// The points, row by row; `points.len()` is width * height.
    pub points: PointCloud,
    /// The camera, where it is known. The sensor radius needs its fx; without one it is estimated.
    pub camera: Option<Camera>,
}

impl OrganizedCloud {
    /// Puts `points` on a grid; refuses a grid that they do not fill exactly.
    pub fn new(width: usize, height: usize, points: PointCloud) -> Result<Self, FrameError> {
        validate_shape(width, height)?;
        points.validate()?;
        if points.len() != width * height {
            return Err(FrameError::LengthMismatch {
                what: format!("an organized cloud of {width}x{height}"),
                len: points.len(),
                expected: width * height,
            });
        }
        Ok(Self { width, height, points, camera: None })
    }

    /// A cloud of positions alone on a grid.
    pub fn from_positions(width: usize, height: usize, positions: Xyz) -> Result<Self, FrameError> {
        Self::new(width, height, PointCloud::new(positions))
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The positions, row by row.
    pub fn positions(&self) -> &Xyz {
        &self.points.positions
    }

    /// 1/fx: metres between neighbouring pixels at 1 m, from the camera where it is known, else from the points.
    ///
    /// In a pinhole image X/Z grows by exactly 1/fx from a pixel to its right neighbour, whatever the surface; the median
    /// of that difference over a sample of the rows is the estimate. `None` if no two neighbours are valid.
    pub fn pixel_pitch_at_1m(&self) -> Option<f64> {
        self.estimate_pitch(&mut Vec::new())
    }

    /// The same with room for the sample, which is kept for the next frame.
    pub(crate) fn estimate_pitch(&self, pitches: &mut Vec<f64>) -> Option<f64> {
        if let Some(camera) = self.camera {
            return Some(1.0 / camera.fx);
        }
        const SAMPLED_ROWS: usize = 16;
        let step = self.height.div_ceil(SAMPLED_ROWS);
        let positions = self.positions();
        pitches.clear();
        for row in (0..self.height).step_by(step) {
            for i in row * self.width..(row + 1) * self.width - 1 {
                let tangent = |j: usize| f64::from(positions.x[j]) / f64::from(positions.z[j]);
                let pitch = (tangent(i + 1) - tangent(i)).abs();
                if positions.is_finite(i) && positions.is_finite(i + 1) && pitch.is_finite() && pitch > 0.0 {
                    pitches.push(pitch);
                }
            }
        }
        if pitches.is_empty() {
            return None;
        }
        let middle = pitches.len() / 2;
        Some(*pitches.select_nth_unstable_by(middle, f64::total_cmp).1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pitch_is_estimated_to_a_part_in_a_thousand_on_a_tilted_noisy_plane() {
        let camera = Camera::kinect_v1();
        let (rays_x, rays_y) = (camera.rays_x(), camera.rays_y());
        let positions = (0..480 * 640)
            .map(|i| {
                let (u, v) = (i % 640, i / 640);
                let z = 1.0 + 0.001 * u as f32 + 0.002 * (i % 7) as f32;
                [rays_x[u] * z, rays_y[v] * z, if i % 11 == 0 { f32::NAN } else { z }]
            })
            .collect();
        let cloud = OrganizedCloud::from_positions(640, 480, positions).unwrap();
        let pitch = cloud.pixel_pitch_at_1m().unwrap();
        assert!((pitch * 525.0 - 1.0).abs() < 1e-3, "{pitch}");
    }

    #[test]
    fn no_valid_neighbours_give_no_pitch() {
        let cloud = OrganizedCloud::from_positions(4, 2, Xyz::filled(8, f32::NAN)).unwrap();
        assert_eq!(cloud.pixel_pitch_at_1m(), None);
        let cloud = OrganizedCloud::from_positions(1, 3, Xyz::filled(3, 1.0)).unwrap();
        assert_eq!(cloud.pixel_pitch_at_1m(), None);
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        let error = OrganizedCloud::from_positions(4, 3, Xyz::filled(11, 0.0)).unwrap_err();
        assert!(error.to_string().contains("11 values where 12"), "{error}");
        assert!(OrganizedCloud::from_positions(0, 3, Xyz::default()).is_err());
        assert!(OrganizedCloud::from_positions(usize::MAX, 2, Xyz::default()).is_err());
    }
}
