//! Conversion between `PointCloud2` and clouds with all their fields.

use super::cloud::{F32, F64, read, scalar_bytes};
use super::{Header, PointCloud2, PointField};
use planish_core::{Attribute, AttributeValues, FormatError, FrameError, OrganizedCloud, PointCloud};
use planish_io::{internal::cloud_from_columns, internal::columns_from_cloud, internal::with_values};

const U8: u8 = 2;

impl PointCloud2 {
    /// Returns the points with all their fields, row by row if the message has a grid.
    ///
    /// # Errors
    /// Same as [`view`](Self::view).
    pub fn to_cloud(&self) -> Result<PointCloud, FormatError> {
        let points = self.view()?.len();
        let columns = self.fields.iter().filter(|field| !field.name.is_empty() && field.name != "_");
        cloud_from_columns(columns.map(|field| self.column(field, points)).collect())
    }

    /// Same as [`to_cloud`](Self::to_cloud), on the grid of the message. A cloud without a grid is an error.
    pub fn to_organized(&self) -> Result<OrganizedCloud, FormatError> {
        if !self.is_organized() {
            return Err(FormatError::Unsupported(format!(
                "the cloud of {} points has no grid; a stream needs frames on a grid",
                self.width
            )));
        }
        Ok(OrganizedCloud::new(self.width as usize, self.height as usize, self.to_cloud()?)?)
    }

    fn column(&self, field: &PointField, points: usize) -> Attribute {
        let count = field.count.max(1) as usize;
        let starts = || self.point_offsets().take(points);
        macro_rules! values {
            ($scalar:ty) => {{
                let size = size_of::<$scalar>();
                let value = |at: usize| read(&self.data, at).map(<$scalar>::from_ne_bytes).unwrap_or_default();
                let of_point = |at: usize| (0..count).map(move |k| at + field.offset as usize + k * size);
                starts().flat_map(of_point).map(value).collect::<Vec<$scalar>>().into()
            }};
        }
        let values: AttributeValues = match field.datatype {
            1 => values!(i8),
            U8 => values!(u8),
            3 => values!(i16),
            4 => values!(u16),
            5 => values!(i32),
            6 => values!(u32),
            F32 => values!(f32),
            _ => values!(f64),
        };
        Attribute { name: field.name.clone(), count, values }
    }

    /// Returns a message with all fields of a cloud, without padding, on `grid` (width and height) if given.
    pub fn of_cloud(header: Header, cloud: &PointCloud, grid: Option<(usize, usize)>) -> Result<Self, FrameError> {
        cloud.validate()?;
        let (width, height) = grid.unwrap_or((cloud.len(), 1));
        let columns = columns_from_cloud(cloud);
        let mut fields = Vec::new();
        let mut point_step = 0;
        for column in &columns {
            let datatype = datatype_of(&column.values);
            let bytes = scalar_bytes(datatype).unwrap_or(8) as u32 * column.count as u32;
            fields.push(PointField {
                name: column.name.clone(),
                offset: point_step,
                datatype,
                count: column.count as u32,
            });
            point_step += bytes;
        }
        let mut data = vec![0; point_step as usize * cloud.len()];
        for (column, field) in columns.iter().zip(&fields) {
            let bytes = ne_bytes(&column.values);
            let (start, len) = (field.offset as usize, bytes.len() / cloud.len().max(1));
            for (point, bytes) in data.chunks_exact_mut(point_step as usize).zip(bytes.chunks_exact(len.max(1))) {
                point[start..start + len].copy_from_slice(bytes);
            }
        }
        Ok(Self {
            header,
            height: height as u32,
            width: width as u32,
            fields,
            is_bigendian: cfg!(target_endian = "big"),
            point_step,
            row_step: point_step * width as u32,
            data,
            is_dense: cloud.valid_points() == cloud.len(),
        })
    }
}

/// Returns the type number of values; 64-bit integers have none and become float64.
fn datatype_of(values: &AttributeValues) -> u8 {
    match values {
        AttributeValues::I8(_) => 1,
        AttributeValues::U8(_) => U8,
        AttributeValues::I16(_) => 3,
        AttributeValues::U16(_) => 4,
        AttributeValues::I32(_) => 5,
        AttributeValues::U32(_) => 6,
        AttributeValues::F32(_) => F32,
        AttributeValues::I64(_) | AttributeValues::U64(_) | AttributeValues::F64(_) => F64,
    }
}

/// Returns the bytes of values, contiguous and in the types that messages support.
fn ne_bytes(values: &AttributeValues) -> Vec<u8> {
    match values {
        AttributeValues::I64(values) => values.iter().flat_map(|&value| (value as f64).to_ne_bytes()).collect(),
        AttributeValues::U64(values) => values.iter().flat_map(|&value| (value as f64).to_ne_bytes()).collect(),
        values => with_values!(values, v => bytemuck::cast_slice(v).to_vec()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::cloud::tests::cloud;
    use super::*;

    #[test]
    fn clouds_with_all_fields_become_messages_and_come_back() {
        let organized = cloud().to_organized().unwrap();
        let message = PointCloud2::of_cloud(Header::default(), &organized.points, Some((3, 2))).unwrap();
        assert_eq!((message.point_step, message.is_dense), (18, true));
        assert_eq!(message.to_organized().unwrap(), organized);
    }
}
