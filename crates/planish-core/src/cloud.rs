//! Point clouds: positions as a structure of arrays, and all other fields of the input, which are passed through
//! unchanged.
//!
//! Positions are f32 metres. A hole (a pixel without a measurement) is a non-finite position. An organized cloud is
//! row-major: pixel (u, v) is index v * width + u.

use std::sync::Arc;

use rayon::prelude::*;

use crate::camera::Camera;
use crate::error::FrameError;
use crate::pose::SensorPose;
use crate::provenance::Provenance;
use crate::xyz::{Xyz, validate_shape};

macro_rules! attribute_values {
    ($($variant:ident($scalar:ty), $doc:literal;)*) => {
        /// The values of a field, in the type that they have in the file.
        #[derive(Debug, Clone, PartialEq)]
        pub enum AttributeValues {
            $(#[doc = $doc] $variant(Vec<$scalar>),)*
        }

        impl AttributeValues {
            /// Returns the number of values, which is the number of points times the number of values per point.
            pub fn len(&self) -> usize {
                match self { $(Self::$variant(values) => values.len(),)* }
            }

            /// Returns the size of one value in bytes.
            pub fn scalar_size(&self) -> usize {
                match self { $(Self::$variant(_) => size_of::<$scalar>(),)* }
            }

            /// Returns value `i` as f64. 64-bit integers beyond 2^53 are rounded.
            pub fn get_f64(&self, i: usize) -> f64 {
                match self { $(Self::$variant(values) => values[i] as f64,)* }
            }

            /// Converts new values to the type of these values; integers are rounded and clamped to their range.
            pub fn of_f64(&self, new: Vec<f64>) -> Self {
                match self { $(Self::$variant(_) => {
                    let convert = |value: f64| if 0.5 as $scalar == 0 as $scalar { value.round() as $scalar } else { value as $scalar };
                    Self::$variant(new.into_iter().map(convert).collect())
                })* }
            }

            /// Appends `count` zeros.
            pub fn push_zeros(&mut self, count: usize) {
                match self { $(Self::$variant(values) => values.resize(values.len() + count, 0 as $scalar),)* }
            }

            /// Returns an empty list of values of the same type.
            pub fn emptied(&self) -> Self {
                match self { $(Self::$variant(_) => Self::$variant(Vec::new()),)* }
            }

            /// Appends the values that `other` has for some points, `count` per point. Values of another type are
            /// converted.
            pub fn extend_from(&mut self, other: &Self, points: &[usize], count: usize) {
                match (self, other) {
                    $((Self::$variant(values), Self::$variant(other)) => {
                        let of_point = |&i: &usize| other[count * i..count * (i + 1)].iter().copied();
                        values.extend(points.iter().flat_map(of_point));
                    })*
                    (this, other) => {
                        let value = |i: usize| other.get_f64(i);
                        let wanted = points.iter().flat_map(|&i| count * i..count * (i + 1)).map(value).collect();
                        let all: Vec<usize> = (0..points.len()).collect();
                        let converted = this.of_f64(wanted);
                        this.extend_from(&converted, &all, count);
                    }
                }
            }

            /// Returns the values of some points, `count` per point.
            fn select(&self, points: &[usize], count: usize) -> Self {
                match self { $(Self::$variant(values) => {
                    let of_point = |&i: &usize| values[count * i..count * (i + 1)].iter().copied();
                    Self::$variant(points.iter().flat_map(of_point).collect())
                })* }
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
    /// Returns true if there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A field of a cloud other than positions: colour, intensity, ring, label, padding.
#[derive(Debug, Clone, PartialEq)]
pub struct Attribute {
    /// The field's name in the file. Padding is called `_`, as in PCD.
    pub name: String,
    /// Number of values per point; 1 for a scalar field.
    pub count: usize,
    /// The values in the order of the points, `count` per point.
    pub values: AttributeValues,
}

impl Attribute {
    /// Returns the field with the values of these points only.
    pub fn select(&self, points: &[usize]) -> Self {
        Self { name: self.name.clone(), count: self.count, values: self.values.select(points, self.count) }
    }
}

/// Absolute coordinate in metres beyond which 4 bytes lose more than 0.1 mm of precision.
const FAR_M: f64 = 1000.0;

/// Indices and precision of the columns x, y and z of a file, for writing the file back in the same layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PositionColumns {
    /// Indices of x, y and z among all columns; the attributes fill the others in order.
    pub index: [usize; 3],
    /// The precision with which x, y and z are written.
    pub precision: Precision,
}

/// The precision with which x, y and z are written, in formats that support both 4 and 8 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// 8 bytes if 4 bytes would lose more than 0.1 mm (beyond 1000 m), otherwise 4 bytes.
    #[default]
    AsNeeded,
    /// 4 bytes.
    F32,
    /// 8 bytes.
    F64,
}

impl Default for PositionColumns {
    fn default() -> Self {
        Self { index: [0, 1, 2], precision: Precision::AsNeeded }
    }
}

/// The coordinates that a file with integer coordinates can hold: an offset plus multiples of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoordinateSteps {
    /// The distance between adjacent coordinates, in metres.
    pub step_m: f64,
    /// The coordinate of step 0, in metres.
    pub offset_m: f64,
}

impl CoordinateSteps {
    /// Returns the coordinate on a step that is nearest to `coordinate_m`.
    fn nearest(&self, coordinate_m: f64) -> f64 {
        ((coordinate_m - self.offset_m) / self.step_m).round() * self.step_m + self.offset_m
    }
}

/// A general point cloud: points in any order, with all their fields.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct PointCloud {
    /// Positions in metres, relative to `origin_m`. A non-finite position is a hole.
    pub positions: Xyz,
    /// Offset in metres that is added to every position, in f64 so that georeferenced clouds keep their digits. Zero
    /// for clouds from a camera.
    pub origin_m: [f64; 3],
    /// All fields except x, y and z, in the order of the file.
    pub attributes: Vec<Attribute>,
    /// The columns of x, y and z in the file.
    pub position_columns: PositionColumns,
    /// The sensor's pose in the frame of the file (not relative to `origin_m`); the identity if unknown.
    pub pose: SensorPose,
    /// The file's coordinates x, y and z in metres, if f32 would lose digits (possibly empty for axes without such a
    /// loss). Unmoved points are written with these digits.
    pub exact_m: Option<[Vec<f64>; 3]>,
    /// The steps of the coordinates x, y and z in the file. Unmoved points are written at the nearest step, without the
    /// rounding of f32.
    pub steps: Option<[CoordinateSteps; 3]>,
    /// Format-specific data of the cloud's file; written back to a file of the same format.
    pub provenance: Provenance,
    /// Positions of the scanners in metres, in the frame of the file, indexed by the field `scan`.
    pub(crate) scanners_m: Option<Arc<[Option<[f64; 3]>]>>,
}

impl PointCloud {
    /// Creates a cloud that has only positions.
    pub fn new(positions: Xyz) -> Self {
        Self {
            positions,
            origin_m: [0.0; 3],
            attributes: Vec::new(),
            position_columns: PositionColumns::default(),
            pose: SensorPose::IDENTITY,
            exact_m: None,
            steps: None,
            provenance: Provenance::default(),
            scanners_m: None,
        }
    }

    /// Sets the position of each scanner; see [`scanners_m`](Self::scanners_m).
    pub fn set_scanners_m(&mut self, scanners_m: Vec<Option<[f64; 3]>>) {
        self.scanners_m = Some(scanners_m.into());
    }

    /// Returns the number of points, including holes.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns true if there are no points, not even holes.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Returns the number of finite points.
    pub fn valid_points(&self) -> usize {
        (0..self.len()).filter(|&i| self.positions.is_finite(i)).count()
    }

    /// Returns the size of a point's fields in bytes, including its f64 coordinates if they are stored.
    pub fn field_bytes_per_point(&self) -> usize {
        let bytes = |field: &Attribute| field.values.scalar_size() * field.count;
        let exact = if self.exact_m.is_some() { 3 * size_of::<f64>() } else { 0 };
        exact + self.attributes.iter().map(bytes).sum::<usize>()
    }

    /// Returns the field with this name.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|attribute| attribute.name == name)
    }

    /// Replaces the field with this name by a scalar field, or appends the scalar field.
    pub fn set_attribute(&mut self, name: &str, values: impl Into<AttributeValues>) {
        let attribute = Attribute { name: name.to_owned(), count: 1, values: values.into() };
        match self.attributes.iter_mut().find(|a| a.name == name) {
            Some(existing) => *existing = attribute,
            None => self.attributes.push(attribute),
        }
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

    /// Returns the points with these indices, with all their fields, in the given order.
    ///
    /// # Panics
    /// If an index is not less than [`len`](Self::len).
    pub fn select(&self, points: &[usize]) -> Self {
        let positions = points.iter().map(|&i| self.positions.get(i)).collect();
        let attributes = self.attributes.par_iter().map(|attribute| attribute.select(points)).collect();
        let exact_m = self
            .exact_m
            .as_ref()
            .map(|axes| axes.each_ref().map(|values| points.iter().filter_map(|&i| values.get(i)).copied().collect()));
        Self { positions, attributes, exact_m, ..self.without_points() }
    }

    /// Returns coordinate `axis` of point `i` in the cloud's frame: exactly the value in the file if the point has
    /// not moved.
    pub fn coordinate(&self, axis: usize, i: usize) -> f64 {
        let (origin, here) = (self.origin_m[axis], self.positions.as_slices()[axis][i]);
        self.exact(axis, i).unwrap_or(origin + f64::from(here))
    }

    /// Returns true if coordinate `axis` of point `i` is known to be unchanged since the file was read. Always false if
    /// neither [`exact_m`](Self::exact_m) nor [`steps`](Self::steps) is set.
    pub fn is_unmoved(&self, axis: usize, i: usize) -> bool {
        self.exact(axis, i).is_some()
    }

    fn exact(&self, axis: usize, i: usize) -> Option<f64> {
        let (origin, here) = (self.origin_m[axis], self.positions.as_slices()[axis][i]);
        let exact = self.exact_m.as_ref().and_then(|axes| axes[axis].get(i)).copied();
        let on_step = || self.steps.map(|steps| steps[axis].nearest(origin + f64::from(here)));
        exact.or_else(on_step).filter(|exact| (exact - origin) as f32 == here)
    }

    /// Returns true if coordinates are written in 8 bytes, in formats that support it.
    pub fn is_written_in_f64(&self) -> bool {
        match self.position_columns.precision {
            Precision::F32 => false,
            Precision::F64 => true,
            Precision::AsNeeded => (0..3).any(|axis| {
                let origin_m = self.origin_m[axis];
                let is_far = |value: &f32| (origin_m + f64::from(*value)).abs() > FAR_M && value.is_finite();
                origin_m != 0.0 && self.positions.as_slices()[axis].iter().any(is_far)
            }),
        }
    }

    /// Stores the coordinates of a file in f64 if f32 loses digits of any coordinate.
    pub fn keep_exact(&mut self, coordinates_m: [Vec<f64>; 3]) {
        let loses = |axis: usize| {
            let values = self.positions.as_slices()[axis];
            let origin = self.origin_m[axis];
            coordinates_m[axis]
                .iter()
                .zip(values)
                .any(|(exact, &value)| origin + f64::from(value) != *exact && !exact.is_nan())
        };
        if (0..3).any(loses) {
            self.exact_m = Some(coordinates_m);
        }
    }

    /// Returns a copy of the cloud with an additional hole at the end, whose other fields are 0.
    pub fn with_an_empty_point(&self) -> Self {
        let mut cloud = self.clone();
        cloud.positions.push([f32::NAN; 3]);
        cloud.exact_m = None;
        cloud.attributes.iter_mut().for_each(|attribute| attribute.values.push_zeros(attribute.count));
        cloud
    }

    /// Returns an empty cloud with the same origin, pose, position columns, coordinate steps, scanners and
    /// format-specific data.
    pub fn without_points(&self) -> Self {
        Self {
            positions: Xyz::default(),
            origin_m: self.origin_m,
            attributes: Vec::new(),
            position_columns: self.position_columns,
            pose: self.pose,
            exact_m: None,
            steps: self.steps,
            provenance: self.provenance.clone(),
            scanners_m: self.scanners_m.clone(),
        }
    }

    /// Returns the side lengths in metres of the bounding box of all finite points; zeros if no point is finite.
    pub fn extent_m(&self) -> [f32; 3] {
        let finite = |values: &[f32]| {
            let finite = values.iter().filter(|value| value.is_finite());
            finite.fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], &value| [low.min(value), high.max(value)])
        };
        self.positions.as_slices().map(finite).map(|[low, high]| (high - low).max(0.0))
    }

    /// Estimates, from a sample of points, the mean number of points within `radius_m` of a point, including the point
    /// itself.
    pub fn mean_neighbours(&self, radius_m: f32) -> f64 {
        const QUERIES: usize = 32;
        let [x, y, z] = self.positions.as_slices();
        let finite: Vec<usize> = (0..self.len()).filter(|&i| self.positions.is_finite(i)).collect();
        let queries: Vec<usize> =
            finite.iter().copied().step_by((finite.len() / QUERIES).max(1)).take(QUERIES).collect();
        let square = f64::from(radius_m) * f64::from(radius_m);
        let within = |&query: &usize| {
            let p = self.positions.get(query).map(f64::from);
            let points = x.iter().zip(y).zip(z);
            let distance = |((&x, &y), &z): ((&f32, &f32), &f32)| {
                let offset = [f64::from(x) - p[0], f64::from(y) - p[1], f64::from(z) - p[2]];
                offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
            };
            points.map(distance).filter(|distance| *distance <= square).count()
        };
        let total: usize = queries.par_iter().map(within).sum();
        total as f64 / queries.len().max(1) as f64
    }
}

