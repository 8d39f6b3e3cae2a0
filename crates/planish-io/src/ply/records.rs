//! Vertices as consecutive little-endian records of scalars, as in binary files.

use ply_rs_bw::ply::{ElementDef, Encoding as PlyEncoding, PropertyType, ScalarType};

use super::super::FormatResult;
use super::super::columns::with_values;
use super::common::malformed;
use planish_core::{Attribute, AttributeValues};

/// A value of a record.
#[derive(Debug, Clone)]
struct Field {
    /// Bytes before it.
    at: usize,
    scalar: ScalarType,
}

/// The values of a record, in order.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    fields: Vec<Field>,
    /// Bytes of a record.
    pub(super) record: usize,
}

fn size_of_scalar(scalar: &ScalarType) -> usize {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

impl Layout {
    /// Of an element; `None` if it has a list.
    pub(super) fn of(element: &ElementDef) -> Option<Self> {
        let mut layout = Self { fields: Vec::new(), record: 0 };
        for property in element.properties.values() {
            let PropertyType::Scalar(scalar) = &property.data_type else { return None };
            layout.fields.push(Field { at: layout.record, scalar: scalar.clone() });
            layout.record += size_of_scalar(scalar);
        }
        Some(layout)
    }

    /// Turns the bytes of every value around.
    pub(super) fn swap(&self, records: &mut [u8]) {
        for record in records.chunks_exact_mut(self.record) {
            for field in &self.fields {
                record[field.at..field.at + size_of_scalar(&field.scalar)].reverse();
            }
        }
    }

    /// Appends the values of records to the columns, one for each field.
    pub(super) fn append(&self, columns: &mut [Attribute], records: &[u8]) -> FormatResult<()> {
        fn values<'a, const N: usize>(
            records: &'a [u8],
            record: usize,
            at: usize,
        ) -> impl Iterator<Item = [u8; N]> + 'a {
            records.chunks_exact(record).filter_map(move |record| record.get(at..at + N)?.try_into().ok())
        }
        let record = self.record;
        for (column, Field { at, .. }) in columns.iter_mut().zip(&self.fields) {
            match &mut column.values {
                AttributeValues::I8(to) => to.extend(values(records, record, *at).map(i8::from_le_bytes)),
                AttributeValues::U8(to) => to.extend(values(records, record, *at).map(u8::from_le_bytes)),
                AttributeValues::I16(to) => to.extend(values(records, record, *at).map(i16::from_le_bytes)),
                AttributeValues::U16(to) => to.extend(values(records, record, *at).map(u16::from_le_bytes)),
                AttributeValues::I32(to) => to.extend(values(records, record, *at).map(i32::from_le_bytes)),
                AttributeValues::U32(to) => to.extend(values(records, record, *at).map(u32::from_le_bytes)),
                AttributeValues::F32(to) => to.extend(values(records, record, *at).map(f32::from_le_bytes)),
                AttributeValues::F64(to) => to.extend(values(records, record, *at).map(f64::from_le_bytes)),
                AttributeValues::I64(_) | AttributeValues::U64(_) => {
                    return malformed("PLY has no 64-bit integers");
                }
            }
        }
        Ok(())
    }

    /// Returns the records of some rows of the columns, one for each field.
    pub(super) fn encode(&self, columns: &[Attribute], rows: impl ExactSizeIterator<Item = usize> + Clone) -> Vec<u8> {
        let mut records = vec![0; self.record * rows.len()];
        for (column, Field { at, .. }) in columns.iter().zip(&self.fields) {
            with_values!(&column.values, values => {
                for (record, row) in records.chunks_exact_mut(self.record).zip(rows.clone()) {
                    let bytes = values[row].to_le_bytes();
                    record[*at..at + bytes.len()].copy_from_slice(&bytes);
                }
            });
        }
        records
    }

    /// Returns a value of a record as a number.
    #[cfg(feature = "scans")]
    pub(super) fn number(&self, record: &[u8], field: usize) -> f64 {
        fn bytes<const N: usize>(record: &[u8], at: usize) -> [u8; N] {
            record.get(at..at + N).and_then(|bytes| bytes.try_into().ok()).unwrap_or([0; N])
        }
        let Field { at, scalar } = &self.fields[field];
        match scalar {
            ScalarType::Float => f64::from(f32::from_le_bytes(bytes(record, *at))),
            ScalarType::Double => f64::from_le_bytes(bytes(record, *at)),
            _ => f64::NAN,
        }
    }
}

/// Splits the records of an element off the front of a binary body, in little-endian order.
pub(super) fn take_records<'a>(
    layout: &Layout,
    count: usize,
    encoding: PlyEncoding,
    body: &mut &'a [u8],
) -> FormatResult<std::borrow::Cow<'a, [u8]>> {
    let Some((records, rest)) = count.checked_mul(layout.record).and_then(|bytes| body.split_at_checked(bytes)) else {
        return malformed(format!(
            "the file is truncated: its header states {count} vertices of {} bytes, but {} bytes follow",
            layout.record,
            body.len()
        ));
    };
    *body = rest;
    if encoding == PlyEncoding::BinaryBigEndian {
        let mut records = records.to_vec();
        layout.swap(&mut records);
        return Ok(records.into());
    }
    Ok(records.into())
}
