//! An array in NumPy's file format (versions 1 to 3): a header that contains a Python dict, followed by the values.

#[cfg(feature = "more-formats")]
use super::half;
use super::header::Header;
#[cfg(feature = "more-formats")]
use super::header::RecordField;
use crate::little_endian::LittleEndian;
use planish_core::FormatError;
#[cfg(feature = "more-formats")]
use planish_core::{Attribute, AttributeValues};

/// A number type with a NumPy name.
pub(crate) trait NpyNumber: LittleEndian {
    /// NumPy's name for the type, as in the `descr` of a header.
    const DESCR: &'static str;
}

macro_rules! npy_numbers {
    ($($number:ty: $descr:literal)*) => {$(
        impl NpyNumber for $number {
            const DESCR: &'static str = $descr;
        }
    )*};
}
npy_numbers!(i8: "|i1" u8: "|u1" i16: "<i2" u16: "<u2" i32: "<i4" u32: "<u4" i64: "<i8" u64: "<u8" f32: "<f4" f64: "<f8");

/// A parsed array, all of whose values are present.
pub(crate) struct Array<'a> {
    pub(crate) header: Header,
    data: &'a [u8],
}

impl<'a> Array<'a> {
    /// Parses the header, and checks that all values are present.
    ///
    /// # Errors
    /// If the file is damaged or truncated, or its values are not numbers.
    pub(crate) fn parse(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let (header, data) = Header::parse(bytes)?;
        let needed = header.len().and_then(|len| len.checked_mul(header.size));
        match needed.and_then(|needed| data.get(..needed)) {
            Some(data) => Ok(Self { header, data }),
            None => Err(FormatError::Malformed(format!(
                "the file is truncated: its header states the shape {:?}",
                header.shape
            ))),
        }
    }

    /// Returns the number of bytes of all values.
    #[cfg(feature = "more-formats")]
    pub(crate) fn bytes(&self) -> usize {
        self.data.len()
    }

    /// Returns the values in row-major order. `T` must have the size of the array's values.
    pub(crate) fn values<T: LittleEndian>(&self) -> Vec<T> {
        let Header { size, shape, is_big_endian, is_fortran, .. } = &self.header;
        let read = if *is_big_endian { T::read_big_endian } else { T::read };
        if !is_fortran || shape.len() < 2 {
            return self.data.chunks_exact(*size).map(read).collect();
        }
        let count = self.data.len() / size;
        let mut values = Vec::with_capacity(count);
        let mut index = vec![0usize; shape.len()];
        for _ in 0..count {
            // Position of the value at this index in Fortran order, in which the first index varies fastest.
            let place = index.iter().zip(shape).rev().fold(0, |place, (&i, &n)| place * n + i);
            values.push(read(&self.data[size * place..size * (place + 1)]));
            for (i, &n) in index.iter_mut().zip(shape).rev() {
                *i += 1;
                if *i < n {
                    break;
                }
                *i = 0;
            }
        }
        values
    }

    /// Returns the subarray at an index of the first dimension, which must be smaller than the dimension.
    ///
    /// # Errors
    /// If the array is in Fortran order, in which the values of a subarray are not contiguous.
    #[cfg(feature = "more-formats")]
    pub(crate) fn page(self, index: usize) -> Result<Self, FormatError> {
        if self.header.is_fortran {
            return Err(FormatError::Unsupported(
                "several images in Fortran order are not supported; save np.ascontiguousarray(array)".into(),
            ));
        }
        let Self { mut header, data } = self;
        let pages = header.shape.remove(0);
        let each = data.len() / pages.max(1);
        Ok(Self { header, data: &data[each * index..each * (index + 1)] })
    }

    /// Returns the fields of an array of records as columns.
    #[cfg(feature = "more-formats")]
    pub(crate) fn columns(&self) -> Result<Vec<Attribute>, FormatError> {
        if self.header.is_fortran && self.header.shape.len() > 1 {
            return Err(FormatError::Unsupported(
                "records in Fortran order are not supported; save np.ascontiguousarray(array)".into(),
            ));
        }
        let mut at = 0;
        let mut columns = Vec::new();
        for field in &self.header.fields {
            // Padding is skipped.
            if field.kind != 'V' {
                columns.push(self.column(field, at)?);
            }
            at += field.bytes();
        }
        Ok(columns)
    }

    #[cfg(feature = "more-formats")]
    fn column(&self, field: &RecordField, at: usize) -> Result<Attribute, FormatError> {
        fn read<T: LittleEndian>(records: &[u8], record: usize, field: &RecordField, at: usize) -> Vec<T> {
            let read = if field.is_big_endian { T::read_big_endian } else { T::read };
            let values =
                records.chunks_exact(record).flat_map(|record| record[at..at + field.bytes()].chunks_exact(field.size));
            values.map(read).collect()
        }
        let (records, record) = (self.data, self.header.size);
        let values: AttributeValues = match (field.kind, field.size) {
            ('i', 1) => read::<i8>(records, record, field, at).into(),
            ('i', 2) => read::<i16>(records, record, field, at).into(),
            ('i', 4) => read::<i32>(records, record, field, at).into(),
            ('i', 8) => read::<i64>(records, record, field, at).into(),
            ('u' | 'b', 1) => read::<u8>(records, record, field, at).into(),
            ('u', 2) => read::<u16>(records, record, field, at).into(),
            ('u', 4) => read::<u32>(records, record, field, at).into(),
            ('u', 8) => read::<u64>(records, record, field, at).into(),
            ('f', 2) => {
                let bits = read::<u16>(records, record, field, at);
                bits.into_iter().map(half::to_f32).collect::<Vec<f32>>().into()
            }
            ('f', 4) => read::<f32>(records, record, field, at).into(),
            ('f', 8) => read::<f64>(records, record, field, at).into(),
            _ => {
                let text = format!(
                    "field {} has an unsupported type of {} bytes; save it as integers, f32 or f64",
                    field.name, field.size
                );
                return Err(FormatError::Unsupported(text));
            }
        };
        Ok(Attribute { name: field.name.clone(), count: field.count, values })
    }
}

/// Encodes an array in the format of `numpy.save`.
pub(crate) fn encode<T: NpyNumber>(shape: &[usize], values: impl Iterator<Item = T>) -> Vec<u8> {
    let mut bytes = Header::encode(T::DESCR, shape);
    bytes.reserve(size_of::<T>() * shape.iter().product::<usize>());
    for value in values {
        let start = bytes.len();
        bytes.resize(start + size_of::<T>(), 0);
        value.write(&mut bytes[start..]);
    }
    bytes
}
