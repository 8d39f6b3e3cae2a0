//! Vertices as consecutive little-endian records of scalars, as in binary files.

use super::super::columns::with_values;
use super::super::{FormatResult, quoted, text};
use super::common::malformed;
use super::header::{Element, Kind, Property, Scalar, Storage};
use planish_core::{Attribute, AttributeValues, FormatError};

/// A numeric value within a record.
#[derive(Debug, Clone, Copy)]
struct Field {
    /// Offset in the record, in bytes.
    at: usize,
    scalar: Scalar,
}

/// The layout of a record: its values, in order.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    fields: Vec<Field>,
    /// Size of a record in bytes.
    pub(super) record: usize,
}

impl Layout {
    /// Returns the layout of an element's records; `None` if the element has a list.
    pub(super) fn of(element: &Element) -> Option<Self> {
        (!element.has_lists()).then(|| Self::of_scalars(element))
    }

    /// Returns the layout of an element's records without their lists.
    pub(super) fn of_scalars(element: &Element) -> Self {
        let mut layout = Self { fields: Vec::new(), record: 0 };
        for property in &element.properties {
            if let Kind::Scalar(scalar) = property.kind {
                layout.fields.push(Field { at: layout.record, scalar });
                layout.record += scalar.bytes();
            }
        }
        layout
    }

    /// Returns the number of values per record.
    #[cfg(feature = "scans")]
    pub(super) fn values(&self) -> usize {
        self.fields.len()
    }

    /// Reverses the byte order of every value in the records.
    pub(super) fn swap(&self, records: &mut [u8]) {
        for record in records.chunks_exact_mut(self.record) {
            for field in &self.fields {
                record[field.at..field.at + field.scalar.bytes()].reverse();
            }
        }
    }

    /// Appends the values of the records to the columns; there is one column for each field.
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

    /// Encodes the given rows of the columns as records; there is one column for each field.
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

    /// Returns a value of a record as a number; NaN if the record is too short.
    #[cfg(feature = "scans")]
    pub(super) fn number(&self, record: &[u8], field: usize) -> f64 {
        let Field { at, scalar } = self.fields[field];
        record.get(at..at + scalar.bytes()).and_then(|bytes| scalar.number(bytes)).unwrap_or(f64::NAN)
    }
}

/// Skips one record at the front of a binary body.
pub(super) fn pass_over(element: &Element, storage: Storage, body: &mut &[u8]) -> FormatResult<()> {
    take_scalars(element, storage, body, |_| ())
}

/// Splits an element's records off the front of a binary body. Returns their bytes without lists.
pub(super) fn without_lists(element: &Element, storage: Storage, body: &mut &[u8]) -> FormatResult<Vec<u8>> {
    let mut scalars = Vec::new();
    (0..element.count)
        .try_for_each(|_| take_scalars(element, storage, body, |bytes| scalars.extend_from_slice(bytes)))?;
    Ok(scalars)
}

/// Splits one record off the front of a binary body. Visits the bytes of each number, and skips lists.
fn take_scalars(
    element: &Element,
    storage: Storage,
    body: &mut &[u8],
    mut visit: impl FnMut(&[u8]),
) -> FormatResult<()> {
    for property in &element.properties {
        let bytes = match property.kind {
            Kind::Scalar(scalar) => Some(scalar.bytes()),
            Kind::List { count, item } => {
                take_number(count, storage, body).and_then(|count| (count as usize).checked_mul(item.bytes()))
            }
        };
        let (value, rest) = bytes.and_then(|bytes| body.split_at_checked(bytes)).ok_or_else(|| ended(element))?;
        if matches!(property.kind, Kind::Scalar(_)) {
            visit(value);
        }
        *body = rest;
    }
    Ok(())
}

/// Reads an element's records from a text body; each record has one or several lines of its own. Returns one line per
/// record, without its lists.
pub(super) fn text_without_lists(element: &Element, body: &mut text::Body<'_>) -> FormatResult<String> {
    let mut scalars = String::new();
    for _ in 0..element.count {
        let (first, line) = body.line().ok_or_else(|| ended(element))?;
        let (mut words, mut lines) = (line.split_ascii_whitespace(), 1);
        let missing = |property: &Property| {
            let name = quoted(&property.name);
            FormatError::Malformed(format!("line {first}: the property {name} of a vertex is missing"))
        };
        let mut next = |property: &Property| loop {
            if let Some(word) = words.next() {
                return Ok::<_, FormatError>(word);
            }
            words = body.line().ok_or_else(|| missing(property))?.1.split_ascii_whitespace();
            lines += 1;
        };
        for property in &element.properties {
            let word = next(property)?;
            if matches!(property.kind, Kind::Scalar(_)) {
                scalars.extend([word, " "]);
                continue;
            }
            let count: usize = word.parse().map_err(|_| missing(property))?;
            (0..count).try_for_each(|_| next(property).map(drop))?;
        }
        // If words remain on the last of several lines, a value is missing, and this line belongs to the next record.
        if let (2.., Some(_), Some(last)) = (lines, words.next(), element.properties.last()) {
            return Err(missing(last));
        }
        scalars.push('\n');
    }
    Ok(scalars)
}

fn ended(element: &Element) -> FormatError {
    FormatError::Malformed(format!("the file is truncated: it ends within element {}", quoted(&element.name)))
}

/// Splits one record off the front of a binary body. Visits each property by its index, with its value or its list of
/// values.
pub(super) fn take_values(
    element: &Element,
    storage: Storage,
    body: &mut &[u8],
    mut visit: impl FnMut(usize, &[f64]),
) -> FormatResult<()> {
    let mut values = Vec::new();
    for (k, property) in element.properties.iter().enumerate() {
        values.clear();
        let (scalar, count) = match property.kind {
            Kind::Scalar(scalar) => (scalar, Some(1)),
            // A negative count becomes 0.
            Kind::List { count, item } => (item, take_number(count, storage, body).map(|count| count as usize)),
        };
        for _ in 0..count.ok_or_else(|| ended(element))? {
            values.push(take_number(scalar, storage, body).ok_or_else(|| ended(element))?);
        }
        visit(k, &values);
    }
    Ok(())
}

/// Splits a number off the front of a binary body.
fn take_number(scalar: Scalar, storage: Storage, body: &mut &[u8]) -> Option<f64> {
    let (value, rest) = body.split_at_checked(scalar.bytes())?;
    *body = rest;
    let mut little_endian = [0; 8];
    let little_endian = &mut little_endian[..value.len()];
    little_endian.copy_from_slice(value);
    if storage == Storage::BigEndian {
        little_endian.reverse();
    }
    scalar.number(little_endian)
}

/// Splits an element's records off the front of a binary body. Returns them in little-endian order.
pub(super) fn take_records<'a>(
    layout: &Layout,
    count: usize,
    storage: Storage,
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
    if storage == Storage::BigEndian {
        let mut records = records.to_vec();
        layout.swap(&mut records);
        return Ok(records.into());
    }
    Ok(records.into())
}
