//! Results in CUDA's memory for libraries that read DLPack or `__cuda_array_interface__`.
//!
//! DLPack's capsules hold a `DLManagedTensor` (dlpack.h, version 0): the reader takes it by renaming the capsule, and
//! calls its deleter when it needs the memory no more.

use std::ffi::{CStr, c_int, c_void};
use std::ptr::{self, NonNull};
use std::sync::Arc;

use planish::CudaMemory;
use pyo3::exceptions::PyBufferError;
use pyo3::ffi;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::errors::to_py;

const CUDA: c_int = 2;
const FLOAT: u8 = 2;
/// The name of a capsule that nobody has taken.
const FRESH: &CStr = c"dltensor";
/// A stream by which a reader says that it needs no order.
const NO_ORDER: isize = -1;

#[repr(C)]
struct DlTensor {
    data: *mut c_void,
    device_type: c_int,
    device_id: c_int,
    dimensions: c_int,
    code: u8,
    bits: u8,
    lanes: u16,
    shape: *mut i64,
    strides: *mut i64,
    byte_offset: u64,
}

#[repr(C)]
struct DlManagedTensor {
    tensor: DlTensor,
    manager: *mut c_void,
    deleter: Option<unsafe extern "C" fn(*mut DlManagedTensor)>,
}

/// What a managed tensor points to.
struct Owner {
    managed: DlManagedTensor,
    shape: [i64; 3],
    _memory: Arc<CudaMemory>,
}

/// float32 [channels, height, width] in CUDA's memory.
#[pyclass(frozen, name = "CudaArray", module = "planish")]
pub struct PyCudaArray {
    memory: Arc<CudaMemory>,
    shape: [i64; 3],
    /// The stream that writes it.
    stream: usize,
}

impl PyCudaArray {
    pub fn new(memory: CudaMemory, shape: [usize; 3], stream: usize) -> Self {
        Self { memory: Arc::new(memory), shape: shape.map(|side| side as i64), stream }
    }
}

#[pymethods]
impl PyCudaArray {
    /// Channels, height and width.
    #[getter]
    fn shape(&self) -> (i64, i64, i64) {
        self.shape.into()
    }

    /// CUDA's array interface, version 3.
    #[getter]
    fn __cuda_array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("shape", self.shape())?;
        interface.set_item("typestr", "<f4")?;
        interface.set_item("data", (self.memory.address(), false))?;
        interface.set_item("strides", py.None())?;
        // The default stream has the number 1 there.
        interface.set_item("stream", self.stream.max(1))?;
        interface.set_item("version", 3)?;
        Ok(interface)
    }

    /// DLPack's kind of device and its number.
    fn __dlpack_device__(&self) -> (c_int, c_int) {
        (CUDA, self.memory.device())
    }

    /// The array as DLPack's capsule, ready on the reader's stream.
    #[pyo3(signature = (*, stream = None, max_version = None, dl_device = None, copy = None))]
    fn __dlpack__(
        &self,
        py: Python<'_>,
        stream: Option<isize>,
        max_version: Option<(u32, u32)>,
        dl_device: Option<(c_int, c_int)>,
        copy: Option<bool>,
    ) -> PyResult<Py<PyAny>> {
        // Readers of later versions take capsules of version 0 too.
        let _ = max_version;
        if dl_device.is_some_and(|device| device != self.__dlpack_device__()) || copy == Some(true) {
            return Err(PyBufferError::new_err("this array is shared where it is, without a copy"));
        }
        // The reader's default stream has the number 1.
        let reads_on = stream.map(|stream| if stream == 1 { 0 } else { stream });
        if reads_on != Some(NO_ORDER) && reads_on != isize::try_from(self.stream).ok() {
            py.detach(|| self.memory.wait_for(self.stream)).map_err(to_py)?;
        }
        let mut owner = Box::new(Owner {
            managed: DlManagedTensor {
                tensor: DlTensor {
                    data: ptr::with_exposed_provenance_mut(self.memory.address() as usize),
                    device_type: CUDA,
                    device_id: self.memory.device(),
                    dimensions: 3,
                    code: FLOAT,
                    bits: 32,
                    lanes: 1,
                    shape: ptr::null_mut(),
                    strides: ptr::null_mut(),
                    byte_offset: 0,
                },
                manager: ptr::null_mut(),
                deleter: Some(delete),
            },
            shape: self.shape,
            _memory: Arc::clone(&self.memory),
        });
        owner.managed.tensor.shape = owner.shape.as_mut_ptr();
        let owner = NonNull::from(Box::leak(owner));
        // SAFETY: the owner lives until the deleter is called, by the reader or by `drop_fresh`.
        unsafe {
            (*owner.as_ptr()).managed.manager = owner.as_ptr().cast();
            let managed = &raw mut (*owner.as_ptr()).managed;
            let capsule = ffi::PyCapsule_New(managed.cast(), FRESH.as_ptr(), Some(drop_fresh));
            let capsule = Bound::from_owned_ptr_or_err(py, capsule);
            if capsule.is_err() {
                delete(managed);
            }
            Ok(capsule?.unbind())
        }
    }

    fn __repr__(&self) -> String {
        let [channels, height, width] = self.shape;
        format!("CudaArray(float32 [{channels}, {height}, {width}], device {})", self.memory.device())
    }
}

/// Frees what a managed tensor points to.
///
/// # Safety
/// It is one of this module's, and not used any more.
unsafe extern "C" fn delete(managed: *mut DlManagedTensor) {
    // SAFETY: the manager is the owner, which was leaked.
    drop(unsafe { Box::from_raw((*managed).manager.cast::<Owner>()) });
}

/// Frees a tensor that no reader has taken.
///
/// # Safety
/// The capsule is one of this module's; Python calls this at its end.
unsafe extern "C" fn drop_fresh(capsule: *mut ffi::PyObject) {
    // SAFETY: the name tells whether it still has its tensor.
    unsafe {
        if ffi::PyCapsule_IsValid(capsule, FRESH.as_ptr()) == 1 {
            delete(ffi::PyCapsule_GetPointer(capsule, FRESH.as_ptr()).cast());
        }
    }
}
