//! An array in NumPy's format (versions 1 to 3): a header, which is a Python dict, and the values.

use super::header::Header;
use crate::little_endian::LittleEndian;
use planish_core::FormatError;

/// A number that NumPy has a name for.
pub(crate) trait NpyNumber: LittleEndian {
    /// Its `descr`.
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

/// An array with all its values present.
pub(crate) struct Array<'a> {
    pub(crate) header: Header,
    data: &'a [u8],
}

impl<'a> Array<'a> {
    /// Reads the header, and checks that all values are present.
    ///
    /// # Errors
    /// If the file is damaged or cut short, or its values are no numbers.
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

    /// Returns the number of bytes of the values.
    pub(crate) fn bytes(&self) -> usize {
        self.data.len()
    }

    /// Returns the values, the last index running fastest. The type must be of the array's size.
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
            // Returns the position of the value with this index; the first index varies fastest.
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
}

/// Encodes an array as `numpy.save` does.
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
