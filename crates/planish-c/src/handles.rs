//! The table of handles.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::ptr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, PoisonError, RwLock};

use crate::error::{Done, PLANISH_HANDLE, PLANISH_NULL, failure};

/// The next handle. Handles are never reused.
static NEXT: AtomicUsize = AtomicUsize::new(1);

/// A hasher for handles: one multiplication, since handles are consecutive numbers.
#[derive(Default)]
pub(crate) struct Number(u64);

impl Hasher for Number {
    fn finish(&self) -> u64 {
        self.0.wrapping_mul(0x9e37_79b9_7f4a_7c15)
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.0 = self.0 << 8 | u64::from(*byte));
    }

    fn write_usize(&mut self, number: usize) {
        self.0 = number as u64;
    }
}

/// All values of one type that have a handle.
pub(crate) struct Handles<T> {
    what: &'static str,
    all: RwLock<HashMap<usize, Arc<T>, BuildHasherDefault<Number>>>,
}

impl<T> Handles<T> {
    pub(crate) const fn new(what: &'static str) -> Self {
        Self { what, all: RwLock::new(HashMap::with_hasher(BuildHasherDefault::new())) }
    }

    /// Stores a value and returns its new handle.
    pub(crate) fn add<H>(&self, value: T) -> *mut H {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        self.all.write().unwrap_or_else(PoisonError::into_inner).insert(number, Arc::new(value));
        ptr::without_provenance_mut(number)
    }

    pub(crate) fn get<H>(&self, handle: *const H) -> Done<Arc<T>> {
        let all = self.all.read().unwrap_or_else(PoisonError::into_inner);
        match all.get(&handle.addr()) {
            Some(value) => Ok(value.clone()),
            None if handle.is_null() => failure(PLANISH_NULL, format!("the {} is null", self.what)),
            None => failure(PLANISH_HANDLE, format!("the {} is invalid or was freed", self.what)),
        }
    }

    /// Removes a handle.
    pub(crate) fn remove<H>(&self, handle: *mut H) -> Done<()> {
        let removed = self.all.write().unwrap_or_else(PoisonError::into_inner).remove(&handle.addr());
        // The value is dropped after the lock is released, since closing a GPU takes time.
        removed.map_or_else(|| failure(PLANISH_HANDLE, format!("the {} has already been freed", self.what)), |_| Ok(()))
    }
}
