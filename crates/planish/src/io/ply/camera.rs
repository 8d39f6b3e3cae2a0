//! The element `camera`: the sensor's pose and the grid, as PCL writes them behind the vertices.
//!
//! PCL has the rows of cloud_from_sensor's rotation in `x_axis`, `y_axis` and `z_axis`, and width and height in the viewport. Of the
//! rest it uses nothing, and writes 0.

use super::super::columns::with_values;
use crate::cloud::{Attribute, AttributeValues};
use crate::pose::SensorPose;

/// The properties in PCL's order: position and rotation, what it does not use, width and height, what it does not use.
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
const WIDTH: usize = 17;
const HEIGHT: usize = 18;

/// Positions are written in f32, which PCL reads, unless that moves them farther than this.
const MAX_ROUNDING_M: f64 = 1e-4;

/// What the element says.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct PlyCamera {
    /// `None` if it states none, or one that is no rotation.
    pub(super) pose: Option<SensorPose>,
    /// Width and height of a grid.
    pub(super) grid: Option<(usize, usize)>,
}

impl PlyCamera {
    /// From the element's properties, one value each.
    pub(super) fn of(columns: &[Attribute]) -> Self {
        let value = |k: usize| first_value(columns.iter().find(|column| column.name == PROPERTIES[k])?);
        let numbers: Option<Vec<f64>> = (0..POSE).map(value).collect();
        let pose = numbers.and_then(|numbers| {
            let row = |k: usize| [numbers[k], numbers[k + 1], numbers[k + 2]];
            SensorPose::from_rotation(row(0), [row(3), row(6), row(9)])
        });
        let pixels = |k| value(k).filter(|&count| count >= 1.0 && count.fract() == 0.0).map(|count| count as usize);
        Self { pose, grid: pixels(WIDTH).zip(pixels(HEIGHT)).filter(|&(_, height)| height > 1) }
    }

    /// The element's properties for a pose, one value each.
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

// Of the ten types one is f64 already.
#[allow(clippy::unnecessary_cast)]
fn first_value(column: &Attribute) -> Option<f64> {
    with_values!(&column.values, values => values.first().map(|&value| value as f64))
}