/// A cloud on the pixel grid of its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct OrganizedCloud {
    width: usize,
    height: usize,
    /// The points, row by row; `points.len()` is width * height.
    pub points: PointCloud,
    /// The camera, if known. [`FrameRadius::Sensor`](crate::FrameRadius::Sensor) needs its focal length fx, which is
    /// estimated from the points if the camera is unknown.
    pub camera: Option<Camera>,
}

impl OrganizedCloud {
    /// Arranges `points` row by row on a grid; refuses a grid that they do not fill exactly.
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

    /// Creates an organized cloud that has only positions.
    pub fn from_positions(width: usize, height: usize, positions: Xyz) -> Result<Self, FrameError> {
        Self::new(width, height, PointCloud::new(positions))
    }

    /// Returns the width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns the height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Returns the positions, row by row.
    pub fn positions(&self) -> &Xyz {
        &self.points.positions
    }

    /// Sets the cloud's camera.
    pub fn with_camera(self, camera: Camera) -> Self {
        Self { camera: Some(camera), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        let error = OrganizedCloud::from_positions(4, 3, Xyz::filled(11, 0.0)).unwrap_err();
        assert!(error.to_string().contains("11 values; expected 12"), "{error}");
        assert!(OrganizedCloud::from_positions(0, 3, Xyz::default()).is_err());
        assert!(OrganizedCloud::from_positions(usize::MAX, 2, Xyz::default()).is_err());
    }
}
