//! Converts numbers from and to bytes.

/// A number that can be converted from and to bytes.
pub(super) trait LittleEndian: Copy {
    /// Reads a little-endian number. `bytes` must have exactly its size.
    fn read(bytes: &[u8]) -> Self;

    /// Reads a big-endian number. `bytes` must have exactly its size.
    fn read_big_endian(bytes: &[u8]) -> Self;

    /// Writes the number in little-endian order. `bytes` must have exactly its size.
    fn write(self, bytes: &mut [u8]);
}

macro_rules! little_endian {
    ($($scalar:ty)*) => {$(
        impl LittleEndian for $scalar {
            #[inline(always)]
            fn read(bytes: &[u8]) -> Self {
                let mut value = [0; size_of::<$scalar>()];
                value.copy_from_slice(bytes);
                Self::from_le_bytes(value)
            }
            #[inline(always)]
            fn read_big_endian(bytes: &[u8]) -> Self {
                let mut value = [0; size_of::<$scalar>()];
                value.copy_from_slice(bytes);
                Self::from_be_bytes(value)
            }
            #[inline(always)]
            fn write(self, bytes: &mut [u8]) {
                bytes.copy_from_slice(&self.to_le_bytes());
            }
        }
    )*};
}
little_endian!(i8 u8 i16 u16 i32 u32 i64 u64 f32 f64);
