//! Converts between a file's columns, which include x, y and z, and a cloud's positions and attributes.

use planish_core::{Attribute, AttributeValues, FormatError, PointCloud, PositionColumns, Precision, Xyz};

use super::quoted;

/// Evaluates an expression on the vector inside `AttributeValues`, whatever its type.
#[doc(hidden)]
#[macro_export]
macro_rules! with_values {
    ($values:expr, $v:ident => $body:expr) => {{
        use $crate::internal::AttributeValues::*;
        match $values {
            I8($v) => $body,
            U8($v) => $body,
            I16($v) => $body,
            U16($v) => $body,
            I32($v) => $body,
            U32($v) => $body,
            I64($v) => $body,
            U64($v) => $body,
            F32($v) => $body,
            F64($v) => $body,
        }
    }};
}
pub use with_values;

/// Largest integer up to which f64 represents every integer exactly.
pub(crate) const EXACT_INTEGERS: u64 = 1 << 53;

/// Coordinate, in metres, above which f32 resolves no better than about 0.1 mm. Clouds with larger coordinates get an
/// origin near their points.
const FAR_M: f64 = 1000.0;

const AXES: [&str; 3] = ["x", "y", "z"];

/// Returns the indices of the columns x, y and z, named in lower or upper case.
pub(crate) fn axes_of(columns: &[Attribute]) -> Result<[usize; 3], FormatError> {
    let mut index = [0; 3];
    for (axis, name) in AXES.iter().enumerate() {
        let exact = columns.iter().position(|column| column.name == *name);
        let any_case = || columns.iter().position(|column| column.name.eq_ignore_ascii_case(name));
        index[axis] = exact.or_else(any_case).ok_or_else(|| {
            let names: Vec<_> = columns.iter().map(|column| column.name.as_str()).collect();
            FormatError::Malformed(format!(
                "missing field {name}; a point cloud needs x, y and z, but the fields are {}",
                quoted(&names.join(" "))
            ))
        })?;
    }
    Ok(index)
}

/// Returns the peak memory per point, in bytes, of columns of these types and of the cloud that [`cloud_from_columns`]
/// makes from them.
pub(crate) fn bytes_per_point(columns: &[Attribute]) -> usize {
    let all: usize = columns.iter().map(|column| column.count * column.values.scalar_size()).sum();
    let Ok(index) = axes_of(columns) else { return all };
    let axes = index.map(|axis| &columns[axis].values);
    if axes.iter().all(|values| matches!(values, AttributeValues::F32(_))) {
        return all;
    }
    // The coordinates are converted to f64, and then to f32.
    let widened = axes.iter().filter(|values| !matches!(values, AttributeValues::F64(_))).count();
    all + 8 * widened + 12
}

/// Converts a file's columns to a cloud; they must include x, y and z.
pub fn cloud_from_columns(mut columns: Vec<Attribute>) -> Result<PointCloud, FormatError> {
    let index = axes_of(&columns)?;
    // Remove the columns from last to first, so that the remaining indices stay valid.
    let mut take_order = [0, 1, 2];
    take_order.sort_by_key(|&axis| std::cmp::Reverse(index[axis]));
    let mut taken = [const { None }; 3];
    for axis in take_order {
        taken[axis] = Some(columns.remove(index[axis]));
    }
    let axes: Vec<Attribute> = taken.into_iter().flatten().collect();
    if let Some(axis) = axes.iter().find(|axis| axis.count != 1) {
        return Err(FormatError::Unsupported(format!(
            "the coordinate {} has {} values per point; expected one",
            axis.name, axis.count
        )));
    }
    let is_f64 = axes.iter().any(|axis| matches!(axis.values, AttributeValues::F64(_)));
    let mut axes = axes.into_iter().map(|axis| axis.values);
    let (positions, origin_m, exact) = match (axes.next(), axes.next(), axes.next()) {
        (Some(AttributeValues::F32(x)), Some(AttributeValues::F32(y)), Some(AttributeValues::F32(z))) => {
            (Xyz::from_arrays([x, y, z])?, [0.0; 3], None)
        }
        // The coordinates are integers, f64, or of different types.
        (x, y, z) => {
            let exact = [x, y, z].map(|values| values.map_or_else(Vec::new, to_f64));
            check_range(&exact)?;
            let origin = [origin_of(&exact[0]), origin_of(&exact[1]), origin_of(&exact[2])];
            let relative = |axis: usize| exact[axis].iter().map(|value| (value - origin[axis]) as f32).collect();
            (Xyz::from_arrays([relative(0), relative(1), relative(2)])?, origin, Some(exact))
        }
    };
    let mut cloud = PointCloud::new(positions);
    cloud.origin_m = origin_m;
    cloud.attributes = columns;
    let precision = if is_f64 { Precision::F64 } else { Precision::AsNeeded };
    cloud.position_columns = PositionColumns { index, precision };
    exact.into_iter().for_each(|exact| cloud.keep_exact(exact));
    Ok(cloud)
}

