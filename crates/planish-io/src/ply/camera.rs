//! The element `camera`, in which PCL writes the sensor's pose and the grid, after the vertices.
//!
//! PCL stores the rows of the rotation cloud_from_sensor in `x_axis`, `y_axis` and `z_axis`, and the width and height
//! in the viewport. It does not use the other properties, and writes them as 0. MeshLab writes an element of the same
//! name with different axes; it is recognized by its focal length, and its pose is ignored.

use super::header::{Element, Property};
use planish_core::{Attribute, AttributeValues, SensorPose};

/// The properties in PCL's order: position and rotation, five unused ones, width and height, two unused ones.
const PROPERTIES: [&str; 21] = [
    "view_px",
    "view_py",
    "view_pz",
    "x_axisx",
    "x_axisy",
    "x_axisz",
    "y_axisx",
    "y_axisy",
    "y_axisz",
    "z_axisx",
    "z_axisy",
    "z_axisz",
    "focal",
    "scalex",
    "scaley",
    "centerx",
    "centery",
    "viewportx",
    "viewporty",
    "k1",
    "k2",
];
const POSE: usize = 12;
const FOCAL_AND_SCALES: std::ops::Range<usize> = 12..15;
const WIDTH: usize = 17;
const HEIGHT: usize = 18;

/// Maximum rounding error, in metres, for a position to be written in f32, the type that PCL reads. Other positions
/// are written in f64.
const MAX_ROUNDING_M: f64 = 1e-4;

/// The contents of the element `camera`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct PlyCamera {
    /// The pose of the sensor; `None` if the file states no pose, or an invalid rotation.
    pub(super) pose: Option<SensorPose>,
    /// Width and height of the grid, if the file states one.
    pub(super) grid: Option<(usize, usize)>,
}

impl PlyCamera {
    /// Decodes the values of the element's properties, in order. Drops a pose that was not written by PCL.
    pub(super) fn of(element: &Element, values: &[f64]) -> Self {
        if values.len() != element.properties.len() {
            return Self::default();
        }
        let value = |k: usize| {
            let is_it = |property: &Property| property.name == PROPERTIES[k];
            values.get(element.properties.iter().position(is_it)?).copied()
        };
        let is_pcl = FOCAL_AND_SCALES.into_iter().all(|k| value(k).is_none_or(|value| value == 0.0));
        let numbers: Option<Vec<f64>> = (0..POSE).map(value).collect();
        let pose = numbers.filter(|_| is_pcl).and_then(|numbers| {
            let row = |k: usize| [numbers[k], numbers[k + 1], numbers[k + 2]];
            SensorPose::from_rotation(row(0), [row(3), row(6), row(9)])
        });
        let pixels = |k| value(k).filter(|&count| count > 1.0 && count.fract() == 0.0).map(|count| count as usize);
        Self { pose, grid: pixels(WIDTH).zip(pixels(HEIGHT)) }
    }

    /// Returns the element's properties for a pose and a grid, as columns of one value each.
    pub(super) fn columns(pose: &SensorPose, (width, height): (usize, usize)) -> Vec<Attribute> {
        let is_exact = |&coordinate: &f64| (f64::from(coordinate as f32) - coordinate).abs() <= MAX_ROUNDING_M;
        let fits = pose.position_m.iter().all(is_exact);
        let numbers: Vec<f64> = pose.position_m.into_iter().chain(pose.rotation().into_iter().flatten()).collect();
        let column = |(k, name): (usize, &str)| {
            let number = numbers.get(k).copied().unwrap_or(0.0);
            let values = match k {
                WIDTH => AttributeValues::I32(vec![width as i32]),
                HEIGHT => AttributeValues::I32(vec![height as i32]),
                0..3 if !fits => AttributeValues::F64(vec![number]),
                _ => AttributeValues::F32(vec![number as f32]),
            };
            Attribute { name: name.into(), count: 1, values }
        };
        PROPERTIES.into_iter().enumerate().map(column).collect()
    }
}
