//! The caller's memory: the extents of buffers, and checks that they do not overlap.

use std::ffi::{CStr, c_char};

use crate::error::{Done, PLANISH_ARGUMENT, PLANISH_NULL, failure};

/// Memory that starts at the address `begin` and has `count` items of `item` bytes each, `stride` bytes apart.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extent {
    what: &'static str,
    begin: usize,
    item: usize,
    stride: usize,
    count: usize,
}

impl Extent {
    /// Checks that a buffer is not null, is aligned, has a sufficient stride, and ends within the address space.
    pub(crate) fn new<T>(
        what: &'static str,
        pointer: *const T,
        align: usize,
        (item, stride, count): (usize, usize, usize),
    ) -> Done<Self> {
        let begin = pointer.addr();
        if pointer.is_null() {
            return failure(PLANISH_NULL, format!("{what} is null"));
        }
        if !begin.is_multiple_of(align) || !stride.is_multiple_of(align) {
            let text = format!(
                "{what} is misaligned; its address and its stride of {stride} bytes must be multiples of {align}"
            );
            return failure(PLANISH_ARGUMENT, text);
        }
        if stride < item && count > 1 {
            return failure(
                PLANISH_ARGUMENT,
                format!("{what} has a stride of {stride} bytes, but at least {item} are needed"),
            );
        }
        let extent = Self { what, begin, item, stride, count };
        let fits =
            extent.bytes().is_some_and(|bytes| bytes <= isize::MAX as usize && begin.checked_add(bytes).is_some());
        if !fits {
            return failure(
                PLANISH_ARGUMENT,
                format!(
                    "{what} with {count} items and a stride of {stride} bytes extends past the end of the address space"
                ),
            );
        }
        Ok(extent)
    }

    /// Returns the number of bytes from the beginning of the first item to the end of the last; `None` on overflow.
    pub(crate) fn bytes(&self) -> Option<usize> {
        let Some(last) = self.count.checked_sub(1) else { return Some(0) };
        last.checked_mul(self.stride)?.checked_add(self.item)
    }

    /// Returns true if an item of this buffer shares a byte with an item of the other.
    fn overlaps(&self, other: &Self) -> bool {
        let (end, other_end) = (self.begin + self.bytes().unwrap_or(0), other.begin + other.bytes().unwrap_or(0));
        if self.begin >= other_end || other.begin >= end {
            return false;
        }
        // Two members of the same array of structs are interleaved: each is in the gaps of the other.
        if self.stride != other.stride || self.item > self.stride || other.item > other.stride {
            return true;
        }
        let apart = other.begin.wrapping_sub(self.begin) as isize;
        let apart = apart.rem_euclid(self.stride as isize) as usize;
        apart < self.item || apart + other.item > self.stride
    }
}

/// Returns an error if outputs overlap each other or the inputs.
pub(crate) fn check_apart(read: &[Extent], written: &[Extent]) -> Done<()> {
    for (i, buffer) in written.iter().enumerate() {
        // Inputs are borrowed as a whole, with the gaps between their items.
        let whole = |other: &&Extent| {
            let end = |extent: &Extent| extent.begin + extent.bytes().unwrap_or(0);
            buffer.begin < end(other) && other.begin < end(buffer)
        };
        let shared = read.iter().find(whole).or_else(|| written[..i].iter().find(|other| other.overlaps(buffer)));
        if let Some(other) = shared {
            let text = format!("{} and {} overlap; give them separate memory", buffer.what, other.what);
            return failure(PLANISH_ARGUMENT, text);
        }
    }
    Ok(())
}

/// Reads a struct whose first member is its size. Members that the caller's version lacks become 0. `least` is the
/// size of the struct's first version.
///
/// # Safety
/// The pointer must be null or point to a struct whose first member states its number of readable bytes.
pub(crate) unsafe fn sized<T: Copy>(what: &str, pointer: *const T, least: usize) -> Done<T> {
    if pointer.is_null() {
        return failure(PLANISH_NULL, format!("{what} is null"));
    }
    if !pointer.is_aligned() {
        return failure(PLANISH_ARGUMENT, format!("{what} is not aligned"));
    }
    // SAFETY: the size is the first member.
    let size = unsafe { pointer.cast::<usize>().read() };
    if size < least || size > 1 << 12 {
        let text = format!(
            "{what} states a size of {size} bytes; set its first member to the struct's sizeof, {}",
            size_of::<T>()
        );
        return failure(PLANISH_ARGUMENT, text);
    }
    let mut value = std::mem::MaybeUninit::<T>::zeroed();
    // SAFETY: `size` bytes are readable, and `value` has room for the copied ones. All members may be 0.
    unsafe {
        let bytes = size.min(size_of::<T>());
        std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), value.as_mut_ptr().cast::<u8>(), bytes);
        Ok(value.assume_init())
    }
}

/// Borrows a string in UTF-8.
///
/// # Safety
/// The pointer must be null or point to a zero-terminated string.
pub(crate) unsafe fn text<'a>(what: &str, pointer: *const c_char) -> Done<&'a str> {
    if pointer.is_null() {
        return failure(PLANISH_NULL, format!("{what} is null"));
    }
    // SAFETY: the caller upholds this function's contract.
    let text = unsafe { CStr::from_ptr(pointer) };
    text.to_str().or_else(|_| failure(PLANISH_ARGUMENT, format!("{what} is not UTF-8")))
}

/// Writes a zero-terminated string to the caller's buffer, truncated if the buffer is too small. `length` receives the
/// length of the whole string in bytes, without the zero.
///
/// # Safety
/// The buffer must be null or have room for `capacity` bytes; the length must be null or writable.
pub(crate) unsafe fn write_text(text: &str, buffer: *mut c_char, capacity: usize, length: *mut usize) {
    if let Some(room) = capacity.checked_sub(1).filter(|_| !buffer.is_null()) {
        let mut end = text.len().min(room);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        // SAFETY: there is room for these bytes and a zero.
        unsafe {
            std::ptr::copy_nonoverlapping(text.as_ptr(), buffer.cast(), end);
            buffer.add(end).write(0);
        }
    }
    if !length.is_null() {
        // SAFETY: the caller upholds this function's contract.
        unsafe { length.write(text.len()) };
    }
}