/// Returns an error if a finite coordinate is beyond f32's range and would become a hole.
fn check_range(coordinates: &[Vec<f64>; 3]) -> Result<(), FormatError> {
    for (name, values) in AXES.iter().zip(coordinates) {
        let is_beyond = |value: &&f64| value.is_finite() && (**value as f32).is_infinite();
        if let Some(value) = values.iter().find(is_beyond) {
            return Err(FormatError::Unsupported(format!(
                "the {name} coordinate {value:e} is too large; the limit is 3.4e38"
            )));
        }
    }
    Ok(())
}

fn to_f64(values: AttributeValues) -> Vec<f64> {
    match values {
        AttributeValues::F64(values) => values,
        values => (0..values.len()).map(|i| values.get_f64(i)).collect(),
    }
}

/// Returns the origin of coordinates along an axis: 0, or, for far coordinates, the median of a sample, truncated to
/// whole metres. Stray points do not move the median.
fn origin_of(values: &[f64]) -> f64 {
    const SAMPLE: usize = 1000;
    let step = values.len().div_ceil(SAMPLE).max(1);
    let mut sample: Vec<f64> = values.iter().step_by(step).copied().filter(|value| value.is_finite()).collect();
    sample.sort_by(f64::total_cmp);
    let middle = sample
        .get(sample.len().saturating_sub(1) / 2)
        .or(values.iter().find(|value| value.is_finite()))
        .copied()
        .unwrap_or(0.0);
    // If coordinates exceed half of f32's range, their differences from an origin may exceed the whole range.
    let is_huge = || values.iter().any(|value| value.is_finite() && value.abs() > f64::from(f32::MAX / 2.0));
    if middle.abs() > FAR_M && !is_huge() { middle.trunc() } else { 0.0 }
}

/// Returns all columns of a cloud, in the order of its file. The type of x, y and z is f64 or f32, depending on the
/// cloud's precision.
pub fn columns_from_cloud(cloud: &PointCloud) -> Vec<Attribute> {
    let mut columns = cloud.attributes.clone();
    let PositionColumns { index, .. } = cloud.position_columns;
    let double = cloud.is_written_in_f64();
    let mut axes = [(0, cloud.positions.x()), (1, cloud.positions.y()), (2, cloud.positions.z())];
    axes.sort_by_key(|&(axis, _)| index[axis]);
    for (axis, values) in axes {
        let coordinates = (0..cloud.len()).map(|i| cloud.coordinate(axis, i));
        let values = if double {
            coordinates.collect::<Vec<f64>>().into()
        } else if cloud.origin_m[axis] == 0.0 {
            AttributeValues::F32(values.to_vec())
        } else {
            coordinates.map(|value| value as f32).collect::<Vec<f32>>().into()
        };
        let at = index[axis].min(columns.len());
        columns.insert(at, Attribute { name: AXES[axis].to_owned(), count: 1, values });
    }
    columns
}
